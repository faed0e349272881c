"""Targets of a robot: poses on a topic, or goals of an action. A newer one replaces an older one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.ros2.rclpy_link import Goal, Outcome, RclpyLink
from rlservo.robots.ros2.ros_messages import POSE_STAMPED, stamp

ACTION = "nav2_msgs/action/NavigateToPose"
UNKNOWN_ERROR = 9000  # of its error codes, those of the controller and planner do not fit
TELL_S = 1.0
log = logging.getLogger("rlservo.ros2")


@dataclass(frozen=True)
class GivenTarget:
    """A place [m] (3,) and, if an action's client gave it, its goal."""

    number: int
    position: tuple[float, float, float]
    goal: Goal | None = None
    given_s: float = 0.0  # of ROS's time

    @property
    def is_cancelled(self) -> bool:
        """Whether the goal's client no longer wants it."""
        return self.goal is not None and self.goal.is_cancelled

    def end(self, outcome: Outcome, why: str = "") -> None:
        """Give the goal's client the result."""
        if self.goal is not None:
            self.goal.end(outcome, {"error_code": 0 if outcome == "succeed" else UNKNOWN_ERROR, "error_msg": why})


class Targets:
    """The newest target, and the numbers of those that were begun and that are over."""

    def __init__(self, link: RclpyLink, frame: str, refusal: Callable[[], str]) -> None:
        """Take targets in a frame from now on. `refusal` returns why the node takes no goals now, empty if it does."""
        self._link, self._frame, self._refusal = link, frame, refusal
        self.newest = GivenTarget(0, (0.0, 0.0, 0.0))
        self.begun = self.done = 0
        link.subscribe("~/target", POSE_STAMPED, self._take)
        try:
            link.serve_action("~/navigate_to_pose", ACTION, self._why_not, self._begin)
        except RobotError as error:
            log.info("node: no action, only ~/target: %s", error)

    @property
    def is_due(self) -> bool:
        """Whether the newest target is not over."""
        return self.newest.number != self.done

    def tell(self, target: GivenTarget, position: tuple[float, float, float], distance: float) -> None:
        """Tell a goal's client where the robot is [m] and how far away [m]."""
        if target.goal is None:
            return
        now_s, place = self._link.now_s(), dict(zip("xyz", position, strict=True))
        header = {"frame_id": self._frame, "stamp": stamp(now_s)}
        target.goal.tell(
            {
                "current_pose": {"header": header, "pose": {"position": place}},
                "navigation_time": stamp(now_s - target.given_s),
                "distance_remaining": distance,
            }
        )

    def end(self, target: GivenTarget, outcome: Outcome, why: str = "") -> None:
        """Note that a target is over."""
        self.done = target.number
        target.end(outcome, why)

    def close(self) -> None:
        """End the goal that is left, and wait until its client has been told."""
        self.newest.end("abort", "the node has ended")
        if self.newest.goal is not None:
            self.newest.goal.is_over.wait(TELL_S)

    def _take(self, message: Any, goal: Goal | None = None) -> None:
        if goal is None and (why := self._wrong_frame(message)):
            log.warning("a target in %s", why)
            return
        place, before = message.pose.position, self.newest
        self.newest = GivenTarget(before.number + 1, (place.x, place.y, place.z), goal, self._link.now_s())
        before.end("abort", "a newer target replaced it")

    def _begin(self, goal: Goal) -> None:
        self._take(goal.request.pose, goal)

    def _why_not(self, request: Any) -> str:
        if request.behavior_tree:
            return f"behavior_tree is {request.behavior_tree!r}: expected none"
        place = request.pose.pose.position
        if not np.isfinite([place.x, place.y, place.z]).all():
            return f"the target is {place.x:g}, {place.y:g}, {place.z:g} m: expected finite numbers"
        return self._wrong_frame(request.pose) or self._refusal()

    def _wrong_frame(self, message: Any) -> str:
        frame = message.header.frame_id
        return f"frame {frame!r} was ignored: expected {self._frame!r}" if frame and frame != self._frame else ""
