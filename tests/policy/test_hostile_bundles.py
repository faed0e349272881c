"""Bundles made to stop a server, and file systems that hang: refused in a sentence while all else continues."""

from __future__ import annotations

import asyncio
import hashlib
import io
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper, numpy_helper

from bundles import rewrite_contract, write_box_policy
from rlservo.bundle import bundle as bundle_files
from rlservo.bundle.bundle import BundleLimits, load_bundle, read_contract
from rlservo.bundle.regular_files import open_regular
from rlservo.bundle.spaces import BoxSpec
from rlservo.client.admin_client import AdminClient
from rlservo.errors import (
    BundleError,
    BundleTamperedError,
    RefusedError,
    RequestError,
    RlservoError,
    UnavailableError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.engines.server_process import repeat
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.deployment_plan import ServedConfig
from rlservo.serve_app.versions.plan_commands import Load, SetAlias
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.version_loader import VersionLoader
from servers import over_uvicorn
from stores import plan_files
from waiting import until

FILES = ("contract.json", "policy.onnx", "policy.ts", "golden.npz", "SHA256SUMS")
OBS = np.zeros(27, np.float32) + 0.1
OPERATOR, _ = new_key("operator", admin=True)
DIGEST = "sha256:" + hashlib.sha256(OPERATOR.encode()).hexdigest()
SOON_S = 5.0  # [s] a command and a request for an action; the machine may be busy


@pytest.fixture
def root(policies: Path, tmp_path: Path) -> Path:
    """A repository with ur5 in 1 and 2, and gridworld."""
    root = tmp_path / "policies"
    for bundle in ("ur5/1", "ur5/2", "gridworld/1"):
        shutil.copytree(policies / bundle, root / bundle)
    return root


@pytest.fixture
def patience(request: pytest.FixtureRequest) -> dict[str, float]:
    """Time that the server waits for the file system."""
    return {"timeout_s": 60.0, **getattr(request, "param", {})}


@pytest.fixture
def url(root: Path, patience: dict[str, float]) -> Iterator[str]:
    """A server of ur5 in 1 and 2, and of gridworld."""
    loader = VersionLoader(Repository([root]), **patience)
    control = PlanFollower(loader, plan_files(root))
    asyncio.run(control.configure({}))
    app = create_app(control, ServerSettings(operator_key=DIGEST), replica="r")
    with over_uvicorn(app) as port:
        yield f"http://127.0.0.1:{port}"


@pytest.fixture
def admin(url: str) -> Iterator[AdminClient]:
    with AdminClient(url, api_key=OPERATOR) as client:
        yield client


def make(kind: str, file: Path) -> None:
    file.unlink()
    if kind == "a FIFO":
        os.mkfifo(file)
    elif kind == "a device":
        file.symlink_to("/dev/zero")
    elif kind == "a folder":
        file.mkdir()
    elif kind == "a socket":
        here = Path.cwd()
        os.chdir(file.parent)  # a socket's path is short
        try:
            with socket.socket(socket.AF_UNIX) as listener:
                listener.bind(file.name)
        finally:
            os.chdir(here)


def work_goes_on(admin: AdminClient, url: str) -> None:
    """Actions and every other command are answered soon."""
    with httpx.Client(base_url=url, timeout=SOON_S) as robot:
        for command in (
            lambda: admin.alias("ur5", "candidate", "1"),
            lambda: admin.shadow("ur5", "candidate"),
            lambda: admin.shadow("ur5", None),
            lambda: admin.alias("ur5", "candidate", None),
            admin.listing,
        ):
            began = time.monotonic()
            command()
            reply = robot.post("/v1/policies/ur5/act", json={"obs": OBS.tolist()})
            assert reply.status_code == 200 and reply.json()["version"] == "2"
            assert time.monotonic() - began < SOON_S


@pytest.mark.parametrize("name", FILES)
def test_what_is_no_regular_file_is_refused_at_once_and_administration_goes_on(
    url: str, admin: AdminClient, root: Path, policies: Path, name: str
) -> None:
    for kind in ("a FIFO", "a device", "a folder", "a socket"):
        folder = Path(shutil.copytree(policies / "ur5" / "10", root / "ur5" / "10"))
        make(kind, folder / name)
        began = time.monotonic()
        with pytest.raises((RefusedError, RequestError), match=f"{name} is {kind}, not a regular file"):
            admin.load("ur5", "10")
        assert time.monotonic() - began < SOON_S
        work_goes_on(admin, url)
        shutil.rmtree(folder)
    assert admin.load("gridworld")["versions"] == ["1"]


def test_a_server_does_not_start_on_a_fifo_and_says_so(root: Path) -> None:
    make("a FIFO", root / "ur5" / "2" / "policy.onnx")
    began = time.monotonic()
    with pytest.raises(BundleError, match=r"policy.onnx is a FIFO, not a regular file"):
        load_served([root], ServedConfig())
    assert time.monotonic() - began < 5


def test_links_to_regular_files_are_a_bundle(policies: Path, tmp_path: Path) -> None:
    folder = tmp_path / "ur5" / "1"
    folder.mkdir(parents=True)
    for file in (policies / "ur5" / "1").iterdir():
        (folder / file.name).symlink_to(file)
    with Policy.load(folder) as policy:
        assert policy.act(OBS).shape == (6,)


@pytest.mark.parametrize("name", FILES)
def test_a_file_beyond_its_limit_is_refused_before_it_is_read(root: Path, name: str) -> None:
    folder = root / "ur5" / "2"
    os.truncate(folder / name, 1 << 40)  # a terabyte of nothing: reading it would take hours
    limits = BundleLimits(max_policy_bytes=1 << 20, max_golden_bytes=1 << 20, max_contract_bytes=1 << 20)
    with pytest.raises(BundleError, match=rf"{name} is larger than [\d,]+ bytes: it has 1,099,511,627,776"):
        Policy.load(folder, limits=limits)


def test_the_limit_of_a_policys_file_is_a_setting(root: Path) -> None:
    settings = ServerSettings.from_environment(environment={"RLSERVO_MAX_POLICY_BYTES": "2048"})
    with pytest.raises(BundleError, match=r"policy.onnx is larger than 2,048 bytes: .* \(max_policy_bytes\)"):
        load_served([root / "ur5"], ServedConfig(), settings)


def test_more_files_than_a_bundle_has_are_not_hashed(root: Path) -> None:
    folder = root / "ur5" / "2"
    with (folder / "SHA256SUMS").open("a") as sums:
        sums.writelines(f"{'0' * 64}  more{number}\n" for number in range(13))
    with pytest.raises(BundleError, match="lists 17 files: at most 16"):
        Policy.load(folder)


def golden_of(folder: Path, members: dict[str, bytes]) -> None:
    """Write a golden.npz of these members, with valid hashes."""
    with zipfile.ZipFile(folder / "golden.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    bundle_files.write_contract(folder, read_contract(folder))


def npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_golden_vectors_that_unpack_to_more_than_the_limit_are_refused(root: Path) -> None:
    folder = root / "ur5" / "2"
    golden_of(folder, {f"input/{n}": npy(np.zeros(1 << 20)) for n in range(4)})
    assert (folder / "golden.npz").stat().st_size < 1 << 18
    with pytest.raises(BundleError, match=r"golden.npz unpacks to 33,\d+,\d+ bytes: at most 16,777,216"):
        Policy.load(folder, limits=BundleLimits(max_golden_bytes=16 << 20))


# Of this program alone: getrusage's figure begins with that of the process that started it.
PEAK = """import re, sys
from rlservo.errors import BundleError
from rlservo.policy.policy import Policy
try:
    Policy.load(sys.argv[1])
except BundleError as error:
    print(error)
print(int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) // 1024)
"""


def test_a_bundle_of_a_megabyte_does_not_take_gigabytes_to_prove(root: Path) -> None:
    """Zeros pack a thousand to one, and a network's layers are larger than its observations: it was 3 GB."""
    folder, rows = root / "ur5" / "2", 600_000
    sizes = {"input/obs": 27, "output/action": 6, "output/action_dist_inputs": 12}
    golden_of(folder, {name: npy(np.zeros((rows, size), np.float32)) for name, size in sizes.items()})
    assert (folder / "golden.npz").stat().st_size < 1 << 20
    loaded = subprocess.run([sys.executable, "-c", PEAK, folder], capture_output=True, text=True, check=True)
    sentence, megabytes = loaded.stdout.splitlines()
    assert "golden.npz holds 600,000 samples: at most 4,096" in sentence
    assert int(megabytes) < 400


def test_golden_vectors_that_claim_more_than_they_hold_are_refused(root: Path) -> None:
    folder = root / "ur5" / "2"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 42,)})
    golden_of(folder, {"input/obs": header.getvalue() + b"\0" * 64})
    with pytest.raises(BundleError, match=r"'input/obs.npy' declares the shape \(4398046511104,\) and holds"):
        Policy.load(folder)


