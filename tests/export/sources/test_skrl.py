"""Runs of skrl's Runner against the agent's own mean actions."""

from __future__ import annotations

import copy
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium import spaces

import rlservo
from rlservo.bundle.spaces import BoxSpec
from rlservo.errors import CheckpointError, RlservoError, UnsupportedError
from rlservo.export.export_checkpoint import export_checkpoint, silent
from rlservo.export.sources.skrl import Skrl
from rlservo.export.sources.source import RestoreOptions
from rlservo.policy.policy import Policy

pytest.importorskip("skrl")
torch = pytest.importorskip("torch")

SEEN = 4
Box, Discrete = spaces.Box, spaces.Discrete


def config(algorithm: str = "PPO", kind: str = "GaussianMixin", **changes: Any) -> dict[str, Any]:
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [8], "activations": "elu"}]
    policy: dict[str, Any] = {"class": kind, "network": network, "output": "ACTIONS"}
    if kind == "GaussianMixin":
        policy["clip_actions"] = True
    return {
        "seed": 1,
        "models": {
            "separate": True,
            "policy": policy,
            "value": {"class": "DeterministicMixin", "network": network, "output": "ONE"},
        },
        "memory": {"class": "RandomMemory", "memory_size": -1},
        "agent": {
            "class": algorithm, "rollouts": 8, "observation_preprocessor": "RunningStandardScaler",
            "observation_preprocessor_kwargs": None, "experiment": {"write_interval": 0, "checkpoint_interval": 0},
        },
        "trainer": {"class": "SequentialTrainer", "timesteps": 24, "headless": True, "disable_progressbar": True,
                    "close_environment_at_exit": False},
        **changes,
    }  # fmt: skip


def off_policy(algorithm: str, roles: dict[str, dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """Return the settings of an agent that learns from a memory."""
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [8], "activations": "elu"}]
    models = {role: {"class": "DeterministicMixin", "network": network, **more} for role, more in roles.items()}
    settings = config(algorithm)
    agent = {**settings["agent"], "batch_size": 8, "learning_starts": 4, "random_timesteps": 4, **changes}
    del agent["rollouts"]
    return {
        **settings, "models": {"separate": True, **models}, "agent": agent,
        "memory": {"class": "RandomMemory", "memory_size": 32},
    }  # fmt: skip


class World(gymnasium.Env[Any, Any]):
    """An environment whose observations are random, to train in."""

    def __init__(self, action_space: Any, states: int | None = None) -> None:
        self.observation_space = Box(-np.inf, np.inf, (SEEN,), np.float32)
        self.action_space = action_space
        self.state_space = None if states is None else Box(-np.inf, np.inf, (states,), np.float32)
        self._rng = np.random.default_rng(3)

    def _observe(self) -> Any:
        return (1 + 2 * self._rng.standard_normal(SEEN)).astype(np.float32)

    def state(self) -> Any:
        return None if self.state_space is None else self._rng.random(self.state_space.shape, np.float32)

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._observe(), -float(np.square(action).sum()), bool(self._rng.random() < 0.1), False, {}


def train(folder: Path, settings: dict[str, Any], action_space: Any, states: int | None = None) -> Any:
    """Return a trained agent whose weights and settings are saved in `folder`, as Isaac Lab leaves them."""
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.utils.runner.torch import Runner

    (folder / "params").mkdir(parents=True)
    (folder / "checkpoints").mkdir()
    (folder / "params" / "agent.yaml").write_text(yaml.dump(settings, sort_keys=False))
    training = copy.deepcopy(settings)
    training["agent"]["experiment"]["directory"] = str(folder)
    runner = Runner(wrap_env(World(action_space, states), wrapper="gymnasium", verbose=False), training)
    runner.run()
    with torch.no_grad():
        for model in runner.agent.models.values():
            for weights in model.parameters():
                weights.add_(0.3 * torch.randn_like(weights))  # a few steps of training leave small actions
    runner.agent.save(str(folder / "checkpoints" / "agent_500.pt"))
    runner.agent.enable_models_training_mode(False)
    return runner.agent


def observations() -> Any:
    torch.manual_seed(5)
    return 1 + 8 * torch.randn(20, SEEN)  # some reach the scaler's clip


def refuse(run: Path, words: str, kind: type[Exception] = CheckpointError) -> None:
    with pytest.raises(kind, match=words):
        export_checkpoint(run, run.parent / "out", notify=lambda _: None)
    assert not (run.parent / "out").exists()


