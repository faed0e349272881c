"""The end-effector positioning task of robo-gym, on the simulated arm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.elements import joint_elements, point_elements, polar_elements
from rlservo.envs.rendering import Start
from rlservo.envs.ur.arm_env import (
    BASE,
    LIMITS,
    POSITION_BOUND,
    REDRAWS,
    Observation,
    RealArmEnv,
    URArmEnv,
    Vector,
    polar,
)
from rlservo.envs.ur.sensor_errors import joint_errors, polar_errors, position_errors, velocity_errors
from rlservo.robots.argument_checks import ElementInfo, InvalidResetError, as_vector
from rlservo.robots.disturbable import Extreme, SensorError
from rlservo.robots.ur.parameters import JOINT_NAMES

START_JOINTS = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)  # [rad]
START_RANGE = (1.5, 0.25, 0.5, 1.0, 0.4, 3.14)  # [rad], +-, with randomize_start
WRIST_1_RANGE = (-3.48, 0.31)  # [rad], with restrict_wrist_1
SUCCESS_DISTANCE = 0.1  # [m]
# A start in a corner: any joints in this range [rad] that bring the tool near the base's axis or the table.
CORNER_LOW = (-math.pi, -math.pi, -2.8, -math.pi, -math.pi, 0.0)
CORNER_HIGH = (math.pi, 0.0, 2.8, math.pi, math.pi, 0.0)
CORNER_RADIUS, CORNER_HEIGHT = 0.25, 0.15  # [m]


class EndEffectorPositioningURSim(URArmEnv):
    """Bring the end effector of a UR arm to within 0.1 m of a target, without touching anything.

    The task, spaces, units and rewards are those of robo-gym 2.0's `EndEffectorPositioningURSim-v0`, so that a policy
    moves between the two unchanged. One step is one control cycle of 0.1 s.

    ## Observation: Box(27,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0 | target_r: distance of the target from tool0 | m | 0 .. inf |
    | 1 | target_theta: acos(z/r) in the tool0 frame | rad | 0 .. pi |
    | 2 | target_phi: atan2(y, x) in the tool0 frame | rad | -pi .. pi |
    | 3-8 | position of base, shoulder, elbow, wrist_1, wrist_2, wrist_3 over 2 pi (elbow: pi) | 1 | -1.1 .. 1.1 |
    | 9-14 | velocity of the same joints | rad/s | unbounded |
    | 15-17 | target x, y, z in base_link | m | unbounded |
    | 18-20 | tool0 x, y, z in base_link | m | unbounded |
    | 21-26 | the action before the last one, all six joints, fixed ones filled in; zeros at first | 1 | -1.01 .. 1.01 |

    (Elements 21-26 lag one step, as in robo-gym: it composes the observation before it stores the action.)

    ## Action: Box(5,), float32, -1 .. 1

    Absolute joint positions, one element per joint that is not fixed, in the order above: `position / 2 pi` (elbow:
    `/ pi`); with `restrict_wrist_1`, wrist_1 maps -1 .. 1 to -3.48 .. 0.31 rad instead. The arm moves towards them in
    max(0.5 s, slowest joint's travel / (scale * velocity limit)), and the next action replaces the motion 0.1 s later.
    A fixed joint is commanded to its position at reset (`fix_wrist_1` together with `restrict_wrist_1` sends that value
    through the restricted mapping, as robo-gym does: pass `restrict_wrist_1=False` with it). An action outside the
    space raises `InvalidActionError` naming the element and the excess.

    ## Reward

    -0.005 * distance [m] each step; +2 instead when the distance is at most 0.1 m; -1 instead on collision.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | success | distance at most 0.1 m, no collision | terminated |
    | collision | a link touches the table, the ground or the arm itself | terminated |
    | max_steps_exceeded | 300 steps | truncated |

    The last step's info also holds `is_success` and `target_coord`.

    ## Reset options

    `joint_positions` (6 numbers, rad), `ee_target_pose` (6 numbers: x, y, z in base_link, orientation unused),
    `randomize_start` (start joints drawn around the given ones, +- 1.5, 0.25, 0.5, 1.0, 0.4, 3.14 rad; a pose that
    collides is redrawn), `continue_on_success` (start where the last episode ended, if it was a success).
    Without options the arm starts at [0, -2.5, 1.5, -1.5, -1.4, 0] rad and the target is drawn uniformly from the
    half ball of the arm's workspace radius, outside a vertical cylinder around its base.

    ## Constructor

    `ur_model` (ur5), `fix_base` ... `fix_wrist_3`, `restrict_wrist_1`,
    `rs_state_to_info` (the robot server's `state_dict` in `info["rs_state"]`; False keeps info picklable for RLlib),
    `render_mode`. Of our own: `randomize_start` (the default of the reset option), `target` (the default of
    `ee_target_pose`: 'base_link:X,Y,Z', 'base:X,Y,Z' in the pendant's frame, or 'joints:' and six), and
    `max_velocity_scale_factor` (0.1) and `action_cycle_rate` (10 Hz), which robo-gym has in its launch file. robo-gym's
    `ip`, `lower_bound_port`, `upper_bound_port`, `gui` and `rs_address` are accepted and unused: there is no server to
    find.

    ## Differences from robo-gym on Gazebo

    The time limit truncates (robo-gym says done); success in the very last step counts as success. All randomness comes
    from the environment's own seed. Resets are immediate, and a colliding start given by the caller is refused.
    Gazebo's controller jitter and sensor delay are not modelled: a command takes effect within the cycle, exactly.
    """

    START_JOINTS = START_JOINTS
    WITHIN = SUCCESS_DISTANCE
    MAX_STEPS = 300
    RESET_OPTIONS = ("joint_positions", "ee_target_pose", "randomize_start", "continue_on_success")
    RS_MODE = "1object"
    OBJECTS = ("sphere50_no_collision",)
    TABLE = True
    ACTION_ELEMENT = ("position_normalized", "1")
    TIME_LIMIT_STATUS = "max_steps_exceeded"
    MAX_VELOCITY_SCALE = 0.1
    RATE_HZ = 10.0

    def __init__(self, *, restrict_wrist_1: bool = True, randomize_start: bool = False, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._restrict_wrist_1 = restrict_wrist_1
        self._randomize_start = randomize_start
        self._target: Vector = np.zeros(3)
        self._previous_action: Vector = np.zeros(6)
        self._success_joints: Vector | None = None

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        observation = polar_elements("target", "tool0")
        observation += joint_elements(JOINT_NAMES, *cls.ACTION_ELEMENT, "joint position", LIMITS, np.zeros(6))
        observation += joint_elements(JOINT_NAMES, "velocity", "rad/s", "joint velocity")
        observation += point_elements("target", "base_link") + point_elements("ee", "base_link")
        return observation + joint_elements(JOINT_NAMES, "previous_action", "1", "last action")

    @classmethod
    def _position_map(cls, *, restrict_wrist_1: bool = True, **_arguments: Any) -> tuple[Vector, Vector]:
        scale, offset = LIMITS.copy(), np.zeros(6)
        if restrict_wrist_1:
            low, high = WRIST_1_RANGE
            scale[3], offset[3] = 0.5 * (high - low), 0.5 * (high + low)
        return scale, offset

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        infinite = np.full(6, np.inf)
        high = np.concatenate([infinite[:3], np.full(6, POSITION_BOUND), infinite, infinite, np.full(6, 1.01)])
        return -high, high

    # -- for disturbances

    def sensor_errors(self) -> dict[str, SensorError]:
        """Return the errors of a real arm's sensors; the previous actions are known exactly."""
        joints = joint_errors("position_normalized") | velocity_errors()
        return polar_errors("target") | joints | position_errors()

    def extreme_options(self, what: Extreme, rng: np.random.Generator) -> dict[str, Any]:
        """Return the options of an episode whose target is beyond the arm's reach, or that starts in a corner.

        In a corner the arm is folded, the tool within 0.25 m of the base's axis or within 0.15 m of the table.
        """
        arm = self.simulation.parameters
        if what == "target":
            # Further than the stretched arm and the success distance, whatever the direction.
            reach = arm.d1 + abs(arm.a2) + abs(arm.a3) + arm.d4 + arm.d5 + arm.d6
            radius, phi = (reach + SUCCESS_DISTANCE) * rng.uniform(1.1, 1.6), rng.uniform(-math.pi, math.pi)
            height = rng.uniform(0.0, 0.7)
            horizontal = math.sqrt(1.0 - height * height)
            position = radius * np.array([horizontal * math.cos(phi), horizontal * math.sin(phi), height])
            return {"ee_target_pose": [*position.tolist(), 0.0, 0.0, 0.0]}
        for _ in range(REDRAWS):
            joints: Vector = rng.uniform(CORNER_LOW, CORNER_HIGH)
            if self.simulation.place(joints):
                continue
            x, y, z = self.simulation.tool_position.tolist()
            if math.hypot(x, y) < CORNER_RADIUS or z < CORNER_HEIGHT:
                return {"joint_positions": joints.tolist(), "randomize_start": False}
        raise InvalidResetError(f"none of {REDRAWS} random poses is in a corner")

    # -- for viewers

    def target_position(self) -> Vector:
        """Return the target's position in MuJoCo's world [m] (3,)."""
        return self._target + BASE

    def move_target(self, position: ArrayLike) -> None:
        """Move the target in MuJoCo's world [m] (3,) within the episode."""
        self._target = as_vector("position", position, 3) - BASE
        self.simulation.place_object(0, self._target)

    def reset_options(self, *, start: Start = "own", keep_target: bool = False) -> dict[str, Any]:
        """Return the options of an episode with the requested start; `keep_target` leaves the target in place."""
        options: dict[str, Any] = {"ee_target_pose": [*self._target.tolist(), 0.0, 0.0, 0.0]} if keep_target else {}
        if start == "here":
            joints = np.clip(self.simulation.joint_positions, -LIMITS, LIMITS)
            options |= {"joint_positions": joints.tolist(), "randomize_start": False}
        elif start == "random":
            options["randomize_start"] = True
        return options

    def start_at(self, position: ArrayLike) -> dict[str, Any]:
        """Return the options of an episode that starts with tool0 there, or as near as the arm gets from here."""
        return {**super().start_at(position), "randomize_start": False}

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put arm and target at the poses of an observation."""
        self.simulation.place(observations[row, 3:9] * LIMITS)
        self.move_target(observations[row, 15:18] + BASE)

    # -- a new episode

    def _place_arm(self, options: Mapping[str, Any]) -> Vector:
        joints_option = options.get("joint_positions")
        centre = np.array(START_JOINTS) if joints_option is None else as_vector("joint_positions", joints_option, 6)
        if options.get("continue_on_success") and self._success_joints is not None:
            centre, randomize = self._success_joints, False
        else:
            randomize = bool(options.get("randomize_start", self._randomize_start))
        centre = self._check_joints(centre)
        if not randomize:
            return self._place_arm_at(centre)
        return self._place_arm_around(centre, START_RANGE)

    def _begin(self, options: Mapping[str, Any]) -> None:
        del options
        self._previous_action = np.zeros(6)
        self._target = self._target_pose()[:3]
        self.simulation.place_object(0, self._target)

    def _random_pose(self) -> Vector:
        arm = self.simulation.parameters
        while True:
            phi = self.np_random.uniform(0.0, 2.0 * math.pi)
            cos_theta = self.np_random.uniform(0.0, 1.0)
            radius = arm.workspace_radius * math.pow(self.np_random.uniform(0.0, 1.0), 1.0 / 3.0)
            horizontal = radius * math.sqrt(1.0 - cos_theta * cos_theta)
            if horizontal > arm.workspace_min_radius:
                return np.array([horizontal * math.cos(phi), horizontal * math.sin(phi), radius * cos_theta, 0, 0, 0])

    # -- a step

    def _fixed_values(self) -> Vector:
        return self._start / LIMITS

    def _to_joint_positions(self, command: Vector) -> Vector:
        positions: Vector = command * LIMITS
        if self._restrict_wrist_1:
            low, high = WRIST_1_RANGE
            positions[3] = low + (command[3] + 1.0) * 0.5 * (high - low)
        return positions

    def _observation(self) -> Observation:
        sim = self.simulation
        tool = sim.tool_position
        target = self._target + self._base_offset
        observation = np.empty(27, dtype=np.float32)
        observation[0:3] = polar((target - tool) @ sim.tool_rotation)  # in the tool0 frame
        observation[3:9] = sim.joint_positions / LIMITS
        observation[9:15] = sim.joint_velocities
        observation[15:18] = target
        observation[18:21] = tool
        observation[21:27] = self._previous_action
        return observation

    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        self._previous_action = command  # after the observation: robo-gym's order, see the data sheet
        distance = float(observation[0])
        if self._base_offset.any():  # the reported position is wrong
            distance = math.dist(self._target, self.simulation.tool_position)
        if self.simulation.in_collision:
            return -1.0, "collision"
        if distance <= SUCCESS_DISTANCE:
            self._success_joints = self.simulation.joint_positions.copy()
            return 2.0, "success"
        return -0.005 * distance, None

    def _final_info(self, status: str) -> dict[str, Any]:
        if status != "success":
            self._success_joints = None
        return {"target_coord": self._target.copy()}


class EndEffectorPositioningURRob(RealArmEnv, EndEffectorPositioningURSim):
    """The same task on a real arm: `robot` is for example 'rtde://192.168.0.2'.

    Observations, actions, rewards and endings are the simulated environment's, computed from the measured joints; a
    robot that stops ends the episode, with the reason as `final_status` (protective_stop, emergency_stop,
    program_stopped, connection_lost, stale_observation ...). A step lasts a control cycle of real time. `reset` moves
    the arm slowly to its start, in a straight line of joint space, after asking at the terminal. A target that is drawn
    is in front of the robot: within 45 degrees of base_link's x axis, and where the limits let the flange go.

    It adds `limits` (names and defaults: `rlservo.robots.limits.Limits`), `confirm` (False: `reset` does not ask),
    `metrics` (HOST:PORT at which Prometheus reads state and limits), and `info["robot"]`: the state, its changes, and
    the limits that applied since the last step.
    """
