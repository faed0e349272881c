"""Servers that `serving.py` compares: their commands and requests, and the environments of those that are not ours.

An environment is made by `serving.py --install` from complete, pinned lists (`peers/requirements/`) and kept in the
user's cache; a peer without one is left out.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.bundle import ONNX_FILE, load_bundle
from rlservo.client.formats.msgpack_arrays import pack

PEERS = Path(__file__).resolve().parent / "peers"
OURS, BARE, OURS_ON_RAY, BARE_ON_RAY = "rlservo serve", "bare uvicorn ASGI", "rlservo on Ray Serve", "bare on Ray Serve"
COMPLETE = ".complete"  # written last
INSTALL_S = 600
SWITCHES = {"RAY_SERVE_ENABLE_HA_PROXY": "1", "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1", "RAY_worker_niceness": "0"}


@dataclass(frozen=True)
class Case:
    """The policy, one observation, and the action that the export proved for it."""

    policies: Path
    bundle: Path
    checkpoint: Path
    obs: NDArray[np.float32]  # (n,)
    action: NDArray[np.float32]

    @property
    def onnx(self) -> str:
        return str(self.bundle / ONNX_FILE)


def case_of(policies: Path, name: str, checkpoint: Path) -> Case:
    """Take the first golden vector of policy `name`, version 1."""
    bundle = policies / name / "1"
    inputs, outputs = load_bundle(bundle).golden()
    return Case(policies, bundle, checkpoint, inputs["obs"][0], outputs["action"][0])


@dataclass(frozen=True)
class Peer:
    """A server that answers a POST of one observation with its action."""

    command: list[str]
    path: str = "/act"
    key: str = "obs"
    environment: dict[str, str] = field(default_factory=dict)
    stream: str = ""  # path of a WebSocket
    message: bytes = b""
    greets: bool = False
    rounds: int = 2
    starts_in_s: float = 60.0
    checks: bool = True  # whether it answers with the policy's action

    def request(self, case: Case, port: int) -> bytes:
        """Return the HTTP request of one observation with the fields and headers that `PolicyClient` sends."""
        obs = [float(str(value)) for value in case.obs]  # float32 numbers in full
        document: object = {self.key: obs, "seq": 4711, "deadline_ms": 4999.87654321}
        if self.path.endswith("/infer"):
            tensor = {"name": "obs", "shape": [1, len(obs)], "datatype": "FP32", "data": obs}
            document = {"inputs": [tensor]}
        body = json.dumps(document).encode()
        head = f"POST {self.path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Type: application/json\r\n"
        head += "Accept: application/json\r\nAccept-Encoding: identity\r\nUser-Agent: rlservo-client\r\n"
        head += "X-Session-Id: 1f0e9d8c7b6a5948\r\n"
        return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


Make = Callable[[Case, int, Path], Peer]


def _ours(case: Case, port: int, _folder: Path) -> Peer:
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(case.policies), "--port", str(port)]
    name, message = case.bundle.parent.name, pack({"obs": case.obs, "seq": 4711, "deadline_ms": 4999.87654321})
    paths = f"/v1/policies/{name}/act", f"/v1/policies/{name}/stream"
    return Peer(command, paths[0], stream=paths[1], message=message, greets=True, rounds=5)


def _bare(case: Case, port: int, _folder: Path) -> Peer:
    return _scripted(sys.executable, "bare_asgi.py", case, port, stream="/", message=case.obs.tobytes(), rounds=5)


def _granian(case: Case, port: int, _folder: Path) -> Peer:
    command = [python_of("asgi"), "-m", "granian", "--interface", "asgi", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--workers", "1", "--no-log", "--working-dir", str(PEERS), "--factory", "bare_asgi:build_named"]
    return Peer(command, environment={"POLICY_ONNX": case.onnx}, stream="/", message=case.obs.tobytes())


def _fastapi(case: Case, port: int, _folder: Path) -> Peer:
    return _scripted(python_of("bare"), "bare.py", case, port, stream="/ws", message=case.obs.tobytes())


def _sanic(case: Case, port: int, _folder: Path) -> Peer:
    return _scripted(python_of("sanic"), "sanic_server.py", case, port)


def _robyn(case: Case, port: int, _folder: Path) -> Peer:
    return _scripted(python_of("robyn"), "robyn_server.py", case, port)


def _fastify(case: Case, port: int, _folder: Path) -> Peer:
    command = ["node", str(PEERS / "fastify" / "server.js"), str(port), case.onnx]
    return Peer(command, environment={"NODE_PATH": str(folder_of("fastify") / "node_modules")})


def _mosec(case: Case, port: int, folder: Path) -> Peer:
    command = [python_of("mosec"), str(PEERS / "mosec_server.py"), "--address", "127.0.0.1", "--port", str(port)]
    command += ["--path", str(folder / "mosec")]
    return Peer(command, "/inference", environment={"POLICY_ONNX": case.onnx})


def _mlserver(case: Case, port: int, _folder: Path) -> Peer:
    command = [python_of("mlserver"), str(PEERS / "mlserver_runtime.py"), str(port), str(port + 1), "ur5", case.onnx]
    return Peer(command, "/v2/models/ur5/infer", rounds=1)


def _litserve(case: Case, port: int, _folder: Path) -> Peer:
    return _scripted(python_of("litserve"), "litserve_server.py", case, port, rounds=1)


def _bentoml(case: Case, port: int, folder: Path) -> Peer:
    command = [python_of("bentoml"), "-m", "bentoml", "serve", "bentoml_service:PolicyService"]
    command += ["--working-dir", str(PEERS), "--host", "127.0.0.1", "--port", str(port)]
    home = {"BENTOML_HOME": str(folder / "bentoml"), "BENTOML_DO_NOT_TRACK": "True"}
    return Peer(command, environment={"POLICY_ONNX": case.onnx, **home}, rounds=1)


def _on_ray(kind: str, source: Path | str, port: int, folder: Path, **options: object) -> Peer:
    # A token of its own: a local ray.init() would write one into the user's home and keep using it.
    own = {"RAY_TMPDIR": str(folder), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    own["RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S"] = "60"  # after 5 s Serve kills a proxy that is not ready yet
    own["PYTHONPATH"] = str(PEERS)  # for the replica
    own |= SWITCHES if kind in ("ours", "bare") else {}
    command = [sys.executable, str(PEERS / "on_ray.py"), str(port), kind, str(source)]
    return Peer(command, environment=own, starts_in_s=120, **options)  # type: ignore[arg-type]


def _scripted(python: str, script: str, case: Case, port: int, **options: object) -> Peer:
    return Peer([python, str(PEERS / script), str(port), case.onnx], **options)  # type: ignore[arg-type]


MAKERS: dict[str, Make] = {
    BARE: _bare,
    OURS: _ours,
    "fastify": _fastify,
    "sanic": _sanic,
    "robyn": _robyn,
    "granian, bare ASGI": _granian,
    "mosec": _mosec,
    "uvicorn + FastAPI": _fastapi,
    OURS_ON_RAY: lambda case, port, folder: _on_ray(
        "ours", case.policies, port, folder, path=f"/v1/policies/{case.bundle.parent.name}/act"
    ),
    BARE_ON_RAY: lambda case, port, folder: _on_ray("bare", case.onnx, port, folder),
    "MLServer": _mlserver,
    "LitServe": _litserve,
    "BentoML": _bentoml,
    "Ray Serve defaults": lambda case, port, folder: _on_ray("defaults", case.onnx, port, folder, rounds=1),
    "RLlib's Serve example": lambda case, port, folder: _on_ray(
        "rllib", case.checkpoint, port, folder, rounds=1, key="observation", checks=False
    ),
}  # fmt: skip


class MissingError(Exception):
    """A peer's environment is not installed here."""