def test_the_scaler_and_the_environments_scale_are_baked_in(tmp_path: Path, notices: list[str]) -> None:
    agent = train(tmp_path / "run", config(), Box(-1, 1, (2,), np.float32))
    env = {"sim": {"dt": 0.01}, "decimation": 2, "actions": {"arm": {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointVelocityAction", "joint_names": ["pan", "lift"],
        "scale": {"lift": 2.0, "pan": 0.5}, "offset": 0.0, "use_default_offset": True, "clip": {"pan": [-0.1, 0.1]}}},
        "scene": {"num_envs": 64, "robot": {"init_state": {"joint_vel": {"lift": 0.3}}}}}  # fmt: skip
    (tmp_path / "run" / "params" / "env.yaml").write_text(yaml.dump(env, sort_keys=False))
    refuse(tmp_path / "run", "in the robot's own order, which no file of the run has")
    result = export_checkpoint(
        tmp_path / "run", tmp_path / "out", name="arm", joint_order=["lift", "wrist", "pan"], notify=notices.append
    )
    obs = observations()
    with torch.no_grad():
        raw = agent.act(obs, None, timestep=0, timesteps=0)[1]["mean_actions"].numpy()
    wanted = np.clip(raw * [2.0, 0.5] + [0.3, 0.0], [-np.inf, -0.1], [np.inf, 0.1])
    with Policy.load(result.path) as policy:
        found = [policy.act(one.numpy()) for one in obs]
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=2e-6)
    assert (np.abs(wanted[:, 1]) == 0.1).any()
    contract = result.contract
    assert contract.baked_in[0].step == "mean_std_filter"
    assert contract.baked_in[0].values["count"] == int(
        agent.checkpoint_modules["observation_preprocessor"].current_count
    )
    assert [(e.name, e.unit) for e in contract.action_space.elements] == [("lift", "rad/s"), ("pan", "rad/s")]
    assert (contract.provenance.algorithm, contract.provenance.env_steps) == ("PPO", 500 * 64)
    assert "expressions that skrl evaluates" in notices[0]


def test_a_relative_action_is_added_to_the_position_that_is_observed(tmp_path: Path) -> None:
    agent = train(tmp_path / "run", config(), Box(-1, 1, (2,), np.float32))
    of_joints = {"asset_cfg": {"name": "robot", "joint_names": ["pan", "lift"]}}
    places = "isaaclab.envs.mdp.observations"
    env = {"actions": {"arm": {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:RelativeJointPositionAction", "scale": 0.0625,
        "joint_names": ["pan", "lift"], "use_zero_offset": True, "clip": {"pan": [-0.01, 0.01]}}},
        "observations": {"policy": {"concatenate_terms": True, "joint_vel": {"func": f"{places}:joint_vel",
            "params": of_joints}, "joint_pos": {"func": f"{places}:joint_pos_rel", "params": of_joints}}},
        "scene": {"robot": {"init_state": {"joint_pos": {"lift": 0.3, "pan": -1.0}}}}}  # fmt: skip
    (tmp_path / "run" / "params" / "env.yaml").write_text(yaml.dump(env, sort_keys=False))
    order = ["lift", "wrist", "pan"]
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", joint_order=order, notify=lambda _: None)
    obs = observations()
    with torch.no_grad():
        raw = agent.act(obs, None, timestep=0, timesteps=0)[1]["mean_actions"].numpy()
    steps = np.clip(raw * 0.0625, [-np.inf, -0.01], [np.inf, 0.01])
    with Policy.load(result.path) as policy:
        found = [policy.act(one.numpy()) for one in obs]
    np.testing.assert_allclose(found, steps + obs[:, 2:].numpy() + [0.3, -1.0], rtol=1e-5, atol=2e-6)
    assert [(e.quantity, e.joint) for e in result.contract.action_space.elements] == [
        ("joint position", "lift"), ("joint position", "pan"),
    ]  # fmt: skip


@pytest.mark.parametrize("scaled", [False, True])
def test_a_critic_may_see_more_than_the_policy(tmp_path: Path, scaled: bool) -> None:
    """Isaac Lab's `state_space`: the value function's own input, whose size only its weights have."""
    settings = config()
    settings["models"]["value"]["network"] = [{"name": "net", "input": "STATES", "layers": [8], "activations": "elu"}]
    if scaled:
        settings["agent"] |= {"state_preprocessor": "RunningStandardScaler", "state_preprocessor_kwargs": None}
    agent = train(tmp_path / "run", settings, Box(-1, 1, (2,), np.float32), 7)
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", notify=lambda _: None)
    obs = observations()
    with torch.no_grad():
        wanted = agent.act(obs, torch.rand(20, 7), timestep=0, timesteps=0)[1]["mean_actions"].numpy()
    with Policy.load(result.path) as policy:
        np.testing.assert_allclose([policy.act(one.numpy()) for one in obs], wanted, rtol=1e-5, atol=2e-6)


