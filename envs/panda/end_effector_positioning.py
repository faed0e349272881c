"""robo-gym 2.1's end-effector positioning task on the simulated Panda.

Source of the figures: jr-robotics/robo-gym 2.1, envs/manipulator/ee_pos_base.py and envs/panda/panda_ee_pos.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.elements import point_elements, polar_elements
from rlservo.envs.panda.arm_env import CENTRE, HALF, PandaArmEnv
from rlservo.envs.ur.arm_env import POSITION_BOUND, Observation, Vector, polar
from rlservo.envs.ur.sensor_errors import JOINT_BIAS, JOINT_NOISE, VELOCITY_NOISE, polar_errors, position_errors
from rlservo.robots.argument_checks import ElementInfo, as_vector
from rlservo.robots.disturbable import SensorError
from rlservo.robots.panda.model import HIGH, JOINTS, LOW

TARGET_LOW, TARGET_HIGH = np.array([0.35, -0.2, 0.15]), np.array([0.65, 0.2, 0.5])  # [m]
START_RANGE = (1.5, 0.25, 0.5, 1.0, 0.4, 3.14, 1.0)  # [rad], +-, with randomize_start
SUCCESS_DISTANCE = 0.1  # [m]
SOLUTION_OFFSET = (0.0, 0.0, 0.04)  # [m] above the target, where the fingers are clear of the table


class EndEffectorPositioningPandaSim(PandaArmEnv):
    """Bring the Panda's hand to within 0.1 m of a target, without touching anything.

    Spaces, units and rewards are those of robo-gym 2.1's `EndEffectorPositioningPandaSim-v0`. One step is one control
    cycle of 1/30 s. The arm stands in robo-gym's table, which is 0.1 m high; positions are in its base's frame.

    ## Observation: Box(29,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0 | target_r: distance of the target from the hand | m | unbounded |
    | 1 | target_theta: acos(z/r) in the hand's frame | rad | unbounded |
    | 2 | target_phi: atan2(y, x) in the hand's frame | rad | unbounded |
    | 3-9 | position of panda_joint1 to panda_joint7, -1 .. 1 between its limits | 1 | -1.1 .. 1.1 |
    | 10-16 | velocity of the same joints | rad/s | unbounded |
    | 17-19 | target x, y, z | m | unbounded |
    | 20-22 | hand x, y, z | m | unbounded |
    | 23-28 | the last action, of the joints that are not fixed; zeros at first | 1 | -1 .. 1 |

    ## Action: Box(6,), float32, -1 .. 1

    As in `EmptyEnvironmentPandaSim`: absolute joint positions, panda_joint7 fixed.

    ## Reward

    -0.005 * distance [m] each step; +2 instead when the distance is at most 0.1 m; -1 instead on collision.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | success | distance at most 0.1 m, no collision | terminated |
    | collision | a link or finger touches the table, the ground or the arm itself | terminated |
    | max_steps_exceeded | 300 steps | truncated |

    The last step's info also holds `is_success`, `dist_coord` [m] and `target_coord`.

    ## Reset options

    `joint_positions` (7 numbers, rad), `ee_target_pose` (6 numbers: x, y, z, orientation unused), `randomize_start`
    (start joints drawn around the given ones, +- 1.5, 0.25, 0.5, 1.0, 0.4, 3.14, 1.0 rad; a pose that collides is
    redrawn). Targets are x 0.35 to 0.65, y -0.2 to 0.2, z 0.15 to 0.5 m.

    ## Constructor

    As in `EmptyEnvironmentPandaSim`, and `randomize_start` (the default of the reset option).
    """

    RESET_OPTIONS = ("joint_positions", "ee_target_pose", "randomize_start")
    RS_MODE = "1object"
    OBJECTS = ("sphere50_no_collision",)
    TABLE = True
    OBSERVES_LAST_ACTION = True
    TIME_LIMIT_STATUS = "max_steps_exceeded"

    def __init__(self, *, randomize_start: bool = False, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._randomize_start = randomize_start
        self._target: Vector = np.zeros(3)
        self._command: Vector = np.zeros(7)

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        observation = polar_elements("target", "panda_hand") + cls._joint_state_elements()
        return observation + point_elements("target", "panda_link0") + point_elements("ee", "panda_link0")

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        infinite, one = np.full(7, np.inf), np.ones(len(self._free))
        high = np.concatenate([infinite[:3], np.full(7, POSITION_BOUND), infinite, infinite[:6], one])
        return -high, high

    def sensor_errors(self) -> dict[str, SensorError]:
        """Return real sensors' errors; the joints' are a UR's: the Panda's data sheet states the same repeatability."""
        joints = {
            f"{joint}_position_normalized": SensorError(JOINT_NOISE / half, JOINT_BIAS / half)
            for joint, half in zip(JOINTS, HALF.tolist(), strict=True)
        }
        velocities = {f"{joint}_velocity": SensorError(VELOCITY_NOISE, 0.0) for joint in JOINTS}
        return polar_errors("target") | joints | velocities | position_errors()

    # -- for viewers, and for learning from a solution

    def target_position(self) -> Vector:
        """Return the target's position in MuJoCo's world [m] (3,)."""
        return self._target + self.BASE

    def move_target(self, position: ArrayLike) -> None:
        """Put the target somewhere else in MuJoCo's world [m] (3,) within the episode."""
        self._target = as_vector("position", position, 3)
        self.simulation.place_object(0, self._target)

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put arm and target where an observation has them."""
        self.simulation.place(np.clip(observations[row, 3:10] * HALF + CENTRE, LOW, HIGH))
        self.move_target(observations[row, 17:20])

    def solution(self) -> Vector:
        """Return an action that ends at the target, by inverse kinematics from the start pose."""
        joints = self.simulation.joints_towards(self._target + SOLUTION_OFFSET, start=self.START_JOINTS)
        action: Vector = (joints - CENTRE) / HALF
        return action[self._free]

    # -- a new episode

    def _place_arm(self, options: Mapping[str, Any]) -> Vector:
        centre = self._check_joints(options.get("joint_positions", self.START_JOINTS))
        if options.get("randomize_start", self._randomize_start):
            return self._place_arm_around(centre, START_RANGE)
        return self._place_arm_at(centre)

    def _begin(self, options: Mapping[str, Any]) -> None:
        self._command = np.zeros(7)
        pose = options.get("ee_target_pose")
        if pose is None:
            self._target = self.np_random.uniform(TARGET_LOW, TARGET_HIGH)
        else:
            self._target = as_vector("ee_target_pose", pose, 6)[:3]
        self.simulation.place_object(0, self._target)

    # -- a step

    def _to_joint_positions(self, command: Vector) -> Vector:
        self._command = command
        return super()._to_joint_positions(command)

    def _observation(self) -> Observation:
        sim = self.simulation
        tool, target = sim.tool_position, self._target + self._base_offset
        parts = (
            polar((target - tool) @ sim.tool_rotation),  # in the hand's frame
            (sim.joint_positions - CENTRE) / HALF,
            sim.joint_velocities,
            target,
            tool,
            self._command[self._free],
        )
        return np.concatenate(parts).astype(np.float32)

    def _distance(self) -> float:
        return float(np.linalg.norm(self._target - self.simulation.tool_position))

    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        del observation, command  # where the arm is, not what is observed
        distance = self._distance()
        if self.simulation.in_collision:
            return -1.0, "collision"
        if distance <= SUCCESS_DISTANCE:
            return 2.0, "success"
        return -0.005 * distance, None

    def _final_info(self, status: str) -> dict[str, Any]:
        del status
        return {"target_coord": self._target.copy(), "dist_coord": self._distance()}