def test_a_contract_that_asks_for_all_the_memory_is_refused(root: Path) -> None:
    folder = root / "ur5" / "2"
    space = BoxSpec(shape=(1 << 20, 1 << 20), dtype="float32", low=None, high=None)
    tensor = read_contract(folder).inputs[0].model_copy(update={"shape": (-1, 1 << 20, 1 << 20)})
    rewrite_contract(folder, observation_space=space, inputs=(tensor,))
    with pytest.raises(BundleError, match=r"has 1,099,511,627,776 elements: at most"):
        Policy.load(folder)


LOOP = """import sys, time
from rlservo.errors import BundleError
from rlservo.policy import loading
from rlservo.policy.policy import Policy
loading.PROOF_S = 0.5
try:
    Policy.load(sys.argv[1])
except BundleError as error:
    print(error)
time.sleep(0.3)
began = time.process_time()
time.sleep(1.0)
print("%.2f" % (time.process_time() - began))
"""


def test_a_graph_that_does_not_come_to_an_end_is_given_up_and_computes_no_further(tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path)
    model = onnx.load(folder / bundle_files.ONNX_FILE)
    tensors = {"value": onnx.TensorProto.FLOAT, "go_on": onnx.TensorProto.BOOL, "turn": onnx.TensorProto.INT64}
    infos = {
        name + end: helper.make_tensor_value_info(name + end, kind, None if name == "value" else [])
        for name, kind in tensors.items()
        for end in ("", "_out")
    }
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go_on"], ["go_on_out"]),
            helper.make_node("Abs", ["value"], ["value_out"]),
        ],
        "body",
        [infos["turn"], infos["go_on"], infos["value"]],
        [infos["go_on_out"], infos["value_out"]],
    )
    turns = numpy_helper.from_array(np.array(2**60), "turns")
    always = numpy_helper.from_array(np.array(True), "always")
    model.graph.initializer.extend([turns, always])
    model.graph.node.insert(0, helper.make_node("Loop", ["turns", "always", "obs"], ["looped"], body=body))
    gemm = next(node for node in model.graph.node if node.op_type == "Gemm")
    gemm.input[0] = "looped"
    onnx.save(model, folder / bundle_files.ONNX_FILE)
    bundle_files.write_contract(folder, read_contract(folder))  # with the hashes of what is there now
    done = subprocess.run([sys.executable, "-c", LOOP, folder], capture_output=True, text=True, timeout=120)
    sentence, busy = done.stdout.splitlines()
    assert "did not finish its golden vectors within 0.5 s" in sentence, done.stderr
    assert float(busy) < 0.5 and not done.stderr


