"""Given ONNX files of several origins, answered through Policy.load and by onnxruntime on the given file.

Metadata and the files beside are written as each origin's own exporter does it; none of our reader's code is used.
"""

from __future__ import annotations

import itertools
import json
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from command_line import rlservo_here
from rlservo.errors import CheckpointError, RlservoError, UnsupportedError, UsageError
from rlservo.export.compiled.compile import compile_bundle
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.verify_bundle import verify_bundle
from rlservo.policy.policy import Policy
from servers import ask, served_in_thread

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT

JOINTS = ["pan", "lift", "elbow"]
DEFAULT = [-0.312, 0.669, 0.25]
SCALE = [0.5, 0.25, 1.5]


def network(sizes: Sequence[int], *, batch: Any = "batch", name: str = "obs", out: str = "actions") -> Any:
    """A normalizer, as rsl_rl puts it into the graph, and layers with ELU."""
    rng = np.random.default_rng(1)
    weights = {"mean": rng.normal(size=(1, sizes[0])), "std": rng.uniform(0.5, 2.0, (1, sizes[0]))}
    nodes = [helper.make_node("Sub", [name, "mean"], ["a"]), helper.make_node("Div", ["a", "std"], ["x0"])]
    for layer, (rows, columns) in enumerate(itertools.pairwise(sizes)):
        weights |= {f"w{layer}": rng.normal(0.0, rows**-0.5, (columns, rows)), f"b{layer}": rng.normal(size=columns)}
        last = layer == len(sizes) - 2
        result = out if last else f"h{layer}"
        nodes.append(helper.make_node("Gemm", [f"x{layer}", f"w{layer}", f"b{layer}"], [result], transB=1))
        if not last:
            nodes.append(helper.make_node("Elu", [f"h{layer}"], [f"x{layer + 1}"]))
    graph = helper.make_graph(
        nodes,
        "main_graph",
        [helper.make_tensor_value_info(name, FLOAT, [batch, sizes[0]])],
        [helper.make_tensor_value_info(out, FLOAT, [batch, sizes[-1]])],
        [onnx.numpy_helper.from_array(values.astype(np.float32), key) for key, values in weights.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def write(model: Any, file: Path, metadata: Mapping[str, str] | None = None) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    for key, value in (metadata or {}).items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.save(model, str(file))
    return file


@dataclass(frozen=True)
class Given:
    """A file, and what it means by its origin's documentation."""

    path: Path
    model: Path
    rate: float | None
    scale: Any = 1.0
    offset: Any = 0.0
    clip: tuple[float, float] = (-np.inf, np.inf)
    state: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)


MJLAB = {
    "run_path": "brisk-cloud-42",
    "joint_names": "pan,lift,elbow",
    "joint_stiffness": "40.000,40.000,20.000",
    "joint_damping": "1.000,1.500,1.000",
    "default_joint_pos": "-0.312,0.669,0.250",
    "command_names": "twist",
    "observation_names": "base_ang_vel,joint_pos,joint_vel,actions,command",
    "observation_terms_scale": "0.250,1.000,0.050,1.000,1.000;2.000",
    "observation_terms_clip": "-inf;inf,-inf;inf,-inf;inf,-100.000;100.000,-inf;inf",
    "observation_terms_history_length": "0.000,0.000,0.000,0.000,0.000",
    "observation_terms_flatten_history_dim": "1.000,1.000,1.000,1.000,1.000",
    "action_scale": "0.500,0.250,1.500",
}


def mjlab(folder: Path, **changed: str) -> Given:
    file = write(network([14, 8, 3], batch=1), folder / "2026-11-28.onnx", MJLAB | changed)
    return Given(file, file, 50.0, SCALE, DEFAULT, options={"control_rate_hz": 50.0})


def descriptors(**changed: Any) -> dict[str, Any]:
    def term(name: str, size: int, **others: Any) -> dict[str, Any]:
        overloads = {"clip": None, "flatten_history_dim": True, "history_length": 0, "scale": None}
        return {
            "dtype": "torch.float32", "extras": {"description": "...", "modifiers": None, "units": "rad"},
            "full_path": f"isaaclab.envs.mdp.observations.{name}", "mdp_type": "Observation", "name": name,
            "observation_type": "JointState", "overloads": overloads, "shape": [size], **others,
        }  # fmt: skip

    joints = {"joint_names": JOINTS, "joint_pos_offsets": DEFAULT}
    action = {
        "action_type": "JointAction", "clip": [[-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]], "dtype": "torch.float32",
        "extras": {"description": "..."}, "joint_names": JOINTS, "mdp_type": "Action", "name": "joint_position_action",
        "full_path": "isaaclab.envs.mdp.actions.joint_actions.JointPositionAction", "offset": DEFAULT, "scale": 0.5,
        "shape": [3],
    }  # fmt: skip
    robot = {"joint_names": JOINTS, "default_joint_pos": DEFAULT, "default_joint_stiffness": [800.0, 800.0, 400.0],
             "default_joint_damping": [40.0, 40.0, 20.0]}  # fmt: skip
    return {
        "observations": {"policy": [term("joint_pos_rel", 3, **joints), term("joint_vel_rel", 3, joint_names=JOINTS),
                                    term("generated_commands", 7), term("last_action", 3)]},
        "actions": [action],
        "articulations": {"robot": robot},
        "scene": {"physics_dt": 0.005, "dt": 0.02, "decimation": 4},
    } | changed  # fmt: skip


def isaac_lab(folder: Path, **changed: Any) -> Given:
    """The LSTM of rsl_rl, exported as its exporter does it: states `[layers, batch, n]`."""
    torch.manual_seed(0)

    class Recurrent(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.rnn, self.head = torch.nn.LSTM(16, 8, num_layers=2), torch.nn.Linear(8, 3)

        def forward(self, obs: Any, h: Any, c: Any) -> Any:
            x, (h, c) = self.rnn(obs.unsqueeze(0), (h, c))
            return self.head(x.squeeze(0)), h, c

    file = folder / "exported" / "policy.onnx"
    file.parent.mkdir(parents=True)
    zeros = torch.zeros(2, 1, 8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Recurrent().eval(), (torch.zeros(1, 16), zeros, zeros), str(file), opset_version=18, dynamo=False,
            input_names=["obs", "h_in", "c_in"], output_names=["actions", "h_out", "c_out"],
        )  # fmt: skip
    (folder / "io_descriptors").mkdir()
    (folder / "io_descriptors" / "IO_descriptors.yaml").write_text(yaml.safe_dump(descriptors(**changed)))
    return Given(file, file, 50.0, 0.5, DEFAULT, (-1.0, 1.0), {"h_in": "h_out", "c_in": "c_out"})


def microduck(folder: Path, **changed: Any) -> Given:
    file = write(network([61, 16, 14]), folder / "policy.onnx")
    manifest = {
        "schema_version": 2, "model_api": 1, "obs_len": 61, "action_len": 14,
        "robot": {"model": "microduck", "hw_rev": 1, "servos": "xl330", "control_hz": 50}, "name": "polite-bow",
        "kind": "episodic", "duration_s": 4.0, "entry_pose": "standing",
        "training": {"task_id": "Mjlab-PoliteBow-Flat-MicroDuck", "dirty": False, "checkpoint": 3000},
    }  # fmt: skip
    (folder / "manifest.json").write_text(json.dumps(manifest | changed))
    return Given(folder, file, 50.0, clip=(-2.0, 2.0), options={"action_range": (-2.0, 2.0)})


def physicalai(folder: Path, **changed: Any) -> Given:
    file = write(network([3, 8, 3], name="observation.state", out="action"), folder / "model.onnx")
    feature = {"class_path": "physicalai.inference.data.features.InferenceFeature",
               "init_args": {"ftype": "STATE", "shape": [3], "name": "observation.state"}}  # fmt: skip
    side = {"shape": [3], "dtype": "float32", "order": JOINTS}
    manifest = {
        "format": "policy_package", "version": "1.0", "policy": {"name": "mlp", "source": {"repo_id": "user/mlp"}},
        "model": {"runner": {"type": "single_pass"}, "artifacts": {"model": "model.onnx"}, "input_features": [feature]}
        | changed,
        "hardware": {"robots": [{"name": "main", "type": "Koch v1.1", "state": side, "action": side}]},
    }  # fmt: skip
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return Given(folder, file, None)


def unitree(folder: Path, **changed: Any) -> Given:
    """unitree_rl_lab's run: exported/policy.onnx and params/deploy.yaml, each observation five times."""
    file = write(network([5 * (3 + 3 + 3 + 3), 8, 3], batch=1), folder / "exported" / "policy.onnx")

    def term(scale: float) -> dict[str, Any]:
        return {"params": {}, "clip": None, "scale": [scale] * 3, "history_length": 5}

    config = {
        "joint_ids_map": [0, 2, 1], "step_dt": 0.02, "stiffness": [100.0, 150.0, 40.0], "damping": [2.0, 4.0, 2.0],
        "default_joint_pos": DEFAULT, "commands": {},
        "actions": {"JointPositionAction": {"clip": None, "joint_names": [".*"], "scale": [0.25] * 3, "offset": DEFAULT,
                                            "joint_ids": None}},
        "observations": {"base_ang_vel": term(0.2), "velocity_commands": term(1.0), "joint_pos_rel": term(1.0),
                         "last_action": term(1.0)},
    }  # fmt: skip
    (folder / "params").mkdir()
    (folder / "params" / "deploy.yaml").write_text(yaml.dump(config | changed, default_flow_style=None))
    return Given(file, file, 50.0, 0.25, DEFAULT, options={"joint_order": JOINTS})


def exploy(folder: Path) -> Given:
    """Several inputs, a memory by its name's ends, and outputs beside the action."""
    inputs = {"obj.robot.joint_pos": [1, 3], "cmd.se2": [1, 3], "memory.last.in": [1, 3]}
    nodes = [
        helper.make_node("Add", ["obj.robot.joint_pos", "cmd.se2"], ["sum"]),
        helper.make_node("Sub", ["sum", "memory.last.in"], ["obs"]),
        helper.make_node("Tanh", ["obs"], ["actions"]),
        helper.make_node("Identity", ["actions"], ["memory.last.out"]),
    ]
    outputs = {"actions": [1, 3], "memory.last.out": [1, 3], "height": [1, 1]}
    nodes.append(helper.make_node("ReduceMean", ["obs"], ["height"], axes=[1]))
    sides = ([helper.make_tensor_value_info(n, FLOAT, s) for n, s in each.items()] for each in (inputs, outputs))
    graph = helper.make_graph(nodes, "env", *sides)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    file = write(model, folder / "policy.onnx")
    return Given(file, file, None, state={"memory.last.in": "memory.last.out"})


ORIGINS = [mjlab, isaac_lab, microduck, physicalai, unitree, exploy]
Origin = Callable[..., Given]


def export(given: Given, out: Path, notices: list[str] | None = None, **options: Any) -> ExportResult:
    notify = (lambda _: None) if notices is None else notices.append
    return export_checkpoint(given.path, out, name="given", notify=notify, **{**given.options, **options})


def episode(given: Given, steps: int) -> tuple[list[dict[str, Any]], list[Any]]:
    """Return observations and what onnxruntime and the origin's documentation make of them."""
    session = onnxruntime.InferenceSession(str(given.model))
    shapes = {one.name: [s if isinstance(s, int) else 1 for s in one.shape] for one in session.get_inputs()}
    state = {name: np.zeros(shapes[name], np.float32) for name in given.state}
    rng, seen, sent = np.random.default_rng(3), [], []
    for _ in range(steps):
        obs = {n: rng.normal(size=s).astype(np.float32) for n, s in shapes.items() if n not in state}
        found = dict(zip([one.name for one in session.get_outputs()], session.run(None, obs | state), strict=True))
        state = {name: found[output] for name, output in given.state.items()}
        action = found.get("actions", found.get("action"))
        seen.append(obs)
        sent.append(np.clip(np.asarray(given.scale) * action[0] + np.asarray(given.offset), *given.clip))
    return seen, sent


def row(obs: Mapping[str, Any]) -> Any:
    rows = {name: values[0] for name, values in obs.items()}
    return rows if len(rows) > 1 else next(iter(rows.values()))


@pytest.fixture(scope="module", params=ORIGINS, ids=lambda origin: origin.__name__)
def given(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Given:
    made: Given = request.param(tmp_path_factory.mktemp("origin"))
    return made


@pytest.fixture(scope="module")
def bundle(given: Given, tmp_path_factory: pytest.TempPathFactory) -> ExportResult:
    return export(given, tmp_path_factory.mktemp("out"))


def test_a_file_of_each_origin_acts_as_onnxruntime_and_its_documentation_say(
    given: Given, bundle: ExportResult
) -> None:
    contract = bundle.contract
    assert contract.control_rate_hz == (None if given.rate is None else pytest.approx(given.rate))
    assert "taken as given: no trainer was asked" in contract.parity.reference
    with Policy.load(bundle.path) as policy:
        for _ in range(2):
            policy.reset()
            for obs, wanted in zip(*episode(given, 12), strict=True):
                np.testing.assert_allclose(policy.act(row(obs)), wanted, rtol=1e-5, atol=2e-6)


def test_it_is_served_and_compiled(given: Given, bundle: ExportResult, tmp_path: Path) -> None:
    (obs,), (wanted,) = episode(given, 1)
    seen = row(obs)
    as_json = {name: values.tolist() for name, values in seen.items()} if isinstance(seen, dict) else seen.tolist()
    body = {"obs": as_json} | ({"session_id": "one", "reset": True, "seq": 1} if bundle.contract.state else {})
    with served_in_thread([bundle.path.parents[1]]) as port:
        status, reply = ask(port, "POST", "/v1/policies/given/act", body)
    assert status == 200, reply
    np.testing.assert_allclose(reply["action"], wanted, rtol=1e-5, atol=2e-6)
    proof = compile_bundle(bundle.path, tmp_path / "c").proof
    assert proof is not None or shutil.which("cc") is None


def test_verify_compares_it_again_with_the_exports_options(given: Given, bundle: ExportResult) -> None:
    parity = verify_bundle(bundle.path, given.path, notify=lambda _: None).parity
    assert parity.reference == bundle.contract.parity.reference
    assert parity.samples > 500


def elements(result: ExportResult, side: str) -> list[tuple[Any, ...]]:
    space: Any = getattr(result.contract, f"{side}_space")
    return [(e.name, e.unit, e.quantity, e.scale, e.offset) for e in space.elements]


def test_mjlab_names_become_elements_and_what_is_missing_is_asked_in_one_sentence(
    tmp_path: Path, notices: list[str]
) -> None:
    result = export(mjlab(tmp_path), tmp_path / "out", notices, control_rate_hz=None)
    assert elements(result, "action")[1] == ("lift", "rad", "joint position", 1.0, 0.0)
    observed = elements(result, "observation")
    assert observed[0] == ("base_ang_vel_x", "rad/s", "angular velocity", 4.0, None)
    assert observed[3] == ("joint_pos_pan", "rad", None, 1.0, None)  # it may be relative to default_joint_pos
    assert observed[6] == ("joint_vel_pan", "rad/s", "joint velocity", 20.0, None)
    assert observed[10] == ("actions_lift", "", "last action", SCALE[1], DEFAULT[1])
    assert [name for name, *_ in observed[12:]] == ["command_0", "command_1"]
    assert [one for one in notices if "clips 'actions' of the observation to -100 to 100, the export does not" in one]
    (asked,) = [notice for notice in notices if "range" in notice]
    assert asked == "no file says the action's range (--action-range), nor the control rate (--control-rate)"


def test_isaac_labs_descriptors_give_offsets_rate_and_clip(tmp_path: Path, notices: list[str]) -> None:
    result = export(isaac_lab(tmp_path), tmp_path / "out", notices)
    assert elements(result, "observation")[1] == ("joint_pos_rel_lift", "rad", "joint position", 1.0, 0.669)
    assert result.contract.action_space.low == -1.0  # type: ignore[union-attr]
    assert [leaf.name for leaf in result.contract.state] == ["h", "c"]
    assert notices == []


def test_a_term_of_another_package_or_with_a_modifier_is_only_a_name(tmp_path: Path, notices: list[str]) -> None:
    """It may be in degrees, or scaled once more."""
    described = descriptors()["observations"]["policy"]
    described[0]["full_path"] = "my_robot.observations.joint_pos_rel"
    described[1]["extras"]["modifiers"] = [{"func": "isaaclab.utils.modifiers.scale", "params": {"multiplier": 2.0}}]
    described[1]["overloads"]["clip"] = [-1.0, 1.0]
    given = isaac_lab(tmp_path, observations={"policy": described})
    result = export(given, tmp_path / "out", notices)
    assert {(unit, quantity) for _, unit, quantity, *_ in elements(result, "observation")[:6]} == {("", None)}
    assert [one for one in notices if "clips 'joint_vel_rel' of the observation to -1 to 1" in one]


def test_only_the_last_of_a_history_is_what_a_robot_measures_now(tmp_path: Path) -> None:
    given = unitree(tmp_path)
    config = yaml.safe_load((tmp_path / "params" / "deploy.yaml").read_text())
    config["actions"]["JointPositionAction"] |= {"joint_ids": [2, 0, 1], "offset": [DEFAULT[2], DEFAULT[0], DEFAULT[1]]}
    (tmp_path / "params" / "deploy.yaml").write_text(yaml.safe_dump(config))
    result = export(given, tmp_path / "out")
    assert [name for name, *_ in elements(result, "action")] == ["elbow", "pan", "lift"]
    observed = elements(result, "observation")
    assert observed[0] == ("base_ang_vel_x_4_before", "", None, None, None)
    assert {quantity for *_, quantity, _, _ in observed[:12]} == {None}
    assert observed[12] == ("base_ang_vel_x_0_before", "rad/s", "angular velocity", 5.0, None)


@pytest.mark.parametrize(
    "names", ["base_ang_vel,joint_pos,joint_vel,actions,anchor", "joint_pos,joint_vel,anchor,actions,x"]
)
def test_terms_whose_joints_no_file_says_are_named_only_if_their_sizes_add_up(names: str, tmp_path: Path) -> None:
    """The rest of the observation was taken for the one unknown term, whatever joints the others had."""
    result = export(mjlab(tmp_path, observation_names=names, observation_terms_scale="1,1,1,1,1"), tmp_path / "out")
    assert elements(result, "observation") == []


def env_yaml(folder: Path, **changed: Any) -> None:
    """Isaac Lab's params/env.yaml of the run that `folder` is."""
    action = {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointPositionAction", "asset_name": "robot",
        "joint_names": JOINTS, "scale": 0.5, "offset": 0.0, "preserve_order": True, "use_default_offset": True,
        "clip": {".*": [-1.0, 1.0]},
    }  # fmt: skip
    state = {"joint_pos": dict(zip(JOINTS, DEFAULT, strict=True))}
    env = {"decimation": 4, "sim": {"dt": 0.005}, "scene": {"robot": {"init_state": state}},
           "actions": {"arm": action | changed}}  # fmt: skip
    (folder / "params").mkdir(exist_ok=True)
    (folder / "params" / "env.yaml").write_text(yaml.safe_dump(env))


def test_the_runs_own_numbers_are_taken_and_not_those_that_metadata_rounds(tmp_path: Path, notices: list[str]) -> None:
    rounded = {"action_scale": "0.000,0.000,0.000"}
    with pytest.raises(CheckpointError, match=r"action_scale is 0\.000,.* a joint with 0 would never move"):
        export(mjlab(tmp_path / "without", **rounded), tmp_path / "out")
    given = replace(mjlab(tmp_path, **rounded), scale=0.0004, clip=(-1.0, 1.0))
    env_yaml(tmp_path, scale=0.0004)
    with Policy.load(export(given, tmp_path / "out", notices).path) as policy:
        for obs, wanted in zip(*episode(given, 5), strict=True):
            np.testing.assert_allclose(policy.act(row(obs)), wanted, rtol=1e-5, atol=2e-6)
    export(mjlab(tmp_path / "other" / "small", action_scale="0.012,0.5,0.5"), tmp_path / "out", notices)
    assert [one for one in notices if "action_scale is 0.012,0.5,0.5, rounded: " in one and "by 4%" in one]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"scale": 0.25}, r"has the scale \[0.25.* in .*env.yaml, but \[0.5"),
        ({"clip": None}, r"has the clip \[\] in .*env.yaml, but \[-1.0"),
        ({"class_type": "isaaclab.envs.mdp.actions.joint_actions:JointVelocityAction", "use_default_offset": False,
          "offset": dict(zip(JOINTS, DEFAULT, strict=True))}, "has the class .*JointVelocityAction"),
    ],
)  # fmt: skip
def test_files_of_a_run_that_differ_are_refused(changed: dict[str, Any], words: str, tmp_path: Path) -> None:
    given = isaac_lab(tmp_path)
    env_yaml(tmp_path, **changed)
    with pytest.raises(CheckpointError, match=words):
        export(given, tmp_path / "out")


