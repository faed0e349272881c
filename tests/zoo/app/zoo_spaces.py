"""A user's own code for the wider zoo: environments of every kind of space, networks and connectors that fit them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.connectors.env_to_module.observation_preprocessor import SingleAgentObservationPreprocessor
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import nn

VECTOR = Box(-1.0, 1.0, (3,), np.float32)
NESTED = Dict({
    "zeta": Box(-2.0, 2.0, (2,), np.float32),
    "arm": Dict({"mode": Discrete(3), "flags": MultiBinary(4)}),
    "grid": Tuple((MultiDiscrete([2, 4]), Box(0, 9, (2, 2), np.int32))),
})  # fmt: skip
OBSERVATIONS: dict[str, Any] = {
    "vector": VECTOR,
    "discrete": Discrete(5),
    "below_zero": Discrete(4, start=-2),
    "multi_discrete": MultiDiscrete([3, 2, 5]),
    "multi_binary": MultiBinary(6),
    "integers": Box(-5, 200, (4,), np.int64),
    "bytes": Box(0, 255, (4, 3), np.uint8),
    "image": Box(0.0, 1.0, (16, 16, 3), np.float32),
    "gray": Box(0.0, 1.0, (16, 16, 1), np.float32),
    "byte_image": Box(0, 255, (16, 16, 3), np.uint8),
    "dict": Dict({"b": Box(-1.0, 1.0, (2,), np.float32), "a": Discrete(3)}),
    "tuple": Tuple((Box(-1.0, 1.0, (2,), np.float64), MultiDiscrete([2, 3]))),
    "nested": NESTED,
    "masked": Dict({"action_mask": Box(0.0, 1.0, (4,), np.float32), "observations": VECTOR}),
    "byte_masked": Dict({"action_mask": Box(0, 1, (4,), np.int8), "observations": VECTOR}),
}
ACTIONS: dict[str, Any] = {
    "discrete": Discrete(4),
    "box": Box(np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32)),
    "multi_discrete": MultiDiscrete([3, 2, 4]),
    "dict": Dict({
        "wheel": Box(-2.0, 6.0, (2,), np.float32),
        "gear": Discrete(3),
        "free": Box(-np.inf, np.inf, (1,), np.float32),
    }),
    "tuple": Tuple((Discrete(2), Box(-0.5, 0.25, (2,), np.float32), MultiDiscrete([2, 3]))),
    "scalar": Box(-1.0, 3.0, (), np.float32),
    "autoregressive": Tuple((Discrete(3), Box(-1.0, 1.0, (1,), np.float32))),
    "nested": Dict({"a": Tuple((Box(0.0, 9.0, (1,), np.float32), Discrete(2))), "b": MultiDiscrete([3, 2])}),
}  # fmt: skip


class Spaces(gym.Env[Any, Any]):
    """Random observations of a space named by `obs`, actions of one named by `action`; episodes of 15 to 25 steps."""

    def __init__(self, config: dict[str, Any] | None = None, **kwargs: Any) -> None:
        names = {"obs": "vector", "action": "discrete", **(config or {}), **kwargs}
        self.observation_space, self.action_space = OBSERVATIONS[names["obs"]], ACTIONS[names["action"]]
        self.masked = names["obs"] in ("masked", "byte_masked")

    def _observe(self) -> Any:
        obs = self.observation_space.sample()
        if self.masked:
            kind = self.observation_space["action_mask"].dtype
            obs["action_mask"] = np.eye(4, dtype=kind)[self.np_random.integers(4)]
            obs["action_mask"][self.np_random.integers(4)] = 1
        return obs

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.steps, self.length = 0, int(self.np_random.integers(15, 25))
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        reward = float(self.np_random.standard_normal()) + worth(action)
        return self._observe(), reward, self.steps >= self.length, False, {}


def worth(action: Any) -> float:
    """Return a number that another action changes."""
    if isinstance(action, dict | tuple):
        return sum(worth(part) for part in (action.values() if isinstance(action, dict) else action))
    return float(np.sum(action)) / 10.0


class DictModule(TorchRLModule, ValueFunctionAPI):
    """Reads a Dict observation as it is: one part through an embedding, one through a linear layer."""

    def setup(self) -> None:
        self.embed = nn.Embedding(3, 8)
        self.linear = nn.Linear(2, 8)
        self.policy = nn.Linear(8, self.action_space.n)
        self.values = nn.Linear(8, 1)

    def _hidden(self, batch: dict[str, Any]) -> Any:
        obs = batch[Columns.OBS]
        return torch.tanh(self.embed(obs["a"].long()) + self.linear(obs["b"]))

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self._hidden(batch))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._hidden(batch)).squeeze(-1)


class ByteImageModule(TorchRLModule, ValueFunctionAPI):
    """A CNN that scales its own bytes."""

    def setup(self) -> None:
        self.net = nn.Sequential(nn.Conv2d(3, 4, 3, 2), nn.ReLU(), nn.Conv2d(4, 4, 3, 2), nn.ReLU(), nn.Flatten())
        self.policy = nn.Linear(36, self.action_space.n)
        self.values = nn.Linear(36, 1)

    def _hidden(self, batch: dict[str, Any]) -> Any:
        return self.net(batch[Columns.OBS].float().permute(0, 3, 1, 2) / 255.0)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self._hidden(batch))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._hidden(batch)).squeeze(-1)


class GruModule(TorchRLModule, ValueFunctionAPI):
    """A recurrent module of the user's own, whose episodes begin with a state that is not zero."""

    def setup(self) -> None:
        self.gru = nn.GRU(self.observation_space.shape[0], 6, batch_first=True)
        self.policy = nn.Linear(6, self.action_space.n)
        self.values = nn.Linear(6, 1)

    def get_initial_state(self) -> dict[str, Any]:
        return {"memory": np.linspace(-0.5, 0.5, 6).astype(np.float32)}

    def _hidden(self, batch: dict[str, Any]) -> Any:
        out, state = self.gru(batch[Columns.OBS], batch[Columns.STATE_IN]["memory"].unsqueeze(0))
        return out, {"memory": state.squeeze(0)}

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        out, state = self._hidden(batch)
        return {Columns.ACTION_DIST_INPUTS: self.policy(out), Columns.STATE_OUT: state}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._hidden(batch)[0]).squeeze(-1)


