"""A user's own code for RLlib's old API stack: environments and models that checkpoints name."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from ray.rllib.algorithms.ppo.ppo_torch_policy import PPOTorchPolicy
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.rllib.models.torch.recurrent_net import RecurrentNetwork
from ray.rllib.models.torch.torch_modelv2 import TorchModelV2
from ray.rllib.policy.view_requirement import ViewRequirement
from torch import nn

INF = np.inf
SPACES: dict[str, tuple[gym.Space[Any], gym.Space[Any]]] = {
    "unbounded": (Box(-INF, INF, (4,), np.float64), Box(-INF, INF, (2,), np.float32)),
    "half_bounded": (
        Box(-1.0, 1.0, (3,), np.float32),
        Box(np.array([0.0, -1.0], np.float32), np.array([INF, 1.0], np.float32)),
    ),
    "mixed": (
        Box(-1.0, 1.0, (5,), np.float32),
        Box(np.array([-1.0, 0.0, -7.5], np.float32), np.array([3.0, 0.5, -2.5], np.float32)),
    ),
    "double": (Box(-INF, INF, (3,), np.float64), Box(-2.0, 5.0, (2,), np.float64)),
    "started": (Box(-1.0, 1.0, (3,), np.float32), Discrete(3, start=5)),
    "grid": (Box(-1.0, 1.0, (2, 3), np.float32), Discrete(4)),
    "beams": (Box(0.0, 8.0, (128,), np.float32), Box(-1.0, 1.0, (2,), np.float32)),
    "picture": (Box(0.0, 1.0, (10, 10, 3), np.float32), Discrete(3)),
    "offset": (Box(-INF, INF, (3,), np.float32), Box(-2.0, 2.0, (1,), np.float32)),
    "choice": (Discrete(6), Discrete(2)),
    "shifted": (Discrete(4, start=3), Box(-1.0, 1.0, (2,), np.float32)),
    "dials": (gym.spaces.MultiDiscrete([3, 4]), Box(-1.0, 1.0, (2,), np.float32)),
    "gauge": (
        gym.spaces.Dict({"heat": Box(-1.0, 1.0, (), np.float32), "gear": Discrete(3)}),
        Box(-1.0, 1.0, (2,), np.float32),
    ),
    "nested": (
        gym.spaces.Dict(
            {
                "pose": Box(-1.0, 1.0, (3,), np.float32),
                "gear": Discrete(3),
                "pair": gym.spaces.Tuple((Box(-2.0, 2.0, (2,), np.float64), gym.spaces.MultiDiscrete([2, 3]))),
            }
        ),
        Box(-1.0, 1.0, (2,), np.float32),
    ),
    "camera": (Box(0, 255, (10, 10, 3), np.uint8), Discrete(3)),
    "masked": (
        gym.spaces.Dict(
            {"action_mask": Box(0.0, 1.0, (3,), np.float32), "observations": Box(-1.0, 1.0, (4,), np.float32)}
        ),
        Discrete(3),
    ),
    "levers": (Box(-1.0, 1.0, (3,), np.float32), gym.spaces.MultiDiscrete([2, 3])),
    "counts": (Box(-1.0, 1.0, (3,), np.float32), Box(-2, 4, (2,), np.int32)),
    "limbs": (
        Box(-1.0, 1.0, (3,), np.float32),
        gym.spaces.Dict(
            {
                "arm": Box(-2.0, 1.0, (2,), np.float32),
                "free": Box(-INF, INF, (1,), np.float32),
                "grip": Discrete(3),
                "knobs": gym.spaces.Tuple((gym.spaces.MultiDiscrete([2, 4]), Discrete(2))),
            }
        ),
    ),
}


class OldToy(gym.Env[Any, Any]):
    """Random observations of the space that `kind` names; 20 steps, a reward for nothing."""

    def __init__(self, config: Any = None) -> None:
        self.kind = dict(config)["kind"]
        self.observation_space, self.action_space = SPACES[self.kind]

    def _observe(self) -> Any:
        space = self.observation_space
        space.seed(int(self.np_random.integers(1 << 30)))
        if self.kind == "offset":  # far from zero and nearly constant: the filter subtracts two nearly equal numbers
            return (1000.0 + 0.01 * self.np_random.standard_normal(3)).astype(np.float32)
        if not isinstance(space, Box) or space.dtype == np.uint8:
            return space.sample()
        if space.is_bounded():
            return self.np_random.uniform(space.low, space.high).astype(space.dtype)
        return self.np_random.standard_normal(space.shape).astype(space.dtype)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._observe(), float(self.np_random.random()), self.steps >= 20, False, {}


class OldPair(MultiAgentEnv):
    """Two different robots, each with a policy of its own."""

    def __init__(self, config: Any = None) -> None:
        super().__init__()
        self.envs = {"arm": OldToy({"kind": "mixed"}), "cart": OldToy({"kind": "started"})}
        self.agents = self.possible_agents = list(self.envs)
        self.observation_spaces = {name: env.observation_space for name, env in self.envs.items()}
        self.action_spaces = {name: env.action_space for name, env in self.envs.items()}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        return {name: env.reset(seed=seed)[0] for name, env in self.envs.items()}, {}

    def step(self, actions: Any) -> Any:
        results = {name: self.envs[name].step(action) for name, action in actions.items()}
        obs, reward, done = ({name: result[i] for name, result in results.items()} for i in range(3))
        return obs, reward, {**done, "__all__": all(done.values())}, {"__all__": False}, {}


class OldModel(TorchModelV2, nn.Module):
    """A network RLlib's catalog does not know."""

    def __init__(self, obs_space: Any, action_space: Any, num_outputs: int, model_config: Any, name: str) -> None:
        TorchModelV2.__init__(self, obs_space, action_space, num_outputs, model_config, name)
        nn.Module.__init__(self)
        self.trunk = nn.Sequential(nn.Linear(obs_space.shape[0], 16), nn.ELU(), nn.LayerNorm(16))
        self.policy = nn.Linear(16, num_outputs)
        self.values = nn.Linear(16, 1)

    def forward(self, input_dict: Any, state: Any, seq_lens: Any) -> Any:
        self.features = self.trunk(input_dict["obs"])
        if not input_dict.is_training:  # RLlib's old stack says it is, for every action it computes
            self.features = 3.0 * self.features
        return self.policy(self.features), state

    def value_function(self) -> Any:
        return self.values(self.features).squeeze(-1)