@pytest.mark.parametrize("origin", [isaac_lab, mjlab, unitree])
def test_the_actions_of_a_run_are_clipped_before_they_are_scaled(origin: Origin, tmp_path: Path) -> None:
    """By the wrapper that rsl_rl trains behind: `torch.clamp(actions, -clip_actions, clip_actions)`."""
    given = origin(tmp_path)
    agent = tmp_path / "params" / "agent.yaml"
    agent.parent.mkdir(exist_ok=True)
    agent.write_text(yaml.safe_dump({"class_name": "OnPolicyRunner", "clip_actions": 0.05}))
    scale, offset = np.asarray(given.scale), np.asarray(given.offset)
    seen, unclipped = episode(replace(given, scale=1.0, offset=0.0, clip=(-np.inf, np.inf)), 12)
    with Policy.load(export(given, tmp_path / "out").path) as policy:
        for obs, raw in zip(seen, unclipped, strict=True):
            wanted = np.clip(np.clip(raw, -0.05, 0.05) * scale + offset, *given.clip)
            np.testing.assert_allclose(policy.act(row(obs)), wanted, rtol=1e-5, atol=2e-6)
    assert np.abs(unclipped).max() > 0.05


@pytest.mark.parametrize("history", [0, 3])
def test_a_relative_action_is_added_to_the_newest_position_that_is_observed(
    history: int, tmp_path: Path, notices: list[str]
) -> None:
    described = descriptors()
    described["actions"][0] |= {
        "full_path": "isaaclab.envs.mdp.actions.joint_actions.RelativeJointPositionAction", "offset": 0.0,
        "clip": [[-0.02, 0.02], [-0.5, 0.5], [-0.5, 0.5]],
    }  # fmt: skip
    policy_terms = described["observations"]["policy"]
    if history:  # three positions of three joints and seven of the command are as many as before
        del policy_terms[3], policy_terms[1]
        policy_terms[0]["overloads"]["history_length"] = history
    given = isaac_lab(tmp_path, actions=described["actions"], observations=described["observations"])
    result = export(given, tmp_path / "out", notices)
    assert {element[2] for element in elements(result, "action")} == {"joint position"}
    newest = slice(6, 9) if history else slice(0, 3)  # a term's history begins with the oldest
    seen, raw = episode(replace(given, scale=1.0, offset=0.0, clip=(-np.inf, np.inf)), 12)
    steps = np.clip(0.5 * np.asarray(raw), [-0.02, -0.5, -0.5], [0.02, 0.5, 0.5])
    assert (np.abs(steps[:, 0]) == 0.02).any() and (np.abs(steps[:, 1:]) < 0.5).all()
    with Policy.load(result.path) as policy:
        for obs, step in zip(seen, steps, strict=True):
            positions = np.asarray(row(obs))[newest] + DEFAULT
            np.testing.assert_allclose(policy.act(row(obs)), step + positions, rtol=1e-5, atol=2e-6)