def folder_of(name: str) -> Path:
    """Return a peer's environment. Raises MissingError."""
    folder = _place(name)
    if not (folder / COMPLETE).exists():
        raise MissingError(f"{name}: not installed")
    return folder


def python_of(name: str) -> str:
    """Return the Python of a peer's environment. Raises MissingError."""
    return str(folder_of(name) / "bin" / "python")


def install() -> None:
    """Make the missing environments; one that cannot be made is named."""
    pip = [sys.executable, "-m", "pip"]
    for name in sorted(path.stem for path in (PEERS / "requirements").glob("*.txt")):
        folder = _place(name)
        into = [*pip, "--python", str(folder / "bin" / "python"), "install", "--quiet", "--no-deps", "-r"]
        make = [sys.executable, "-m", "venv", "--without-pip", str(folder)]
        _install(name, make, [*into, str(PEERS / "requirements" / f"{name}.txt")])
    folder = _place("fastify")
    # No scripts: onnxruntime-node's would fetch CUDA's libraries, and the CPU's are in the package.
    quiet = ["--ignore-scripts", "--no-audit", "--no-fund", "--no-package-lock", "--loglevel=error"]
    copy = ["install", "-D", str(PEERS / "fastify" / "package.json"), str(folder / "package.json")]
    _install("fastify", copy, ["npm", "install", "--prefix", str(folder), *quiet])


def _install(name: str, *commands: list[str]) -> None:
    folder = _place(name)
    if (folder / COMPLETE).exists():
        return
    print(f"installing {name} into {folder}", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        for command in commands:
            subprocess.run(command, check=True, timeout=INSTALL_S)
    except (OSError, subprocess.SubprocessError) as error:
        print(f"{name} is left out: {error}")
    else:
        (folder / COMPLETE).touch()


def _place(name: str) -> Path:
    made_of = PEERS / "fastify" / "package.json" if name == "fastify" else PEERS / "requirements" / f"{name}.txt"
    digest = hashlib.sha256(made_of.read_bytes() + sys.version.encode()).hexdigest()[:12]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "rlservo-bench" / f"{name}-{digest}"
