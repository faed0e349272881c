"""A user's own code for the zoo of reports: networks that read a part, or hold what is not finite."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from ray.rllib.connectors.env_to_module.observation_preprocessor import MultiAgentObservationPreprocessor
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from torch import nn

VECTOR = Box(-1.0, 1.0, (3,), np.float32)
LARGEST = float(np.finfo(np.float32).max)
OBSERVATIONS: dict[str, Any] = {
    "vector": VECTOR,
    "privileged": Dict({"actor": VECTOR, "critic": Box(-5.0, 5.0, (2,), np.float32)}),
    "partly_read": Dict({
        "arm": Dict({"angles": VECTOR, "serial": Box(0.0, 9.0, (1,), np.float32)}),
        "pair": Tuple((Discrete(3), Box(-1.0, 1.0, (2,), np.float32))),
    }),
    "unusual": Dict({
        "short": Box(0, 60000, (2,), np.uint16),
        "long": Box(0, 4_000_000_000, (2,), np.uint32),
        "half": Box(-2.0, 2.0, (2,), np.float16),
    }),
    "uint32": Box(0, 4_000_000_000, (3,), np.uint32),
    "image": Box(0.0, 1.0, (64, 64, 3), np.float32),
    "huge": Box(-LARGEST, LARGEST, (3,), np.float32),
    "unsorted": Dict([("wheels", Box(-1.0, 1.0, (2,), np.float32)), ("arm", Box(-1.0, 1.0, (2,), np.float32))]),
}  # fmt: skip
ACTIONS: dict[str, Any] = {
    "box": Box(np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32)),
    "discrete": Discrete(4),
    "huge": Box(-LARGEST, LARGEST, (2,), np.float32),
}


class Reported(gym.Env[Any, Any]):
    """Random observations of a space named by `obs`, actions of one named by `action`; episodes of 20 steps."""

    def __init__(self, config: dict[str, Any]) -> None:
        self.observation_space, self.action_space = OBSERVATIONS[config["obs"]], ACTIONS[config["action"]]
        self.bounded = config["obs"] != "huge"

    def _observe(self) -> Any:
        return self.observation_space.sample() if self.bounded else self.np_random.normal(size=3).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._observe(), float(self.np_random.standard_normal()), self.steps >= 20, False, {}


class Asymmetric(TorchRLModule, ValueFunctionAPI):
    """An actor that sees what the robot has, and a critic that sees what the simulation knows."""

    def setup(self) -> None:
        self.policy = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 4))
        self.values = nn.Sequential(nn.Linear(5, 16), nn.Tanh(), nn.Linear(16, 1))

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(batch[Columns.OBS]["actor"])}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        obs = batch[Columns.OBS]
        return self.values(torch.cat((obs["actor"], obs["critic"]), dim=-1)).squeeze(-1)


class TrainsOtherwise(TorchRLModule, ValueFunctionAPI):
    """Acts otherwise where RLlib builds it for inference only: in its actors."""

    def setup(self) -> None:
        self.policy, self.values = nn.Linear(3, 4), nn.Linear(3, 1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        logits = self.policy(batch[Columns.OBS])
        return {Columns.ACTION_DIST_INPUTS: -logits if self.inference_only else logits}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(batch[Columns.OBS]).squeeze(-1)


class NeedsItsCritic(TrainsOtherwise):
    """Acts the same, but has its critic only where RLlib trains."""

    def setup(self) -> None:
        self.policy = nn.Linear(3, 4)
        if not self.inference_only:
            self.values = nn.Linear(3, 1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(batch[Columns.OBS])}


class TakesItsArgument(TrainsOtherwise):
    """Takes an argument out of its dict, where RLlib looks for it when it saves."""

    def setup(self) -> None:
        super().setup()
        self.gain = 1.0 if self.model_config.pop("vf_share_layers", None) is None else 3.0

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: torch.sin(self.gain * self.policy(batch[Columns.OBS]))}


class PartReader(TorchRLModule, ValueFunctionAPI):
    """Reads one part of a Dict and one of a Tuple."""

    def setup(self) -> None:
        self.policy, self.values = nn.Linear(5, 4), nn.Linear(5, 1)

    def _read(self, batch: dict[str, Any]) -> Any:
        obs = batch[Columns.OBS]
        return torch.cat((obs["arm"]["angles"], obs["pair"][1]), dim=-1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self._read(batch))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._read(batch)).squeeze(-1)


class InOrder(TorchRLModule, ValueFunctionAPI):
    """Reads the parts of a Dict in the order in which they come."""

    def setup(self) -> None:
        self.policy, self.values = nn.Linear(4, 4), nn.Linear(4, 1)

    def _read(self, batch: dict[str, Any]) -> Any:
        return torch.cat(list(batch[Columns.OBS].values()), dim=-1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self._read(batch))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._read(batch)).squeeze(-1)


class SeesTheBase(MultiAgentObservationPreprocessor):
    """Gives the arms what the base sees, if it acts."""

    def preprocess(self, observations: dict[str, Any], episode: Any) -> dict[str, Any]:
        seen = float(observations.get("base", [0.0])[0])
        return {agent: obs + np.float32(agent != "base") * seen for agent, obs in observations.items()}

    def torch_forward(self, obs: Any) -> Any:
        return obs


class OutOfOrder(MultiAgentEnv):
    """One agent, to which the parts of its observation come in another order than in its space."""

    def __init__(self, config: Any = None) -> None:
        super().__init__()
        self.agents = self.possible_agents = ["robot"]
        self.space = Dict({"arm": Box(-1.0, 1.0, (2,), np.float32), "wheels": Box(-1.0, 1.0, (2,), np.float32)})
        self.observation_spaces, self.action_spaces = {"robot": self.space}, {"robot": Discrete(4)}
        self.time = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.time = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        return self._observe(), {"robot": 1.0}, {"__all__": self.time >= 20}, {"__all__": False}, {}

    def _observe(self) -> dict[str, Any]:
        drawn = self.space.sample()
        return {"robot": {"wheels": drawn["wheels"], "arm": drawn["arm"]}}


class Masked(TorchRLModule, ValueFunctionAPI):
    """Attention over the observation's elements with a causal mask, and bounds of which some are infinite."""

    mask: torch.Tensor
    low: torch.Tensor

    def setup(self) -> None:
        self.embed, self.policy, self.values = nn.Linear(1, 8), nn.Linear(8, 4), nn.Linear(8, 1)
        self.register_buffer("mask", torch.triu(torch.full((3, 3), -torch.inf), diagonal=1))
        self.register_buffer("low", torch.tensor([-torch.inf, -1.0, -0.5]))

    def _hidden(self, batch: dict[str, Any]) -> Any:
        tokens = torch.tanh(self.embed(torch.maximum(batch[Columns.OBS], self.low).unsqueeze(-1)))
        weights = torch.softmax(tokens @ tokens.transpose(1, 2) + self.mask, dim=-1)
        return (weights @ tokens)[:, -1]

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self._hidden(batch))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self._hidden(batch)).squeeze(-1)
