"""The MiR100's tasks on a real base, behind ROS 2 or a rosbridge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from rlservo.envs.checks import InvalidResetError
from rlservo.envs.mir100.navigation import Mir100Navigation
from rlservo.envs.mir100.no_obstacle_navigation import NoObstacleNavigationMir100Sim
from rlservo.envs.mir100.obstacle_avoidance import ObstacleAvoidanceMir100Sim
from rlservo.envs.mir100.worlds import Pose
from rlservo.envs.rendering import Start


class _RealBase(Mir100Navigation):
    """Differences of a real base: an episode begins where it stands, and its world is not known."""

    RESET_OPTIONS: ClassVar[tuple[str, ...]] = ("target_pose",)

    def __init__(self, *, robot: str = "", **arguments: Any) -> None:
        if not robot:
            raise ValueError(
                "robot is missing: expected the base's address, such as robot=ros2: or rosbridge://HOST:9090"
            )
        super().__init__(robot=robot, **arguments)

    def reset_options(self, *, start: Start = "own", keep_target: bool = False) -> dict[str, Any]:
        """Return the options of an episode that starts where the base stands."""
        del start
        return {"target_pose": self.simulation.target} if keep_target else {}

    def _random_start(self) -> Pose:
        return self.simulation.pose

    def _place(self, start: Sequence[float], target: Sequence[float], options: Mapping[str, Any]) -> None:
        del options
        self.simulation.place(start, target=target)
        if (status := self._failure()) is not None:
            raise InvalidResetError(f"the base stands where an episode ends at once ({status}): drive it away by hand")


class NoObstacleNavigationMir100Rob(_RealBase, NoObstacleNavigationMir100Sim):
    """`NoObstacleNavigationMir100Sim` on a real base; `robot` is 'ros2:' or 'rosbridge://HOST:9090'.

    Observations, actions, rewards and endings are the simulated environment's, computed from odometry, in whose frame
    `target_pose` and the boundary are; a base that stops ends the episode, with the reason as `final_status`
    (connection_lost, stale_observation). A step lasts a control cycle of real time. An episode begins where the base
    stands. It adds `limits` (names and defaults: `rlservo.envs.ros2.base.BaseLimits`), `confirm` (False: `reset` does
    not ask), and `info["robot"]`: the state, its changes, and the limits that applied.
    """


class ObstacleAvoidanceMir100Rob(_RealBase, ObstacleAvoidanceMir100Sim):
    """`ObstacleAvoidanceMir100Sim` on a real base, with the additions of `NoObstacleNavigationMir100Rob`.

    The readings are those of the MiR100's own two scans if they are published, else computed from one scan around
    base_link. A collision is a reading below 0.15 m: walls and cubes are not known.
    """