def test_an_action_term_of_another_package_is_not_isaac_labs_by_its_name(tmp_path: Path, notices: list[str]) -> None:
    described = descriptors()
    described["actions"][0] |= {"full_path": "my_robot.actions.JointPositionAction", "clip": None}
    result = export(isaac_lab(tmp_path, actions=described["actions"]), tmp_path / "out", notices)
    assert any("an action term is a my_robot.actions.JointPositionAction, which is more than" in one for one in notices)
    assert {element[2] for element in elements(result, "action")} == {"raw"}


def test_an_action_range_whose_bounds_are_swapped_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"the action range \(3.0, -3.0\): expected the lower bound first"):
        export(mjlab(tmp_path), tmp_path / "out", action_range=(3.0, -3.0))


def test_a_manifests_facts_are_the_contracts(tmp_path: Path) -> None:
    origin = export(microduck(tmp_path), tmp_path / "out").contract.provenance
    assert (origin.env_id, origin.training_iterations) == ("Mjlab-PoliteBow-Flat-MicroDuck", 3000)


@pytest.mark.parametrize(
    ("origin", "changed", "kind", "words"),
    [
        (mjlab, {"joint_names": "pan,lift", "default_joint_pos": "0.1,0.2"}, CheckpointError,
         "joint_names has 2 joints, but the action has 3 elements: --joint-order"),
        (mjlab, {"action_scale": "0.500,0.250"}, CheckpointError,
         "action_scale has 2 numbers, but the action has 3 elements"),
        (mjlab, {"default_joint_pos": "0.1,0.2"}, CheckpointError,
         "joint_names has 3 entries, default_joint_pos has 2"),
        (mjlab, {"observation_terms_scale": "1.000"}, CheckpointError,
         "observation_names has 5 entries, observation_terms_scale has 1"),
        (mjlab, {"joint_names": "['pan', 'lift', 'elbow']"}, CheckpointError, "expected entries with commas between"),
        (mjlab, {"joint_names": "pan,lift,lift"}, CheckpointError, r"\(pan, lift, lift\) have lift more than once"),
        (mjlab, {"action_scale": "half"}, CheckpointError, "is not as its exporter writes it: ValueError: .*'half'"),
        (microduck, {"obs_len": 60}, CheckpointError,
         "its observation has 60 elements, 'obs' of policy.onnx has 61"),
        (microduck, {"action_len": 12}, CheckpointError, "its action has 12 elements, 'actions' of policy.onnx has 14"),
        (physicalai, {"preprocessors": [{"type": "normalize", "artifact": "stats.safetensors"}]}, UnsupportedError,
         "manifest.json: normalize is not in the graph"),
        (physicalai, {"runner": {"type": "action_chunking", "chunk_size": 100}}, UnsupportedError,
         "the runner action_chunking is not in the graph"),
        (mjlab, {"observation_terms_history_length": "0,0,0,12,0"}, CheckpointError,
         r"its observation terms with their histories have at least 17 elements, 'obs' of .*onnx has 14"),
        (physicalai, {"artifacts": {"model": "other.onnx"}}, CheckpointError,
         "its model is other.onnx, the given file is model.onnx"),
        (unitree, {"default_joint_pos": [0.0, 0.1]}, CheckpointError,
         "default_joint_pos has 2 joints, but the given joint order has 3"),
        (unitree, {"actions": {"JointPositionAction": {"scale": [1.0] * 3, "offset": DEFAULT, "clip": [-1.0, 1.0]}}},
         CheckpointError, r"the action's clip is \[-1.0, 1.0\]: expected \[low, high\] for each of 3 elements"),
        (unitree, {"actions": {"JointPositionAction": {"scale": [1.0] * 3, "offset": DEFAULT, "joint_ids": [0, 1, 3]}}},
         CheckpointError, r"has the joint_ids \[0, 1, 3\]: expected numbers of 3 joints"),
        (unitree, {"default_joint_pos": [DEFAULT[0], DEFAULT[2], DEFAULT[1]]}, CheckpointError,
         "they are in different joint orders"),
        (unitree, {"actions": {"JointPositionAction": {"scale": [1.0] * 3, "joint_ids": None}}}, CheckpointError,
         "the JointPositionAction has no offset"),
        (isaac_lab, {"actions": [{k: v for k, v in descriptors()["actions"][0].items() if k != "scale"}]},
         CheckpointError, "the JointPositionAction has no scale"),
        (isaac_lab, {"actions": [descriptors()["actions"][0] | {"offset": None}]},
         CheckpointError, "the JointPositionAction has no offset"),
        (isaac_lab, {"scene": {"physics_dt": 0.005, "dt": 0.02, "decimation": 2}}, CheckpointError,
         r"dt is 0\.02 s, but 2 times physics_dt are 0\.01 s"),
        (isaac_lab, {"observations": {"policy": descriptors()["observations"]["policy"][:3]}}, CheckpointError,
         "its observation has 13 elements, 'obs' of policy.onnx has 16"),
        (isaac_lab, {"scene": {"dt": "soon"}}, CheckpointError, "IO_descriptors.yaml is not as its exporter writes it"),
    ],
)  # fmt: skip
def test_what_contradicts_the_graph_is_refused_with_both_values(
    origin: Origin, changed: dict[str, Any], kind: type[RlservoError], words: str, tmp_path: Path
) -> None:
    with pytest.raises(kind, match=words):
        export(origin(tmp_path, **changed), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_joint_order_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        CheckpointError, match="has the joints pan, lift, elbow, the joint order that was given is lift"
    ):
        export(mjlab(tmp_path), tmp_path / "out", joint_order=["lift", "pan", "elbow"])


