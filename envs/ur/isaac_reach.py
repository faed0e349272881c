"""robo-gym 2.1's Isaac Lab reach task: bring the tool of a UR arm to a pose, position and orientation.

Source of the figures: jr-robotics/robo-gym 2.1, envs/manipulator/isaac_reach.py and envs/ur/ur_isaac_reach.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.elements import joint_elements, point_elements, quaternion_elements
from rlservo.envs.ur.arm_env import BASE, LIMITS, POSITION_BOUND, Observation, URArmEnv, Vector
from rlservo.envs.ur.sensor_errors import JOINT_BIAS, JOINT_NOISE, velocity_errors
from rlservo.robots.argument_checks import ElementInfo, as_vector
from rlservo.robots.disturbable import SensorError
from rlservo.robots.ur.parameters import JOINT_NAMES, JOINTS

DEFAULT_JOINTS = (0.0, -1.7120, 1.7120, 0.0, 0.0, 0.0)  # [rad], Isaac Lab's UR10
ACTION_SCALE = 0.5  # [rad] of one unit of an action
TARGET_LOW, TARGET_HIGH = np.array([0.35, -0.2, 0.15]), np.array([0.65, 0.2, 0.5])  # [m] in base_link
TARGET_PITCH, TARGET_YAW = math.pi / 2, 3.14  # [rad]; the yaw +-
SUCCESS_DISTANCE, SUCCESS_ANGLE = 0.02, 0.05  # [m], [rad]
START_RANGE = 0.5  # [rad], +-, with randomize_start
# The posture in the middle of the targets, at yaw 0, from which inverse kinematics find the others.
POSTURE = (-0.334, -1.393, 1.970, 0.993, 1.571, 1.237)  # [rad]


class IsaacReachURSim(URArmEnv):
    """Bring the end effector of a UR arm to a pose, to within 2 cm and 0.05 rad.

    Spaces, units and rewards are those of robo-gym 2.1's `IsaacReachURSim-v0`, and so of Isaac Lab's
    `Isaac-Reach-UR10-v0`. One step is one control cycle of 1/30 s. The arm stands on Isaac Lab's table; the end
    effector is `tool1`, whose x axis is the flange's direction, which targets point down.

    ## Observation: Box(25,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0-5 | position of base, shoulder, elbow, wrist_1, wrist_2, wrist_3 minus the default pose | rad | 1.1 limits |
    | 6-11 | velocity of the same joints | rad/s | unbounded |
    | 12-14 | target x, y, z in base_link | m | unbounded |
    | 15-18 | target's quaternion w, x, y, z | 1 | -1 .. 1 |
    | 19-24 | the last action; zeros at first | 1 | the action's |

    The default pose is [0, -1.712, 1.712, 0, 0, 0] rad.

    ## Action: Box(6,), float32

    Joint positions as (position - default pose) / 0.5 rad, within the joint limits. The arm moves towards them in
    max(0.5 s, slowest joint's travel / (scale * velocity limit)), and the next action replaces the motion a cycle
    later. An action outside the space raises `InvalidActionError` naming the element and the excess.

    ## Reward

    -0.005 * distance [m] - 0.05 * angle [rad] each step; +2 instead within 2 cm and 0.05 rad; -1 on collision.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | success | distance at most 2 cm and angle below 0.05 rad, no collision | terminated |
    | collision | a link touches the table, the ground or the arm itself | terminated |
    | max_steps_exceeded | 600 steps | truncated |

    The last step's info also holds `is_success`, `dist_coord` [m], `dist_rot` [rad] and `target_coord`.

    ## Reset options

    `joint_positions` (6 numbers, rad), `ee_target_pose` (6 numbers: x, y, z, roll, pitch, yaw in base_link),
    `randomize_start` (start joints drawn within 0.5 rad of the given ones; a pose that collides is redrawn). Without
    options an episode begins where the last one ended, unless that was a collision or a seed is given: then at the
    default pose. Targets are x 0.35 to 0.65, y -0.2 to 0.2, z 0.15 to 0.5 m, roll 0, pitch pi/2, yaw -3.14 to 3.14.

    ## Constructor

    `ur_model` (ur10), `fix_*` (none), `continue_except_collision` (True; False: each episode begins at the default
    pose), `randomize_start`, `target`, `rs_state_to_info`, `render_mode`, `max_velocity_scale_factor`
    (0.2), `action_cycle_rate` (30 Hz), and robo-gym's arguments for a server, as of `EndEffectorPositioningURSim`.
    """

    FIXED = ()
    TOOL = "tool1"
    START_JOINTS = DEFAULT_JOINTS
    START_RANGE: ClassVar[float] = START_RANGE
    WITHIN = SUCCESS_DISTANCE
    TARGET_TURN = (0.0, TARGET_PITCH, 0.0)
    MAX_STEPS = 600
    RESET_OPTIONS = ("joint_positions", "ee_target_pose", "randomize_start")
    RS_MODE = "1object"
    OBJECTS = ("sphere50_no_collision",)
    TABLE = "isaac"
    ACTION_ELEMENT = ("position_offset", "0.5 rad")
    OBSERVES_LAST_ACTION = True
    TIME_LIMIT_STATUS = "max_steps_exceeded"
    RATE_HZ = 30.0

    def __init__(
        self,
        *,
        ur_model: str = "ur10",
        continue_except_collision: bool = True,
        randomize_start: bool = False,
        **arguments: Any,
    ) -> None:
        super().__init__(ur_model=ur_model, **arguments)
        self._continues = continue_except_collision
        self._randomize_start = randomize_start
        self._target: Vector = np.zeros(3)
        self._quaternion: Vector = np.array([1.0, 0.0, 0.0, 0.0])  # the target's, w, x, y, z
        self._target_rotation: Vector = np.eye(3)
        self._yaw = 0.0  # [rad], the target's
        self._command: Vector = np.zeros(6)
        self._end: Vector | None = None  # where an episode ended, if the next one may begin there

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        observation = joint_elements(JOINT_NAMES, "position_offset", "rad", "joint position", [1.0] * 6, DEFAULT_JOINTS)
        observation += joint_elements(JOINT_NAMES, "velocity", "rad/s", "joint velocity")
        return observation + point_elements("target", "base_link") + quaternion_elements("target", "base_link", "wxyz")

    @classmethod
    def _position_map(cls, **_arguments: Any) -> tuple[Vector, Vector]:
        return np.full(6, ACTION_SCALE), np.array(DEFAULT_JOINTS)

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        low, high = (side[self._free] for side in self._action_bounds())
        infinite, quaternion = np.full(9, np.inf), np.ones(4)
        limit, default = POSITION_BOUND * LIMITS, np.array(DEFAULT_JOINTS)
        return (
            np.concatenate([-limit - default, -infinite, -quaternion, low]),
            np.concatenate([limit - default, infinite, quaternion, high]),
        )

    def _action_bounds(self) -> tuple[Vector, Vector]:
        default = np.array(DEFAULT_JOINTS)
        return (-LIMITS - default) / ACTION_SCALE, (LIMITS - default) / ACTION_SCALE

    def sensor_errors(self) -> dict[str, SensorError]:
        """Return the errors of a real arm's sensors; the target is a command, and known exactly."""
        return {
            f"{joint}_position_offset": SensorError(JOINT_NOISE, JOINT_BIAS) for joint in JOINTS
        } | velocity_errors()

    # -- for viewers, and for learning from a solution

    def target_position(self) -> Vector:
        """Return the target's position in MuJoCo's world [m] (3,)."""
        return self._target + BASE

    def move_target(self, position: ArrayLike) -> None:
        """Put the target somewhere else in MuJoCo's world [m] (3,) within the episode."""
        self._target = as_vector("position", position, 3) - BASE
        self.simulation.place_object(0, self._target)

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put arm and target where an observation has them."""
        self.simulation.place(np.clip(observations[row, :6] + DEFAULT_JOINTS, -LIMITS, LIMITS))
        self.move_target(observations[row, 12:15] + BASE)

    def solution(self) -> Vector:
        """Return an action that ends at the target, by inverse kinematics; all joints are free."""
        joints = np.array(POSTURE)
        joints[5] -= self._yaw  # the flange points down: it turns against the yaw
        joints = self.simulation.joints_towards(self._target, self._target_rotation, start=joints)
        return (joints - DEFAULT_JOINTS) / ACTION_SCALE

    # -- a new episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the class's docstring lists the options."""
        if seed is not None:
            self._end = None  # the same seed, the same episode
        return super().reset(seed=seed, options=options)

    def _place_arm(self, options: Mapping[str, Any]) -> Vector:
        values = options.get("joint_positions")
        if values is not None:
            centre = self._check_joints(values)
        elif self._end is not None and self._continues:
            return self._place_arm_at(self._end)
        else:
            centre = np.array(self.START_JOINTS)
        if not options.get("randomize_start", self._randomize_start):
            return self._place_arm_at(centre)
        return self._place_arm_around(centre, self.START_RANGE)

    def _begin(self, options: Mapping[str, Any]) -> None:
        del options
        self._command = np.zeros(6)
        pose = self._target_pose()
        self._target = pose[:3]
        roll, pitch, self._yaw = pose[3:].tolist()
        self._quaternion = quaternion_of(roll, pitch, self._yaw)
        self._target_rotation = rotation_of(self._quaternion)
        self.simulation.place_object(0, self._target)

    def _random_pose(self) -> Vector:
        position = self.np_random.uniform(TARGET_LOW, TARGET_HIGH)
        return np.array([*position, 0.0, TARGET_PITCH, self.np_random.uniform(-TARGET_YAW, TARGET_YAW)])

    # -- a step

    def _fixed_values(self) -> Vector:
        return (self._start - DEFAULT_JOINTS) / ACTION_SCALE

    def _to_joint_positions(self, command: Vector) -> Vector:
        self._command = command
        return command * ACTION_SCALE + DEFAULT_JOINTS

    def _observation(self) -> Observation:
        sim = self.simulation
        parts = (
            sim.joint_positions - DEFAULT_JOINTS,
            sim.joint_velocities,
            self._target + self._base_offset,
            self._quaternion,
            self._command[self._free],
        )
        return np.concatenate(parts).astype(np.float32)

    def _errors(self) -> tuple[float, float]:
        """Return how far the tool is from the target, [m] and [rad]."""
        cosine = 0.5 * (float(np.vdot(self.simulation.tool_rotation, self._target_rotation)) - 1.0)
        return math.dist(self._target, self.simulation.tool_position), math.acos(max(-1.0, min(1.0, cosine)))

    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        del observation, command  # where the arm is, not what is observed
        distance, angle = self._errors()
        if self.simulation.in_collision:
            return -1.0, "collision"
        if distance <= SUCCESS_DISTANCE and angle < SUCCESS_ANGLE:
            return 2.0, "success"
        return -0.005 * distance - 0.05 * angle, None

    def _final_info(self, status: str) -> dict[str, Any]:
        self._end = None if status == "collision" else np.clip(self.simulation.joint_positions, -LIMITS, LIMITS)
        distance, angle = self._errors()
        return {"target_coord": self._target.copy(), "dist_coord": distance, "dist_rot": angle}


def quaternion_of(roll: float, pitch: float, yaw: float) -> Vector:
    """Return the quaternion w, x, y, z of rotations about the fixed axes x, y and z; Isaac Lab's sign."""
    (cr, cp, cy), (sr, sp, sy) = ([turn(0.5 * angle) for angle in (roll, pitch, yaw)] for turn in (math.cos, math.sin))
    return np.array(
        [
            cy * cr * cp + sy * sr * sp,
            cy * sr * cp - sy * cr * sp,
            cy * cr * sp + sy * sr * cp,
            sy * cr * cp - cy * sr * sp,
        ]
    )


def rotation_of(quaternion: Vector) -> Vector:
    """Return the rotation matrix (3, 3) of a unit quaternion w, x, y, z."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