INT32, INT64 = onnx.TensorProto.INT32, onnx.TensorProto.INT64


def with_nodes(folder: Path, *nodes: Any, constants: Any = (), functions: Any = ()) -> None:
    """Put nodes that turn `obs` into `changed` before a graph's first layer."""
    model = onnx.load(folder / bundle_files.ONNX_FILE)
    model.graph.initializer.extend(constants)
    model.functions.extend(functions)
    model.opset_import.extend(helper.make_opsetid(each.domain, 1) for each in functions)
    for node in reversed(nodes):
        model.graph.node.insert(0, node)
    next(node for node in model.graph.node if node.op_type == "Gemm").input[0] = "changed"
    onnx.save(model, folder / bundle_files.ONNX_FILE)
    bundle_files.write_contract(folder, read_contract(folder))


def divided(op: str = "Div", kind: int = INT64, by: str = "int", domain: str = "", **options: Any) -> list[Any]:
    return [
        helper.make_node("Cast", ["obs"], ["int"], to=kind),
        helper.make_node(op, ["int", by], ["quotient"], domain=domain, **options),
        helper.make_node("Cast", ["quotient"], ["changed"], to=onnx.TensorProto.FLOAT),
    ]


def in_branches(nodes: list[Any], *constants: Any) -> list[Any]:
    """Return an If with the nodes as each of its branches, with constants of its own."""
    made = helper.make_tensor_value_info("changed", onnx.TensorProto.FLOAT, None)
    branch = helper.make_graph(nodes, "branch", [], [made], constants)
    return [helper.make_node("If", ["yes"], ["changed"], then_branch=branch, else_branch=branch)]


