"""robo-gym's basic obstacle avoidance: keep away from a ball that goes up and down in front of the arm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.elements import joint_elements, polar_elements
from rlservo.envs.ur.arm_env import BASE, LIMITS, POSITION_BOUND, Observation, URArmEnv, Vector, polar
from rlservo.envs.ur.sensor_errors import joint_errors, polar_errors
from rlservo.robots.argument_checks import ElementInfo, InvalidResetError, as_vector
from rlservo.robots.disturbable import SensorError
from rlservo.robots.ur.object_paths import object_path
from rlservo.robots.ur.parameters import JOINT_NAMES

OBJECT_X, OBJECT_Y = 0.12, 0.34  # [m]
Z_AMPLITUDE_RANGE, Z_OFFSET_RANGE, Z_FREQUENCY = (0.09, 0.35), (0.2, 0.6), 0.125  # [m], [m], [Hz]
MINIMUM_DISTANCE = 0.3  # [m], of the ball from end effector and forearm
RAPID_CHANGE = 0.5  # of an action element between two steps
REDRAWS = 1000

# Rewards per step.
AT_START_REWARD, SMALL_ACTION_REWARD, RAPID_COST, CLOSE_COST = 0.001, 0.001, 0.0002, 0.002
AT_START_RANGE = 0.1 * 6  # of the summed distance of all joints from the start, normalised


class BasicAvoidanceURSim(URArmEnv):
    """Stay near the start pose, and out of the way of a ball moving up and down.

    The task, spaces, units and rewards are those of robo-gym 2.0's `BasicAvoidanceURSim-v0`. One step is one control
    cycle of 0.05 s.

    ## Observation: Box(18,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0 | object_r: distance of the ball from tool0 | m | 0 .. inf |
    | 1 | object_theta: acos(z/r) in the tool0 frame | rad | 0 .. pi |
    | 2 | object_phi: atan2(y, x) in the tool0 frame | rad | -pi .. pi |
    | 3-8 | position of base, shoulder, elbow, wrist_1, wrist_2, wrist_3 over 2 pi (elbow: pi) | 1 | -1.1 .. 1.1 |
    | 9-14 | the same, less the start position | 1 | -1.1 .. 1.1 |
    | 15-17 | the ball as in 0-2, in the forearm frame, with `include_polar_to_elbow`; else zeros | m, rad, rad | |

    ## Action: Box(5,), float32, -1 .. 1

    Offset in rad from the start joints, one element per joint that is not fixed, in the order above. The arm moves
    there in max(0.5 s, slowest joint's travel / (scale * velocity limit)), and the next action replaces the motion 0.05
    s later. A fixed joint is commanded to its start position. An action outside the space raises `InvalidActionError`
    naming the element and the excess.

    ## Reward

    In thousandths, each step, over all six joints (a fixed joint's action counts as 0): 1 - s / 0.6 for being near the
    start, where s is the sum of |elements 9-14|, while the sum of |elements 12-17| is below 0.6 (robo-gym sums those);
    1 - mean(action^2) for small actions; -0.2 for each joint whose action changed by more than 0.5; -2 while the ball
    is nearer than 0.3 m to tool0 or to the forearm's origin, the elbow.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | collision | a link touches the ball, the table, the ground or the arm itself | terminated |
    | success | 1000 steps without a collision | truncated |

    The last step's info also holds `is_success` and `target_coord`, the ball's position.

    ## Reset options

    `joint_positions` (6 numbers, rad; [-1.57, -1.31, -1.31, -2.18, 1.57, 0] without it), `fixed_object_position`
    (3 numbers, m, in base_link: the ball stays there). Of our own: `z_amplitude` and `z_offset` [m] of the ball's
    motion, which are drawn from 0.09 .. 0.35 and 0.2 .. 0.6 without them. The ball goes up and down at x 0.12,
    y 0.34 m, once in 8 s, and has done so for 20 cycles when the first observation is made. A motion that hits the arm
    before that is drawn again; one given by the caller that does so is refused with `InvalidResetError`.

    ## Constructor

    `ur_model` (ur5), `fix_base` ... `fix_wrist_3`, `include_polar_to_elbow`,
    `rs_state_to_info` (the robot server's `state_dict` of the mode `1moving2points` in `info["rs_state"]`; False keeps
    info picklable for RLlib), `render_mode`. Of our own: `max_velocity_scale_factor` (0.2) and `action_cycle_rate`
    (20 Hz), which robo-gym has in its launch file. robo-gym's `ip`, `lower_bound_port`, `upper_bound_port`, `gui`
    (`render_mode="human"`) and `rs_address` are accepted; there is no server to find.

    ## Differences from robo-gym on Gazebo

    robo-gym 2.0.1's own class cannot be reset or stepped with any server (its `reset` and `step` call their parents
    with the signatures of version 1); its intent is implemented here. The time limit truncates (robo-gym says done).
    All randomness comes from the environment's own seed. Resets are immediate, and a colliding start is refused.
    """

    START_JOINTS = (-1.57, -1.31, -1.31, -2.18, 1.57, 0.0)  # [rad]
    MAX_STEPS = 1000
    RESET_OPTIONS = ("joint_positions", "fixed_object_position", "z_amplitude", "z_offset")
    RS_MODE = "1moving2points"
    OBJECTS = ("sphere50",)
    TABLE = True
    ACTION_ELEMENT = ("offset", "rad")

    def __init__(self, *, include_polar_to_elbow: bool = False, **arguments: Any) -> None:
        self._include_polar_to_elbow = include_polar_to_elbow
        super().__init__(**arguments)
        self._previous_action: Vector = np.zeros(6)

    @classmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        observation = polar_elements("object", "tool0")
        observation += joint_elements(JOINT_NAMES, "position_normalized", "1", "joint position", LIMITS, np.zeros(6))
        observation += joint_elements(JOINT_NAMES, "offset_normalized", "1", "joint position", LIMITS)
        return observation + polar_elements("object_to_elbow", "forearm_link")

    @classmethod
    def _position_map(cls, **_arguments: Any) -> tuple[Vector, None]:
        return np.ones(6), None  # from the start, which `joint_positions` chooses

    def _observation_bounds(self) -> tuple[Vector, Vector]:
        elbow = np.full(3, np.inf) if self._include_polar_to_elbow else np.zeros(3)
        high = np.concatenate([np.full(3, np.inf), np.full(12, POSITION_BOUND), elbow])
        return -high, high

    # -- for disturbances

    def sensor_errors(self) -> dict[str, SensorError]:
        """Return the errors of a real arm's sensors and a camera."""
        joints = joint_errors("position_normalized") | joint_errors("offset_normalized")
        elbow = polar_errors("object_to_elbow") if self._include_polar_to_elbow else {}
        return polar_errors("object") | joints | elbow

    # -- for viewers

    def target_position(self) -> Vector:
        """Return the ball's position in MuJoCo's world [m] (3,)."""
        return self.simulation.object_position(0) + BASE

    def move_target(self, position: ArrayLike) -> None:
        """Put the ball at a position in MuJoCo's world [m] (3,), where it stays for the rest of the episode."""
        self.simulation.place_object(0, as_vector("position", position, 3) - BASE)

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put arm and ball at the poses of an observation."""
        sim = self.simulation
        sim.place(observations[row, 3:9] * LIMITS)
        r, theta, phi = observations[row, 0:3].tolist()
        in_tool = r * np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
        sim.place_object(0, sim.tool_position + sim.tool_rotation @ in_tool)

    # -- a new episode

    def _begin(self, options: Mapping[str, Any]) -> None:
        self._previous_action = np.zeros(6)
        position = options.get("fixed_object_position")
        if position is not None:
            self._start_object("fixed_position", dict(zip("xyz", as_vector("fixed_object_position", position, 3))))  # noqa: B905
            return
        is_given = any(name in options for name in ("z_amplitude", "z_offset"))
        for _ in range(1 if is_given else REDRAWS):
            wave = {
                "x": OBJECT_X,
                "y": OBJECT_Y,
                "z_frequency": Z_FREQUENCY,
                "z_amplitude": self._drawn_or_given(options, "z_amplitude", Z_AMPLITUDE_RANGE),
                "z_offset": self._drawn_or_given(options, "z_offset", Z_OFFSET_RANGE),
            }
            if self._start_object("triangle_wave", wave, refuse=is_given):
                return
        raise InvalidResetError(f"all {REDRAWS} random motions of the ball hit the arm at the given joint positions")

    def _start_object(self, function: str, parameters: dict[str, float], *, refuse: bool = True) -> bool:
        sim = self.simulation
        self.robot.place(self._start)
        path = object_path(function, 0, {f"object_0_{name}": v for name, v in parameters.items()}, self.np_random)
        sim.move_objects({0: path})
        self.robot.settle()
        if sim.in_collision and refuse:
            x, y, z = sim.object_position(0).tolist()
            raise InvalidResetError(
                f"the ball hits the arm before the first step: it is at ({x:.3f}, {y:.3f}, {z:.3f}) m, expected a "
                f"fixed_object_position, or z_amplitude and z_offset, that stay clear of the start joint positions"
            )
        return not sim.in_collision

    def _drawn_or_given(self, options: Mapping[str, Any], name: str, bounds: tuple[float, float]) -> float:
        if name in options:
            return float(as_vector(name, np.ravel(options[name]), 1)[0])
        return float(self.np_random.uniform(*bounds))

    # -- a step

    def _fixed_values(self) -> Vector:
        return np.zeros(6)

    def _to_joint_positions(self, command: Vector) -> Vector:
        return self._start + command

    def _observation(self) -> Observation:
        sim = self.simulation
        ball = sim.object_position(0) + self._base_offset
        joints = sim.joint_positions / LIMITS
        observation = np.zeros(18, dtype=np.float32)
        observation[0:3] = polar((ball - sim.tool_position) @ sim.tool_rotation)
        observation[3:9] = joints
        observation[9:15] = joints - self._start / LIMITS
        if self._include_polar_to_elbow:
            observation[15:18] = polar((ball - sim.forearm_position) @ sim.forearm_rotation)
        return observation

    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        sim = self.simulation
        ball = sim.object_position(0)
        reward = 0.0
        if float(np.abs(observation[-6:]).sum()) < AT_START_RANGE:
            reward += AT_START_REWARD * (1.0 - float(np.abs(observation[9:15]).sum()) / AT_START_RANGE)
        reward += SMALL_ACTION_REWARD * (1.0 - float(command @ command) / 6.0)
        reward -= RAPID_COST * int((np.abs(command - self._previous_action) > RAPID_CHANGE).sum())
        nearest = min(math.dist(ball, sim.tool_position), math.dist(ball, sim.forearm_position))
        if nearest < MINIMUM_DISTANCE:
            reward -= CLOSE_COST
        self._previous_action = command
        return reward, "collision" if sim.in_collision else None

    def _final_info(self, status: str) -> dict[str, Any]:  # noqa: ARG002
        return {"target_coord": self.simulation.object_position(0)}
