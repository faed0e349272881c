"""Robot of a robot server: place it, command it for one cycle, read its state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # MuJoCo is imported when a robot is made
    from rlservo.envs.rendering import Camera

CLOCKS = ("fast", "real")


@dataclass(frozen=True)
class RobotState:
    """robo-gym's State message, both ways."""

    values: Sequence[float] = ()
    names: Mapping[str, float] = field(default_factory=dict)  # state_dict
    float_params: Mapping[str, float] = field(default_factory=dict)
    string_params: Mapping[str, str] = field(default_factory=dict)


class ServedRobot(Protocol):
    """A robot, simulated or real. Every method raises ValueError for an impossible request."""

    @property
    def is_real(self) -> bool:
        """Whether its cycles take real time with any clock."""
        ...

    @property
    def camera(self) -> Camera: ...

    @property
    def cycle_s(self) -> float:
        """Duration of a control cycle [s]."""
        ...

    def state(self) -> RobotState:
        """Return the state, as a list and, if the original has names, by names."""
        ...

    def set_state(self, target: RobotState) -> int:
        """Place the robot and its scene as in `target`; return the number of cycles that this counts as."""
        ...

    def act(self, action: Sequence[float]) -> None:
        """Command the robot for one cycle."""
        ...

    def idle(self, cycles: int) -> None:
        """Let cycles pass without a command."""
        ...

    def close(self) -> None:
        """Close the window, and stop a real robot."""
        ...
