"""Small real bundles for the runtime and the server: an ONNX graph, TorchScript, golden vectors and hashes.

They are written with only `onnx.helper` and `rlservo.bundle.bundle`, so that these tests need no exporter.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from cache import cached, digest, versions
from checkpoints import APP, TRAINED_WITH
from rlservo.bundle import bundle as bundle_files
from rlservo.bundle.contract import (
    BakedStep,
    Contract,
    Distribution,
    FormatParity,
    Parity,
    Provenance,
    StateSpec,
    TensorSpec,
)
from rlservo.bundle.spaces import BoxSpec, DiscreteSpec, Element, leaf_specs
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.version_loader import VersionLoader
from stores import plan_files

if TYPE_CHECKING:
    from rlservo.export.export_checkpoint import ExportResult

ROOT = Path(__file__).resolve().parents[1]
OBS = 27
HIDDEN = 256
ACTIONS = 6
UR5_ELEMENTS = tuple(Element(name=f"element_{i}", unit="rad") for i in range(OBS))
PROVENANCE = Provenance(
    algorithm="PPO",
    api_stack="new",
    module_id="default_policy",
    module_class="DefaultPPOTorchRLModule",
    checkpoint_sha256="0" * 64,
    ray_version="2.60.0",
    torch_version="2.13.0",
    rlservo_version="0.1.0",
    exported_at="2026-01-01T00:00:00Z",
)
PARITY = Parity(
    reference="tests",
    samples=8,
    batch_sizes=(8,),
    rtol=1e-5,
    atol=1e-6,
    formats={"onnx": FormatParity(max_abs=0, max_rel=0)},
)


def contract_of(name: str, obs: Any, action: Any, *, version: str = "1", **more: Any) -> Contract:
    """Return the contract of a policy of these spaces; `more` are fields that differ from those of a plain one."""
    inputs, outputs = (
        tuple(TensorSpec(name=path, dtype=leaf.dtype, shape=(-1, *leaf.shape)) for path, leaf in leaves.items())
        for leaves in (leaf_specs(obs, "obs"), leaf_specs(action, "action"))
    )
    plain: dict[str, Any] = {
        "inputs": inputs, "outputs": outputs, "distribution": None, "baked_in": (BakedStep(step="network"),),
        "control_rate_hz": None, "provenance": PROVENANCE, "parity": PARITY,
    }  # fmt: skip
    return Contract(name=name, version=version, observation_space=obs, action_space=action, **{**plain, **more})


def weights(rng: np.random.Generator, rows: int, columns: int) -> NDArray[np.float32]:
    return (rng.standard_normal((rows, columns)) / np.sqrt(rows)).astype(np.float32)


def save_graph(
    file: Path,
    nodes: list[onnx.NodeProto],
    constants: dict[str, NDArray[Any]],
    inputs: list[tuple[str, int, list[Any]]],
    outputs: list[tuple[str, int, list[Any]]],
) -> None:
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(*tensor) for tensor in inputs],
        [helper.make_tensor_value_info(*tensor) for tensor in outputs],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, file)


def write_bundle(folder: Path, contract: Contract, obs: NDArray[Any], **more: NDArray[Any]) -> Path:
    """Complete a folder that holds policy.onnx: a file for TorchScript, golden vectors of `obs`, contract and hashes.

    `more` are further inputs by name, a dot written as two underscores.
    """
    # What loads and serves bundles checks its hash and never opens it; torch would take each process seconds to import.
    (folder / bundle_files.TORCHSCRIPT_FILE).write_bytes(b"no TorchScript: " + bytes(1000))
    session = onnxruntime.InferenceSession(folder / bundle_files.ONNX_FILE)
    names = [tensor.name for tensor in contract.outputs]
    inputs = {"obs": obs, **{name.replace("__", "."): array for name, array in more.items()}}
    outputs = dict(zip(names, session.run(names, inputs), strict=True))
    bundle_files.write_golden(folder, inputs, outputs)
    bundle_files.write_contract(folder, contract)
    return folder


def write_box_policy(
    root: Path,
    *,
    name: str = "ur5",
    version: str = "1",
    seed: int = 0,
    action_scale: float = 1.0,
    unbounded: bool = False,
    named: bool = True,
) -> Path:
    """A 27 -> 6 Gaussian policy with a 2x256 tanh network, unsquashed to [-1, 1] x [-2, 2] ... and clipped.

    `action_scale` above 1 leaves the clip out and lets actions walk out of the space.
    """
    rng = np.random.default_rng(seed)
    folder = root / name / version
    folder.mkdir(parents=True)
    high = np.array([1, 1, 1, 2, 1, 1], np.float32)
    constants = {
        "w1": weights(rng, OBS, HIDDEN),
        "w2": weights(rng, HIDDEN, HIDDEN),
        "w3": weights(rng, HIDDEN, ACTIONS),
        "b1": np.zeros(HIDDEN, np.float32),
        "b2": np.zeros(HIDDEN, np.float32),
        "b3": np.zeros(ACTIONS, np.float32),
        "log_std": np.full((1, ACTIONS), -1.0, np.float32),
        "low": -high,
        "high": high,
        "scale": high * np.float32(action_scale),
        "batch_of": np.array([0], np.int64),
        "six": np.array([ACTIONS], np.int64),
    }
    nodes = [
        helper.make_node("Gemm", ["obs", "w1", "b1"], ["z1"]),
        helper.make_node("Tanh", ["z1"], ["h1"]),
        helper.make_node("Gemm", ["h1", "w2", "b2"], ["z2"]),
        helper.make_node("Tanh", ["z2"], ["h2"]),
        helper.make_node("Gemm", ["h2", "w3", "b3"], ["mean"]),
        helper.make_node("Shape", ["obs"], ["shape"]),
        helper.make_node("Gather", ["shape", "batch_of"], ["batch"]),
        helper.make_node("Concat", ["batch", "six"], ["wide"], axis=0),
        helper.make_node("Expand", ["log_std", "wide"], ["log_stds"]),
        helper.make_node("Concat", ["mean", "log_stds"], ["action_dist_inputs"], axis=1),
        helper.make_node("Mul", ["mean", "scale"], ["scaled"]),
    ]
    if action_scale > 1 or unbounded:
        nodes.append(helper.make_node("Identity", ["scaled"], ["action"]))
    else:
        nodes.append(helper.make_node("Max", ["scaled", "low"], ["floored"]))
        nodes.append(helper.make_node("Min", ["floored", "high"], ["action"]))
    save_graph(
        folder / bundle_files.ONNX_FILE,
        nodes,
        constants,
        [("obs", TensorProto.FLOAT, ["batch", OBS])],
        [("action", TensorProto.FLOAT, ["batch", ACTIONS]), ("action_dist_inputs", TensorProto.FLOAT, ["batch", 12])],
    )
    bounds = tuple(high.tolist())
    contract = contract_of(
        name,
        BoxSpec(shape=(OBS,), dtype="float32", low=None, high=None, elements=UR5_ELEMENTS if named else ()),
        BoxSpec(
            shape=(ACTIONS,),
            dtype="float32",
            low=None if unbounded else tuple(-b for b in bounds),
            high=None if unbounded else bounds,
            elements=tuple(Element(name=f"joint_{i}", unit="rad", quantity="joint position") for i in range(ACTIONS)),
        ),
        version=version,
        outputs=tuple(
            TensorSpec(name=output, dtype="float32", shape=(-1, size))
            for output, size in (("action", ACTIONS), ("action_dist_inputs", 2 * ACTIONS))
        ),
        distribution=Distribution(kind="diag_gaussian", transform="none" if unbounded else "unsquash"),
        baked_in=(BakedStep(step="network"), BakedStep(step="clip")),
        control_rate_hz=10.0,
    )
    # Small golden observations keep the actions of an unclipped policy inside its space.
    obs = (rng.standard_normal((8, OBS)) * (0.05 if action_scale > 1 else 1.0)).astype(np.float32)
    return write_bundle(folder, contract, obs)


def write_slow_policy(root: Path, *, version: str) -> Path:
    """`write_box_policy` with a loop around nothing, which takes about a tenth of a second for each request."""
    folder = write_box_policy(root, version=version)
    model = onnx.load(folder / bundle_files.ONNX_FILE)
    kinds = {"turn": TensorProto.INT64, "go_on": TensorProto.BOOL, "value": TensorProto.FLOAT}
    infos = {
        name + end: helper.make_tensor_value_info(name + end, kind, None if name == "value" else [])
        for name, kind in kinds.items()
        for end in ("", "_out")
    }
    nodes = [helper.make_node("Identity", [name], [f"{name}_out"]) for name in ("go_on", "value")]
    inputs = [infos[name] for name in kinds]
    body = helper.make_graph(nodes, "body", inputs, [infos["go_on_out"], infos["value_out"]])
    for name, value in (("turns", 30_000), ("always", True)):
        model.graph.initializer.append(numpy_helper.from_array(np.array(value), name))
    next(node for node in model.graph.node if node.op_type == "Gemm").input[0] = "looped"
    model.graph.node.insert(0, helper.make_node("Loop", ["turns", "always", "obs"], ["looped"], body=body))
    onnx.save(model, folder / bundle_files.ONNX_FILE)
    bundle_files.write_contract(folder, bundle_files.read_contract(folder))  # with the hashes of what is there now
    return folder


def write_discrete_policy(root: Path, *, name: str = "gridworld", version: str = "1", start: int = 0) -> Path:
    """A Discrete(5) observation, one-hot, to a Discrete(3) action by argmax of a linear layer."""
    rng = np.random.default_rng(1)
    folder = root / name / version
    folder.mkdir(parents=True)
    constants = {
        "depth": np.array(5, np.int64),
        "zero_one": np.array([0, 1], np.float32),
        "w": weights(rng, 5, 3),
        "b": np.zeros(3, np.float32),
        "start": np.array(start, np.int64),
    }
    nodes = [
        helper.make_node("OneHot", ["obs", "depth", "zero_one"], ["hot"]),
        helper.make_node("Gemm", ["hot", "w", "b"], ["action_dist_inputs"]),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["index"], axis=1, keepdims=0),
        helper.make_node("Add", ["index", "start"], ["action"]),
    ]
    save_graph(
        folder / bundle_files.ONNX_FILE,
        nodes,
        constants,
        [("obs", TensorProto.INT64, ["batch"])],
        [("action", TensorProto.INT64, ["batch"]), ("action_dist_inputs", TensorProto.FLOAT, ["batch", 3])],
    )
    contract = contract_of(
        name,
        DiscreteSpec(n=5),
        DiscreteSpec(n=3, start=start),
        version=version,
        outputs=(
            TensorSpec(name="action", dtype="int64", shape=(-1,)),
            TensorSpec(name="action_dist_inputs", dtype="float32", shape=(-1, 3)),
        ),
        distribution=Distribution(kind="categorical", transform="none"),
        baked_in=(BakedStep(step="one_hot"), BakedStep(step="network")),
    )
    return write_bundle(folder, contract, np.arange(5, dtype=np.int64))


def write_leaky_policy(
    root: Path, *, name: str = "leaky", version: str = "1", seed: int = 0, like: Contract | None = None
) -> Path:
    """A policy with a memory, of three numbers: h becomes h / 2 + obs @ w, and h in [-1, 1] is the action of two.

    With `like` it has the spaces, and so the sizes, of that contract, and was trained where that was.
    """
    observed = BoxSpec(shape=(3,), dtype="float32", low=None, high=None) if like is None else like.observation_space
    acted = BoxSpec(shape=(2,), dtype="float32", low=-1.0, high=1.0) if like is None else like.action_space
    sees, does = observed.size, acted.size
    rng = np.random.default_rng(seed)
    folder = root / name / version
    folder.mkdir(parents=True)
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["seen"]),
        helper.make_node("Mul", ["state_in.h", "half"], ["left"]),
        helper.make_node("Add", ["left", "seen"], ["state_out.h"]),
        helper.make_node("Clip", ["state_out.h", "low", "high"], ["action"]),
    ]
    constants = {"w": weights(rng, sees, does), "half": np.float32([0.5]), "low": np.float32(-1), "high": np.float32(1)}
    save_graph(
        folder / bundle_files.ONNX_FILE,
        nodes,
        {key: np.asarray(value) for key, value in constants.items()},
        [("obs", TensorProto.FLOAT, ["batch", sees]), ("state_in.h", TensorProto.FLOAT, ["batch", does])],
        [("action", TensorProto.FLOAT, ["batch", does]), ("state_out.h", TensorProto.FLOAT, ["batch", does])],
    )
    inputs, outputs = (
        tuple(TensorSpec(name=each, dtype="float32", shape=(-1, size)) for each, size in tensors.items())
        for tensors in ({"obs": sees, "state_in.h": does}, {"action": does, "state_out.h": does})
    )
    contract = contract_of(
        name,
        observed,
        acted,
        version=version,
        inputs=inputs,
        outputs=outputs,
        state=(StateSpec(name="h", dtype="float32", shape=(does,)),),
        baked_in=(BakedStep(step="network"), BakedStep(step="clip")),
        control_rate_hz=10.0,
        provenance=PROVENANCE if like is None else like.provenance,
    )
    obs, state = (rng.standard_normal((8, size)).astype(np.float32) for size in (sees, does))
    return write_bundle(folder, contract, obs, state_in__h=state)


@pytest.fixture(scope="session")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository: ur5 in versions 1, 2 and 10 (different weights), gridworld in version 1."""
    root = tmp_path_factory.mktemp("policies")
    for seed, version in enumerate(("1", "2", "10")):
        write_box_policy(root, version=version, seed=seed)
    write_discrete_policy(root)
    return root