def number(name: str, value: Any, dtype: Any = np.int64) -> Any:
    return numpy_helper.from_array(np.array(value, dtype), name)


ABS = helper.make_node("Abs", ["other"], ["size"])
OTHER = helper.make_node("Cast", ["obs"], ["other"], to=INT64)
QUOTIENT = helper.make_function(
    "own", "Quotient", ["x", "harmless"], ["y"], [helper.make_node("Div", ["x", "harmless"], ["y"])],
    [helper.make_opsetid("", 18)],
)  # fmt: skip
YES = numpy_helper.from_array(np.array(True), "yes")
IS_OLD = onnxruntime.__version__.startswith(("1.23", "1.24"))  # a division by zero ends its process
ONLY_OLD = pytest.mark.skipif(not IS_OLD, reason="this onnxruntime checks for a division by zero")
ONLY_NEW = pytest.mark.skipif(IS_OLD, reason="a division by zero ends this onnxruntime's process")


@pytest.mark.parametrize(
    ("nodes", "more"),
    [
        (divided(), {}),
        (divided("Mod", INT32), {}),
        (divided(by="one"), {"constants": [number("one", -1)]}),
        (divided(by="ones"), {"constants": [number("ones", [3, -1] * 13 + [3])]}),
        (in_branches(divided()), {"constants": [YES]}),
        (divided("Quotient", by="int", domain="own"), {"functions": [QUOTIENT], "constants": [number("harmless", 2)]}),
        ([OTHER, *divided(by="other")], {}),
        (in_branches(divided(by="one"), number("one", -1)), {"constants": [YES, number("one", 1)]}),
        pytest.param([OTHER, ABS, *divided(by="size")], {}, marks=ONLY_OLD),
        pytest.param(divided(by="none"), {"constants": [number("none", 0)]}, marks=ONLY_OLD),
    ],
    ids=[
        "Div",
        "Mod",
        "constant",
        "one of them",
        "in a branch",
        "in a function",
        "variable",
        "covered",
        "absolute",
        "zero",
    ],
)
def test_an_integer_division_that_could_end_the_process_is_refused(
    tmp_path: Path, nodes: list[Any], more: dict[str, Any]
) -> None:
    folder = write_box_policy(tmp_path)
    with_nodes(folder, *nodes, **more)
    ours = r"divides integers by a number that may be .*-1, which ends the process.*, or export the policy again$"
    with pytest.raises(BundleError, match=ours):
        Policy.load(folder, check_golden=False)


def test_a_division_that_could_end_the_server_is_refused_by_it(url: str, admin: AdminClient, root: Path) -> None:
    with_nodes(write_box_policy(root, version="10"), *divided())
    with pytest.raises((RefusedError, RequestError), match="divides integers by a number that may be "):
        admin.load("ur5", "10")
    work_goes_on(admin, url)