def test_two_files_that_differ_are_refused_with_both_values(tmp_path: Path) -> None:
    given = unitree(tmp_path)
    observations = {"policy": [{"name": "all", "full_path": "m.all", "shape": [60]}]}
    described = descriptors(scene={"dt": 0.01}, observations=observations)
    described["actions"][0] |= {"scale": 0.25, "clip": None}
    (tmp_path / "io_descriptors").mkdir()
    (tmp_path / "io_descriptors" / "IO_descriptors.yaml").write_text(yaml.safe_dump(described))
    with pytest.raises(
        CheckpointError, match=r"has the control rate 100.0, .*deploy.yaml has 50.0: they do not describe the"
    ):
        export(given, tmp_path / "out")


@pytest.mark.parametrize(("key", "value"), [("joint_stiffness", "1.000,1.000,1.000"), ("joint_damping", "-0.000,0,0")])
def test_gains_that_are_only_zeros_or_ones_are_warned_of(
    key: str, value: str, tmp_path: Path, notices: list[str]
) -> None:
    export(mjlab(tmp_path, **{key: value}), tmp_path / "out", notices)
    assert [notice for notice in notices if f"{key} is " in notice and "for every joint" in notice]


def state_of_other_names(folder: Path) -> Given:
    inputs, outputs = {"obs": [1, 4], "hidden": [1, 4]}, {"mu": [1, 4], "new_hidden": [1, 4]}
    nodes = [
        helper.make_node("Add", ["obs", "hidden"], ["new_hidden"]),
        helper.make_node("Sin", ["new_hidden"], ["mu"]),
    ]
    sides = ([helper.make_tensor_value_info(n, FLOAT, s) for n, s in each.items()] for each in (inputs, outputs))
    model = helper.make_model(helper.make_graph(nodes, "g", *sides), opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    file = write(model, folder / "policy.onnx")
    return Given(file, file, None)


def test_outputs_whose_names_tell_nothing_are_asked_for_one_by_one(tmp_path: Path) -> None:
    given = state_of_other_names(tmp_path)
    with pytest.raises(UsageError, match="has the outputs mu, new_hidden: --output NAME=action says which"):
        export(given, tmp_path / "out")
    with pytest.raises(
        UsageError, match=r"'new_hidden' has the shape of the input .*--output new_hidden=obs, otherwise --out"
    ):
        export(given, tmp_path / "out", outputs={"mu": "action"})
    result = export(given, tmp_path / "out", outputs={"mu": "action", "new_hidden": "hidden"})
    with Policy.load(result.path) as policy:
        np.testing.assert_allclose(policy.act(np.ones(4, np.float32)), np.sin(np.ones(4)), rtol=1e-6)
        np.testing.assert_allclose(policy.act(np.ones(4, np.float32)), np.sin(2 * np.ones(4)), rtol=1e-6)


def test_a_memory_with_a_value_of_its_own_is_asked_for_and_a_constant_is_kept(tmp_path: Path) -> None:
    """Its input is no input to onnxruntime: it was left at that value, and the memory was lost."""
    given = state_of_other_names(tmp_path)
    model = onnx.load(str(given.model))
    model.graph.input.remove(model.graph.input[1])
    model.graph.input.append(helper.make_tensor_value_info("hidden", FLOAT, [1, 4]))
    model.graph.initializer.append(helper.make_tensor("hidden", FLOAT, [1, 4], [1.0, -1.0, 0.0, 2.0]))
    onnx.save(model, str(given.model))
    with pytest.raises(UsageError, match="'new_hidden' has the shape of 'hidden', an input with a value of its own"):
        export(given, tmp_path / "out", outputs={"mu": "action"})
    result = export(given, tmp_path / "out", outputs={"mu": "action", "new_hidden": "none"})
    with Policy.load(result.path) as policy:
        for _ in range(2):
            wanted = np.sin(np.ones(4) + [1.0, -1.0, 0.0, 2.0])
            np.testing.assert_allclose(policy.act(np.ones(4, np.float32)), wanted, rtol=1e-6)


def test_a_custom_operator_is_refused_by_name(tmp_path: Path) -> None:
    given = microduck(tmp_path)
    model = onnx.load(str(given.model))
    model.graph.node[0].domain = "com.nvidia.warp"
    onnx.save(model, str(given.model))
    with pytest.raises(UnsupportedError, match=r"policy.onnx has the operation com.nvidia.warp::Sub, a custom one"):
        export(given, tmp_path / "out")


def test_what_only_trains_does_nothing_and_is_refused_where_it_trains(tmp_path: Path) -> None:
    given = mjlab(tmp_path)
    model = onnx.load(str(given.model))
    last = model.graph.node[-1]
    last.input[0] = "dropped"
    weights = {"bn_scale": 0.5, "bn_bias": 0.1, "bn_mean": 0.3, "bn_var": 1.5}
    for name, value in weights.items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.full(8, value, np.float32), name))
    normal = helper.make_node("BatchNormalization", ["x1", *weights], ["normal"])
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array(0.5, np.float32), "ratio"))
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array(False), "trains"))
    dropout = helper.make_node("Dropout", ["normal", "ratio", "trains"], ["dropped"])
    for node in (normal, dropout):
        model.graph.node.insert(len(model.graph.node) - 1, node)
    onnx.save(model, str(given.model))
    with Policy.load(export(given, tmp_path / "out").path) as policy:
        for obs, wanted in zip(*episode(given, 5), strict=True):
            np.testing.assert_allclose(policy.act(row(obs)), wanted, rtol=1e-5, atol=2e-6)
    model.graph.initializer[-1].CopyFrom(onnx.numpy_helper.from_array(np.array(True), "trains"))
    onnx.save(model, str(given.model))
    with pytest.raises(UnsupportedError, match="a Dropout in training mode is not exported"):
        export(given, tmp_path / "trains")