@pytest.fixture(scope="session")
def ur5(policies: Path) -> Path:
    """The newest ur5 bundle."""
    return policies / "ur5" / "10"


def rewrite_contract(folder: Path, **changes: Any) -> None:
    """Change fields of a bundle's contract and record the hashes again: tampering that hashes cannot see."""
    bundle_files.write_contract(folder, bundle_files.read_contract(folder).model_copy(update=changes))


EXPORTED_WITH = versions("ray", "torch", "onnx", "onnxscript", "onnxruntime", "gymnasium", "numpy")
PRODUCT = [ROOT / folder for folder in ("rlservo", "export", "envs")]  # what an export runs through


@functools.cache
def _exporting_code() -> str:
    """A word for what an export runs through, its own code and others'."""
    return digest([*PRODUCT, APP, EXPORTED_WITH])


@functools.cache
def _exported_checkpoint(checkpoint: Path, module_id: str | None) -> Path:
    def export(out: Path) -> None:
        from rlservo.export.export_checkpoint import export_checkpoint

        how: dict[str, Any] = {"name": "policy", "app_dir": APP, "module_id": module_id}
        export_checkpoint(checkpoint, out, notify=lambda line: None, **how)

    name = "-".join(["exported", checkpoint.name, *([module_id] if module_id else [])])
    return cached(name, [checkpoint, _exporting_code(), str(module_id)], export) / "policy" / "1"