@pytest.mark.parametrize(
    ("nodes", "more"),
    [
        (divided(by="two"), {"constants": [number("two", 2)]}),
        (divided("Mod", INT32, by="twos"), {"constants": [number("twos", [2, -3] * 13 + [2], np.int32)]}),
        (divided("Mod", fmod=1), {}),
        (divided(kind=onnx.TensorProto.DOUBLE), {}),
        pytest.param([OTHER, ABS, *divided(by="size")], {}, marks=ONLY_NEW),
        (in_branches(divided(by="two")), {"constants": [YES, number("two", 2)]}),
    ],
    ids=["constant", "constants", "fmod", "floating-point", "absolute", "in a branch"],
)
def test_a_division_that_cannot_end_the_process_is_loaded(
    tmp_path: Path, nodes: list[Any], more: dict[str, Any]
) -> None:
    folder = write_box_policy(tmp_path)
    with_nodes(folder, *nodes, **more)
    with Policy.load(folder, check_golden=False) as policy:
        assert policy.act(np.ones(policy.contract.observation_space.shape, np.float32)) is not None


# Half of an observation's elements minus the other half: nothing for equal numbers, as in a look at how long it takes.
SIGNS = number("signs", [1, -1] * 13 + [0], np.float32)
CONSTANTS = [SIGNS, number("nothing", 0), number("one", 1), number("ones", [1]), number("axes", [0, 2]),
             number("first", [0, 1]), number("most", [1 << 40]), number("box", [[[2, 0, 2, 0]]], np.float32),
             number("corner", [[[0, 0, 1, 1]]], np.float32), number("always", True, np.bool_),
             number("many", 30_000_000), number("half", 0.5, np.float32),
             number("wall", np.linspace(0, 1, 40_000), np.float32)]  # fmt: skip
COUNTED = [
    helper.make_node("Mul", ["obs", "signs"], ["signed"]),
    helper.make_node("ReduceSum", ["signed"], ["sum"], keepdims=0),
    helper.make_node("Relu", ["sum"], ["positive"]),
    helper.make_node("Cast", ["positive"], ["count"], to=INT64),
]
ENDING = [
    helper.make_node("ReduceMax", ["slow"], ["last"], keepdims=0),
    helper.make_node("Cast", ["last"], ["number"], to=onnx.TensorProto.FLOAT),
    helper.make_node("Mul", ["number", "smallest"], ["shift"]),
    helper.make_node("Add", ["obs", "shift"], ["changed"]),
]
CONSTANTS.append(number("smallest", 0.0, np.float32))


def turning(turns: str) -> Any:
    """Return a loop of so many turns."""
    values = {"turn": (INT64, []), "go_on": (onnx.TensorProto.BOOL, []), "value": (onnx.TensorProto.FLOAT, None)}
    made = {
        name + end: helper.make_tensor_value_info(name + end, *kind)
        for name, kind in values.items()
        for end in ("", "2")
    }
    body = helper.make_graph(
        [helper.make_node("Identity", ["go_on"], ["go_on2"]), helper.make_node("Abs", ["value"], ["value2"])],
        "body", [made["turn"], made["go_on"], made["value"]], [made["go_on2"], made["value2"]],
    )  # fmt: skip
    return helper.make_node("Loop", [turns, "always", "obs"], ["slow"], body=body)


def branching() -> list[Any]:
    """Return nodes that turn thirty million times if the count is not zero."""
    made = helper.make_tensor_value_info("slow", onnx.TensorProto.FLOAT, None)
    long = helper.make_graph([turning("many")], "long", [], [made])
    short = helper.make_graph([helper.make_node("Identity", ["obs"], ["slow"])], "short", [], [made])
    return [
        helper.make_node("Cast", ["positive"], ["yes"], to=onnx.TensorProto.BOOL),
        helper.make_node("If", ["yes"], ["slow"], then_branch=long, else_branch=short),
    ]


def going_on() -> list[Any]:
    """Return a loop that ends when its condition, computed from an observation, does."""
    loop = turning("many")
    body = loop.attribute[0].g
    body.node[0].CopyFrom(helper.make_node("Greater", ["positive", "half"], ["go_on2"]))
    return [loop]


def growing(*nodes: Any) -> list[Any]:
    """Return nodes that multiply a column of so many numbers by a row of them."""
    return [
        *nodes,
        helper.make_node("Cast", ["list"], ["row"], to=onnx.TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["row", "nothings"], ["wide"]),
        helper.make_node("Unsqueeze", ["row", "ones"], ["high"]),
        helper.make_node("MatMul", ["high", "wide"], ["slow"]),
    ]


