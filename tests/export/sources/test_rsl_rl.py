"""Runs of rsl_rl, as Isaac Lab and mjlab leave them, against the runner's own inference policy."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.serve_app.runtime.policy import Policy

pytest.importorskip("rsl_rl")
torch = pytest.importorskip("torch")

JOINTS = {"shoulder_pan_joint": 0.0, "shoulder_lift_joint": -1.712, "elbow_joint": 1.712}
OBSERVED = 5


def settings(**actor: Any) -> dict[str, Any]:
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "scalar"}
    of_actor = {"class_name": "MLPModel", "hidden_dims": [8], "activation": "elu", "obs_normalization": True}
    return {
        "num_steps_per_env": 4, "save_interval": 100, "clip_actions": None, "multi_gpu": None, "logger": "tensorboard",
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]},
        "algorithm": {"class_name": "PPO"},
        "actor": {**of_actor, "distribution_cfg": distribution, **actor},
        "critic": {**of_actor, "distribution_cfg": None},
    }  # fmt: skip


def environment(action: dict[str, Any], joint_pos: dict[str, float] | None = None) -> dict[str, Any]:
    return {
        "decimation": 2, "sim": {"dt": 1 / 60},
        "scene": {"robot": {"init_state": {"joint_pos": JOINTS if joint_pos is None else joint_pos}}},
        "actions": {"arm_action": {
            "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointPositionAction", "asset_name": "robot",
            "joint_names": [".*"], "scale": 0.5, "offset": 0.0, "use_default_offset": True, "clip": None, **action,
        }},
    }  # fmt: skip


def train(folder: Path, agent: dict[str, Any], env: dict[str, Any] | None) -> Any:
    """Return a runner whose weights and statistics are saved in `folder`, as Isaac Lab's train.py leaves it."""
    from rsl_rl.runners import OnPolicyRunner  # here: it imports all of torch's compiler
    from tensordict import TensorDict

    torch.manual_seed(0)
    obs = TensorDict({"policy": torch.randn(6, OBSERVED), "privileged": torch.randn(6, 2)}, batch_size=[6])
    world = SimpleNamespace(num_envs=6, num_actions=3, device="cpu", cfg={}, get_observations=lambda: obs)
    (folder / "params").mkdir(parents=True)
    (folder / "params" / "agent.yaml").write_text(yaml.dump(agent))
    if env is not None:
        written = yaml.dump(env, sort_keys=False).replace(
            "joint_names:", "unused: !!python/tuple [1, 2]\n    joint_names:", 1
        )
        (folder / "params" / "env.yaml").write_text(written)
    runner = OnPolicyRunner(world, agent, log_dir=None, device="cpu")
    actor = runner.alg.get_policy()
    for _ in range(5):
        actor.update_normalization(TensorDict({"policy": 2 + 3 * torch.randn(50, OBSERVED)}, batch_size=[50]))
    with torch.no_grad():
        for weights in actor.parameters():
            weights.add_(0.2 * torch.randn_like(weights))
    runner.save(str(folder / "model_40.pt"))
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


def export(folder: Path, notices: list[str]) -> ExportResult:
    return export_checkpoint(folder, folder.parent / "out", name="arm", notify=notices.append)


