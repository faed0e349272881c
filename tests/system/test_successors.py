"""Successors of a version that clients are connected to: each kind of difference, with the three kinds of clients."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto, helper

from bundles import contract_of, save_graph
from rlservo.bundle import bundle as bundle_files
from rlservo.bundle.contract import TensorSpec
from rlservo.bundle.spaces import BoxSpec, DictSpec, Element, Quantity
from rlservo.client.admin_client import AdminClient
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.errors import RefusedError
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from servers import Run, free_ports, running, wait_until_served
from waiting import wait_for

pytestmark = [pytest.mark.serve, pytest.mark.slow]

JOINTS, GOAL = ("shoulder", "elbow", "wrist"), ("x", "y")
OBS = {"joints": np.array([0.1, -0.2, 0.3], np.float32), "goal": np.array([0.5, -0.5], np.float32)}
TYPES = {"float32": TensorProto.FLOAT, "float64": TensorProto.DOUBLE}


def arm(
    root: Path,
    version: str,
    *,
    names: tuple[str, ...] = JOINTS,
    unit: str = "rad",
    rate_hz: float = 10.0,
    high: float = 1.0,
    farthest: float = 5.0,
    actions: int = 3,
    dtype: str = "float32",
    camera: bool = False,
    command: Quantity | None = None,
) -> Path:
    """A policy that gives its version number in each element: observations are three joints and a goal."""
    folder = root / "arm" / version
    folder.mkdir(parents=True)
    leaves = {"goal": (dtype, len(GOAL)), "joints": (dtype, 3)} | ({"camera": ("float32", 4)} if camera else {})
    nodes = []
    for name in leaves:
        nodes.append(helper.make_node("Cast", [f"obs.{name}"], [f"{name}.f"], to=TensorProto.FLOAT))
        nodes.append(helper.make_node("MatMul", [f"{name}.f", f"{name}.w"], [f"{name}.y"]))
    total = "goal.y"
    for name in list(leaves)[1:]:
        nodes.append(helper.make_node("Add", [total, f"{name}.y"], [f"{total}+{name}"]))
        total = f"{total}+{name}"
    nodes.append(helper.make_node("Add", [total, "bias"], ["action"]))
    constants = {f"{name}.w": np.zeros((size, actions), np.float32) for name, (_, size) in leaves.items()}
    constants["bias"] = np.full(actions, int(version) / 100, np.float32)
    inputs = [(f"obs.{name}", TYPES[kind], ["batch", size]) for name, (kind, size) in leaves.items()]
    save_graph(
        folder / bundle_files.ONNX_FILE, nodes, constants, inputs, [("action", TensorProto.FLOAT, ["batch", actions])]
    )
    elements = tuple(Element(name=name, unit=unit) for name in names)
    spaces = {
        "goal": BoxSpec(shape=(2,), dtype=dtype, low=-farthest, high=farthest,
                        elements=tuple(Element(name=name, unit="m") for name in GOAL)),
        "joints": BoxSpec(shape=(3,), dtype=dtype, low=-4.0, high=4.0, elements=elements),
    }  # fmt: skip
    if camera:
        spaces["camera"] = BoxSpec(shape=(4,), dtype="float32", low=0.0, high=1.0)
    acted = tuple(each.model_copy(update={"quantity": command}) for each in elements) if actions == 3 else ()
    contract = contract_of(
        "arm",
        DictSpec(spaces=spaces),
        BoxSpec(shape=(actions,), dtype="float32", low=-high, high=high, elements=acted),
        version=version,
        inputs=tuple(TensorSpec(name=f"obs.{name}", dtype=kind, shape=(-1, n)) for name, (kind, n) in leaves.items()),
        control_rate_hz=rate_hz,
    )
    (folder / bundle_files.TORCHSCRIPT_FILE).write_bytes(b"no TorchScript: " + bytes(1000))
    golden = {f"obs.{name}": np.full((4, size), 0.5, kind) for name, (kind, size) in leaves.items()}
    session = onnxruntime.InferenceSession(folder / bundle_files.ONNX_FILE)
    bundle_files.write_golden(folder, golden, dict(zip(["action"], session.run(["action"], golden), strict=True)))
    bundle_files.write_contract(folder, contract)
    return folder


HARMLESS: dict[str, tuple[dict[str, Any], str]] = {
    "2": ({"names": ("pan", "lift", "wrist")}, "obs.joints element 0 is 'pan' [rad] instead of 'shoulder' [rad]"),
    "3": ({"names": ()}, "obs.joints element 0 is without a name instead of 'shoulder' [rad]"),
    "4": ({"unit": ""}, "obs.joints element 0 is 'shoulder' [no unit] instead of 'shoulder' [rad]"),
    "5": ({"rate_hz": 20.0}, "the control rate is 20 Hz instead of 10 Hz"),
    "6": ({}, ""),
    "7": (
        {"command": "joint position"},
        "action element 0 is 'shoulder' [rad], joint position instead of 'shoulder' [rad]",
    ),
}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "11": ({"names": ("elbow", "shoulder", "wrist")}, "obs.joints has 'elbow' as element 0 instead of 1"),
    "12": ({"high": 2.0}, "action element 0 (shoulder) has low -2 instead of -1"),
    "13": ({"farthest": 3.0}, "obs.goal element 0 (x) has low -3 instead of -5"),
    "14": ({"actions": 2}, "action has shape (2,) instead of (3,)"),
    "15": ({"dtype": "float64"}, "obs.goal has dtype float64 instead of float32"),
    "16": ({"camera": True}, "obs.camera is new"),
    "17": ({"unit": "deg"}, "obs.joints element 0 (shoulder) has unit deg instead of rad"),
}


@dataclass
class Loop:
    """A client that asks without pause, the last action and what went wrong."""

    act: Callable[[], Any]
    last: float = 0.0
    steps: int = 0
    failures: list[str] = field(default_factory=list)

    def run(self, ended: threading.Event) -> None:
        while not ended.is_set():
            try:
                self.last = round(100 * float(np.asarray(self.act()).ravel()[0]), 3)
            except Exception as error:
                self.failures.append(repr(error))
            self.steps += 1
            time.sleep(0.01)


def over_grpc(channel: grpc.Channel) -> Callable[[], Any]:
    infer = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")

    def act() -> Any:
        message = messages.ModelInferRequest(model_name="arm")
        for name, array in OBS.items():
            message.inputs.add(name=f"obs.{name}", datatype="FP32", shape=[1, len(array)])
            message.raw_input_contents.append(array.tobytes())
        reply = messages.ModelInferResponse.FromString(infer(message.SerializeToString(), timeout=20))
        return np.frombuffer(reply.raw_output_contents[0], np.float32)

    return act


@dataclass
class Fleet:
    """A server of two workers, and a loop over HTTP, WebSocket and gRPC each."""

    url: str
    key: str
    loops: dict[str, Loop]

    def command(self, command: str, **document: Any) -> dict[str, Any]:
        with AdminClient(self.url, api_key=self.key) as admin:
            return admin.command("arm", command, document)

    def all_get(self, version: str) -> None:
        wait_for(lambda: all(loop.last == float(version) for loop in self.loops.values()), f"version {version}")

    def go_on(self) -> None:
        """Wait for some steps more of each."""
        goal = {name: loop.steps + 20 for name, loop in self.loops.items()}
        wait_for(lambda: all(loop.steps >= goal[name] for name, loop in self.loops.items()), "further steps")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    root = tmp_path_factory.mktemp("policies")
    arm(root, "1")
    for version, (changes, _) in {**HARMLESS, **REFUSED}.items():
        arm(root, version, **changes)
    port, grpc_port = free_ports(2)
    runtime = tmp_path_factory.mktemp("runtime")
    command = [
        sys.executable, "-m", "rlservo.deploy.cli", "serve", str(root), "--port", str(port), "--grpc-port",
        str(grpc_port), "--workers", "2", "--alias", "arm:production=1",
    ]  # fmt: skip
    with running(command, port, XDG_RUNTIME_DIR=str(runtime)) as run, contextlib.ExitStack() as stack:
        drained: list[str] = []
        drain = threading.Thread(target=drained.extend, args=(run.process.stdout,), daemon=True)
        drain.start()
        wait_until_served(run, drained)
        yield stack.enter_context(connected(run, grpc_port, runtime))
        stack.close()
        run.end(signal.SIGTERM)
        drain.join()


@contextlib.contextmanager
def connected(run: Run, grpc_port: int, runtime: Path) -> Iterator[Fleet]:
    url, ended = f"http://127.0.0.1:{run.port}", threading.Event()
    (key_file,) = (runtime / "rlservo").glob("*")
    with (
        PolicyClient(url, "arm", deadline_ms=20_000) as http,
        StreamClient(url, "arm", deadline_ms=20_000) as stream,
        grpc.insecure_channel(f"127.0.0.1:{grpc_port}") as channel,
    ):
        loops = {
            "http": Loop(lambda: http.act(OBS)),
            "stream": Loop(lambda: stream.act(OBS)),
            "grpc": Loop(over_grpc(channel)),
        }
        threads = [threading.Thread(target=loop.run, args=(ended,)) for loop in loops.values()]
        for thread in threads:
            thread.start()
        try:
            yield Fleet(url, key_file.read_text().strip(), loops)
        finally:
            ended.set()
            for thread in threads:
                thread.join()


@pytest.mark.parametrize("version", HARMLESS)
def test_clients_follow_a_successor_that_differs_without_harm(fleet: Fleet, version: str) -> None:
    fleet.all_get("1")
    said = fleet.command("canary", version=version, share=0.5)["notes"]
    fleet.go_on()
    fleet.command("canary", version=None)
    said_again = fleet.command("alias", alias="production", version=version)["notes"]
    fleet.all_get(version)
    fleet.go_on()
    fleet.command("rollback")
    fleet.all_get("1")
    assert {name: loop.failures for name, loop in fleet.loops.items()} == {"http": [], "stream": [], "grpc": []}
    _, difference = HARMLESS[version]
    for notes in (said, said_again):
        assert difference in " ".join(notes) if difference else notes == []


@pytest.mark.parametrize("version", REFUSED)
def test_successor_that_clients_cannot_use_is_refused_with_both_values(fleet: Fleet, version: str) -> None:
    fleet.all_get("1")
    _, difference = REFUSED[version]
    for command, document in (
        ("alias", {"alias": "production", "version": version}),
        ("canary", {"version": version, "share": 0.5}),
    ):
        with pytest.raises(RefusedError) as caught:
            fleet.command(command, **document)
        assert difference in caught.value.message and f"version {version} " in caught.value.message
    fleet.go_on()
    fleet.all_get("1")
    assert {name: loop.failures for name, loop in fleet.loops.items()} == {"http": [], "stream": [], "grpc": []}