CONSTANTS.append(number("nothings", [0]))
SUPPRESSING = [
    helper.make_node("Range", ["nothing", "count", "one"], ["numbers"]),
    helper.make_node("Cast", ["numbers"], ["positions"], to=onnx.TensorProto.FLOAT),
    helper.make_node("Unsqueeze", ["positions", "axes"], ["column"]),
    helper.make_node("Mul", ["column", "box"], ["spread"]),
    helper.make_node("Add", ["spread", "corner"], ["boxes"]),
    helper.make_node("Unsqueeze", ["positions", "first"], ["scores"]),
    helper.make_node("NonMaxSuppression", ["boxes", "scores", "most"], ["slow"]),
]
SHAPED = helper.make_node("Reshape", ["count", "ones"], ["shape"])
SLOW: dict[str, list[Any]] = {
    "Range": SUPPRESSING,
    "Loop": [turning("count")],
    "If": branching(),
    "Loop that goes on": going_on(),
    "Range in a product": growing(helper.make_node("Range", ["nothing", "count", "one"], ["list"])),
    "Expand": growing(SHAPED, helper.make_node("Expand", ["half", "shape"], ["list"])),
    "ConstantOfShape": growing(SHAPED, helper.make_node("ConstantOfShape", ["shape"], ["list"])),
    "NonZero": growing(
        helper.make_node("Min", ["positive", "half"], ["height"]),
        helper.make_node("Less", ["wall", "height"], ["low"]),
        helper.make_node("NonZero", ["low"], ["found"]),
        helper.make_node("Squeeze", ["found", "nothings"], ["list"]),
    ),
}  # fmt: skip
HARMLESS: dict[str, list[Any]] = {
    "a fixed loop": [turning("one")],
    "a batch's size": [
        helper.make_node("Shape", ["obs"], ["size"]),
        helper.make_node("Expand", ["half", "size"], ["slow"]),
    ],
    "clamp": [helper.make_node("Min", ["positive", "half"], ["slow"])],
}


@pytest.mark.parametrize("kind", SLOW)
def test_a_graph_whose_time_depends_on_an_observation_is_refused(tmp_path: Path, kind: str) -> None:
    folder = write_box_policy(tmp_path)
    with_nodes(folder, *COUNTED, *SLOW[kind], *ENDING, constants=CONSTANTS)
    with pytest.raises(BundleError, match=r"the size, repetitions or branch of \w+ '\w+' depend on the observation"):
        Policy.load(folder)


@pytest.mark.parametrize("kind", HARMLESS)
def test_a_graph_whose_sizes_are_fixed_is_loaded(tmp_path: Path, kind: str) -> None:
    folder = write_box_policy(tmp_path)
    with_nodes(folder, *COUNTED, *HARMLESS[kind], *ENDING, constants=CONSTANTS)
    with Policy.load(folder) as policy:
        assert policy.act(OBS).shape == (6,)


def test_a_graph_that_always_takes_long_is_refused(tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path)
    with_nodes(folder, turning("many"), *ENDING, constants=CONSTANTS)
    with pytest.raises(
        BundleError, match=r"computed for \d+\.\d s on an observation of \de[+-]\d\d, and may take at most 1 s"
    ):
        Policy.load(folder, check_golden=False)


@pytest.mark.parametrize("name", ["policy.onnx", "golden.npz"])
def test_what_is_loaded_is_what_was_hashed(root: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = root / "ur5" / "2"

    def exchange_after(*arguments: Any, **named: Any) -> Any:
        bundle = load_bundle(*arguments, **named)
        shutil.copy(root / "ur5" / "1" / name, folder / name)
        return bundle

    monkeypatch.setattr("rlservo.policy.policy.load_bundle", exchange_after)
    with pytest.raises(BundleTamperedError, match=f"{name} is not the file that was exported"):
        Policy.load(folder)


def test_a_bundle_that_is_another_one_while_it_is_read_is_not_served_under_the_accepted_hash(root: Path) -> None:
    def other(folder: Path) -> Policy:
        return Policy.load(folder.with_name("1"))

    repository = Repository([root])
    version, digest = repository.look().find("ur5", "2")
    with pytest.raises(BundleTamperedError, match="is not the bundle that was accepted"):
        asyncio.run(VersionLoader(repository, other).load(("ur5", version, digest)))


class Stalled:
    """A file system that does not answer for one file until it is let go."""

    def __init__(self, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.file = file
        self.reached, self.go_on = threading.Event(), threading.Event()
        self.waiting = 0
        monkeypatch.setattr("rlservo.bundle.bundle.open_regular", self)

    def __call__(self, file: Path, max_bytes: int | None = None) -> Any:
        if file == self.file:
            self.waiting += 1
            self.reached.set()
            assert self.go_on.wait(60)
        return open_regular(file, max_bytes)


@pytest.fixture
def stall(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path], Stalled]]:
    made: list[Stalled] = []

    def stall(file: Path) -> Stalled:
        made.append(Stalled(file, monkeypatch))
        return made[-1]

    yield stall
    for one in made:
        one.go_on.set()