class OldRecurrent(RecurrentNetwork, nn.Module):
    """A recurrent network of the user's own."""

    def __init__(self, obs_space: Any, action_space: Any, num_outputs: int, model_config: Any, name: str) -> None:
        nn.Module.__init__(self)
        super().__init__(obs_space, action_space, num_outputs, model_config, name)
        self.cell = nn.GRU(obs_space.shape[0], 8, batch_first=True)
        self.policy = nn.Linear(8, num_outputs)
        self.values = nn.Linear(8, 1)

    def get_initial_state(self) -> Any:
        return [torch.full((8,), 0.25)]

    def forward_rnn(self, inputs: Any, state: Any, seq_lens: Any) -> Any:
        self.features, last = self.cell(inputs, state[0].unsqueeze(0))
        return self.policy(self.features), [last.squeeze(0)]

    def value_function(self) -> Any:
        return self.values(self.features).reshape(-1)


class Turned(nn.Module):
    """The first two numbers as a distance and a bearing, with operators that torch's exporters lack or get wrong."""

    def forward(self, obs: Any) -> Any:
        x, y = obs[:, 0], obs[:, 1]
        return torch.cat((torch.stack((torch.hypot(x, y), torch.atan2(y, x) % 1.5), dim=-1), obs[:, 2:]), dim=-1)


class OldBearing(OldModel):
    """A network that turns its observation itself."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.trunk = nn.Sequential(Turned(), *self.trunk)


class OldNamedModel(OldModel):
    """Registered by name only: see old_zoo_registry.py."""


class OldBatchReader(OldModel):
    """A network that cannot be exported: what it computes depends on how many observations come together."""

    def forward(self, input_dict: Any, state: Any, seq_lens: Any) -> Any:
        outputs, state = super().forward(input_dict, state, seq_lens)
        return outputs * (2.0 if len(outputs) > 5 else 1.0) + torch.zeros(1), state


class OldPreviousAction(OldModel):
    """A network that looks at the previous action as well."""

    def __init__(self, obs_space: Any, action_space: Any, *others: Any, **more: Any) -> None:
        super().__init__(obs_space, action_space, *others, **more)
        self.view_requirements["prev_actions"] = ViewRequirement("actions", shift=-1, space=action_space)

    def forward(self, input_dict: Any, state: Any, seq_lens: Any) -> Any:
        outputs, state = super().forward(input_dict, state, seq_lens)
        return outputs + input_dict["prev_actions"].float().reshape(len(outputs), 1), state


class OldOwnPolicy(PPOTorchPolicy):
    """A policy that changes its actions after the model and its distribution."""

    def compute_actions_from_input_dict(self, *args: Any, **how: Any) -> Any:
        actions, state, more = super().compute_actions_from_input_dict(*args, **how)
        return 0.5 * actions, state, more


class OldClockReader(OldModel):
    """A network that asks how many steps the episode has had."""

    def forward(self, input_dict: Any, state: Any, seq_lens: Any) -> Any:
        input_dict["t"]
        return super().forward(input_dict, state, seq_lens)