class GreedyModule(DictModule):
    """Computes its actions itself."""

    def _forward_inference(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTIONS: torch.argmin(self.policy(self._hidden(batch)), dim=-1)}


class Scaled(SingleAgentObservationPreprocessor):
    """A user's own preprocessing, with the same in torch for the export."""

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        return Box(-3.0, 3.0, (4,), np.float32)

    def preprocess(self, observation: Any, episode: Any) -> Any:
        return np.append(observation * 3.0, np.float32(observation[0] > 0.5)).astype(np.float32)

    def torch_forward(self, obs: Any) -> Any:
        return torch.cat((obs * 3.0, (obs[:, :1] > 0.5).float()), dim=-1)


class WronglyScaled(Scaled):
    """The two disagree: the gate has to find out."""

    def torch_forward(self, obs: Any) -> Any:
        return torch.cat((obs * 3.0, (obs[:, :1] > 0.9).float()), dim=-1)


class Polar(SingleAgentObservationPreprocessor):
    """What a mobile robot's environment sees, as the goal's distance, bearing and heading error [rad]."""

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        return Box(-np.inf, np.inf, (4,), np.float32)

    def preprocess(self, observation: Any, episode: Any) -> Any:
        x, y, turn = observation
        bearing = np.arctan2(y, x)
        error = (turn - bearing + np.float32(np.pi)) % np.float32(2 * np.pi) - np.float32(np.pi)
        return np.array([np.hypot(x, y), bearing, np.sin(error), np.cos(error)], np.float32)

    def torch_forward(self, obs: Any) -> Any:
        x, y, turn = torch.unbind(obs, dim=-1)
        bearing = torch.atan2(y, x)
        error = (turn - bearing + np.pi) % (2 * np.pi) - np.pi
        return torch.stack((torch.hypot(x, y), bearing, torch.sin(error), torch.cos(error)), dim=-1)


class BearingModule(TorchRLModule, ValueFunctionAPI):
    """A module that turns its observation itself, with operators that torch's exporters lack or get wrong."""

    def setup(self) -> None:
        self.register_buffer("sectors", torch.tensor([-2.0, -0.5, 0.0, 0.5, 2.0]))
        self.policy = nn.Linear(5, self.action_space.n)
        self.values = nn.Linear(5, 1)

    def _hidden(self, batch: dict[str, Any]) -> Any:
        x, y, z = torch.unbind(batch[Columns.OBS], dim=-1)
        bearing = torch.atan2(y, x)
        sector = torch.searchsorted(self.sectors, bearing.contiguous()).float() / 5.0
        return torch.stack((torch.hypot(x, y), bearing, sector, torch.copysign(z, x), z * 7.0 // 2.0), dim=-1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self._hidden(batch))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._hidden(batch)).squeeze(-1)


class Halved(ConnectorV2):
    """A user's own module-to-env connector."""

    def __call__(self, *, batch: Any, **kwargs: Any) -> Any:
        self.foreach_batch_item_change_in_place(batch, Columns.ACTIONS, lambda action, *_: action * 0.5)
        return batch

    def torch_forward(self, action: Any) -> Any:
        return action * 0.5
