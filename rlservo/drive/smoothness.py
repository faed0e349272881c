"""Smoothness of a rollout: the steps of the action and of the commanded velocity from one control cycle to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.drive.driven_episode import EpisodeEnv

ACTION = "action"


@dataclass(frozen=True)
class StepSize:
    """Sizes of the steps, over all elements and episodes."""

    mean: float
    largest: float


@dataclass
class _Steps:
    total: float = 0.0
    count: int = 0
    largest: float = 0.0

    def add(self, step: NDArray[np.float64]) -> None:
        self.total += float(step.sum())
        self.count += step.size
        self.largest = max(self.largest, float(step.max()))


@dataclass
class MeasuredEnv:
    """An environment that measures the steps of its actions and of the commanded velocities.

    Discrete actions have none. Velocities come from an environment's `commanded_velocity` by unit, and start from rest.
    """

    env: EpisodeEnv
    robot: Any  # the environment without wrappers
    _steps: dict[str, _Steps] = field(default_factory=dict)
    _last: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(seed=seed)
        self._last = {}
        for unit, velocity in self._velocities().items():
            self._last[unit] = np.zeros_like(velocity)
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if isinstance(action, np.ndarray) and action.dtype.kind == "f" and action.size:
            self._compare(ACTION, action.astype(np.float64))
        result = self.env.step(action)
        for unit, velocity in self._velocities().items():
            self._compare(unit, velocity)
        return result

    def sizes(self) -> dict[str, StepSize]:
        """Return the step sizes of the action under "action", and of the velocities under their units."""
        order = sorted(self._steps, key=lambda what: (what != ACTION, what))
        return {
            what: StepSize(self._steps[what].total / self._steps[what].count, self._steps[what].largest)
            for what in order
        }

    def _velocities(self) -> Mapping[str, NDArray[np.float64]]:
        return getattr(self.robot, "commanded_velocity", None) or {}

    def _compare(self, what: str, value: NDArray[np.float64]) -> None:
        last = self._last.get(what)
        self._last[what] = value
        if last is not None:
            self._steps.setdefault(what, _Steps()).add(np.abs(value - last))