def test_a_policy_that_sees_the_critics_state_is_refused(tmp_path: Path) -> None:
    settings = config()
    settings["models"]["policy"]["network"] = [
        {"name": "net", "input": "concatenate([OBSERVATIONS, STATES])", "layers": [8], "activations": "elu"}
    ]
    settings["models"]["value"]["network"] = [{"name": "net", "input": "STATES", "layers": [8], "activations": "elu"}]
    train(tmp_path / "run", settings, Box(-1, 1, (2,), np.float32), 7)
    refuse(tmp_path / "run", "its policy takes STATES, which only a simulator has", UnsupportedError)


def test_actions_without_an_environments_file_have_no_bounds(tmp_path: Path, notices: list[str]) -> None:
    train(tmp_path / "run", config(), Box(-1, 1, (2,), np.float32))
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", notify=notices.append)
    assert isinstance(result.contract.action_space, BoxSpec)
    assert (result.contract.action_space.low, result.contract.action_space.high) == (None, None)
    assert not [notice for notice in notices if "inside" in notice]
    # Another source's bounds, which nothing enforces, are reported in its own name.
    seen, chosen = Box(-np.inf, np.inf, (SEEN,), np.float32), Box(-1, 1, (2,), np.float32)
    own = torch.nn.Linear(SEEN, 2)
    rlservo.export_policy(own, seen, chosen, tmp_path / "out", name="own", clip=False, notify=notices.append)
    assert [notice for notice in notices if notice.startswith("action: torch sends the network's own numbers, whether")]


@pytest.mark.parametrize("normalized", [False, True])
def test_a_categorical_policy_takes_the_likeliest_choice_and_explores_as_the_agent(
    normalized: bool, tmp_path: Path, notices: list[str]
) -> None:
    settings = config(kind="CategoricalMixin")
    if normalized:  # the model gives probabilities, to any sum
        settings["models"]["policy"] |= {"unnormalized_log_prob": False, "output": "3 * sigmoid(ACTIONS)"}
    agent = train(tmp_path / "run", settings, Discrete(3))
    (tmp_path / "run" / "checkpoints" / "best_agent.pt").touch()
    result = export_checkpoint(
        tmp_path / "run" / "checkpoints" / "agent_500.pt", tmp_path / "out", name="chooser", notify=notices.append
    )
    assert any("this is agent_500.pt" in notice and "best_agent.pt" in notice for notice in notices)
    assert result.contract.provenance.env_steps is None  # without env.yaml the number of environments is unknown
    obs = observations()
    with torch.no_grad():
        agent.act(obs, None, timestep=0, timesteps=0)
        wanted = agent.models["policy"].distribution(role="policy").probs.numpy()
    with Policy.load(result.path) as policy:
        np.testing.assert_array_equal([policy.act(one.numpy()) for one in obs], wanted.argmax(-1))
        for number, one in enumerate(obs[:6]):
            drawn = policy.act(np.repeat(one.numpy()[None], 4000, 0), explore=True, seed=number)
            shares = np.bincount(drawn, minlength=3) / 4000
            np.testing.assert_allclose(shares, wanted[number], atol=4 * 0.5 / 4000**0.5)


@pytest.mark.parametrize("algorithm", ["DQN", "DDQN"])
@pytest.mark.parametrize("scaled", [True, False])
def test_a_q_network_takes_the_choice_of_the_largest_value(
    algorithm: str, scaled: bool, tmp_path: Path, notices: list[str]
) -> None:
    roles = {"q_network": {"output": "ACTIONS"}, "target_q_network": {"output": "ACTIONS"}}
    settings = off_policy(algorithm, roles, exploration_scheduler="max(1 - timestep / 20, 0.04)")
    if not scaled:
        del settings["agent"]["observation_preprocessor"]
    agent = train(tmp_path / "run", settings, Discrete(3))
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="chooser", notify=notices.append)
    agent.cfg.exploration_scheduler = None  # it draws 4% at random for ever
    obs = observations()
    with torch.no_grad():
        wanted = agent.act(obs, None, timestep=100, timesteps=100)[0][:, 0].numpy()
    assert len(set(wanted)) > 1
    with Policy.load(result.path) as policy:
        np.testing.assert_array_equal([policy.act(one.numpy()) for one in obs], wanted)
    assert any(tensor.name == "q_values" for tensor in result.contract.outputs)
    assert result.contract.distribution is None