@pytest.fixture(scope="session")
def exported() -> Callable[..., ExportResult]:
    """Return a function that gives the export of a checkpoint, of one of its modules. Its files: not to be written to.

    Tests of the exporting itself, of what it says and of its other options, call `export_checkpoint`.
    """
    from rlservo.export.export_checkpoint import ExportResult

    def export(checkpoint: Path, module_id: str | None = None) -> ExportResult:
        path = _exported_checkpoint(checkpoint, module_id)
        return ExportResult(path, bundle_files.read_contract(path))

    return export


RECURRENT = ("lstm_box", "lstm_previous", "act_nested")
SHIPPED = {  # by the name they are served under
    "ur5": "ur_positioning",
    "mir100": "mir100_navigation",
    "mir100_obstacle_avoidance": "mir100_obstacle_avoidance_waiting",
}


@pytest.fixture(scope="session")
def recurrent(wide_zoo: Path) -> Path:
    """A repository of three LSTM policies, trained for one iteration by RLlib and exported. Not to be written to.

    lstm_box: 3 numbers to a Box; lstm_previous: sees its last actions and rewards; act_nested: nested both ways.
    """

    def export(out: Path) -> None:
        from rlservo.export.export_checkpoint import export_checkpoint

        for name in RECURRENT:
            export_checkpoint(wide_zoo / name, out, name=name, app_dir=APP, notify=lambda line: None)

    return cached("recurrent-policies", [*RECURRENT, *TRAINED_WITH, *PRODUCT, EXPORTED_WITH], export)


