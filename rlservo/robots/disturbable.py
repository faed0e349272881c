"""Interfaces by which `DomainRandomization` disturbs a simulation; each is optional, each robot has its own sizes."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

MAX_MODEL_ERROR = 0.5  # share of a figure of the model

Extreme = Literal["target", "start"]
"""Placements outside the task: the target out of reach, or the robot in a corner."""


class SensorError(NamedTuple):
    """Errors of one observed element, in its own unit."""

    noise: float  # standard deviation, drawn at each step
    bias: float  # largest constant error, drawn once an episode from -bias .. bias


@runtime_checkable
class CarriesPayload(Protocol):
    """A simulation whose robot carries a load."""

    def set_payload(self, mass: float) -> None: ...


@runtime_checkable
class HasRobotModels(Protocol):
    """An environment whose robot can be replaced by another of the same kind."""

    def set_robot_model(self, name: str) -> None:
        """Replace the robot; call `reset` next. Raises ValueError for a model that does not exist."""
        ...


@runtime_checkable
class HasModelError(Protocol):
    """A simulation whose robot may differ from its data sheet."""

    def draw_model_error(self, size: float, rng: np.random.Generator) -> dict[str, Any]:
        """Change masses, inertias, gains, friction and velocity limit by up to `size` (0.05: 5%).

        Return what was drawn. Sizes are relative to the data sheet, whatever was drawn before; 0 restores it.
        """
        ...


@runtime_checkable
class HasBaseOffset(Protocol):
    """An environment whose robot may be displaced without knowing it."""

    def set_base_offset(self, offset: tuple[float, float]) -> None:
        """Give the policy positions of objects that are wrong by `offset` (x, y) [m], until the next call."""
        ...


@runtime_checkable
class HasSensorErrors(Protocol):
    """An environment that states the errors of real sensors by element, with their sources."""

    def sensor_errors(self) -> dict[str, SensorError]: ...


@runtime_checkable
class HasExtremes(Protocol):
    """An environment that can place its target out of reach and its robot in a corner."""

    def extreme_options(self, what: Extreme, rng: np.random.Generator) -> dict[str, Any]:
        """Return the reset options of an episode that the task itself never draws."""
        ...
