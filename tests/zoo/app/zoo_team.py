"""An environment with three agents for the zoo: two arms that share a module, and a base with one of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.env.multi_agent_env import MultiAgentEnv

OBSERVATIONS = {
    "left": Box(-3.0, 3.0, (4,), np.float32),
    "right": Box(-3.0, 3.0, (4,), np.float32),
    "base": Box(-1.0, 1.0, (2,), np.float32),
}
ARM = Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 5.0], np.float32))
ACTIONS = {"left": ARM, "right": ARM, "base": Discrete(3)}
MODULES = {"left": "arms", "right": "arms", "base": "wheels"}


def module_of(agent: str, *_: Any, **__: Any) -> str:
    return MODULES[agent]


def module_of_its_own(agent: str, *_: Any, **__: Any) -> str:
    return f"{agent}_arm"


class Team(MultiAgentEnv):
    """The arms see other ranges, so that their filters differ; episodes end after seven steps. `agents` may be some."""

    def __init__(self, config: Any = None) -> None:
        super().__init__()
        self.agents = self.possible_agents = list((config or {}).get("agents", OBSERVATIONS))
        self.observation_spaces = {agent: OBSERVATIONS[agent] for agent in self.agents}
        self.action_spaces = {agent: ACTIONS[agent] for agent in self.agents}
        self.rng = np.random.default_rng(0)
        self.time = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.time = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        done = {"__all__": self.time >= 7}
        return self._observe(), dict.fromkeys(self.agents, 1.0), done, {"__all__": False}, {}

    def _observe(self) -> dict[str, Any]:
        drawn = {agent: self.rng.uniform(space.low, space.high) for agent, space in OBSERVATIONS.items()}
        drawn["right"] = drawn["right"] / 3.0 + 1.0
        return {agent: drawn[agent].astype(np.float32) for agent in self.agents}


class Committee(MultiRLModule):
    """Modules that might decide together: nobody can tell from outside."""
