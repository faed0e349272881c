"""Servers that are compared: how each is started, and the one policy they are all asked about."""

from __future__ import annotations

import json
import secrets
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.bundle import ONNX_FILE, Bundle, load_bundle
from rlservo.serve_app.ray_serve.processes import free_ports
from rlservo.serve_app.wire.msgpack_arrays import pack
from speed.environments import InstallError, python_of
from speed.servers import Exchange, Server

PEERS = Path(__file__).resolve().parent.parent / "peers"
BARE, RLSERVO, TWO = "uvicorn + FastAPI", "rlservo serve", "rlservo serve, 2 replicas"
MLSERVER, LITSERVE, BENTOML = "MLServer", "LitServe", "BentoML"
DEFAULTS, RLLIB = "Ray Serve defaults", "RLlib's Ray Serve example"
BATCH = 1024
HEAVY_BATCH = 64


@dataclass(frozen=True)
class Case:
    """The policy, and what every server is asked."""

    bundle: Bundle
    checkpoint: Path
    obs: NDArray[np.float32]  # (n,)
    action: NDArray[np.float32]

    @property
    def name(self) -> str:
        return self.bundle.contract.name

    @property
    def onnx_file(self) -> str:
        return str(self.bundle.path / ONNX_FILE)

    def batch(self, rows: int) -> NDArray[np.float32]:
        """Return so many different observations around the one."""
        noise = np.random.default_rng(0).standard_normal((rows, len(self.obs))).astype(np.float32)
        rows_of_obs: NDArray[np.float32] = self.obs + np.float32(0.01) * noise
        return rows_of_obs


def case_of(bundle: Path, checkpoint: Path) -> Case:
    """Take the first golden vector, which the export proved. Raises BundleError."""
    loaded = load_bundle(bundle)
    inputs, outputs = loaded.golden()
    obs = inputs.get("obs")
    if obs is None or obs.ndim != 2 or obs.dtype != np.float32:
        raise SystemExit(f"the bare server reads a flat list of numbers; policy {loaded.contract.name!r} wants another")
    # Numbers as a robot's client sends them: a float32's shortest digits.
    return Case(loaded, checkpoint, obs[0], outputs["action"][0])


def servers(case: Case, folder: Path) -> tuple[list[Server], dict[str, str]]:
    """Return the servers, and why others are missing."""
    made: list[Server] = []
    missing: dict[str, str] = {}
    for make in (rlservo, two_replicas, bare, mlserver, litserve, bentoml, ray_defaults, rllib_example):
        try:
            made.append(make(case, folder))
        except InstallError as error:
            missing[make.__name__] = str(error)
    return made, missing


def digits(obs: NDArray[np.float32]) -> Any:
    return [float(str(value)) for value in obs]


def plain(case: Case, path: str, key: str = "obs", method: str = "POST") -> Exchange:
    return Exchange(method, path, json.dumps({key: digits(case.obs)}).encode())


def binary(case: Case, rows: int) -> Exchange:
    """The Open Inference Protocol's binary form of a batch, as Triton's client sends it."""
    obs = case.batch(rows)
    tensor = {
        "name": "obs",
        "shape": list(obs.shape),
        "datatype": "FP32",
        "parameters": {"binary_data_size": obs.nbytes},
    }
    outputs = [{"name": "action", "parameters": {"binary_data": True}}]
    head = json.dumps({"inputs": [tensor], "outputs": outputs}).encode()
    headers = (
        ("Content-Type", "application/octet-stream"),
        ("Inference-Header-Content-Length", str(len(head))),
    )
    return Exchange("POST", f"/v2/models/{case.name}/infer", head + obs.astype("<f4").tobytes(), headers)


def rlservo(case: Case, _folder: Path, name: str = RLSERVO, replicas: int = 1) -> Server:
    port, grpc_port = free_ports(2)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(case.bundle.path), "--port", str(port)]
    return asked(case, name, [*command, "--grpc-port", str(grpc_port), "--replicas", str(replicas)], port, grpc_port)


def asked(case: Case, name: str, command: list[str], port: int, grpc_port: int | None = None) -> Server:
    """Return a server of ours, and how it is asked."""
    return Server(
        name,
        command,
        port,
        plain(case, f"/v1/policies/{case.name}/act"),
        batch=binary(case, BATCH),
        heavy=binary(case, HEAVY_BATCH),
        stream=f"/v1/policies/{case.name}/stream",
        message=pack({"obs": case.obs}),
        greets=True,
        grpc_port=grpc_port,
    )


def two_replicas(case: Case, folder: Path) -> Server:
    return rlservo(case, folder, TWO, 2)


def bare(case: Case, _folder: Path) -> Server:
    python, (port,) = python_of("bare"), free_ports(1)
    command = [str(python), str(PEERS / "bare.py"), str(port), case.onnx_file]
    return Server(BARE, command, port, plain(case, "/act"), stream="/ws", message=case.obs.tobytes())


def mlserver(case: Case, _folder: Path) -> Server:
    python, (port, grpc_port) = python_of("mlserver"), free_ports(2)
    tensor = {"name": "obs", "shape": [1, len(case.obs)], "datatype": "FP32", "data": digits(case.obs)}
    act = Exchange("POST", f"/v2/models/{case.name}/infer", json.dumps({"inputs": [tensor]}).encode())
    command = [str(python), str(PEERS / "mlserver_runtime.py"), str(port), str(grpc_port), case.name, case.onnx_file]
    return Server(MLSERVER, command, port, act, grpc_port=grpc_port)


def litserve(case: Case, _folder: Path) -> Server:
    python, (port,) = python_of("litserve"), free_ports(1)
    return Server(
        LITSERVE, [str(python), str(PEERS / "litserve_server.py"), str(port), case.onnx_file], port, plain(case, "/act")
    )


def bentoml(case: Case, folder: Path) -> Server:
    python, (port,) = python_of("bentoml"), free_ports(1)
    command = [str(python), "-m", "bentoml", "serve", "bentoml_service:PolicyService"]
    env = {"POLICY_ONNX": case.onnx_file, "BENTOML_HOME": str(folder / "bentoml"), "BENTOML_DO_NOT_TRACK": "True"}
    command += ["--working-dir", str(PEERS), "--host", "127.0.0.1", "--port", str(port)]
    return Server(BENTOML, command, port, plain(case, "/act"), env)


# The two on Ray run in this project's own environment: an environment of theirs would hold the same Ray and torch.


def ray_environment(folder: Path) -> dict[str, str]:
    # A token of our own: a local ray.init() would otherwise write one into the user's home and keep using it.
    return {"RAY_TMPDIR": str(folder), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}


def ray_defaults(case: Case, folder: Path) -> Server:
    (port,) = free_ports(1)
    command = [sys.executable, str(PEERS / "ray_serve_defaults.py"), str(port), case.onnx_file]
    return Server(DEFAULTS, command, port, plain(case, "/act"), ray_environment(folder))


def rllib_example(case: Case, folder: Path) -> Server:
    (port,) = free_ports(1)
    command = [sys.executable, str(PEERS / "rllib_example.py"), str(port), str(case.checkpoint)]
    return Server(RLLIB, command, port, plain(case, "/rllib-rlmodule", "observation", "GET"), ray_environment(folder))
