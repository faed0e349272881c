"""Runs of rsl_rl, as Isaac Lab and mjlab leave them, against the runner's own inference policy."""

from __future__ import annotations

import copy
import pickle
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

import rlservo
from rlservo.errors import CheckpointError, ParityError, RlservoError, UnsupportedError, UsageError
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint, silent
from rlservo.export.recipe.recipe import Affine
from rlservo.export.sources import isaac_env
from rlservo.export.sources.isaac_env import ActionTerms, action_terms
from rlservo.export.sources.rsl_rl import RslRl
from rlservo.export.sources.source import RestoreOptions
from rlservo.policy.policy import Policy

pytest.importorskip("rsl_rl")
torch = pytest.importorskip("torch")

JOINTS = {"shoulder_pan_joint": 0.0, "shoulder_lift_joint": -1.712, "elbow_joint": 1.712}
ROBOT = ["elbow_joint", "shoulder_pan_joint", "shoulder_lift_joint"]
"""The robot's own order, which no setting shows."""
DEFAULTS = np.array([1.712, 0.0, -1.712])
"""JOINTS in the robot's order."""
OBSERVED = 5


def settings(**actor: Any) -> dict[str, Any]:
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "scalar"}
    of_actor = {"class_name": "MLPModel", "hidden_dims": [8], "activation": "elu", "obs_normalization": True}
    return {
        "num_steps_per_env": 8, "save_interval": 100, "clip_actions": None, "multi_gpu": None, "logger": "tensorboard",
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]},
        "algorithm": {"class_name": "PPO"},
        "actor": {**of_actor, "distribution_cfg": distribution, **actor},
        "critic": {**of_actor, "distribution_cfg": None},
    }  # fmt: skip


def environment(action: dict[str, Any], joint_pos: dict[str, Any] | None = None) -> dict[str, Any]:
    return {
        "decimation": 2, "sim": {"dt": 1 / 60},
        "scene": {"robot": {"init_state": {"joint_pos": JOINTS if joint_pos is None else joint_pos}}},
        "actions": {"arm_action": {
            "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointPositionAction", "asset_name": "robot",
            "joint_names": [".*"], "scale": 0.5, "offset": 0.0, "preserve_order": False, "use_default_offset": True,
            "clip": None, **action,
        }},
    }  # fmt: skip


def describe(
    folder: Path,
    joints: list[str],
    actions: list[dict[str, Any]] | None = None,
    scene: dict[str, Any] | None = None,
) -> None:
    """Write what Isaac Lab writes into a run with `--export_io_descriptors`."""
    (folder / "io_descriptors").mkdir(parents=True, exist_ok=True)
    described = {"actions": actions or [], "articulations": {"robot": {"joint_names": joints}}, "observations": {},
                 "scene": scene or {}}  # fmt: skip
    (folder / "io_descriptors" / "IO_descriptors.yaml").write_text(yaml.safe_dump(described))


class World:
    """A vectorized environment whose observations are random, to train in."""

    num_envs, max_episode_length, device = 6, 20, "cpu"

    def __init__(self, widths: dict[str, int], actions: int) -> None:
        self._widths, self.num_actions = widths, actions
        self.cfg: dict[str, Any] = {}
        self.episode_length_buf = torch.zeros(6, dtype=torch.long)

    def get_observations(self) -> Any:
        from tensordict import TensorDict

        seen = {name: 2 + 3 * torch.randn(6, width) for name, width in self._widths.items()}
        return TensorDict(seen, batch_size=[6])

    def step(self, actions: Any) -> tuple[Any, Any, Any, dict[str, Any]]:
        return self.get_observations(), -(actions**2).sum(-1), (torch.rand(6) < 0.2).long(), {}


def train(folder: Path, agent: dict[str, Any], env: dict[str, Any] | None, *, actions: int = 3, **widths: int) -> Any:
    """Return a trained runner whose model_2.pt is in `folder`, and write the settings as Isaac Lab's train.py does."""
    from rsl_rl.runners import OnPolicyRunner  # here: it imports all of torch's compiler

    torch.manual_seed(0)
    (folder / "params").mkdir(parents=True)
    (folder / "params" / "agent.yaml").write_text(yaml.dump(agent))
    if env is not None:
        written = yaml.dump(env, sort_keys=False).replace(
            "joint_names:", "unused: !!python/tuple [1, 2]\n    joint_names:", 1
        )
        (folder / "params" / "env.yaml").write_text(written)
    world = World(widths or {"policy": OBSERVED, "privileged": 2}, actions)
    runner = OnPolicyRunner(world, copy.deepcopy(agent), None, "cpu")
    runner.learn(3)
    with torch.no_grad():
        for weights in runner.alg.get_policy().parameters():
            weights.add_(0.2 * torch.randn_like(weights))  # a few steps of training leave small actions
    runner.save(str(folder / "model_2.pt"))
    return runner


def raw_actions(runner: Any, episodes: list[Any]) -> list[Any]:
    """Return what the runner's own inference policy gives over episodes."""
    from tensordict import TensorDict

    policy = runner.get_inference_policy()
    found = []
    for episode in episodes:
        policy.reset()
        with torch.no_grad():
            found += [policy(TensorDict({"policy": obs[None]}, batch_size=[1]))[0].numpy() for obs in episode]
    return found


def bundle_actions(result: ExportResult, episodes: list[Any]) -> list[Any]:
    found = []
    with Policy.load(result.path) as policy:
        for episode in episodes:
            policy.reset()
            found += [policy.act(obs.numpy()) for obs in episode]
    return found


def observations() -> list[Any]:
    torch.manual_seed(5)
    return [2 + 3 * torch.randn(8, OBSERVED) for _ in range(2)]


