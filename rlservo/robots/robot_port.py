"""Port between an environment, or a robot server, and the robot that it has, simulated or real.

Beside its robot it has the robot's simulation, from which tool, contacts and pictures are taken: a simulated robot is
that simulation, a real one sets it to what it measures.
"""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import ArrayLike

from rlservo.robots.arm_interface import Vector


class Robot(Protocol):
    """What every robot has; the bodies are a simulated robot's."""

    @property
    def stopped_by(self) -> str | None:
        """Reason why it has stopped, as an episode's final status."""
        return None

    def advance(self) -> None:
        """Let one control cycle pass."""

    def robot_info(self) -> dict[str, Any] | None:
        """Return a step's info on a real robot."""
        return None

    def limited(self) -> dict[str, int] | None:
        """Return the number of commands in which each limit of a real robot applied."""
        return None

    def take_over(self) -> None:
        """Let a person lead the robot, or take it back. Raises ValueError for a simulated one."""
        raise ValueError("a simulated robot cannot be led by a person")

    def close(self) -> None:
        """Stop the robot and free what it holds."""
        return


class Arm(Robot, Protocol):
    """An arm that is placed at, and commanded to, joint positions [rad] (joints,)."""

    def place(self, joint_positions: ArrayLike) -> bool: ...  # at rest; whether it collides there
    def settle(self) -> None: ...  # wait until it is at rest
    def command(self, joint_positions: ArrayLike) -> object: ...  # replaces the command before
    def hold(self) -> None: ...  # stops where it is


class MobileBase(Robot, Protocol):
    """A base that is commanded to velocities [m/s], [rad/s]."""

    def command(self, linear: float, angular: float) -> bool: ...  # whether the command is used
    @property
    def scan(self) -> Vector: ...  # all readings of both scanners [m] (1012,)
