"""Base of the Panda's tasks, and robo-gym's empty environment, which is the arm alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.elements import joint_elements
from rlservo.envs.panda.server_state import state_dict
from rlservo.envs.ur.arm_env import POSITION_BOUND, ArmEnv, Observation, Vector
from rlservo.robots.argument_checks import ElementInfo
from rlservo.robots.panda.model import HIGH, JOINTS, LOW
from rlservo.robots.panda.simulation import PandaSimulation
from rlservo.robots.ur.model import Table
from rlservo.robots.ur.parameters import cycle_of

CENTRE: Vector = 0.5 * (np.array(LOW) + np.array(HIGH))  # [rad]
HALF: Vector = 0.5 * (np.array(HIGH) - np.array(LOW))


class PandaArmEnv(ArmEnv[PandaSimulation]):
    """Move the Panda by one position per joint and cycle. A normalised position is -1 .. 1 between a joint's limits."""

    JOINTS = JOINTS
    JOINT_NAMES: ClassVar[Mapping[str, str]] = {joint: joint for joint in JOINTS}
    LOW, HIGH = np.array(LOW), np.array(HIGH)
    BASE = np.zeros(3)
    FIXED: ClassVar[tuple[str, ...]] = ("panda_joint7",)
    START_JOINTS = (-0.018, -0.76, 0.02, -2.342, 0.03, 1.541, 0.753)  # [rad]
    MAX_STEPS = 300
    TABLE: ClassVar[Table]
    ACTION_ELEMENT = ("position_normalized", "1")
    RATE_HZ = 30.0

    def __init__(
        self,
        *,
        fix_panda_joint1: bool | None = None,
        fix_panda_joint2: bool | None = None,
        fix_panda_joint3: bool | None = None,
        fix_panda_joint4: bool | None = None,
        fix_panda_joint5: bool | None = None,
        fix_panda_joint6: bool | None = None,
        fix_panda_joint7: bool | None = None,
        rs_state_to_info: bool = True,
        gui: bool = False,
        max_velocity_scale_factor: float | None = None,
        action_cycle_rate: float | None = None,
        render_mode: str | None = None,
        rs_address: str | None = None,
        ip: str | None = None,
        lower_bound_port: int | None = None,
        upper_bound_port: int | None = None,
    ) -> None:
        """The arguments are described in the tasks' docstrings; None takes the task's own value."""
        del rs_address, ip, lower_bound_port, upper_bound_port  # no robot server to reach
        choices = (
            fix_panda_joint1, fix_panda_joint2, fix_panda_joint3, fix_panda_joint4, fix_panda_joint5, fix_panda_joint6,
            fix_panda_joint7,
        )  # fmt: skip
        rate_hz = self.RATE_HZ if action_cycle_rate is None else action_cycle_rate
        super().__init__(
            partial(
                PandaSimulation,
                max_velocity_scale=(
                    self.MAX_VELOCITY_SCALE if max_velocity_scale_factor is None else max_velocity_scale_factor
                ),
                cycle_s=cycle_of(rate_hz),
                objects=self.OBJECTS,
                table=self.TABLE,
            ),
            fixed=self._fixed_joints(choices),
            rate_hz=rate_hz,
            rs_state_to_info=rs_state_to_info,
            gui=gui,
            render_mode=render_mode,
        )

    def _rs_state(self) -> dict[str, float]:
        return state_dict(self.simulation, self.RS_MODE)

    @classmethod
    def _joint_state_elements(cls) -> list[ElementInfo]:
        positions = joint_elements(cls.JOINT_NAMES, *cls.ACTION_ELEMENT, "joint position", HALF, CENTRE)
        return positions + joint_elements(cls.JOINT_NAMES, "velocity", "rad/s", "joint velocity")

    @classmethod
    def _position_map(cls, **_arguments: Any) -> tuple[Vector, Vector]:
        return HALF, CENTRE

    def _fixed_values(self) -> Vector:
        return (self._start - CENTRE) / HALF

    def _to_joint_positions(self, command: Vector) -> Vector:
        return command * HALF + CENTRE


class EmptyEnvironmentPandaSim(PandaArmEnv):
    """Move a Panda about in an empty world.

    Spaces, units and endings are those of robo-gym 2.1's `EmptyEnvironmentPandaSim-v0`. One step is one control cycle
    of 1/30 s.

    ## Observation: Box(14,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0-6 | position of panda_joint1 to panda_joint7, -1 .. 1 between its limits | 1 | -1.1 .. 1.1 |
    | 7-13 | velocity of the same joints | rad/s | unbounded |

    ## Action: Box(6,), float32, -1 .. 1

    Absolute joint positions, normalised alike, one element per joint that is not fixed (panda_joint7 is). The arm moves
    towards them in max(0.5 s, slowest joint's travel / (scale * velocity limit)), and the next action replaces the
    motion a cycle later. A fixed joint is commanded to its position at reset. An action outside the space raises
    `InvalidActionError` naming the element and the excess.

    ## Reward and endings

    0, always. `info["final_status"]`: "collision" (a link touches the ground or the arm; terminated), or "success"
    (300 steps without; truncated). The last step's info also holds `is_success`.

    ## Reset options, constructor

    `joint_positions` (7 numbers, rad); [-0.018, -0.76, 0.02, -2.342, 0.03, 1.541, 0.753] without it.
    `fix_panda_joint1` to `fix_panda_joint7`, `rs_state_to_info`, `render_mode`, `max_velocity_scale_factor` (0.2),
    `action_cycle_rate` (30 Hz), and robo-gym's arguments for a server, which are accepted and unused.
    """

    RESET_OPTIONS = ("joint_positions",)
    RS_MODE = "only_robot"
    OBJECTS = ()
    TABLE = False

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        return cls._joint_state_elements()

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        high = np.concatenate([np.full(7, POSITION_BOUND), np.full(7, np.inf)])
        return -high, high

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put the arm where an observation has it."""
        self.simulation.place(np.clip(observations[row, :7] * HALF + CENTRE, LOW, HIGH))

    def _begin(self, options: Mapping[str, Any]) -> None:
        del options  # the start pose is the only one
        self.robot.settle()

    def _observation(self) -> Observation:
        sim = self.simulation
        return np.concatenate([(sim.joint_positions - CENTRE) / HALF, sim.joint_velocities]).astype(np.float32)

    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        del observation, command  # nothing to reach
        return 0.0, "collision" if self.simulation.in_collision else None
