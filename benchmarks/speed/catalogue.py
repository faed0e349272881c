"""Servers that are compared: how each is started, and the one policy they are all asked about."""

from __future__ import annotations

import json
import secrets
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.bundle import ONNX_FILE, Bundle, load_bundle
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.wire.msgpack_arrays import pack
from speed.environments import InstallError, node_modules_of, python_of
from speed.servers import Exchange, Server

PEERS = Path(__file__).resolve().parent.parent / "peers"
BARE, RLSERVO, TWO = "uvicorn + FastAPI", "rlservo serve", "rlservo serve, 2 replicas"
DIRECTLY = ", direct port"
DIRECT = RLSERVO + DIRECTLY
BARE_ASGI, GRANIAN = "uvicorn, bare ASGI", "granian, bare ASGI"
MOSEC, FASTIFY = "mosec", "fastify + onnxruntime-node"
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


def servers(case: Case, folder: Path, names: Collection[str] | None = None) -> tuple[list[Server], dict[str, str]]:
    """Return the servers (those of `names`, and ours), and why others are missing."""
    made: list[Server] = []
    missing: dict[str, str] = {}
    for name, make in MAKERS.items():
        if names is None or name in (RLSERVO, *names):
            try:
                made.append(make(case, folder))
            except InstallError as error:
                missing[name] = str(error)
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
    port, grpc_port, direct_port = free_ports(3)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(case.bundle.path), "--port", str(port)]
    command += ["--grpc-port", str(grpc_port), "--direct-port", str(direct_port), "--replicas", str(replicas)]
    server = asked(case, name, command, port, grpc_port)
    server.direct_port = direct_port
    return server


def direct(server: Server) -> Server:
    """Return a started server of ours as who goes without its proxy sees it."""
    assert server.direct_port is not None
    return replace(server, name=server.name + DIRECTLY, port=server.direct_port, grpc_port=None)


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


def bare(case: Case, _folder: Path) -> Server:
    python, (port,) = python_of("bare"), free_ports(1)
    command = [str(python), str(PEERS / "bare.py"), str(port), case.onnx_file]
    return Server(BARE, command, port, plain(case, "/act"), stream="/ws", message=case.obs.tobytes())


def bare_asgi(case: Case, _folder: Path) -> Server:
    python, (port,) = python_of("asgi"), free_ports(1)
    command = [str(python), str(PEERS / "bare_asgi.py"), str(port), case.onnx_file]
    return Server(BARE_ASGI, command, port, plain(case, "/act"), stream="/", message=case.obs.tobytes())


def granian(case: Case, _folder: Path) -> Server:
    """The same application as `bare_asgi`'s, on a server written in Rust."""
    python, (port,) = python_of("asgi"), free_ports(1)
    command = [str(python), "-m", "granian", "--interface", "asgi", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--workers", "1", "--no-log", "--working-dir", str(PEERS), "--factory", "bare_asgi:build_named"]
    env = {"POLICY_ONNX": case.onnx_file}
    return Server(GRANIAN, command, port, plain(case, "/act"), env, stream="/", message=case.obs.tobytes())


def mosec(case: Case, folder: Path) -> Server:
    python, (port,) = python_of("mosec"), free_ports(1)
    command = [str(python), str(PEERS / "mosec_server.py"), "--address", "127.0.0.1", "--port", str(port)]
    command += ["--path", str(folder / "mosec")]  # its processes' socket
    return Server(MOSEC, command, port, plain(case, "/inference"), {"POLICY_ONNX": case.onnx_file})


def fastify(case: Case, _folder: Path) -> Server:
    modules, (port,) = node_modules_of("fastify"), free_ports(1)
    command = ["node", str(PEERS / "fastify" / "server.js"), str(port), case.onnx_file]
    return Server(FASTIFY, command, port, plain(case, "/act"), {"NODE_PATH": str(modules)})


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


MAKERS: dict[str, Callable[[Case, Path], Server]] = {
    RLSERVO: rlservo,
    BARE: bare,
    BARE_ASGI: bare_asgi,
    GRANIAN: granian,
    MOSEC: mosec,
    FASTIFY: fastify,
    MLSERVER: mlserver,
    LITSERVE: litserve,
    BENTOML: bentoml,
    DEFAULTS: ray_defaults,
    RLLIB: rllib_example,
}
