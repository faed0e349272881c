"""robo-gym's empty environment: only the arm, to try a controller or a policy's interfaces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.elements import joint_elements
from rlservo.envs.ur.arm_env import LIMITS, POSITION_BOUND, Observation, URArmEnv, Vector
from rlservo.robots.argument_checks import ElementInfo
from rlservo.robots.ur.parameters import JOINT_NAMES


class EmptyEnvironmentURSim(URArmEnv):
    """Move a UR arm about in an empty world.

    Spaces, units and endings are those of robo-gym 2.0's `EmptyEnvironmentURSim-v0`. One step is one control cycle of
    0.05 s. There is no table: the arm stands 0.1 m above the ground.

    ## Observation: Box(12,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0-5 | position of base, shoulder, elbow, wrist_1, wrist_2, wrist_3 over 2 pi (elbow: pi) | 1 | -1.1 .. 1.1 |
    | 6-11 | velocity of the same joints | rad/s | unbounded |

    ## Action: Box(5,), float32, -1 .. 1

    Absolute joint positions over 2 pi (elbow: pi), one element per joint that is not fixed, in the order above. The arm
    moves towards them in max(0.5 s, slowest joint's travel / (scale * velocity limit)), and the next action replaces
    the motion 0.05 s later. A fixed joint is commanded to its position at reset. An action outside the space raises
    `InvalidActionError` naming the element and the excess.

    ## Reward

    0, always.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | collision | a link touches the ground or the arm itself | terminated |
    | success | 300 steps without a collision | truncated |

    The last step's info also holds `is_success`.

    ## Reset options

    `joint_positions` (6 numbers, rad); [0, -2.5, 1.5, 0, -1.4, 0] without it.

    ## Constructor

    `ur_model` (ur5), `fix_base` ... `fix_wrist_3`, `rs_state_to_info` (the robot
    server's `state_dict` of the mode `only_robot` in `info["rs_state"]`; False keeps info picklable for RLlib),
    `render_mode`. Of our own: `max_velocity_scale_factor` (0.2) and `action_cycle_rate` (20 Hz), which robo-gym has in
    its launch file. robo-gym's `ip`, `lower_bound_port`, `upper_bound_port`, `gui` (`render_mode="human"`) and
    `rs_address` are accepted; there is no server to find.

    ## Differences from robo-gym on Gazebo

    The time limit truncates (robo-gym says done). Resets are immediate, and a colliding start is refused. Gazebo's
    controller jitter and sensor delay are not modelled: a command takes effect within the cycle, exactly.
    """

    START_JOINTS = (0.0, -2.5, 1.5, 0.0, -1.4, 0.0)  # [rad]
    MAX_STEPS = 300
    RESET_OPTIONS = ("joint_positions",)
    RS_MODE = "only_robot"
    OBJECTS = ()
    TABLE = False
    ACTION_ELEMENT = ("position_normalized", "1")

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        observation = joint_elements(JOINT_NAMES, *cls.ACTION_ELEMENT, "joint position", LIMITS, np.zeros(6))
        return observation + joint_elements(JOINT_NAMES, "velocity", "rad/s", "joint velocity")

    @classmethod
    def _position_map(cls, **_arguments: Any) -> tuple[Vector, Vector]:
        return LIMITS, np.zeros(6)

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        high = np.concatenate([np.full(6, POSITION_BOUND), np.full(6, np.inf)])
        return -high, high

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put the arm at the pose of an observation."""
        self.simulation.place(observations[row, :6] * LIMITS)

    def _begin(self, options: Mapping[str, Any]) -> None:
        del options  # the start pose is the only one
        self.robot.settle()

    def _fixed_values(self) -> Vector:
        return self._start / LIMITS

    def _to_joint_positions(self, command: Vector) -> Vector:
        return command * LIMITS

    def _observation(self) -> Observation:
        observation = np.empty(12, dtype=np.float32)
        observation[:6] = self.simulation.joint_positions / LIMITS
        observation[6:] = self.simulation.joint_velocities
        return observation

    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        del observation, command  # nothing to reach
        return 0.0, "collision" if self.simulation.in_collision else None