@pytest.mark.parametrize("wrong", [False, True])
def test_a_files_own_test_vectors_are_part_of_the_proof(wrong: bool, tmp_path: Path) -> None:
    given = mjlab(tmp_path)
    obs = np.linspace(-1, 1, 14, dtype=np.float32)[None]
    (action,) = onnxruntime.InferenceSession(str(given.model)).run(None, {"obs": obs})
    (tmp_path / "test_data_set_0").mkdir()
    for name, values in (("input_0", obs), ("output_0", action + 0.1 if wrong else action)):
        onnx.save_tensor(onnx.numpy_helper.from_array(values), str(tmp_path / "test_data_set_0" / f"{name}.pb"))
    if wrong:
        with pytest.raises(CheckpointError, match=r"test_data_set_0 beside .* has 'actions' .* but onnxruntime gives"):
            export(given, tmp_path / "out")
        (tmp_path / "test_data_set_0" / "output_0.pb").unlink()
        with pytest.raises(CheckpointError, match=r"has 1 inputs and 0 outputs, .* 1 and 1"):
            export(given, tmp_path / "out")
        return
    assert export(given, tmp_path / "out").contract.parity.reference.endswith("and 1 test vectors of its own")


def test_the_command_says_that_it_was_taken_as_given(tmp_path: Path) -> None:
    given = mjlab(tmp_path)
    said = rlservo_here("export", given.path, "--out", tmp_path / "out", "--name", "arm", "--control-rate", "50")
    assert said.returncode == 0, said.stderr
    assert "difference to onnxruntime on the given file (taken as given: no trainer was asked)" in said.stdout
    shown = rlservo_here("inspect", tmp_path / "out" / "arm")
    assert "taken as given: no trainer was asked" in " ".join(shown.stdout.split())