@pytest.mark.parametrize("name", ["contract.json", "policy.onnx"])
def test_while_a_file_system_does_not_answer_all_else_goes_on(
    url: str, admin: AdminClient, root: Path, policies: Path, name: str, stall: Callable[[Path], Stalled]
) -> None:
    folder = Path(shutil.copytree(policies / "ur5" / "10", root / "ur5" / "10"))
    stalled = stall(folder / name)
    loaded: list[dict[str, Any]] = []

    def load() -> None:
        with AdminClient(url, api_key=OPERATOR) as another:
            loaded.append(another.load("ur5", "10"))

    loading = threading.Thread(target=load)
    loading.start()
    try:
        assert stalled.reached.wait(20)
        work_goes_on(admin, url)
        assert loading.is_alive() and not loaded
    finally:
        stalled.go_on.set()
        loading.join(40)
    assert loaded[0]["versions"] == ["1", "2", "10"] and loaded[0]["default"] == "2"


@pytest.mark.parametrize(
    ("name", "patience", "sentence"),
    [("contract.json", {"timeout_s": 0.5}, "listing the policies took longer than 0.5 s and was"),
     ("policy.onnx", {"timeout_s": 0.5}, "loading policy 'ur5' version 10 took longer")],
    indirect=["patience"],
)  # fmt: skip
def test_a_file_system_that_hangs_is_given_up_with_a_few_threads_at_most(
    url: str,
    admin: AdminClient,
    root: Path,
    policies: Path,
    name: str,
    sentence: str,
    stall: Callable[[Path], Stalled],
) -> None:
    folder = Path(shutil.copytree(policies / "ur5" / "10", root / "ur5" / "10"))
    stalled = stall(folder / name)
    with pytest.raises(RlservoError, match=sentence):
        admin.load("ur5", "10")
    for _ in range(5):
        with pytest.raises(RlservoError, match=r"given up|could not start"):
            admin.load("ur5", "10")
    assert stalled.waiting <= 4
    work_goes_on(admin, url)
    stalled.go_on.set()
    for _ in range(100):
        try:
            assert admin.load("ur5", "10")["versions"] == ["1", "2", "10"]
            break
        except RlservoError:  # the machine may be busy, and half a second is little
            time.sleep(0.1)
    else:
        pytest.fail("the version does not load although the file system is back")