def test_a_deterministic_policy_acts_without_its_training_noise(tmp_path: Path, notices: list[str]) -> None:
    network = [{"name": "net", "input": "concatenate([OBSERVATIONS, ACTIONS])", "layers": [8], "activations": "elu"}]
    critics: dict[str, dict[str, Any]] = {
        role: {"network": network, "output": "ONE"} for role in ("critic", "target_critic")
    }
    roles: dict[str, dict[str, Any]] = {
        "policy": {"output": "tanh(ACTIONS)"},
        "target_policy": {"output": "tanh(ACTIONS)"},
        **critics,
    }
    settings = off_policy("DDPG", roles, exploration_noise="OrnsteinUhlenbeckNoise",
                          exploration_noise_kwargs={"theta": 0.15, "sigma": 0.2, "base_scale": 1.0})  # fmt: skip
    agent = train(tmp_path / "run", settings, Box(-1, 1, (2,), np.float32))
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", notify=notices.append)
    obs = observations()
    scaled = agent.checkpoint_modules["observation_preprocessor"](obs)
    with torch.no_grad():
        wanted = agent.models["policy"].act({"observations": scaled, "states": None}, role="policy")[0].numpy()
    with Policy.load(result.path) as policy:
        np.testing.assert_allclose([policy.act(one.numpy()) for one in obs], wanted, rtol=1e-5, atol=2e-6)


def test_a_network_on_part_of_the_observation_has_the_whole_ones_size(tmp_path: Path, notices: list[str]) -> None:
    settings = config()
    settings["models"]["policy"]["network"] = [
        {"name": "net", "input": "OBSERVATIONS[:, :2]", "layers": [8], "activations": "elu"}
    ]
    agent = train(tmp_path / "run", settings, Box(-1, 1, (2,), np.float32))
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", notify=notices.append)
    obs = observations()
    with torch.no_grad():
        wanted = agent.act(obs, torch.rand(20, 7), timestep=0, timesteps=0)[1]["mean_actions"].numpy()
    with Policy.load(result.path) as policy:
        np.testing.assert_allclose([policy.act(one.numpy()) for one in obs], wanted, rtol=1e-5, atol=2e-6)
    del settings["agent"]["observation_preprocessor"]  # without it no file has the size
    shutil.rmtree(tmp_path / "out")
    train(tmp_path / "other", settings, Box(-1, 1, (2,), np.float32))
    refuse(tmp_path / "other", "number of elements of an observation is in no file of the run", UnsupportedError)


