"""The MiR100 with robo-gym's interface, on its simulation.

Source of the behaviour: jr-robotics/robo-gym-robot-servers, mir100_robot_server.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rlservo.envs.rendering import Camera
from rlservo.envs.robot_server.robot_server_settings import Mir100Settings
from rlservo.envs.robot_server.robots.robot import RobotState
from rlservo.robots.mir100.parameters import BEAM_COUNT, CYCLE_S
from rlservo.robots.mir100.simulation import ROOM_VIEW, Mir100Simulation

STATE_LENGTH = 8 + BEAM_COUNT + 1 + 9
TARGET, ROBOT, CUBES = slice(0, 3), slice(3, 6), slice(9 + BEAM_COUNT, STATE_LENGTH)
SETTLE_CYCLES = 2


class Mir100Robot:
    """The robot in its world."""

    is_real = False

    def __init__(self, settings: Mir100Settings) -> None:
        self.simulation = Mir100Simulation(settings.world_name, rng=np.random.default_rng(settings.seed))
        self.camera = Camera(self.simulation.model, self.simulation.data, **ROOM_VIEW)

    @property
    def cycle_s(self) -> float:
        """Duration of a control cycle [s]."""
        return CYCLE_S

    def close(self) -> None:
        """Close the window."""
        self.camera.close()

    def state(self) -> RobotState:
        """Return the 1,030 numbers; the original has no names for them."""
        return RobotState(values=self.simulation.state().tolist())

    def set_state(self, target: RobotState) -> int:
        """Put target and robot at rest, and cubes if there are any and they are given; it counts as two cycles."""
        values = target.values
        if not (len(values) == STATE_LENGTH or ROBOT.stop <= len(values) <= CUBES.start):
            raise ValueError(
                f"the state has {len(values)} elements: expected {STATE_LENGTH}, or {ROBOT.stop} to {CUBES.start} "
                f"to leave the cubes in place"
            )
        cubes = None
        if self.simulation.world.cubes and len(values) == STATE_LENGTH:
            flat = list(values[CUBES])
            cubes = [flat[start : start + 3] for start in range(0, len(flat), 3)]
        self.simulation.place(list(values[ROBOT]), target=list(values[TARGET]), cubes=cubes)
        # Not simulated: a robot at rest stays, and one that was put into a wall is reported there, in collision.
        return SETTLE_CYCLES

    def act(self, action: Sequence[float]) -> None:
        """Drive with a linear [m/s] and an angular velocity [rad/s] for one cycle."""
        if len(action) != 2:
            raise ValueError(f"the action has {len(action)} elements, expected 2: linear [m/s], angular [rad/s]")
        for name, value in zip(("linear", "angular"), action, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"the {name} velocity is {value:g}: expected a finite number")
        self.simulation.command(action[0], action[1])  # refused near an obstacle: the robot stands, as in the original
        self.simulation.advance()

    def idle(self, cycles: int) -> None:
        """Let cycles pass without a command: the last one holds until it is 0.5 s old."""
        for _ in range(cycles):
            self.simulation.advance()
