"""Outcomes of a base's drives as its node reports them, with a base that is not ours behind a rosbridge."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from foreign_base import ForeignBase, Scanner
from ros import Process, Ros

FRONT, HALF_WIDTH = 0.0376 + 0.45, 0.29  # [m], of the MiR100's body
BOX = (1.7, 2.2, -1.5, 1.5)  # [m]
STANDS = 0.01  # [m/s]
OK, WARN, ERROR = [0], [1], [2]  # DiagnosticStatus' levels


@pytest.fixture(scope="module")
def base() -> Iterator[ForeignBase]:
    base = ForeignBase([Scanner()], [BOX])
    try:
        yield base
    finally:
        base.close()


@pytest.fixture(scope="module")
def node(ros: Ros, base: ForeignBase, all_shipped: Path) -> Process:
    ros.ask("subscribe", topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray")
    node = ros.rlservo(
        "ros2", "--bundle", all_shipped / "mir100_navigation", "--robot", base.robot, "--unproven", "--autostart"
    )
    node.wait_for("check -> ready")
    return node


def level(ros: Ros) -> list[int]:
    """Return the level of the newest heartbeat."""
    found: list[int] = ros.ask("since", topic="/diagnostics", time_s=0.0, count=1)[-1][1]["status"][0]["level"]
    return found


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ((math.nan, 0.0), "the target is nan, 0 m: expected finite numbers"),
        ((20.0, 0.0), "the target is out of the boundary of 10 m"),
        ((1.65, 0.0), "the scan shows something at the target, 0.05 m from it"),
    ],
)
def test_target_that_cannot_be_reached_is_refused_before_anything_moves(
    ros: Ros, base: ForeignBase, node: Process, target: tuple[float, float], reason: str
) -> None:
    seen, sent = len(node.lines), len(base.commands)
    ros.heartbeat()
    ros.give_target(*target, frame="odom")
    node.wait_for("-> refused", after=seen)
    beat = ros.heartbeat()
    assert reason in beat["message"]
    assert level(ros) == WARN
    assert max((abs(linear) + abs(angular) for _, linear, angular in base.commands[sent:]), default=0.0) == 0.0


def test_target_in_another_frame_is_ignored(ros: Ros, node: Process) -> None:
    ros.give_target(1.0, 0.0, frame="map")
    node.wait_for("a target in frame 'map' was ignored: expected 'odom'")


def test_reached_target_is_a_success(ros: Ros, base: ForeignBase, node: Process) -> None:
    assert ros.drive_to(0.9, 0.3, frame="odom")["message"] == "arrived: success"
    assert level(ros) == OK
    assert math.hypot(base.now.x - 0.9, base.now.y - 0.3) < 0.2 + 0.15


def test_blocked_base_says_so_and_its_drive_has_failed(ros: Ros, base: ForeignBase, node: Process) -> None:
    ros.begin_driving(4.0, 0.0, frame="odom")
    ros.wait_until(lambda: ros.heartbeat()["state"] == "blocked")
    assert level(ros) == WARN
    assert "stop_distance" in ros.heartbeat()["message"]
    assert abs(base.now.linear) < STANDS
    seen: list[str] = []  # the next drive may begin before another look
    ros.wait_until(lambda: (seen.append(ros.heartbeat()["message"]), seen[-1].startswith("failed"))[1])
    assert seen[-1].startswith("failed: max_steps_exceeded, blocked: something is within stop_distance")
    assert level(ros) == ERROR
    assert base.gap(FRONT, HALF_WIDTH) > 0.0
    assert ros.drive_to(0.0, 0.0, frame="odom")["message"] == "arrived: success"


def test_lost_scanner_is_named_at_once_and_then_a_fault(ros: Ros, base: ForeignBase, node: Process) -> None:
    ros.begin_driving(-3.0, 0.0, frame="odom")
    ros.wait_until(lambda: abs(base.now.linear) > 0.2)
    seen = len(node.lines)
    base.silent.add("/scan")
    try:
        node.wait_for("the base holds: no message on /scan for 0.3", after=seen)
        node.wait_for("fault: connection_lost: no message on /scan for 2 s", after=seen)
        ros.wait_until(lambda: ros.heartbeat()["message"].startswith("fault: connection_lost: no message on /scan"))
        assert level(ros) == ERROR
    finally:
        base.silent.clear()
    assert abs(base.now.linear) < STANDS