@pytest.mark.parametrize("cell", ["GRU", "LSTM"])
def test_a_recurrent_agent_forgets_where_an_episode_starts(cell: str, tmp_path: Path, notices: list[str]) -> None:
    from skrl.agents.torch.ppo import PPO_RNN
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import GaussianMixin, Model
    from skrl.resources.preprocessors.torch import RunningStandardScaler
    from skrl_recurrent import RecurrentPolicy

    class Recurrent(GaussianMixin, Model):  # type: ignore[misc]  # as skrl's documentation has it
        def __init__(self, *spaces: Any) -> None:
            Model.__init__(self, observation_space=spaces[0], action_space=spaces[1], device="cpu")
            GaussianMixin.__init__(self)
            self.memory = getattr(torch.nn, cell)(SEEN, 6, num_layers=2, batch_first=True)
            self.head = torch.nn.Linear(6, 2)
            self.log_std = torch.nn.Parameter(torch.zeros(2))

        def get_specification(self) -> dict[str, Any]:
            return {"rnn": {"sequence_length": 4, "sizes": [(2, 1, 6)] * (2 if cell == "LSTM" else 1)}}

        def compute(self, inputs: dict[str, Any], role: str) -> tuple[Any, dict[str, Any]]:
            before = tuple(inputs["rnn"]) if cell == "LSTM" else inputs["rnn"][0]
            seen, after = self.memory(inputs["observations"][:, None], before)
            after = list(after) if cell == "LSTM" else [after]
            return self.head(seen[:, 0]).tanh(), {"log_std": self.log_std, "rnn": after}

    torch.manual_seed(0)
    seen = spaces.Box(-np.inf, np.inf, (SEEN,), np.float32)
    chosen = spaces.Box(-1, 1, (2,), np.float32)
    models = {"policy": Recurrent(seen, chosen), "value": Recurrent(seen, chosen)}
    settings = {"observation_preprocessor": RunningStandardScaler,
                "observation_preprocessor_kwargs": {"size": seen, "device": "cpu"}}  # fmt: skip
    agent = PPO_RNN(models=models, memory=RandomMemory(memory_size=8, device="cpu"), cfg=settings,
                    observation_space=seen, action_space=chosen, device="cpu")  # fmt: skip
    agent.init()
    agent.checkpoint_modules["observation_preprocessor"](1 + 2 * torch.randn(200, SEEN), train=True)
    agent.enable_models_training_mode(False)
    policy = RecurrentPolicy(agent)
    result = rlservo.export_policy(
        policy, seen, chosen, tmp_path, name="arm", state=policy.initial_state(), notify=notices.append
    )
    obs = observations()
    wanted = []
    for _ in range(2):  # skrl's own acting, its memory zero where an episode starts
        memory = [torch.zeros(size) for size in policy.sizes]
        for one in obs:
            scaled = agent.checkpoint_modules["observation_preprocessor"](one[None])
            outputs = agent.models["policy"].act(
                {"observations": scaled, "states": None, "rnn": memory}, role="policy"
            )[1]
            memory = outputs["rnn"]
            wanted.append(outputs["mean_actions"][0].detach().numpy())
    with Policy.load(result.path) as acting:
        found = []
        for _ in range(2):
            acting.reset()
            found += [acting.act(one.numpy()) for one in obs]
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=2e-6)
    assert not np.allclose(found[0], found[len(obs) // 2]), "the memory did not matter"


def test_a_scaler_that_the_settings_do_not_name_is_refused(tmp_path: Path) -> None:
    """It was left out: the run's two files contradict each other."""
    settings = config()
    train(tmp_path / "run", settings, Box(-1, 1, (2,), np.float32))
    settings["agent"]["observation_preprocessor"] = None
    (tmp_path / "run" / "params" / "agent.yaml").write_text(yaml.dump(settings))
    refuse(tmp_path / "run", "has an observation_preprocessor, and .*agent.yaml names none: they do not belong")


def test_runs_that_cannot_be_read_are_refused_with_the_reason(tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(run, config(), Box(-1, 1, (2,), np.float32))
    file = run / "params" / "agent.yaml"
    clipping = config()
    clipping["models"]["policy"]["clip_mean_actions"] = True
    file.write_text(yaml.dump(clipping))
    refuse(run, "clips to the action space, whose bounds are in no file of the run", UnsupportedError)
    other = config()
    other["models"]["policy"]["network"][0]["layers"] = [9]
    file.write_text(yaml.dump(other))
    refuse(run, "cannot be restored from agent.yaml: .*policy|size mismatch|Error")
    file.write_text(yaml.dump(config("PPO_RNN")))
    refuse(run, "is of a recurrent agent.*examples/skrl_recurrent.py", UnsupportedError)
    file.write_text(yaml.dump(config("MAPPO")))
    refuse(run, r"is of several agents \(MAPPO: .*\): give the policy of each", UnsupportedError)
    file.write_text("models: [")
    refuse(run, "agent.yaml cannot be read")
    file.write_bytes(b"models:\xff")
    refuse(run, "agent.yaml cannot be read")
    file.write_text(yaml.dump(config()))
    (run / "checkpoints" / "agent_500.pt").write_bytes(pickle.dumps({"policy": SimpleNamespace()}))
    refuse(run, "as weights alone: it is a pickle with Python objects in it, which would run code when loaded")


def test_settings_of_another_type_are_refused_with_a_sentence(tmp_path: Path) -> None:
    """Each setting, and each entry of the checkpoint, of four other types: no traceback."""
    run = tmp_path / "run"
    settings = config()
    train(run, settings, Box(-1, 1, (2,), np.float32))
    file, weights = run / "params" / "agent.yaml", run / "checkpoints" / "agent_500.pt"
    refused = 0
    for changed in others({**settings, "agent": {**settings["agent"], "experiment": None}}):
        file.write_text(yaml.dump(changed, sort_keys=False))
        refused += not exports(run)
    file.write_text(yaml.dump(settings, sort_keys=False))
    saved = torch.load(weights, weights_only=True)
    for key in saved:
        for value in (3, [1], {"a": 1}, {"net_container.0.weight": torch.zeros(2)}):
            torch.save({**saved, key: value}, weights)
            refused += not exports(run)
    assert refused > 50


def others(value: Any) -> Iterator[Any]:
    """Yield `value` with each of its parts replaced in turn."""
    yield from (7, "text", [None], {"a": "b"})
    for key in value if isinstance(value, dict) else ():
        for changed in others(value[key]):
            yield {**value, key: changed}


def exports(run: Path) -> bool:
    """Return whether a run is restored; anything but an error of our own fails the test."""
    source = Skrl()
    try:
        files = source.locate(run, None, None)
        source.facts(files, silent)
        source.restore(files, RestoreOptions(run), silent)
    except RlservoError as error:
        assert "weights_only" not in error.message
        return False
    return True
