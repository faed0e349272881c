"""Unusual environments for the trainer's tests: `edge_environments:edge/Float64-v0` and the others below."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete


class Edge(gym.Env[Any, Any]):
    """Rewards the action that has the sign of the first number seen; subclasses say what is seen."""

    action_space: Any = Discrete(2)
    length = 25

    def look(self) -> Any:
        raise NotImplementedError

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        self.speed = self.np_random.uniform(-1, 1, 3)
        return self.look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = float(bool(np.ravel(action)[0] > 0) == bool(self.speed[0] > 0))
        self.steps += 1
        self.speed = self.np_random.uniform(-1, 1, 3)
        return self.look(), reward, False, self.steps >= self.length, {}


class Float64(Edge):
    """float64 observations and actions, as much of the world's code gives."""

    observation_space: Any = Box(-1.0, 1.0, (3,), np.float64)
    action_space: Any = Box(-1.0, 1.0, (1,), np.float64)

    def look(self) -> Any:
        return self.speed


class Promises32(Float64):
    """Says float32 and gives float64."""

    observation_space: Any = Box(-1.0, 1.0, (3,), np.float32)
    action_space: Any = Discrete(2)


class Camera(Edge):
    """A Dict with an image."""

    observation_space: Any = Dict({"image": Box(0, 255, (12, 10, 3), np.uint8), "speed": Box(-1.0, 1.0, (3,))})

    def look(self) -> Any:
        return {
            "image": self.np_random.integers(0, 256, (12, 10, 3), np.uint8),
            "speed": self.speed.astype(np.float32),
        }


class Endless(Float64):
    """Episodes that no training iteration sees the end of."""

    length = 1_000_000


class Failing(Promises32):
    """Fails in every sample, only where the policy is evaluated, or already when made outside a process."""

    def __init__(self, fails: bool = True, only_in: int | None = None) -> None:
        if only_in not in (None, os.getpid()):
            raise RuntimeError("no licence for this process")
        self._fails = fails

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._fails:
            raise RuntimeError("the gripper is not calibrated")
        return super().step(action)


class Crashing(Promises32):
    """Fails after 60 steps of its life, as a simulator does now and then, until `log` has seen it `crashes` times."""

    def __init__(self, log: str, crashes: int = 1_000) -> None:
        self._log = Path(log)
        self._crashes = crashes
        self._life = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._life += 1
        so_far = self._log.read_text() if self._log.exists() else ""
        if self._life > 60 and so_far.count("crash") < self._crashes:
            self._log.write_text(so_far + "crash\n")
            raise RuntimeError("the simulator's connection was lost")
        return super().step(action)


for kind in (Float64, Promises32, Camera, Endless, Failing, Crashing):
    gym.register(f"edge/{kind.__name__}-v0", f"{__name__}:{kind.__name__}")
