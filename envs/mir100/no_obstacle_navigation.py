"""The navigation task of robo-gym without obstacles, on the simulated MiR100."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from rlservo.envs.mir100.navigation import Mir100Navigation
from rlservo.robots.disturbable import Extreme
from rlservo.robots.mir100.worlds import EMPTY, Pose

BOUNDARY = 10.0  # [m], from the origin


class NoObstacleNavigationMir100Sim(Mir100Navigation):
    """Drive a MiR100 to within 0.2 m of a target on an empty floor.

    The task, spaces, units and rewards are those of robo-gym 2.0's `NoObstacleNavigationMir100Sim-v0`, so that a policy
    moves between the two unchanged. One step is one control cycle of 0.1 s. The robot's pose is that of base_link: on
    the floor below the middle of the wheel axle, x ahead, y to the left.

    ## Observation: Box(4,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0 | target_r: distance of the target from the robot | m | -inf .. inf (never negative) |
    | 1 | target_theta: its direction from the robot, to the left positive | rad | -pi .. pi |
    | 2 | linear_velocity, ahead positive | m/s | -1.1 .. 1.1 |
    | 3 | angular_velocity, to the left positive | rad/s | -1.6 .. 1.6 |

    ## Action: Box(2,), float32, -1 .. 1

    | index | name | one means |
    |---|---|---|
    | 0 | linear_velocity_normalized | 0.5 m/s |
    | 1 | angular_velocity_normalized | 0.7 rad/s |

    The robot changes its velocities by at most 2.0 m/s^2 and 2.5 rad/s^2. An action outside the space raises
    `InvalidActionError` naming the element and the excess.

    ## Reward

    50 per metre by which the target came nearer (none in an episode's first step), minus 0.30 |a0| and 0.03 |a1| for
    the motors. The last step of an episode gives instead: +200 on success, -200 out of the boundary.

    ## Endings

    | `info["final_status"]` | when | flag |
    |---|---|---|
    | success | the target is nearer than 0.2 m | terminated |
    | out of boundary | x beyond +-10 m or y beyond 10 m (robo-gym does not look at y below -10 m) | terminated |
    | max_steps_exceeded | 500 steps | truncated |

    The last step's info also holds `is_success`.

    ## Reset options

    `start_pose` and `target_pose` (3 numbers each: x, y in m, yaw in rad; the target's yaw is unused). Without them the
    robot starts anywhere within +-2 m in x and y and in any direction, and the target is drawn within +-1 m, at least
    1 m from the robot.

    ## Constructor

    `render_mode`. robo-gym's `ip`, `lower_bound_port`, `upper_bound_port` and `rs_address` are accepted and unused:
    there is no server to find; so is `rs_state_to_info`: robo-gym's MiR100 environments never put the server's state
    into info (it is `env.simulation.state()` here). `gui=True` is `render_mode="human"`. `laser_noise`, of our own,
    is the standard deviation of the lasers, which this task does not look at. Also of our own, for trainings that weigh
    them differently: `failure_reward`, which a failed episode's last step gives instead of -200, and
    `step_reward` (0), which every other step gives in addition. Raises ValueError if one is not finite.

    ## Differences from robo-gym on Gazebo

    The time limit truncates (robo-gym says done), and arriving in the very last step is a success (robo-gym gives the
    success reward and calls it max_steps_exceeded). A step lasts exactly 0.1 s and a command takes effect within it;
    Gazebo's is about that, with the odometry's delay. The wheels do not slip or bounce. Resets are immediate.
    """

    WORLD = EMPTY.name
    LASER_COUNT = 0
    SUCCESS_REWARD = 200.0
    VIEW: ClassVar[dict[str, Any]] = {"lookat": (0.0, 0.0, 0.1), "distance": 6.5, "azimuth": 120.0, "elevation": -32.0}

    def _random_start(self) -> Pose:
        x, y = self.np_random.uniform(-2.0, 2.0, 2).tolist()
        return x, y, self.np_random.uniform(-math.pi, math.pi)

    def _random_target_position(self, start: Sequence[float]) -> tuple[float, float]:  # noqa: ARG002
        x, y = self.np_random.uniform(-1.0, 1.0, 2).tolist()
        return x, y

    def _place(self, start: Sequence[float], target: Sequence[float], options: Mapping[str, Any]) -> None:  # noqa: ARG002
        self.simulation.place(start, target=target)

    def extreme_options(self, what: Extreme, rng: np.random.Generator) -> dict[str, Any]:
        """Return the options of an episode with the target beyond the boundary, or the start in a corner of it."""
        if what == "target":
            # In x: robo-gym's boundary is open at y below -10 m.
            x, y = rng.choice((-1.0, 1.0)) * rng.uniform(1.5, 2.0) * BOUNDARY, rng.uniform(-0.5, 0.5) * BOUNDARY
            return {"target_pose": (x, y, 0.0)}
        x, y = (rng.choice((-1.0, 1.0), 2) * rng.uniform(0.85, 0.95, 2) * BOUNDARY).tolist()
        return {"start_pose": (x, y, rng.uniform(-math.pi, math.pi))}

    def _failure(self) -> str | None:
        x, y, _ = self.simulation.pose
        return "out of boundary" if abs(x) > BOUNDARY or y > BOUNDARY else None
