"""Runs of skrl's Runner against the agent's own mean actions."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from gymnasium import spaces

import rlservo
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.serve_app.runtime.policy import Policy

pytest.importorskip("skrl")
torch = pytest.importorskip("torch")

SEEN = 4


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
            "class": algorithm, "rollouts": 4, "observation_preprocessor": "RunningStandardScaler",
            "observation_preprocessor_kwargs": None,
        },
        "trainer": {"class": "SequentialTrainer", "timesteps": 10, "close_environment_at_exit": False},
        **changes,
    }  # fmt: skip


def train(folder: Path, settings: dict[str, Any], action_space: Any) -> Any:
    from skrl.utils.runner.torch import Runner

    env: Any = SimpleNamespace(
        device="cpu", num_envs=1, num_agents=1, observation_space=spaces.Box(-np.inf, np.inf, (SEEN,), np.float32),
        state_space=None, action_space=action_space,
    )  # fmt: skip
    agent = Runner(env, settings).agent
    torch.manual_seed(3)
    scaler = agent.checkpoint_modules.get("observation_preprocessor")
    if scaler is not None:
        scaler(1 + 2 * torch.randn(500, SEEN), train=True)
    with torch.no_grad():
        for weights in agent.models["policy"].parameters():
            weights.add_(0.3 * torch.randn_like(weights))
    (folder / "params").mkdir(parents=True)
    (folder / "checkpoints").mkdir()
    (folder / "params" / "agent.yaml").write_text(yaml.dump(settings, sort_keys=False))
    agent.save(str(folder / "checkpoints" / "agent_500.pt"))
    agent.enable_models_training_mode(False)
    return agent


def observations() -> Any:
    torch.manual_seed(5)
    return 1 + 8 * torch.randn(20, SEEN)  # some reach the scaler's clip


def test_the_scaler_and_the_environments_scale_are_baked_in(tmp_path: Path, notices: list[str]) -> None:
    agent = train(tmp_path / "run", config(), spaces.Box(-1, 1, (2,), np.float32))
    env = {"sim": {"dt": 0.01}, "decimation": 2, "actions": {"arm": {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointVelocityAction", "joint_names": ["pan", "lift"],
        "scale": 0.5, "offset": 0.0, "use_default_offset": True}}}  # fmt: skip
    (tmp_path / "run" / "params" / "env.yaml").write_text(yaml.dump(env, sort_keys=False))
    result = export_checkpoint(tmp_path / "run", tmp_path / "out", name="arm", notify=notices.append)
    obs = observations()
    with torch.no_grad():
        wanted = 0.5 * agent.act(obs, None, timestep=0, timesteps=0)[1]["mean_actions"].numpy()
    with Policy.load(result.path) as policy:
        found = [policy.act(one.numpy()) for one in obs]
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=2e-6)
    contract = result.contract
    assert contract.baked_in[0].step == "mean_std_filter" and contract.baked_in[0].values["count"] == 501
    assert [(e.name, e.unit) for e in contract.action_space.elements] == [("pan", "rad/s"), ("lift", "rad/s")]
    assert (contract.provenance.algorithm, contract.provenance.env_steps) == ("PPO", 500)
    assert "expressions that skrl evaluates" in notices[0]


def test_a_categorical_policy_takes_the_likeliest_choice(tmp_path: Path, notices: list[str]) -> None:
    agent = train(tmp_path / "run", config(kind="CategoricalMixin"), spaces.Discrete(3))
    result = export_checkpoint(
        tmp_path / "run" / "checkpoints" / "agent_500.pt", tmp_path / "out", name="chooser", notify=notices.append
    )
    obs = observations()
    with torch.no_grad():
        wanted = agent.act(obs, None, timestep=0, timesteps=0)[1]["net_output"].argmax(-1).numpy()
    with Policy.load(result.path) as policy:
        np.testing.assert_array_equal([policy.act(one.numpy()) for one in obs], wanted)


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


def test_runs_that_cannot_be_read_are_refused_with_the_reason(tmp_path: Path, notices: list[str]) -> None:
    train(tmp_path / "run", config(), spaces.Box(-1, 1, (2,), np.float32))
    file = tmp_path / "run" / "params" / "agent.yaml"

    def refused(words: str, kind: type[Exception] = CheckpointError) -> None:
        with pytest.raises(kind, match=words):
            export_checkpoint(tmp_path / "run", tmp_path / "out", notify=notices.append)
        assert not (tmp_path / "out").exists()

    clipping = config()
    clipping["models"]["policy"]["clip_mean_actions"] = True
    file.write_text(yaml.dump(clipping))
    refused("clips to the action space, whose bounds are in no file of the run", UnsupportedError)
    other = config()
    other["models"]["policy"]["network"][0]["layers"] = [9]
    file.write_text(yaml.dump(other))
    refused("cannot be restored from agent.yaml: .*policy|size mismatch|Error")
    file.write_text(yaml.dump(config("PPO_RNN")))
    refused("is of a recurrent agent.*examples/skrl_recurrent.py", UnsupportedError)
    file.write_text("models: [")
    refused("agent.yaml cannot be read")
