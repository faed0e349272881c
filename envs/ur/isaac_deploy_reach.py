"""Isaac Lab's reach task for a real UR10e: bring the flange to a pose, by joint targets near the present position.

Source of the figures: isaac-sim/IsaacLab 3.0, isaaclab_tasks/.../deploy/reach/reach_env_cfg.py and
config/ur_10e/joint_pos_env_cfg.py; isaaclab_assets/robots/universal_robots.py (start pose and drives).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.elements import joint_elements, point_elements, quaternion_elements
from rlservo.envs.ur.arm_env import BASE, LIMITS, POSITION_BOUND, Observation, RealArmEnv, Vector
from rlservo.envs.ur.isaac_reach import IsaacReachURSim
from rlservo.envs.ur.sensor_errors import JOINT_BIAS, JOINT_NOISE, velocity_errors
from rlservo.robots.argument_checks import ElementInfo, EnvDescription
from rlservo.robots.disturbable import SensorError
from rlservo.robots.ur.parameters import JOINT_NAMES, JOINTS

START_JOINTS = (math.pi, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)  # [rad]
START_RANGE = 0.125  # [rad], +-, with randomize_start
# Targets in the frame base: x, y, z [m] and roll, pitch, yaw [rad]; the middle, and +-.
TARGET_MIDDLE = np.array([0.8875, -0.225, 0.2, math.pi, 0.0, -math.pi / 2])
TARGET_RANGE = np.array([0.25, 0.125, 0.1, math.pi / 6, math.pi / 6, 2.0 * math.pi / 3])
HALF_TURN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.pi])  # from base to base_link, about z
MIRRORED = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
# Isaac Lab's drives move a joint by (stiffness / damping) * (target - position) rad/s: 18 / s at shoulder and elbow.
FOLLOWING_S = 1.0 / 18.0
ORDERS = {"xyzw": (1, 2, 3, 0), "wxyz": (0, 1, 2, 3)}


class IsaacDeployReachURSim(IsaacReachURSim):
    """Bring the flange of a UR arm to a pose, to within 2 cm and 0.05 rad.

    Observations, actions, targets and start are those of Isaac Lab's `Isaac-Deploy-Reach-UR10e-ROS-Inference-v0`. One
    step is one control cycle of 1/60 s. The arm stands on Isaac Lab's table and looks away from it, along `base`'s x.

    ## Observation: Box(19,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0-5 | position of base, shoulder, elbow, wrist_1, wrist_2, wrist_3 | rad | 1.1 limits |
    | 6-11 | velocity of the same joints | rad/s | unbounded |
    | 12-14 | target x, y, z in base, the pendant's frame: base_link turned by 180 degrees about z | m | unbounded |
    | 15-18 | target's quaternion x, y, z, w in base (`quaternion=wxyz`: w, x, y, z, as Isaac Lab 2) | 1 | -1 .. 1 |

    ## Action: Box(6,), float32

    Joint positions [rad]. The policy's own number moves its target by 0.0625 rad from the observed position (Isaac
    Lab's RelativeJointPositionAction); the export adds the two. Targets beyond the joint limits are clipped to them, as
    the physics does there. The arm moves towards them in max(1/18 s, slowest joint's travel / (scale * velocity
    limit)), and the next action replaces the motion a cycle later.

    ## Reward, endings and reset options

    Those of `IsaacReachURSim`, with 720 steps, and with a random start within 0.125 rad. Isaac Lab resamples the target
    every 4 s; here a target is an episode, and the next begins where it ended. Targets are x 0.6375 to 1.1375, y -0.35
    to -0.1, z 0.1 to 0.3 m, and roll 150 to 210, pitch -30 to 30, yaw -210 to 30 degrees, in base.

    ## Constructor

    As of `IsaacReachURSim`, with `ur_model` ur10e and 60 Hz, and `quaternion` (xyzw).
    """

    TOOL = "tool0"  # the URDF's wrist_3_link has its frame
    START_JOINTS = START_JOINTS
    START_RANGE = START_RANGE
    TARGET_TURN = (math.pi, 0.0, math.pi / 2)
    FRONT_FRAME = "base"
    MIN_TRAJECTORY_S = FOLLOWING_S
    MAX_STEPS = 720
    ACTION_ELEMENT = ("position", "rad")
    OBSERVES_LAST_ACTION = False
    RATE_HZ = 60.0
    COMMAND: ClassVar[str] = "pose_command"  # the observation term, in Isaac Lab

    def __init__(self, *, ur_model: str = "ur10e", quaternion: str = "xyzw", **arguments: Any) -> None:
        if quaternion not in ORDERS:
            raise ValueError(f"quaternion is {quaternion!r}: expected {' or '.join(ORDERS)}")
        self._order = list(ORDERS[quaternion])
        self._observed_turn: Vector = np.zeros(4)  # the target's quaternion as it is observed
        super().__init__(ur_model=ur_model, **arguments)

    @classmethod
    def describe(cls, *, quaternion: str = "xyzw", **arguments: Any) -> EnvDescription:
        """Name the elements for the constructor arguments given, without building a simulator."""
        described = super().describe(**arguments)
        described["observation"] += quaternion_elements(cls.COMMAND, "base", quaternion)
        return described

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        ones, zeros = np.ones(6), np.zeros(6)
        observation = joint_elements(JOINT_NAMES, "position", "rad", "joint position", ones, zeros)
        observation += joint_elements(JOINT_NAMES, "velocity", "rad/s", "joint velocity", ones, zeros)
        return observation + point_elements(cls.COMMAND, "base")

    @classmethod
    def _position_map(cls, **_arguments: Any) -> tuple[Vector, Vector]:
        return np.ones(6), np.zeros(6)

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        high = np.concatenate([POSITION_BOUND * LIMITS, np.full(9, np.inf), np.ones(4)])
        return -high, high

    def _action_bounds(self) -> tuple[Vector, Vector]:
        infinite = np.full(6, np.inf)
        return -infinite, infinite

    def sensor_errors(self) -> dict[str, SensorError]:
        """Return the errors of a real arm's sensors; the target is a command, and known exactly."""
        return {f"{joint}_position": SensorError(JOINT_NOISE, JOINT_BIAS) for joint in JOINTS} | velocity_errors()

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put arm and target where an observation has them."""
        self.simulation.place(np.clip(observations[row, :6], -LIMITS, LIMITS))
        self.move_target(observations[row, 12:15] * MIRRORED[:3] + BASE)

    def solution(self) -> Vector:
        """Return an action that ends at the target, by inverse kinematics; all joints are free."""
        joints = np.array(START_JOINTS)
        joints[5] -= self._yaw - self.TARGET_TURN[2]  # the flange points down: it turns against the yaw
        return self.simulation.joints_towards(self._target, self._target_rotation, start=joints)

    def _random_pose(self) -> Vector:
        in_base = self.np_random.uniform(TARGET_MIDDLE - TARGET_RANGE, TARGET_MIDDLE + TARGET_RANGE)
        return np.asarray(in_base * MIRRORED + HALF_TURN, np.float64)

    def _begin(self, options: Mapping[str, Any]) -> None:
        super()._begin(options)
        w, x, y, z = self._quaternion  # in base_link
        in_base = np.array([z, y, -x, -w])
        # Of the two signs of a turn, the one that Isaac Lab's targets have.
        self._observed_turn = np.copysign(1.0, in_base[1] - in_base[2]) * in_base[self._order]

    def _fixed_values(self) -> Vector:
        return self._start

    def _to_joint_positions(self, command: Vector) -> Vector:
        return np.clip(command, -LIMITS, LIMITS)

    def _observation(self) -> Observation:
        sim = self.simulation
        position = (self._target + self._base_offset) * MIRRORED[:3]
        parts = (sim.joint_positions, sim.joint_velocities, position, self._observed_turn)
        return np.concatenate(parts).astype(np.float32)


class IsaacDeployReachURRob(RealArmEnv, IsaacDeployReachURSim):
    """The same task on a real arm; see `EndEffectorPositioningURRob`."""