def test_a_process_whose_files_hang_follows_what_others_change_meanwhile(
    root: Path, tmp_path: Path, stall: Callable[[Path], Stalled], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rlservo.serve_app.versions.plan_files.FOLDER_POLL_S", 0.05)
    monkeypatch.setattr("rlservo.serve_app.versions.plan_follower.RETRY_PERIOD_S", 0.3)
    elsewhere = Path(shutil.copytree(root, tmp_path / "elsewhere"))

    async def run() -> None:
        controls: list[PlanFollower] = []
        for folder in (root, elsewhere):
            loader = VersionLoader(Repository([folder]), timeout_s=1)
            controls.append(PlanFollower(loader, plan_files(root)))
        config = {"policies": {"ur5": {"versions": ["1"]}, "gridworld": {}}, "unlisted": "ignore"}
        for control in controls:
            await control.configure(config)
        stalled = stall(elsewhere / "ur5" / "2" / "policy.onnx")

        def served() -> PolicyStore:
            assert controls[1].store is not None
            return controls[1].store

        watching = asyncio.create_task(
            repeat(controls[1].files.poll_s, controls[1].follow, "the plan cannot be followed")
        )
        await controls[0].give(Load(version="2"), "ur5")
        await until(lambda: controls[1].behind)
        assert controls[1].behind[0].startswith("loading policy 'ur5' version 2 took longer than 1 s")
        for number in range(5):  # of the other policy
            await controls[0].give(SetAlias(alias=f"alias{number}", version="1"), "gridworld")
            await until(lambda: f"alias{number}" in served().plans["gridworld"].aliases)  # noqa: B023 - awaited here
        stalled.go_on.set()
        await until(lambda: served().versions("ur5") == ("1", "2"))
        watching.cancel()
        assert controls[1].behind == ()

    asyncio.run(run())


def test_a_start_does_not_wait_in_silence_for_a_file_system_that_hangs(
    root: Path, stall: Callable[[Path], Stalled]
) -> None:
    stalled = stall(root / "ur5" / "1" / "contract.json")
    with pytest.raises(UnavailableError, match=r"listing the policies took longer than 0.3 s"):
        load_served([root], ServedConfig(), ServerSettings(load_timeout_s=0.3))
    stalled.go_on.set()


def test_a_functions_own_time_out_is_not_taken_for_ours() -> None:
    def fail() -> None:
        raise TimeoutError("of a network file system")

    with pytest.raises(TimeoutError, match="of a network"):
        asyncio.run(BlockingCalls(5).run("test", fail))


def test_threads_are_free_again_for_another_event_loop() -> None:
    calls = BlockingCalls(20, limit=1)
    for number in range(50):  # each loop ends as soon as it has its result
        assert asyncio.run(asyncio.wait_for(calls.run("test", int, number), 20)) == number


LOAD = """
import os, sys
from rlservo.policy.policy import Policy
import onnxruntime

def resident(what):
    line = next(line for line in open("/proc/self/status") if line.startswith(what))
    return int(line.split()[1]) / 1e3

Policy.load(sys.argv[1])
before = resident("VmRSS")
policy = Policy.load(sys.argv[2])
print(resident("VmHWM") - before, resident("VmRSS") - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_large_graph_is_in_memory_about_once(policies: Path, tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path, name="large")
    model = onnx.load(folder / "policy.onnx")
    rng = np.random.default_rng(0)
    wide = 5000
    model.graph.initializer.extend(
        [
            numpy_helper.from_array((rng.standard_normal((27, wide), np.float32) * 1e-2), "into"),
            numpy_helper.from_array((rng.standard_normal((wide, wide), np.float32) * 1e-2), "across"),
            numpy_helper.from_array((rng.standard_normal((wide, 27), np.float32) * 1e-2), "out_of"),
        ]
    )
    for node, (left, right) in zip(
        ("x1", "x2", "x3"), (("obs", "into"), ("x1", "across"), ("x2", "out_of")), strict=True
    ):
        model.graph.node.insert(int(node[1]) - 1, helper.make_node("MatMul", [left, right], [node]))
    first = next(node for node in model.graph.node if node.op_type == "Gemm")
    first.input[0] = "x3"
    onnx.save(model, folder / "policy.onnx")
    megabytes = (folder / "policy.onnx").stat().st_size / 1e6
    assert megabytes > 100
    contract = read_contract(folder)
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    obs = rng.standard_normal((8, 27)).astype(np.float32)
    names = [tensor.name for tensor in contract.outputs]
    outputs = dict(zip(names, session.run(names, {"obs": obs}), strict=True))
    bundle_files.write_golden(folder, {"obs": obs}, outputs)
    bundle_files.write_contract(folder, contract)
    done = subprocess.run(
        [sys.executable, "-c", LOAD, str(policies / "ur5" / "1"), str(folder)],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    peak, kept = (float(number) for number in done.stdout.split())
    # Measured: 1.5 and 1.0 times the file; from bytes it was 2.9 and 1.9.
    assert peak < 2.2 * megabytes and kept < 1.5 * megabytes, (peak, kept, megabytes)
