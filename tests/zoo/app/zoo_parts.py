"""A user's own code: environments, a module and a connector that checkpoints name and an export may have to import."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import nn

INF = np.inf
SPACES = {
    "unbounded": (Box(-INF, INF, (4,), np.float64), Box(-INF, INF, (2,), np.float32)),
    "mixed": (
        Box(-1.0, 1.0, (5,), np.float32),
        Box(np.array([-1.0, 0.0, -7.5], np.float32), np.array([3.0, 0.5, -2.5], np.float32)),
    ),
    "half_bounded": (
        Box(-1.0, 1.0, (3,), np.float32),
        Box(np.array([0.0, -1.0], np.float32), np.array([INF, 1.0], np.float32)),
    ),
    "double": (Box(-INF, INF, (3,), np.float64), Box(-2.0, 5.0, (2,), np.float64)),
    "started": (Box(-1.0, 1.0, (3,), np.float32), Discrete(3, start=5)),
    "offset": (Box(-INF, INF, (3,), np.float32), Box(-2.0, 2.0, (1,), np.float32)),
    "grid": (Box(-1.0, 1.0, (2, 3), np.float32), Discrete(4)),
}


class Toy(gym.Env[Any, Any]):
    """Random observations of a space named by `spaces`; 20 steps, no reward for anything."""

    def __init__(self, config: dict[str, Any] | None = None, **kwargs: Any) -> None:
        self.kind = {**(config or {}), **kwargs}["spaces"]
        self.observation_space, self.action_space = SPACES[self.kind]

    @classmethod
    def describe(cls, spaces: str = "mixed", **_others: Any) -> dict[str, Any]:
        obs, action = SPACES[spaces]
        return {
            "observation": [{"name": f"sensor_{i}", "unit": "m"} for i in range(int(np.prod(obs.shape)))],
            "action": [{"name": f"motor_{i}", "unit": "rad/s"} for i in range(int(np.prod(action.shape)))],
            "control_rate_hz": 25.0,
        }

    def _observe(self) -> Any:
        if self.kind == "offset":  # far from zero and nearly constant: the filter subtracts two nearly equal numbers
            return (1000.0 + 0.01 * self.np_random.standard_normal(3)).astype(np.float32)
        return self.np_random.standard_normal(self.observation_space.shape).astype(self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        done = self.steps >= 20
        return self._observe(), -float(np.sum(np.square(action))), done, False, {"is_success": True} if done else {}


class UserModule(TorchRLModule, ValueFunctionAPI):
    """A network RLlib's catalogs do not know."""

    def setup(self) -> None:
        self.trunk = nn.Sequential(nn.Linear(self.observation_space.shape[0], 16), nn.ELU(), nn.LayerNorm(16))
        self.policy = nn.Linear(16, self.action_space.n)
        self.values = nn.Linear(16, 1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self.trunk(batch[Columns.OBS]))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self.trunk(batch[Columns.OBS])).squeeze(-1)


class BatchReader(UserModule):
    """A network that cannot be exported: what it computes depends on how many observations come together."""

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        obs = batch[Columns.OBS]
        logits = self.policy(self.trunk(obs))
        return {Columns.ACTION_DIST_INPUTS: logits * (2.0 if len(obs) > 5 else 1.0) + torch.zeros(1)}


class Doubler(ConnectorV2):
    """A user's own env-to-module connector."""

    def __call__(self, *, episodes: Any, batch: Any, **kwargs: Any) -> Any:
        for episode in self.single_agent_episode_iterator(episodes):
            episode.set_observations(at_indices=-1, new_data=episode.get_observations(-1) * 2)
        return batch
