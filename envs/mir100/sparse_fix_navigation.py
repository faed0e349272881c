"""Navigation with rare fixes: the partially observed form of the task without obstacles.

Not one of robo-gym's. It adds only what is hidden; robot, reward and endings are the parent's.
"""

from __future__ import annotations

from typing import Any

from rlservo.envs.mir100.navigation import Observation
from rlservo.envs.mir100.no_obstacle_navigation import NoObstacleNavigationMir100Sim

FIX_INTERVAL = 20  # control cycles: one fix every 2 s


class SparseFixNavigationMir100Sim(NoObstacleNavigationMir100Sim):
    """Drive a MiR100 to within 0.2 m of a target whose position it gets once every two seconds.

    The task is `rlservo/NoObstacleNavigationMir100Sim-v0`, for a robot whose localisation is slow: odometry arrives
    every cycle, and a beacon or marker gives a fix every `fix_interval` cycles. In between a policy must remember the
    last fix and the velocities since, to know the target's position.

    ## Observation: Box(4,), float32

    | index | name | unit | range |
    |---|---|---|---|
    | 0 | target_r: distance of the target from the robot at a fix; 0 between fixes | m | -inf .. inf (never negative) |
    | 1 | target_theta: its direction from the robot at a fix, to the left positive; 0 between fixes | rad | -pi .. pi |
    | 2 | linear_velocity, ahead positive | m/s | -1.1 .. 1.1 |
    | 3 | angular_velocity, to the left positive | rad/s | -1.6 .. 1.6 |

    `reset` returns a fix, and so do steps `fix_interval`, `2 * fix_interval` and so on. A distance of 0 is never one:
    an episode ends nearer than 0.2 m.

    ## Action, reward, endings, reset options

    Those of `NoObstacleNavigationMir100Sim`: velocities up to 0.5 m/s and 0.7 rad/s at 10 Hz; 50 per metre gained (also
    if the policy does not see it), +200 on success, -200 out of the boundary; 500 steps at most.

    ## Constructor

    That of `NoObstacleNavigationMir100Sim`, and `fix_interval` (20): control cycles from one fix to the next, 1 or
    more; 1 hides nothing. Raises ValueError for less.

    ## Differences from robo-gym

    robo-gym has no such task.
    """

    def __init__(self, *, fix_interval: int = FIX_INTERVAL, **arguments: Any) -> None:
        if isinstance(fix_interval, bool) or not isinstance(fix_interval, int) or fix_interval < 1:
            raise ValueError(f"fix_interval is {fix_interval!r}: expected a whole number of control cycles, 1 or more")
        self.fix_interval = fix_interval
        super().__init__(**arguments)

    def _observation(self, distance: float, bearing: float) -> Observation:
        observation = super()._observation(distance, bearing)
        if self._steps % self.fix_interval:
            observation[0:2] = 0.0
        return observation