@pytest.mark.parametrize("memory", ["none", "lstm", "gru"])
def test_isaac_labs_run_becomes_joint_targets(memory: str, tmp_path: Path, notices: list[str]) -> None:
    rnn = {"class_name": "RNNModel", "rnn_type": memory, "rnn_hidden_dim": 4, "rnn_num_layers": 2}
    runner = train(tmp_path / "run", settings(**({} if memory == "none" else rnn)), environment({}))
    result = export(tmp_path / "run", notices)
    episodes = observations()
    wanted = [0.5 * raw + np.array(list(JOINTS.values())) for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    contract = result.contract
    assert [element.name for element in contract.action_space.elements] == list(JOINTS)
    assert contract.action_space.elements[0].unit == "rad"
    assert contract.control_rate_hz == pytest.approx(30.0)
    assert contract.baked_in[0].step == "mean_std_filter" and contract.baked_in[0].values["count"] == 250
    assert len(contract.state) == {"none": 0, "lstm": 2, "gru": 1}[memory]
    assert (contract.provenance.algorithm, contract.provenance.training_iterations) == ("PPO", 40)
    assert not any("loading" in notice for notice in notices)  # nothing is unpickled
    assert "the joints' order is that of env.yaml's init_state" in " ".join(notices)


def test_clip_before_scale_and_scales_of_single_joints(tmp_path: Path, notices: list[str]) -> None:
    action = {"joint_names": ["elbow_joint", "wrist_1_joint", "wrist_2_joint"], "use_default_offset": False,
              "scale": {"wrist_.*": 2.0, "elbow_joint": 0.25}, "offset": 0.1}  # fmt: skip
    runner = train(tmp_path / "run", {**settings(), "clip_actions": 0.3}, environment(action))
    result = export(tmp_path / "run", notices)
    episodes = observations()
    wanted = [np.clip(raw, -0.3, 0.3) * [0.25, 2.0, 2.0] + 0.1 for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)


def test_mjlab_names_its_parts_otherwise(tmp_path: Path, notices: list[str]) -> None:
    env = environment({}, {".*": 0.2})
    env["scene"] = {"entities": env["scene"]}
    env["sim"] = {"mujoco": {"timestep": 0.005}}
    term = env["actions"]["arm_action"]
    term |= {"class_type": "mjlab.envs.mdp.actions.actions.JointPositionAction", "entity_name": "robot"}
    term["actuator_names"] = term.pop("joint_names")
    runner = train(tmp_path / "run", settings(), env)
    result = export(tmp_path / "run", notices)
    episodes = observations()
    wanted = [0.5 * raw + 0.2 for raw in raw_actions(runner, episodes)]
    np.testing.assert_allclose(bundle_actions(result, episodes), wanted, rtol=1e-5, atol=2e-6)
    assert result.contract.control_rate_hz == pytest.approx(100.0) and not result.contract.action_space.elements


def test_an_order_of_joints_that_was_lost_is_not_guessed(tmp_path: Path, notices: list[str]) -> None:
    runner = train(tmp_path / "run", settings(), environment({}))
    file = tmp_path / "run" / "params" / "env.yaml"
    file.write_text(yaml.dump(environment({}), sort_keys=True))
    result = export(tmp_path / "run", notices)
    episodes = observations()
    np.testing.assert_allclose(bundle_actions(result, episodes), raw_actions(runner, episodes), rtol=1e-5, atol=2e-6)
    assert "a default offset of single joints" in " ".join(notices) and "NOT in the export" in " ".join(notices)


def test_what_is_no_scale_stays_the_policys_own_and_is_said(tmp_path: Path, notices: list[str]) -> None:
    env = environment(
        {"class_type": "isaaclab.envs.mdp.actions.task_space_actions:DifferentialInverseKinematicsAction"}
    )
    runner = train(tmp_path / "run", settings(), env)
    result = export(tmp_path / "run", notices)
    episodes = observations()
    np.testing.assert_allclose(bundle_actions(result, episodes), raw_actions(runner, episodes), rtol=1e-5, atol=2e-6)
    assert "DifferentialInverseKinematicsAction, which is more than a scale and an offset" in " ".join(notices)


def test_runs_that_cannot_be_read_are_refused_with_the_reason(tmp_path: Path, notices: list[str]) -> None:
    train(tmp_path / "run", settings(), environment({"joint_names": ["elbow_joint"]}))
    model = tmp_path / "run" / "model_40.pt"
    saved = torch.load(model, weights_only=True)
    agent = tmp_path / "run" / "params" / "agent.yaml"

    def refused(words: str, kind: type[Exception] = CheckpointError) -> None:
        with pytest.raises(kind, match=words):
            export(tmp_path / "run", notices)
        assert not (tmp_path / "out").exists()

    refused(r"action terms \(arm_action\) have 1 elements, the policy's action has 3: they do not belong together")
    (tmp_path / "run" / "params" / "env.yaml").unlink()
    agent.write_text(yaml.dump(settings(hidden_dims=[9])))
    refused("its weights do not fit params/agent.yaml: .*size mismatch")
    agent.write_text(yaml.dump(settings(class_name="their_models:Mine")))
    refused("the class of its actor cannot be imported: it needs the Python module 'their_models'")
    agent.write_text(yaml.dump(settings()))
    torch.save({"model_state_dict": saved["actor_state_dict"], "iter": 1}, model)
    refused("a run of an older rsl_rl", UnsupportedError)
    torch.save({**saved, "infos": SimpleNamespace()}, model)
    refused("cannot be read as weights alone")
    model.write_bytes(b"not an archive")
    refused("cannot be read as weights alone")
