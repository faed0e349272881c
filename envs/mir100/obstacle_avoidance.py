"""The obstacle avoidance task of robo-gym, on the simulated MiR100."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from rlservo.envs.mir100.navigation import Mir100Navigation
from rlservo.envs.rendering import Start
from rlservo.robots.argument_checks import InvalidResetError, as_vector
from rlservo.robots.disturbable import Extreme
from rlservo.robots.mir100.parameters import LENGTH, WIDTH
from rlservo.robots.mir100.simulation import ROOM_VIEW
from rlservo.robots.mir100.worlds import LAB_6X8, Pose

SAFETY_RADIUS = 0.40  # [m], of a corner of the robot from a cube's centre
MIN_READING = 0.15  # [m]
SIDE = (2.1, 3.1)  # [m], |y| of start and target
CUBE_COLUMNS = ((-2.4, -1.5), (-0.5, 0.5), (1.5, 2.4))  # [m], x of each cube
# robo-gym's corners are those of a body centred at base_link.
CORNERS = tuple((sx * LENGTH / 2, sy * WIDTH / 2) for sx in (1, -1) for sy in (1, -1))  # [m], in base_link
REDRAWS = 1000  # of the cubes, while they are in the way of a requested start pose


class ObstacleAvoidanceMir100Sim(Mir100Navigation):
    """Drive a MiR100 across a room to within 0.2 m of a target, past three cubes.

    The task, spaces, units and rewards are those of robo-gym 2.0's `ObstacleAvoidanceMir100Sim-v0`, so that a policy
    moves between the two unchanged. One step is one control cycle of 0.1 s. The robot's pose is that of base_link: on
    the floor below the middle of the wheel axle, x ahead, y to the left.

    ## Observation: Box(20,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0 | target_r: distance of the target from the robot | m | -inf .. inf (never negative) |
    | 1 | target_theta: its direction from the robot, to the left positive | rad | -pi .. pi |
    | 2 | linear_velocity, ahead positive | m/s | -1.1 .. 1.1 |
    | 3 | angular_velocity, to the left positive | rad/s | -1.6 .. 1.6 |
    | 4-11 | laser_0 .. laser_7, front scanner (ahead on the left corner) | m | 0 .. 29 (0.05 .. 29) |
    | 12-19 | laser_8 .. laser_15, back scanner (behind on the right corner) | m | 0 .. 29 (0.05 .. 29) |

    The lasers are 16 of the 1,012 beams, evenly picked from the front scan followed by the back scan. Their directions
    from straight ahead, to the left positive: -75, -41.5, -7.5, 26, 60, 93.5, 127, 161 degrees; 114, 148, -178.5, -145,
    -111, -77.5, -43.5, -10 degrees. Readings have Gaussian noise of 0.01 m.

    ## Action: Box(2,), float32, -1 .. 1

    That of `NoObstacleNavigationMir100Sim`: velocities up to 0.5 m/s and 0.7 rad/s. The robot refuses to move while
    something is within 0.04 m of a scanner, which is inside its housing: no episode lasts that long.

    ## Reward

    50 per metre by which the target came nearer (none in an episode's first step), minus 0.30 |a0| and 0.03 |a1| for
    the motors. The last step of an episode gives instead: +100 on success, -200 on collision.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | success | the target is nearer than 0.2 m | terminated |
    | collision | a wall or cube is touched, a beam reads below 0.15 m, or a corner is near a cube | terminated |
    | max_steps_exceeded | 500 steps | truncated |

    Any of the 1,012 beams counts. A corner (+-0.45, +-0.29 m) is near a cube when within 0.40 m of the cube's centre.
    If success and collision fall into one step, it is a success. The last step's info also holds `is_success`.

    ## Reset options

    `start_pose` and `target_pose` (3 numbers each: x, y in m, yaw in rad; the target's yaw is unused). Without them the
    robot starts within +-2 m in x and 2.1 to 3.1 m from the middle in y, on either side and in any direction; the
    target is drawn in the same way on the other side. The cubes (0.5 m) stand at x -2.4 .. -1.5, -0.5 .. 0.5 and
    1.5 .. 2.4 m, y -1 .. 1 m, turned at random. Cubes in the way of a `start_pose` are drawn again; a pose that fails
    wherever they stand is refused with `InvalidResetError`. Of our own: `cubes` (three poses) places them.
    The room is 5.70 x 7.70 m inside, its middle at (-0.027, 0.014).

    ## Constructor

    That of `NoObstacleNavigationMir100Sim`; `laser_noise` is the standard deviation of the readings in m, and
    `failure_reward` what a collision gives instead of -200.

    ## Differences from robo-gym on Gazebo

    The time limit truncates (robo-gym says done), and arriving in the very last step is a success (robo-gym gives the
    success reward and calls it max_steps_exceeded). `reset` takes `seed` and `options` and returns info, which
    robo-gym 2.0.1 forgot for this task; all randomness comes from the environment's own seed. The cubes cannot be
    pushed (Gazebo's weigh 1 kg). Readings belong to the end of the cycle; Gazebo's arrive at 12.5 Hz with a delay. A
    step lasts exactly 0.1 s and a command takes effect within it. The wheels do not slip or bounce. Resets are
    immediate.
    """

    RESET_OPTIONS: ClassVar[tuple[str, ...]] = (*Mir100Navigation.RESET_OPTIONS, "cubes")
    WORLD = LAB_6X8.name
    LASER_COUNT = 16
    SUCCESS_REWARD = 100.0
    VIEW = ROOM_VIEW

    def _random_start(self) -> Pose:
        x = self.np_random.uniform(-2.0, 2.0)
        y = self.np_random.uniform(*SIDE)
        side = 1.0 if self.np_random.integers(2) else -1.0
        return x, side * y, self.np_random.uniform(-math.pi, math.pi)

    def _random_target_position(self, start: Sequence[float]) -> tuple[float, float]:
        x = self.np_random.uniform(-2.0, 2.0)
        y = self.np_random.uniform(*SIDE)
        return x, -y if start[1] > 0.0 else y

    def _random_cubes(self) -> list[Pose]:
        draw = self.np_random.uniform
        return [(draw(*column), draw(-1.0, 1.0), draw(-math.pi, math.pi)) for column in CUBE_COLUMNS]

    def reset_options(self, *, start: Start = "own", keep_target: bool = False) -> dict[str, Any]:
        """Return the options of an episode with the requested start; if the robot stays, so do the cubes."""
        options = super().reset_options(start=start, keep_target=keep_target)
        return {**options, "cubes": self.simulation.cubes} if start == "here" else options

    def _place(self, start: Sequence[float], target: Sequence[float], options: Mapping[str, Any]) -> None:
        given = options.get("cubes")
        cubes = None if given is None else as_vector("cubes", np.ravel(given), 3 * len(CUBE_COLUMNS)).reshape(-1, 3)
        for _ in range(REDRAWS if cubes is None else 1):
            self.simulation.place(start, target=target, cubes=self._random_cubes() if cubes is None else cubes)
            if self._failure() is None:
                return
        contacts = " and ".join(self.simulation.contacts())
        raise InvalidResetError(
            f"reset option 'start_pose' is {[round(value, 3) for value in start]}: the robot "
            f"{f'touches {contacts}' if contacts else f'is within {MIN_READING} m of something'} there, "
            f"{'wherever the cubes stand' if cubes is None else 'with these cubes'}; expected a pose inside the room, "
            f"clear of the walls"
        )

    def extreme_options(self, what: Extreme, rng: np.random.Generator) -> dict[str, Any]:
        """Return the options of an episode with the target behind a wall, or the robot in a corner, facing it."""
        if what == "target":
            return {"target_pose": (rng.uniform(-2.0, 2.0), rng.choice((-1.0, 1.0)) * rng.uniform(4.5, 5.5), 0.0)}
        side_x, side_y = rng.choice((-1.0, 1.0), 2).tolist()
        x, y = side_x * rng.uniform(1.9, 2.1), side_y * rng.uniform(3.0, 3.15)
        facing = math.atan2(side_y, side_x) + rng.uniform(-0.4, 0.4)
        return {"start_pose": (x, y, facing)}

    def _failure(self) -> str | None:
        is_failure = (
            self.simulation.in_collision or float(self.robot.scan.min()) < MIN_READING or self._corner_is_near_a_cube()
        )
        return "collision" if is_failure else None

    def _corner_is_near_a_cube(self) -> bool:
        x, y, yaw = self.simulation.pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        for cube_x, cube_y, _ in self.simulation.cubes:
            dx, dy = cube_x - x, cube_y - y
            ahead, left = cos * dx + sin * dy, cos * dy - sin * dx  # the cube's centre in base_link
            for corner_ahead, corner_left in CORNERS:
                if (ahead - corner_ahead) ** 2 + (left - corner_left) ** 2 <= SAFETY_RADIUS**2:
                    return True
        return False