def export(folder: Path, notices: list[str], joint_order: Sequence[str] = ()) -> ExportResult:
    return export_checkpoint(folder, folder.parent / "out", name="arm", joint_order=joint_order, notify=notices.append)


def refuse(folder: Path, words: str, kind: type[Exception] = CheckpointError, joint_order: Sequence[str] = ()) -> None:
    with pytest.raises(kind, match=words):
        export(folder, [], joint_order)
    assert not (folder.parent / "out").exists()


@pytest.mark.parametrize("memory", ["none", "lstm", "gru"])
def test_isaac_labs_run_becomes_joint_targets(memory: str, tmp_path: Path, notices: list[str]) -> None:
    rnn = {"class_name": "RNNModel", "rnn_type": memory, "rnn_hidden_dim": 4, "rnn_num_layers": 2}
    runner = train(tmp_path / "run", settings(**({} if memory == "none" else rnn)), environment({}))
    result = export(tmp_path / "run", notices, ROBOT)
    episodes = observations()
    wanted = [0.5 * raw + DEFAULTS for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    contract = result.contract
    assert [element.name for element in contract.action_space.elements] == ROBOT
    assert contract.action_space.elements[0].unit == "rad"
    assert contract.control_rate_hz == pytest.approx(30.0)
    assert contract.baked_in[0].step == "mean_std_filter" and contract.baked_in[0].values["count"] == 6 * 8 * 3
    assert len(contract.state) == {"none": 0, "lstm": 2, "gru": 1}[memory]
    assert (contract.provenance.algorithm, contract.provenance.training_iterations) == ("PPO", 2)
    assert not any("loading" in notice for notice in notices)  # nothing is unpickled


OWN_MODELS = """
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import GaussianDistribution
from torch.nn import Module, Sequential

class Half(Module):
    def forward(self, given):
        return 0.5 * given

class Mine(MLPModel):
    def forward(self, obs, *rest, **more):
        return 0.5 * super().forward(obs, *rest, **more)

    def as_onnx(self, verbose):
        network = super().as_onnx(verbose)
        network.mlp = Sequential(network.mlp, Half())
        return network

class Begins(RNNModel):
    def reset(self, dones=None, hidden_state=None):
        super().reset(dones, hidden_state)
        if dones is not None and self.rnn.hidden_state is not None:
            self.rnn.hidden_state[..., dones == 1, :] = 1.0

class BeginsElsewhere(RNNModel):
    def forward(self, obs, masks=None, hidden_state=None, stochastic_output=False):
        if self.rnn.hidden_state is None:
            self.rnn.hidden_state = obs["policy"].new_ones(1, len(obs["policy"]), 4)
        return super().forward(obs, masks, hidden_state, stochastic_output)

class Asks(MLPModel):
    def forward(self, obs, *rest, **more):
        action = super().forward(obs, *rest, **more)
        return action + obs["extra"][..., :3] if "extra" in obs.keys() else action

class Gets(MLPModel):
    def forward(self, obs, *rest, **more):
        extra = obs.get("extra", None)
        return super().forward(obs, *rest, **more) + (0 if extra is None else extra[..., :3])

class Stops(MLPModel):
    def forward(self, obs, *rest, **more):  # for numbers that no sample has
        return super().forward(obs, *rest, **more) * (obs[self.obs_groups[0]].abs() < 1e7).all(-1, keepdim=True)

class Limits(GaussianDistribution):
    def deterministic_output(self, mlp_output):
        return mlp_output.clamp(-1e4, 1e4)
"""
GRU = {"rnn_type": "gru", "rnn_hidden_dim": 4, "rnn_num_layers": 1}
LIMITED = {"distribution_cfg": {"class_name": "own_models:Limits", "init_std": 0.5, "std_type": "scalar"}}
OWN = {
    "Begins": (GRU, "own_models.Begins does not begin an episode with a memory of zeros"),
    "BeginsElsewhere": (GRU, "own_models.BeginsElsewhere does not begin an episode with a memory of zeros"),
    "Asks": ({}, "own_models.Asks asks which observation groups there are"),
    "Gets": ({}, "own_models.Gets asks for the observation group 'extra'"),
    "MLPModel": (LIMITED, "own_models.Limits acts by its own 'deterministic_output', which the .* of Gaussian"),
    "Stops": ({}, "own_models.Stops acts by its own 'forward', which the 'as_onnx' of .*MLPModel leaves out"),
}


@pytest.fixture
def own_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let classes of a user's own be imported."""
    (tmp_path / "own_models.py").write_text(OWN_MODELS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_models", raising=False)


@pytest.mark.parametrize("name", OWN)
def test_own_model_that_the_reference_would_not_see_through_is_refused(
    name: str, own_models: None, tmp_path: Path
) -> None:
    options, words = OWN[name]
    run = tmp_path / "run"
    train(run, settings(class_name=f"own_models:{name}", **options), None, policy=OBSERVED, privileged=2, extra=3)
    refuse(run, words, UnsupportedError)


def test_own_model_is_exported_if_it_is_one_group_and_acts_as_its_graph(
    own_models: None, tmp_path: Path, notices: list[str]
) -> None:
    runner = train(tmp_path / "run", settings(class_name="own_models:Mine"), None)
    result, episodes = export(tmp_path / "run", notices), observations()
    np.testing.assert_allclose(bundle_actions(result, episodes), raw_actions(runner, episodes), rtol=1e-5, atol=2e-6)
    two = settings(class_name="own_models:Mine")
    two["obs_groups"]["actor"] = ["policy", "privileged"]
    train(tmp_path / "two" / "run", two, None)
    refuse(tmp_path / "two" / "run", "which may treat the groups policy, privileged apart", UnsupportedError)


# What Isaac Lab's own rules give for a robot whose joints are elbow, pan, lift (joint_actions.py and
# resolve_matching_names of isaaclab 2.3): the joints in the action's order, scale, offset, low and high.
INF = float("inf")
RULES: dict[str, tuple[dict[str, Any], list[str], Any, Any, Any, Any]] = {
    "the list's order does not count": (
        {"joint_names": ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"]},
        ["elbow_joint", "shoulder_pan_joint", "shoulder_lift_joint"], 0.5, [1.712, 0.0, -1.712], -INF, INF,
    ),
    "unless it is preserved": (
        {"joint_names": ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"], "preserve_order": True},
        ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"], 0.5, [0.0, -1.712, 1.712], -INF, INF,
    ),
    "patterns in the robot's order": (
        {"joint_names": ["shoulder_.*", "elbow_joint"], "scale": {"shoulder_.*": 2.0, "elbow.*": 0.25}},
        ["elbow_joint", "shoulder_pan_joint", "shoulder_lift_joint"], [0.25, 2.0, 2.0], [1.712, 0.0, -1.712], -INF, INF,
    ),
    "patterns in their own order": (
        {"joint_names": ["shoulder_.*", "elbow_joint"], "preserve_order": True, "scale": {"shoulder_lift.*": 3.0}},
        ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"], [1.0, 3.0, 1.0], [0.0, -1.712, 1.712], -INF, INF,
    ),
    "an offset of some joints": (
        {"use_default_offset": False, "offset": {"shoulder_.*": 0.1}, "scale": 1},
        ["elbow_joint", "shoulder_pan_joint", "shoulder_lift_joint"], 1.0, [0.0, 0.1, 0.1], -INF, INF,
    ),
    "a clip of some joints, after the offset": (
        {"clip": {"elbow_joint": [1.6, 1.8], "shoulder_lift_joint": [-INF, -1.7]}},
        ["elbow_joint", "shoulder_pan_joint", "shoulder_lift_joint"], 0.5, [1.712, 0.0, -1.712],
        [1.6, -INF, -INF], [1.8, INF, -1.7],
    ),
}  # fmt: skip


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("described", [True, False], ids=["described", "given"])
def test_joints_are_found_and_scaled_as_isaac_lab_does(
    rule: str, described: bool, tmp_path: Path, notices: list[str]
) -> None:
    action, names, scale, offset, low, high = RULES[rule]
    runner = train(tmp_path / "run", settings(), environment(action))
    if described:
        describe(tmp_path / "run", ["base", *ROBOT, "finger"] if "joint_names" in action else ROBOT)
    result = export(tmp_path / "run", notices, () if described else ROBOT)
    episodes = observations()
    wanted = [np.clip(raw * scale + offset, low, high) for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    assert [element.name for element in result.contract.action_space.elements] == names
    if "clip" in action:
        unclipped = np.array([raw * scale + offset for raw in raw_actions(runner, episodes)])
        assert (unclipped != wanted).any(0).tolist() == [True, False, True], "a clip was never reached"


def test_the_wrappers_clip_is_before_the_scale(tmp_path: Path, notices: list[str]) -> None:
    action = {"use_default_offset": False, "scale": {"shoulder_.*": 2.0, "elbow_joint": 0.25}, "offset": 0.1}
    runner = train(tmp_path / "run", {**settings(), "clip_actions": 0.3}, environment(action))
    result = export(tmp_path / "run", notices, ROBOT)
    episodes = observations()
    raw = raw_actions(runner, episodes)
    assert (np.abs(raw) > 0.3).any()
    wanted = [np.clip(each, -0.3, 0.3) * [0.25, 2.0, 2.0] + 0.1 for each in raw]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    (tmp_path / "run" / "params" / "env.yaml").unlink()
    result = export(tmp_path / "run", notices)
    wanted = [np.clip(each, -0.3, 0.3) for each in raw]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)


def test_several_terms_of_one_robot(tmp_path: Path, notices: list[str]) -> None:
    env = environment({"joint_names": ["shoulder_pan_joint", "elbow_joint"], "scale": 2.0})
    wheel = {"class_type": "isaaclab.envs.mdp.actions.joint_actions:JointVelocityAction",
             "joint_names": ["shoulder_lift_joint"], "scale": 0.1, "use_default_offset": True}  # fmt: skip
    env["actions"] |= {"unused": None, "wheel": {**env["actions"]["arm_action"], **wheel}}
    env["scene"]["robot"]["init_state"]["joint_vel"] = {".*": 0.7}
    runner = train(tmp_path / "run", settings(), env)
    result = export(tmp_path / "run", notices, ROBOT)
    episodes = observations()
    wanted = [raw * [2.0, 2.0, 0.1] + [1.712, 0.0, 0.7] for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    elements = [(element.name, element.unit) for element in result.contract.action_space.elements]
    assert elements == [("elbow_joint", "rad"), ("shoulder_pan_joint", "rad"), ("shoulder_lift_joint", "rad/s")]


def mjlab(action: dict[str, Any], joint_pos: dict[str, Any]) -> dict[str, Any]:
    env = environment(action, joint_pos)
    env["scene"] = {"entities": env["scene"]}
    env["sim"] = {"mujoco": {"timestep": 0.005}}
    term = env["actions"]["arm_action"]
    term |= {"class_type": "mjlab.envs.mdp.actions.actions.JointPositionAction", "entity_name": term.pop("asset_name")}
    term["actuator_names"] = term.pop("joint_names")
    return env


def test_mjlab_names_its_parts_otherwise(tmp_path: Path, notices: list[str]) -> None:
    # mjlab takes the first pattern that matches a name's beginning (utils/string.py, resolve_expr).
    runner = train(tmp_path / "run", settings(), mjlab({}, {"shoulder_p": 0.2, "shoulder": -0.4, "elbow_joint": 1.5}))
    result = export(tmp_path / "run", notices, ROBOT)
    episodes = observations()
    wanted = [0.5 * raw + [1.5, 0.2, -0.4] for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    assert result.contract.control_rate_hz == pytest.approx(100.0)
    # Some releases preserve the order, others do not.
    listed = {"joint_names": list(JOINTS), "preserve_order": True}
    (tmp_path / "run" / "params" / "env.yaml").write_text(yaml.dump(mjlab(listed, {".*": 0.0})))
    shutil.rmtree(tmp_path / "out")
    refuse(tmp_path / "run", "some releases of mjlab ignore", joint_order=ROBOT)
    refuse(tmp_path / "run", "give --joint-order")


@pytest.mark.parametrize("names", [list(JOINTS), [".*"], ["shoulder_.*", "elbow_joint"]])
def test_an_order_of_joints_that_no_file_has_is_asked_for(names: list[str], tmp_path: Path) -> None:
    train(tmp_path / "run", settings(), environment({"joint_names": names}))
    refuse(tmp_path / "run", "in the robot's own order, which no file of the run has: give --joint-order")
    refuse(tmp_path / "run", "names a joint twice", UsageError, [*ROBOT, ROBOT[0]])
    refuse(tmp_path / "run", "matches none of|have . elements", joint_order=ROBOT[:2])


def test_a_preserved_list_needs_no_order_of_the_robot(tmp_path: Path, notices: list[str]) -> None:
    train(tmp_path / "run", settings(), environment({"joint_names": list(JOINTS), "preserve_order": True}))
    result = export(tmp_path / "run", notices)
    assert [element.name for element in result.contract.action_space.elements] == list(JOINTS)


def test_files_of_two_runs_are_refused_with_both_names(tmp_path: Path) -> None:
    train(tmp_path / "run", settings(), environment({}))
    action = {"joint_names": ROBOT, "scale": 0.5, "offset": DEFAULTS.tolist(), "clip": None}
    describe(tmp_path / "run", ROBOT, [{**action, "offset": [1.7, 0.0, -1.712]}])
    refuse(tmp_path / "run", r"has the offset \[1.712.*env.yaml, but \[1.7, .*IO_descriptors.yaml")
    describe(tmp_path / "run", ROBOT, [{**action, "joint_names": list(JOINTS)}])
    refuse(tmp_path / "run", "has the joint_names .*env.yaml, but .*IO_descriptors.yaml")
    describe(tmp_path / "run", ROBOT, [{**action, "scale": [0.5, 0.5, 0.25]}])
    refuse(tmp_path / "run", "has the scale .*env.yaml, but .*IO_descriptors.yaml")
    path = "isaaclab.envs.mdp.actions.joint_actions.JointVelocityAction"
    describe(tmp_path / "run", ROBOT, [{**action, "full_path": path}])
    refuse(tmp_path / "run", r"has the class \['JointPositionAction'\] in .*env.yaml, but \['JointVelocityAction'\]")
    describe(tmp_path / "run", ROBOT, [{**action, "clip": [[-1.0, 1.0]] * 3}])
    refuse(tmp_path / "run", r"has the clip \[\] in .*env.yaml, but \[-1.0, 1.0")
    describe(tmp_path / "run", ROBOT, [action], {"dt": 0.02})
    refuse(tmp_path / "run", "env.yaml has a control rate of 30 Hz, but .*IO_descriptors.yaml steps of 0.02 s")
    describe(tmp_path / "run", ROBOT, [action])
    refuse(
        tmp_path / "run", "joint order that was given .* is not that of .*IO_descriptors.yaml", joint_order=list(JOINTS)
    )
    export(tmp_path / "run", [])


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ({"scale": float("nan")}, "'arm_action' has a scale of nan for the joint 'elbow_joint'"),
        ({"scale": {".*": 1.0, "elbow.*": 2.0}}, "two entries of scale for the joint 'elbow_joint'"),
        ({"scale": {"elbow.*": 2.0, "wrist": 1.0}}, "an entry of scale, 'wrist', that matches none of"),
        ({"scale": {"shoulder_.*": INF}}, "has a scale of inf for the joint 'shoulder_pan_joint'"),
        ({"scale": 1e39}, r"has a scale of 1e\+39"),
        ({"scale": [1, 2, 3]}, "expected a number"),
        ({"use_default_offset": False, "offset": {"elbow_joint": float("nan")}}, "offset of nan for the joint 'elbow"),
        ({"clip": {".*": [float("nan"), 1.0]}}, "has a clip of .* for the joint 'elbow_joint'"),
        ({"clip": {".*": [2.0, 1.0]}}, "has a clip of .* for the joint 'elbow_joint'"),
        ({"clip": 3}, "has a clip of 3"),
        ({"joint_names": ["elbow_joint", "(["]}, "arm_action"),
        ({"joint_names": 7}, "names no joints"),
    ],
)
def test_numbers_that_no_robot_takes_are_refused(action: dict[str, Any], words: str, tmp_path: Path) -> None:
    train(tmp_path / "run", settings(), environment(action))
    refuse(tmp_path / "run", words, joint_order=ROBOT)


def test_a_default_offset_that_is_not_in_the_file_is_not_guessed(tmp_path: Path) -> None:
    env = environment({})
    train(tmp_path / "run", settings(), env)
    file = tmp_path / "run" / "params" / "env.yaml"
    file.write_text(yaml.dump(environment({}, {**JOINTS, "elbow_joint": float("nan")})))
    refuse(tmp_path / "run", "has a default joint_pos of nan for the joint 'elbow_joint'", joint_order=ROBOT)
    file.write_text(yaml.dump({**env, "scene": {}}))
    refuse(tmp_path / "run", "default joint_pos of 'robot', which env.yaml does not have", joint_order=ROBOT)


@pytest.mark.parametrize(
    "path",
    [
        "isaaclab.envs.mdp.actions.task_space_actions:DifferentialInverseKinematicsAction",
        "my_tasks.actions:JointPositionAction",  # may do anything
    ],
)
def test_what_is_no_scale_stays_the_policys_own_and_is_said(path: str, tmp_path: Path, notices: list[str]) -> None:
    runner = train(tmp_path / "run", settings(), environment({"class_type": path}))
    result = export(tmp_path / "run", notices)
    episodes = observations()
    np.testing.assert_allclose(bundle_actions(result, episodes), raw_actions(runner, episodes), rtol=1e-5, atol=2e-6)
    assert "which is more than a scale and an offset" in " ".join(notices)
    assert [element.quantity for element in result.contract.action_space.elements] == ["raw"] * 3
    assert "action=absolute, relative, velocity or effort" in notices[-1]
    result = export_checkpoint(
        tmp_path / "run", tmp_path / "out", conventions={"action": "relative"}, notify=notices.append
    )
    assert [element.quantity for element in result.contract.action_space.elements] == ["relative joint position"] * 3


def test_groups_of_observations_are_side_by_side(tmp_path: Path, notices: list[str]) -> None:
    agent = settings()
    agent["obs_groups"] = {"actor": ["policy", "extra"], "critic": ["policy", "privileged"]}
    runner = train(tmp_path / "run", agent, None, policy=3, extra=2, privileged=2)
    result = export(tmp_path / "run", notices)
    from tensordict import TensorDict

    obs = observations()[0]
    with torch.no_grad():
        wanted = runner.get_inference_policy()(TensorDict({"policy": obs[:, :3], "extra": obs[:, 3:]}, batch_size=[8]))
    np.testing.assert_allclose(bundle_actions(result, [obs]), wanted, rtol=1e-5, atol=2e-6)
    assert "concatenates the groups policy, extra" in " ".join(notices)


def test_a_distilled_student_acts_on_its_own_observations(tmp_path: Path, notices: list[str]) -> None:
    from rsl_rl.runners import DistillationRunner

    whole = settings()
    agent = {
        **whole, "algorithm": {"class_name": "Distillation", "gradient_length": 4},
        "student": whole["actor"], "teacher": whole["critic"],
        "obs_groups": {"student": ["policy"], "teacher": ["policy", "privileged"]},
    }  # fmt: skip
    (tmp_path / "run" / "params").mkdir(parents=True)
    (tmp_path / "run" / "params" / "agent.yaml").write_text(yaml.dump(agent))
    torch.manual_seed(0)
    runner = DistillationRunner(World({"policy": OBSERVED, "privileged": 2}, 3), copy.deepcopy(agent), None, "cpu")
    runner.alg.teacher_loaded = True
    runner.learn(2)
    runner.save(str(tmp_path / "run" / "model_1.pt"))
    result = export(tmp_path / "run", notices)
    episodes = observations()
    np.testing.assert_allclose(bundle_actions(result, episodes), raw_actions(runner, episodes), rtol=1e-5, atol=2e-6)


def test_runs_that_cannot_be_read_are_refused_with_the_reason(tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(run, settings(), environment({"joint_names": ["elbow_joint"]}))
    model, agent = run / "model_2.pt", run / "params" / "agent.yaml"
    saved = torch.load(model, weights_only=True)
    refuse(run, r"action terms \(arm_action\) have 1 elements, the policy's action has 3: they do not belong together")
    (run / "params" / "env.yaml").unlink()
    agent.write_text(yaml.dump(settings(hidden_dims=[9])))
    refuse(run, "its weights do not fit params/agent.yaml: .*size mismatch")
    agent.write_text(yaml.dump(settings(class_name="their_models:Mine")))
    refuse(run, "the class of its actor cannot be imported: it needs the Python module 'their_models'")
    agent.write_text(yaml.dump({**settings(), "algorithm": {"class_name": "their_models:Mine"}}))
    refuse(run, "cannot be restored by rsl_rl's own runner: it needs the Python module 'their_models'")
    agent.write_text(yaml.dump(settings()))
    agent.write_bytes(b"actor:\xff")
    refuse(run, "agent.yaml cannot be read")
    agent.write_text(yaml.dump(settings()))
    torch.save({"model_state_dict": saved["actor_state_dict"], "iter": 1}, model)
    refuse(run, "is of rsl_rl 2, 3 or 4.*examples/rsl_rl_older.py", UnsupportedError)
    torch.save({**saved, "actor_state_dict": {**saved["actor_state_dict"], "std": torch.ones(3)}}, model)
    refuse(run, "is of rsl_rl 2, 3 or 4.*examples/rsl_rl_older.py", UnsupportedError)


@pytest.mark.parametrize("release", [2, 3, 4])
def test_the_actor_of_an_older_rsl_rl_is_exported_as_a_module(release: int, tmp_path: Path) -> None:
    from rsl_rl_older import OlderActor

    runner = train(tmp_path / "run", settings(hidden_dims=[8, 6]), None)
    model = tmp_path / "run" / "model_2.pt"
    weights = torch.load(model, weights_only=True)["actor_state_dict"]
    # The names that rsl_rl 2.3.3, 3.3.0 and 4.0.1 give them.
    normalizer = {name.split(".")[1]: weights.pop(name) for name in list(weights) if name.startswith("obs_normalizer.")}
    layers = {name.removeprefix("mlp."): weight for name, weight in weights.items() if name.startswith("mlp.")}
    actor = {"std": torch.ones(3), **{f"actor.{name}": weight for name, weight in layers.items()}}
    saved = {
        2: {"model_state_dict": actor, "obs_norm_state_dict": normalizer},
        3: {"model_state_dict": actor | {f"actor_obs_normalizer.{name}": value for name, value in normalizer.items()}},
        4: {"actor_state_dict": {f"obs_normalizer.{name}": value for name, value in normalizer.items()}
            | {f"mlp.{name}": weight for name, weight in layers.items()} | {"std": torch.ones(3)}},
    }[release]  # fmt: skip
    critic = {f"critic.{name}": torch.zeros_like(weight) for name, weight in layers.items()}
    torch.save({name: {**part, **critic} for name, part in saved.items()}, model)
    older = OlderActor(model, torch.nn.ELU)
    result = rlservo.export_policy(
        older, older.observations(), older.actions(), tmp_path / "out", name="arm", scale=0.5
    )
    episodes = observations()
    wanted = [0.5 * raw for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)


def test_an_older_actor_whose_deviation_depends_on_the_state_is_refused(tmp_path: Path) -> None:
    """rsl_rl 3.1 to 4.0 with `state_dependent_std`: the last layer gives means and deviations; there is no `std`."""
    from rsl_rl_older import OlderActor

    layers = {"actor.0.weight": torch.zeros(8, 5), "actor.0.bias": torch.zeros(8),
              "actor.2.weight": torch.zeros(6, 8), "actor.2.bias": torch.zeros(6)}  # fmt: skip
    torch.save({"model_state_dict": layers}, tmp_path / "model_3.pt")
    with pytest.raises(ValueError, match="is not of an actor whose layers end in one mean for each action"):
        OlderActor(tmp_path / "model_3.pt", torch.nn.ELU)


MISREAD: dict[str, Callable[[ActionTerms, Affine], ActionTerms]] = {
    "scales swapped": lambda terms, affine: replace(terms, affine=replace(affine, scale=affine.scale[[1, 0, 2]])),
    "offsets in another order": lambda terms, affine: replace(
        terms, affine=replace(affine, offset=affine.offset[[2, 1, 0]])
    ),
    "one offset off by a percent": lambda terms, affine: replace(
        terms, affine=replace(affine, offset=affine.offset * np.array([1, 1, 1.01], np.float32))
    ),
    "no clip before": lambda terms, affine: replace(terms, affine=replace(affine, limit=None)),
    "no clip after": lambda terms, affine: replace(terms, bounds=None),
    "nothing at all": lambda terms, affine: replace(terms, affine=None),
}


@pytest.mark.parametrize("how", MISREAD)
def test_the_gate_sees_what_the_recipe_misreads(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    action = {"scale": {"elbow.*": 0.5, "shoulder_.*": 0.25}, "clip": {"elbow_joint": [1.6, 1.8]}}
    train(tmp_path / "run", {**settings(), "clip_actions": 0.5}, environment(action))

    def misread(*given: Any) -> ActionTerms:
        terms = action_terms(*given)
        assert terms.affine is not None
        return MISREAD[how](terms, terms.affine)

    monkeypatch.setattr(isaac_env, "action_terms", misread)
    refuse(tmp_path / "run", "action", ParityError, ROBOT)


def test_code_in_place_of_weights_is_not_run_nor_advised(tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(run, settings(), None)
    model = run / "model_2.pt"
    saved = torch.load(model, weights_only=True)
    torch.save({**saved, "infos": SimpleNamespace()}, model)
    refuse(run, r"as weights alone: it is a pickle with the Python class types.SimpleNamespace in it, which would run "
                "code when loaded: save tensors and numbers only$")  # fmt: skip
    model.write_bytes(pickle.dumps({"actor_state_dict": SimpleNamespace()}))
    refuse(run, "as weights alone: it is a pickle with Python objects in it")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of torch.jit.script
        torch.jit.script(torch.nn.Linear(2, 2)).save(str(model))
    refuse(run, "as weights alone: it is a TorchScript module")
    for damaged in (b"", b"not an archive", model.read_bytes()[:300]):
        model.write_bytes(damaged)
        refuse(run, "cannot be read as weights alone: (?!.*weights_only)")


def test_settings_of_another_type_are_refused_with_a_sentence(tmp_path: Path) -> None:
    """Each setting of both files, and each entry of the checkpoint, of four other types: no traceback."""
    run = tmp_path / "run"
    train(run, settings(), environment({"clip": {".*": [-9.0, 9.0]}}))
    describe(run, ROBOT, [{"joint_names": ROBOT, "scale": 0.5}])
    refused = 0
    for file in (*run.glob("params/*.yaml"), run / "io_descriptors" / "IO_descriptors.yaml"):
        whole = yaml.unsafe_load(file.read_text())
        for changed in others(whole):
            file.write_text(yaml.dump(changed, sort_keys=False))
            refused += not exports(run)
        file.write_text(yaml.dump(whole, sort_keys=False))
    saved = torch.load(run / "model_2.pt", weights_only=True)
    for key in saved:
        for value in (3, [1], {"a": 1}, {"mlp.0.weight": torch.zeros(2)}):
            torch.save({**saved, key: value}, run / "model_2.pt")
            refused += not exports(run)
    assert refused > 100


def others(value: Any) -> Iterator[Any]:
    """Yield `value` with each of its parts replaced in turn."""
    yield from (7, "text", [None], {"a": "b"})
    for key in value if isinstance(value, dict) else ():
        for changed in others(value[key]):
            yield {**value, key: changed}


def exports(run: Path) -> bool:
    """Return whether a run is restored; anything but an error of our own fails the test."""
    source = RslRl()
    try:
        files = source.locate(run, None, None)
        source.facts(files, silent)
        source.restore(files, RestoreOptions(run, joint_order=()), silent)
    except RlservoError as error:
        assert "weights_only" not in error.message
        return False
    return True


# -- conventions

UR = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
OBSERVATIONS = "isaaclab.envs.mdp.observations"


def reach_task(version: str, action: dict[str, Any] | None = None) -> dict[str, Any]:
    """Settings of Isaac Lab's reach tasks as train.py dumps them; 2 and 3 differ in `sim` and in every turn."""
    rot = [1.0, 0.0, 0.0, 0.0] if version == "2" else [0.0, 0.0, 0.0, 1.0]
    env = environment(action or {"joint_names": [".*"]}, dict.fromkeys(UR, 0.25))
    env["scene"]["robot"]["init_state"]["rot"] = rot
    env["scene"]["light"] = {"init_state": {"pos": [0.0, 0.0, 0.0], "rot": rot}}
    env["sim"] |= {"physx": {"solver_type": 1}} if version == "2" else {"physics": {"solver_type": 1}}
    terms = {
        "joint_pos": {"func": f"{OBSERVATIONS}:joint_pos_rel", "params": {}, "scale": None, "history_length": 0},
        "joint_vel": {"func": f"{OBSERVATIONS}:joint_vel_rel", "params": {}, "scale": 0.1},
        "pose_command": {"func": f"{OBSERVATIONS}:generated_commands", "params": {"command_name": "ee_pose"}},
        "actions": {"func": f"{OBSERVATIONS}:last_action", "params": {}},
    }
    env["observations"] = {"policy": {"concatenate_terms": True, "enable_corruption": False, **terms}}
    env["commands"] = {
        "ee_pose": {"class_type": "isaaclab.envs.mdp.commands.pose_command:UniformPoseCommand", "asset_name": "robot"}
    }
    return env


def trained_arm(run: Path, env: dict[str, Any], size: int = 25) -> Any:
    agent = {**settings(), "obs_groups": {"actor": ["policy"], "critic": ["policy"]}}
    runner = train(run, agent, env, actions=6, policy=size)
    describe(run, UR)
    return runner


@pytest.mark.parametrize(("version", "order"), [("2", "wxyz"), ("3", "xyzw")])
def test_release_of_isaac_lab_tells_the_order_of_quaternions(
    version: str, order: str, tmp_path: Path, notices: list[str]
) -> None:
    trained_arm(tmp_path / "run", reach_task(version))
    space = export(tmp_path / "run", notices).contract.observation_space
    assert "".join(element.axis for element in space.elements[15:19]) == order
    assert [element.quantity for element in space.elements] == [
        *["joint position"] * 6, *["joint velocity"] * 6, *["position"] * 3, *["quaternion"] * 4, *["last action"] * 6,
    ]  # fmt: skip
    assert [element.joint for element in space.elements[:6]] == UR
    assert (space.elements[0].scale, space.elements[0].offset) == (1.0, 0.25)
    assert space.elements[6].scale == pytest.approx(10.0)  # the term is a tenth of the velocity
    assert "the frame of pose_command_x ... (--convention frame=NAME)" in notices[-1]
    assert "quaternion" not in notices[-1]


def test_policy_of_isaac_lab_3_does_not_drive_our_isaac_reach(tmp_path: Path, notices: list[str]) -> None:
    from rlservo.drive.control_loop import rollout

    for version, words in (
        ("3", "are a quaternion w, x, y, z there, but the policy has x, y, z, w"),
        ("2", "element 12 is"),
    ):
        env = reach_task(version)
        env["scene"]["robot"]["init_state"]["joint_pos"] = dict(
            zip(UR, (0.0, -1.712, 1.712, 0.0, 0.0, 0.0), strict=True)
        )
        env["observations"]["policy"]["joint_vel"]["scale"] = None
        trained_arm(tmp_path / version / "run", env)
        result = export(tmp_path / version / "run", notices)
        with Policy.load(result.path) as policy, pytest.raises(UsageError, match=words):
            rollout(policy, "rlservo/IsaacReachURSim-v0", episodes=1)


@pytest.mark.parametrize(
    ("asset", "joints"),
    [
        ({"joint_names": ["wrist_1_joint", "elbow_joint"], "preserve_order": True}, ["wrist_1_joint", "elbow_joint"]),
        ({"joint_names": ["wrist_1_joint", "elbow_joint"], "preserve_order": False}, ["elbow_joint", "wrist_1_joint"]),
        ({"joint_ids": [3, 1]}, [UR[3], UR[1]]),
        ({"joint_ids": slice(0, 4, 2)}, [UR[0], UR[2]]),
        ({"name": "cabinet"}, []),
    ],
)
def test_an_observed_joint_is_that_which_isaac_lab_picks(
    asset: dict[str, Any], joints: list[str], tmp_path: Path, notices: list[str]
) -> None:
    """By SceneEntityCfg's names, numbers and robot: the command's last elements were taken for joints."""
    env = reach_task("3")
    term = env["observations"]["policy"]["joint_pos"]
    env["observations"]["policy"] = {
        "joint_pos": {**term, "params": {"asset_cfg": {"name": "robot", **asset}}, "clip": [-3.0, 3.0]},
        "beside": {"func": "my_task.observations:beside", "params": {}},
        "actions": env["observations"]["policy"]["actions"],
    }
    trained_arm(tmp_path / "run", env, size=2 + 3 + 6)
    (tmp_path / "run" / "io_descriptors" / "IO_descriptors.yaml").unlink()
    elements = export(tmp_path / "run", notices, UR).contract.observation_space.elements
    assert [element.joint for element in elements[:5]] == [*joints, "", "", ""][: len(elements)]
    last = [(element.quantity, element.scale, element.offset) for element in elements[5:]]
    assert last == [("last action", 0.5, 0.25)] * (6 if joints else 0)
    assert [one for one in notices if "clips 'joint_pos' of the observation to -3 to 3" in one]


def test_a_joint_order_is_of_the_robot_that_moves_and_of_no_other(tmp_path: Path) -> None:
    env = environment({"joint_names": ["elbow_joint"]})
    env["actions"]["other"] = {
        **env["actions"]["arm_action"],
        "asset_name": "gripper",
        "joint_names": ["elbow_joint", "x"],
    }
    env["scene"]["gripper"] = env["scene"]["robot"]
    train(tmp_path / "run", settings(), env)
    refuse(tmp_path / "run", "'other' acts on the joints elbow_joint, x in the robot's own order", joint_order=ROBOT)
    env["actions"]["other"] |= {"preserve_order": True, "use_default_offset": False}
    (tmp_path / "run" / "params" / "env.yaml").write_text(yaml.dump(env, sort_keys=False))
    action = export(tmp_path / "run", [], ROBOT).contract.action_space
    assert [element.name for element in action.elements] == ["elbow_joint", "elbow_joint", "x"]


@pytest.mark.parametrize(
    "change",
    [
        lambda env: env["sim"].pop("physx"),  # neither release
        lambda env: env["sim"].update(physics={}),  # both
        lambda env: [entity["init_state"].update(rot=[0.0, 0.0, 0.0, 1.0]) for entity in env["scene"].values()],
    ],
    ids=["neither", "both", "poses"],
)
def test_order_that_is_not_certain_is_asked_for_and_given(
    change: Callable[[Any], Any], tmp_path: Path, notices: list[str]
) -> None:
    env = reach_task("2")
    change(env)
    trained_arm(tmp_path / "run", env)
    space = export(tmp_path / "run", notices).contract.observation_space
    assert {element.axis for element in space.elements[15:19]} == {""}
    assert "the order of the quaternion of pose_command_q0 ... (--convention quaternion=wxyz or xyzw)" in notices[-1]
    given = {"quaternion": "xyzw", "frame": "base"}
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", conventions=given)
    elements = result.contract.observation_space.elements
    assert "".join(element.axis for element in elements[15:19]) == "xyzw"
    assert {element.frame for element in elements[12:19]} == {"base"}


def test_given_convention_does_not_overrule_the_files(tmp_path: Path) -> None:
    trained_arm(tmp_path / "run", reach_task("3"))
    for given, words in (
        ({"quaternion": "wxyz"}, r"element 15 \(pose_command_qx\) is the part x according to its source, not w"),
        (
            {"action": "relative"},
            "shoulder_pan_joint is a joint position according to its source, not a relative joint position",
        ),
        ({"quaternion": "zyxw"}, "--convention quaternion=zyxw: expected quaternion=wxyz or xyzw, frame=NAME"),
    ):
        with pytest.raises(UsageError, match=words):
            export_checkpoint(tmp_path / "run", tmp_path / "out", conventions=given, notify=lambda _: None)


@pytest.mark.parametrize(
    ("seen", "factor", "offset"),
    [
        ({"func": f"{OBSERVATIONS}:joint_pos"}, 1.0, 0.0),
        ({"clip": [-100.0, 100.0]}, 1.0, 0.25),  # joint_pos_rel, from a default of 0.25 rad
        ({"scale": 0.5}, 2.0, 0.25),
        ({"clip": [-1.0, 1.0]}, 0.0, 0.0),  # no longer a position, so the action stays relative
        ({"func": f"{OBSERVATIONS}:joint_effort"}, 0.0, 0.0),
    ],
    ids=["absolute", "from the default", "scaled", "clipped", "not seen"],
)
@pytest.mark.parametrize("before", ["", "base_lin_vel"])
def test_relative_action_is_scaled_clipped_and_added_to_the_position_that_is_observed(
    before: str, seen: dict[str, Any], factor: float, offset: float, tmp_path: Path, notices: list[str]
) -> None:
    term = {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:RelativeJointPositionAction", "joint_names": [".*"],
        "scale": 0.0625, "offset": 3.0, "use_zero_offset": True, "clip": {"elbow_joint": [-0.01, 0.01]},
    }  # fmt: skip
    env = reach_task("3", term)
    del env["actions"]["arm_action"]["use_default_offset"]
    terms = env["observations"]["policy"]
    del terms["actions"]
    terms["joint_pos"] |= seen
    first, size = (3, 22) if before else (0, 19)
    if before:
        env["observations"]["policy"] = {before: {"func": f"{OBSERVATIONS}:{before}", "params": {}}, **terms}
    runner = trained_arm(tmp_path / "run", env, size=size)
    result = export(tmp_path / "run", notices)
    elements = result.contract.action_space.elements
    assert [(one.quantity, one.joint, one.unit) for one in elements] == [
        ("joint position" if factor else "relative joint position", joint, "rad") for joint in UR
    ]
    torch.manual_seed(5)
    episodes = [2 + 3 * torch.randn(8, size)]
    raw = np.array(raw_actions(runner, episodes)) * 0.0625
    wanted = raw.copy()
    wanted[:, 2] = np.clip(wanted[:, 2], -0.01, 0.01)
    assert (raw != wanted).any()
    if factor:
        wanted += episodes[0][:, first : first + 6].numpy() * factor + offset
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    assert not any("relative action's" in one for one in result.contract.parity.unreached)
