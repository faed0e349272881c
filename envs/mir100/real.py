"""The MiR100's tasks on a real base, behind ROS 2 or a rosbridge."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from rlservo.envs.mir100.navigation import (
    ANGULAR_SCALE,
    LINEAR_SCALE,
    MAX_STEPS,
    MIN_TARGET_DISTANCE,
    SUCCESS_DISTANCE,
    Mir100Navigation,
    from_base,
)
from rlservo.envs.mir100.no_obstacle_navigation import BOUNDARY, NoObstacleNavigationMir100Sim
from rlservo.envs.mir100.obstacle_avoidance import ObstacleAvoidanceMir100Sim
from rlservo.envs.rendering import Start
from rlservo.robots.argument_checks import InvalidResetError
from rlservo.robots.mir100.parameters import CYCLE_S
from rlservo.robots.mir100.worlds import EMPTY, Pose
from rlservo.robots.ros2.real_base import RealMir100

FARTHEST, AHEAD = 1.5, math.pi / 3  # [m], [rad] on either side, of random targets
REDRAWS = 100


class _RealBase(Mir100Navigation):
    """Differences of a real base: an episode begins where it stands, and its world is not known."""

    RESET_OPTIONS: ClassVar[tuple[str, ...]] = ("target_pose",)
    WORLD = EMPTY.name
    is_real = True

    def __init__(
        self, *, robot: str = "", limits: Mapping[str, Any] | None = None, confirm: bool = True, **arguments: Any
    ) -> None:
        if not robot:
            raise ValueError(
                "robot is missing: expected the base's address, such as robot=ros2: or rosbridge://HOST:9090"
            )
        super().__init__(**arguments)
        self.robot = self._base = RealMir100(
            robot,
            self.simulation,
            needs_scan=self.LASER_COUNT > 0,
            fastest=(LINEAR_SCALE, ANGULAR_SCALE),
            limits=limits or {},
            confirm=confirm,
        )

    def reset_options(self, *, start: Start = "own", keep_target: bool = False) -> dict[str, Any]:
        """Return the options of an episode that starts where the base stands."""
        del start
        return {"target_pose": self.simulation.target} if keep_target else {}

    def _out_of_reach(self, target: Sequence[float]) -> str:
        """Return why a target can never be reached; empty if it may."""
        del target
        return ""

    def _random_start(self) -> Pose:
        x, y, yaw = self._base.present_pose()
        return x, y, yaw

    def _random_target(self, start: Sequence[float]) -> Pose:
        """Draw a target ahead of the base as it stands, which may be reached if one of many may."""
        target: Pose = (0.0, 0.0, 0.0)
        for _ in range(REDRAWS):
            distance = self.np_random.uniform(MIN_TARGET_DISTANCE, FARTHEST)
            bearing = self.np_random.uniform(-AHEAD, AHEAD)
            target = from_base(start, distance * math.cos(bearing), distance * math.sin(bearing))
            if not self._refusal(target):
                break
        return target

    def _refusal(self, target: Sequence[float]) -> str:
        """Return why a target is refused; empty if it is not."""
        return self._out_of_reach(target) or self._base.unreachable(
            *target[:2], within=SUCCESS_DISTANCE, time_s=MAX_STEPS * CYCLE_S
        )

    def _place(self, start: Sequence[float], target: Sequence[float], options: Mapping[str, Any]) -> None:
        del start, options
        if why := self._refusal(target):
            raise InvalidResetError(f"reset option 'target_pose': {why}")
        self._base.start_towards(target)
        if (status := self._failure()) is not None:
            raise InvalidResetError(
                f"the base stands where an episode would end at once ({status}): drive it away by hand"
            )


class NoObstacleNavigationMir100Rob(_RealBase, NoObstacleNavigationMir100Sim):
    """`NoObstacleNavigationMir100Sim` on a real base; `robot` is 'ros2:' or 'rosbridge://HOST:9090'.

    Observations, actions, rewards and endings are the simulated environment's, computed from odometry, in whose frame
    `target_pose` and the boundary are; a base that stops ends the episode, with the reason as `final_status`
    (connection_lost, stale_observation). A step lasts a control cycle of real time. An episode begins where the base
    stands; a target that is drawn is 1 to 1.5 m ahead of it, within 60 degrees. It adds `limits` (names and defaults:
    `rlservo.robots.ros2.base_driver.BaseLimits`), `confirm` (False: `reset` does not ask), and `info["robot"]`: the
    state, its changes, and the limits that applied.
    """

    def _out_of_reach(self, target: Sequence[float]) -> str:
        is_outside = max(abs(target[0]), target[1]) > BOUNDARY + SUCCESS_DISTANCE
        return f"the target is out of the boundary of {BOUNDARY:g} m" if is_outside else ""


class ObstacleAvoidanceMir100Rob(_RealBase, ObstacleAvoidanceMir100Sim):
    """`ObstacleAvoidanceMir100Sim` on a real base, with the additions of `NoObstacleNavigationMir100Rob`.

    The readings are those of the MiR100's own two scans if they are published, else computed from one scan around
    base_link. A collision is a reading below 0.15 m: walls and cubes are not known.
    """