def _exported(name: str, checkpoints: Mapping[str, str]) -> Path:
    """Return a repository of shipped checkpoints, by the names given here."""
    pytest.importorskip("torch")  # the newest Python runs the unit tests without
    folders = {served: ROOT / "examples" / "checkpoints" / checkpoint for served, checkpoint in checkpoints.items()}

    def export(out: Path) -> None:
        from rlservo.export.export_checkpoint import export_checkpoint

        for served, folder in folders.items():
            export_checkpoint(folder, out, name=served, notify=lambda line: None)

    return cached(name, [*folders, *folders.values(), *PRODUCT, EXPORTED_WITH], export)


@pytest.fixture(scope="session")
def shipped() -> Path:
    """A repository of the shipped policies for robo-gym's tasks, by the names in SHIPPED. Not to be written to."""
    return _exported("shipped-policies", SHIPPED)


@pytest.fixture(scope="session")
def all_shipped() -> Path:
    """A repository of every shipped policy, by the name of its checkpoint. Not to be written to."""
    names = [path.parent.name for path in (ROOT / "examples" / "checkpoints").glob("*/training.yaml")]
    return _exported("all-shipped-policies", {name: name for name in sorted(names)})


@contextlib.contextmanager
def controlled(*folders: Path, config: Any = None, **loader: Any) -> Iterator[PlanFollower]:
    """Control over what is served of some folders, for an application that can be administered."""
    loads = VersionLoader(Repository(list(folders)), **loader)
    with tempfile.TemporaryDirectory() as plans:
        control = PlanFollower(loads, plan_files(Path(plans)))
        asyncio.run(control.configure({} if config is None else config))
        yield control
