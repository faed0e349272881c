"""Bases of other makers: where their scanners are, what they do not see, and how large they are."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect

from foreign_base import NO_TURN, ForeignBase, Scanner, transform
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.control_law import Phase
from rlservo.robots.mir100.simulation import Mir100Simulation
from rlservo.robots.ros2.base_driver import BaseLimits, RosBase
from rlservo.robots.ros2.real_base import RealMir100

PATIENCE_S = 60.0
FRONT, HALF_WIDTH = 0.0376 + 0.45, 0.29  # [m], of a MiR100's body
STOP_DISTANCE = 0.1  # [m], the default
NOISE = 0.06  # [m]: a cycle and a scan's age at 0.5 m/s
BOX = (2.0, 3.0, -1.0, 1.0)
STANDS = 0.01  # [m/s]


@contextmanager
def closing_both(base: ForeignBase, connect: Callable[[], RosBase]) -> Iterator[RosBase]:
    try:
        real = connect()
        try:
            yield real
        finally:
            real.close()
    finally:
        base.close()


@pytest.fixture
def free_base() -> Iterator[ForeignBase]:
    """A base with free space all around."""
    base = ForeignBase([Scanner()])
    try:
        yield base
    finally:
        base.close()


def drive(real: RosBase, seconds: float, linear: float = 0.5, angular: float = 0.0) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        real.command(linear, angular)
        time.sleep(0.05)


def drive_until(real: RosBase, condition: Callable[[], bool], linear: float = 0.5, angular: float = 0.0) -> None:
    limit = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < limit, (real.phase, real.fault, real.limited())
        drive(real, 0.1, linear, angular)


def drive_to_a_box(real: RosBase, base: ForeignBase) -> None:
    drive_until(real, lambda: "stop_distance" in real.limited() and abs(base.now.linear) < STANDS)
    drive(real, 1.0)


def assert_stopped_before_a_box(base: ForeignBase, front: float = FRONT, half_width: float = HALF_WIDTH) -> None:
    # [m] that it went on while a busy machine gave its driver no time: a driver that is silent for longer is wrong.
    unheard = 0.5 * min(max(base.without_commands() - 0.05, 0.0), 0.2)
    assert STOP_DISTANCE - NOISE - unheard < base.gap(front, half_width) < STOP_DISTANCE + 0.25


def limits(**values: Any) -> BaseLimits:
    return BaseLimits.of({"blend_s": 0.0, **values})


@pytest.mark.parametrize(
    "scanner",
    [
        Scanner(yaw=math.pi),
        Scanner(x=-0.4),
        Scanner(x=0.2, y=0.1, yaw=-2.0, is_inverted=True),
        Scanner(x=0.3, yaw=0.5, half_angle=2.0, frame="/laser"),
    ],
    ids=["turned", "behind", "upside down", "half"],
)
def test_base_stops_before_a_box_wherever_its_scanner_is_mounted(scanner: Scanner) -> None:
    base = ForeignBase([scanner], [BOX])
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        drive_to_a_box(real, base)
        assert_stopped_before_a_box(base)
        assert abs(base.now.linear) < STANDS
        assert real.limited()["stop_distance"] > 0


@pytest.mark.parametrize(
    ("scanner", "transforms", "options", "sentence"),
    [
        (Scanner(frame="laser"), [], "", r"/scan is in frame 'laser', .*set scan_pose=X:Y:YAW"),
        (Scanner(frame="laser"), [transform("gripper", "laser", (0.0, 0.0, 0.0), NO_TURN)], "", "in frame 'laser'"),
        (
            Scanner(),
            None,
            ",base_frame=base",
            r"/odom is in frame 'base_link', .*'base': publish that, or set base_fra",
        ),
        (
            Scanner(),
            [transform("base_link", "front_laser_link", (0.0, 0.0, 0.0), {"x": 0.0, "y": 0.3, "z": 0.0, "w": 0.954})],
            "",
            "'front_laser_link' is tilted: expected a scanner with a horizontal plane",
        ),
    ],
)
def test_frame_that_is_not_known_is_refused_before_anything_moves(
    scanner: Scanner, transforms: list[dict[str, Any]] | None, options: str, sentence: str
) -> None:
    base = ForeignBase([scanner], [BOX], transforms=transforms)
    try:
        with pytest.raises(RobotError, match=sentence):
            RosBase(base.robot + options, limits=limits())
        assert base.commands == []
    finally:
        base.close()


def test_pose_option_takes_the_place_of_transforms() -> None:
    base = ForeignBase([Scanner(x=-0.4, y=0.1, yaw=3.0, frame="laser")], [BOX], transforms=[])
    with closing_both(base, lambda: RosBase(f"{base.robot},scan_pose=-0.4:0.1:3", limits=limits())) as real:
        drive_to_a_box(real, base)
        assert_stopped_before_a_box(base)


def test_chain_of_transforms_leads_from_the_scanner_and_from_the_odometry_to_the_base() -> None:
    scanner = Scanner(x=0.3, y=-0.2, yaw=1.0)
    mast = transform("base_link", "mast", (0.3, -0.2, 0.0), NO_TURN)
    laser = transform(
        "mast", scanner.frame, (0.0, 0.0, 0.4), {"x": 0.0, "y": 0.0, "z": math.sin(0.5), "w": math.cos(0.5)}
    )
    wheels = transform("wheels", "base_link", (-0.25, 0.0, 0.1), NO_TURN)
    base = ForeignBase([scanner], [BOX], transforms=[laser, mast, wheels], child_frame="wheels", child_offset=0.25)
    with closing_both(base, lambda: RosBase(base.robot, limits=limits(stop_distance=0.3))) as real:
        drive(real, 2.0, 0.2, 0.6)
        pose, velocity = real.state().pose, real.state().velocity
        truth = base.now
        assert pose[:2] == pytest.approx((truth.x, truth.y), abs=0.03)
        assert math.remainder(pose[2] - truth.yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=0.06)
        assert velocity == pytest.approx((0.2, 0.6), abs=0.01)
        readings = real.state().readings
        assert readings is not None
        nearest = math.hypot(BOX[0] - truth.x, max(0.0, abs(truth.y) - BOX[3]))
        assert float(np.min(readings)) == pytest.approx(nearest, abs=0.55)  # of the body's own scanners


def ahead_is_blind(own: np.ndarray) -> np.ndarray:
    """Return whether a beam is among the quarter ahead."""
    return np.abs(own) < math.pi / 4.0


@pytest.mark.parametrize("has_null", [False, True], ids=["NaN", "null"])
def test_beams_that_show_nothing_in_the_direction_of_motion_stop_the_base(has_null: bool) -> None:
    scanner = Scanner()
    base = ForeignBase([scanner], [BOX, (-3.0, 3.0, 3.0, 4.0), (-4.0, -3.0, -4.0, 4.0)], has_null=has_null)
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        for box in ((3.0, 4.0, -4.0, 4.0), (-4.0, 4.0, -4.0, -3.0)):
            base.boxes.append(box)  # all around, no beam is free
        drive_until(real, lambda: base.now.linear > 0.3)
        scanner.blind = ahead_is_blind
        drive(real, 3.0)
        assert abs(base.now.linear) < STANDS
        assert real.limited()["unseen"] > 0
        assert base.gap(FRONT, HALF_WIDTH) > 0.5  # it stood long before the box
        before = base.now.x
        drive_until(real, lambda: base.now.x < before - 0.1, -0.3)  # what is behind is seen


def test_gaps_that_are_narrow_and_beams_that_are_free_do_not_stop_the_base() -> None:
    base = ForeignBase([Scanner(blind=lambda own: np.arange(len(own)) % 4 != 0)], [(2.5, 3.0, -1.0, 1.0)])
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        drive_until(real, lambda: base.now.x > 1.0)
        assert "unseen" not in real.limited()


def test_scanner_of_nulls_is_free_only_where_that_was_chosen() -> None:
    base = ForeignBase([Scanner()], [(4.0, 5.0, -1.0, 1.0)], has_null=True)
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        drive(real, 1.0, -0.5)
        assert base.now.x == pytest.approx(0.0, abs=1e-3)
    base = ForeignBase([Scanner()], [(4.0, 5.0, -1.0, 1.0)], has_null=True)
    with closing_both(base, lambda: RosBase(f"{base.robot},unknown_beams=free", limits=limits())) as real:
        drive_until(real, lambda: base.now.x < -0.2, -0.5)


def test_base_does_not_drive_where_no_scanner_looks() -> None:
    scanner = Scanner(x=0.4, half_angle=math.radians(120.0))
    base = ForeignBase([scanner], [BOX])
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        drive(real, 1.0, -0.5)
        assert base.now.x == pytest.approx(0.0, abs=1e-3)
        drive_until(real, lambda: base.now.yaw > 0.2, 0.0, 0.5)  # a turn needs no eyes behind


LONG = [[1.2, 0.4], [1.2, -0.4], [-0.2, -0.4], [-0.2, 0.4]]


def test_footprint_of_another_base_keeps_the_distance() -> None:
    base = ForeignBase([Scanner(x=1.1)], [BOX])
    with closing_both(base, lambda: RosBase(base.robot, limits=limits(footprint=LONG))) as real:
        drive_to_a_box(real, base)
        assert_stopped_before_a_box(base, front=1.2, half_width=0.4)


@pytest.mark.parametrize(
    "footprint",
    [[], [[0.4, 0.3], [0.4, -0.3]], [[0.4, 0.3], [0.4, math.nan], [-0.4, 0.0]], 0.5, [[1, 2, 3]] * 3, "body"],
)
def test_footprint_that_is_none_is_refused(footprint: Any) -> None:
    with pytest.raises(RobotError, match=r"limits: footprint is .*: expected at least 3 corners"):
        BaseLimits.of({"footprint": footprint})


class Rival:
    """Another client of the base's bridge, with a rosbridge's own messages."""

    def __init__(self, base: ForeignBase) -> None:
        self._socket = connect(f"ws://127.0.0.1:{base.port}", compression=None)

    def drive(self, linear: float) -> None:
        message = {"linear": {"x": linear, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
        self._socket.send(json.dumps({"op": "publish", "topic": "/cmd_vel", "msg": message}))

    def close(self) -> None:
        self._socket.close()


def test_second_commander_that_comes_later_is_noticed_and_left_alone(free_base: ForeignBase) -> None:
    base = free_base
    with closing(RosBase(base.robot, limits=limits(speed_scale=0.2, stop_distance=0), needs_scan=False)) as real:
        drive_until(real, lambda: base.now.linear > 0.09)
        rival = Rival(base)
        began = time.monotonic()
        while not real.fault:
            assert time.monotonic() < began + PATIENCE_S
            real.command(0.5, 0.0)
            rival.drive(0.8)
            time.sleep(0.05)
        assert real.fault.startswith("second_commander: /cmd_vel is also commanded by another node")
        time.sleep(0.2)
        known = len(base.commands)
        for _ in range(10):
            real.command(0.5, 0.0)
            time.sleep(0.05)
        assert base.commands[known:] == []  # the base is the other's now
        assert max(abs(one.linear) for one in base.truth) < 0.4  # not for long at the rival's speed
        rival.close()


def test_odometry_that_jumps_as_no_base_can_is_a_fault_with_its_reason(free_base: ForeignBase) -> None:
    base = free_base

    def jump(message: dict[str, Any]) -> None:
        message["pose"]["pose"]["position"]["x"] += 3.0

    with closing(RosBase(base.robot, limits=limits(stop_distance=0), needs_scan=False)) as real:
        drive_until(real, lambda: base.now.linear > 0.3)
        base.odom_error = jump
        began = time.monotonic()
        while not real.fault:
            assert time.monotonic() < began + PATIENCE_S
            drive(real, 0.05)
        assert real.fault.startswith("odometry_jumped: /odom moved by 3.0")
        while abs(base.now.linear) > STANDS:
            assert time.monotonic() < began + PATIENCE_S
            drive(real, 0.05)


SUSPENDED = """
import sys, time
from rlservo.robots.ros2.base_driver import BaseLimits, RosBase
from rlservo.robots.ros2.real_base import RealMir100
base = RosBase(sys.argv[1], limits=BaseLimits(stop_distance=0.0), needs_scan=False)
while not base.fault:
    base.command(0.5, 0.0)
    time.sleep(0.02)
print(base.fault)
"""


def test_suspended_process_begins_again_from_a_standstill(free_base: ForeignBase) -> None:
    base = free_base
    process = subprocess.Popen([sys.executable, "-c", SUSPENDED, base.robot], env=os.environ)
    try:
        for seconds in (3.0, 0.7):
            limit = time.monotonic() + PATIENCE_S
            while base.now.linear < 0.45:
                assert time.monotonic() < limit
                time.sleep(0.02)
            process.send_signal(signal.SIGSTOP)
            time.sleep(seconds)
            before = len(base.commands)
            still, continued_s = base.now.linear, time.monotonic()  # it may still brake by its own timeout
            process.send_signal(signal.SIGCONT)
            while len(base.commands) < before + 12:
                assert time.monotonic() < limit
                time.sleep(0.02)
            speeds = [linear for _, linear, _ in base.commands[before:]]
            assert max(speeds[:2]) < 0.05
            assert max(np.diff(speeds[:8])) < 0.09  # blends in: 0.5 s to 0.5 m/s, so never above 1 m/s for each second
            assert all(one.linear < 0.03 + max(still, one.time_s - continued_s) for one in base.since(continued_s))
    finally:
        process.kill()
        process.wait()


def not_finite(message: dict[str, Any]) -> None:
    message["twist"]["twist"]["angular"]["z"] = math.nan


def jumped_back(message: dict[str, Any]) -> None:
    message["header"]["stamp"]["secs"] -= 100


def renamed(message: dict[str, Any]) -> None:
    message["child_frame_id"] = "imu"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (not_finite, "bad_messages: /odom has numbers that are not finite"),
        (jumped_back, "stale_stamps: /odom has no new stamp for 2"),
        (renamed, "bad_messages: /odom is in frame 'imu', which /tf_static does not connect with 'base_link'"),
    ],
)
def test_reason_of_a_fault_is_the_cause_that_is_known(
    free_base: ForeignBase, error: Callable[[dict[str, Any]], None], reason: str
) -> None:
    base = free_base
    with closing(RosBase(base.robot, limits=limits(stop_distance=0), needs_scan=False)) as real:
        drive_until(real, lambda: base.now.linear > 0.3)
        base.odom_error = error
        began_s = time.monotonic()
        drive_until(real, lambda: bool(real.fault))
        assert real.fault.startswith(reason)
        assert base.since(began_s + 1.5)
        assert max(abs(one.linear) for one in base.since(began_s + 1.5)) < STANDS


class Repeated:
    """A driver that repeats an old message's fields under new stamps."""

    def __init__(self, *names: str) -> None:
        self._names = names
        self._kept: dict[str, Any] = {}

    def __call__(self, message: dict[str, Any]) -> None:
        self._kept = self._kept or {name: message[name] for name in self._names}
        message.update(self._kept)


@pytest.mark.parametrize(("linear", "angular"), [(0.5, 0.0), (-0.3, 0.0), (0.0, 0.7), (0.02, -0.3)])
def test_odometry_that_stands_while_the_base_is_driven_is_a_fault(
    free_base: ForeignBase, linear: float, angular: float
) -> None:
    base = free_base
    with closing(RosBase(base.robot, limits=limits())) as real:
        drive(real, 1.0, linear, angular)
        base.odom_error = Repeated("pose", "twist")
        began = base.now
        drive_until(real, lambda: bool(real.fault), linear, angular)
        assert real.fault.startswith("not_following: /odom shows 0.0")
        drive_until(real, lambda: max(abs(base.now.linear), abs(base.now.angular)) < STANDS, linear, angular)
        # 0.5 m or 0.8 rad, a cycle, braking, and what a busy machine adds: its timeout.
        assert math.hypot(base.now.x - began.x, base.now.y - began.y) < 1.0
        assert abs(base.now.yaw - began.yaw) < 1.5


def test_base_that_does_not_move_at_all_is_a_fault(free_base: ForeignBase) -> None:
    base = free_base
    with closing(RosBase(base.robot, limits=limits(), setpoint_timeout_s=1.0)) as real:
        drive(real, 1.0)
        base.odom_error = Repeated("pose")  # its wheels are blocked, or its motors off
        drive_until(real, lambda: bool(real.fault))
        assert real.fault.startswith("not_following")


def test_slow_base_that_turns_and_stands_by_turns_is_no_fault(free_base: ForeignBase) -> None:
    base = free_base
    with closing(RosBase(base.robot, limits=limits())) as real:
        for linear, angular in ((0.03, 0.0), (0.0, 0.0), (0.0, 0.05), (-0.03, -0.05), (0.0, 0.0), (0.5, 0.7)):
            drive(real, 2.5, linear, angular)
            assert not real.fault


def test_scan_that_is_repeated_while_the_base_moves_stops_it() -> None:
    base = ForeignBase([Scanner()], [(4.0, 5.0, -1.0, 1.0)])
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        drive(real, 3.0, 0.0)  # standing, it is the same each time
        assert not real.fault
        drive_until(real, lambda: base.now.linear > 0.4)
        base.scan_error = Repeated("ranges")
        began = base.now
        drive_until(real, lambda: bool(real.fault))
        assert real.fault.startswith("bad_messages: /scan cannot be used: its ranges are the same to the last digit")
        assert base.now.x - began.x < 0.7 and abs(base.now.linear) < STANDS


@pytest.mark.parametrize(("linear", "angular"), [(0.5, 0.0), (0.0, 0.7), (-0.4, 0.6)])
def test_base_is_a_persons_once_it_stands(free_base: ForeignBase, linear: float, angular: float) -> None:
    base = free_base
    with closing(RosBase(base.robot, limits=limits(stop_distance=0), needs_scan=False)) as real:
        drive_until(real, lambda: max(abs(base.now.linear), abs(base.now.angular)) > 0.35, linear, angular)
        real.free()
        limit = time.monotonic() + PATIENCE_S
        while real.phase != Phase.FREE:
            assert time.monotonic() < limit
            time.sleep(0.002)
        assert max(abs(base.now.linear), abs(base.now.angular)) < 0.06
        assert base.commands[-1][1:] == (0.0, 0.0)
        time.sleep(0.2)  # a command that is on its way
        known = len(base.commands)
        time.sleep(0.3)
        assert len(base.commands) == known


@pytest.mark.parametrize("moved", [Scanner(yaw=math.pi), Scanner(x=-1.0)])
def test_frame_that_changes_its_place_later_stops_the_base(moved: Scanner) -> None:
    base = ForeignBase([Scanner()], [BOX])
    with closing_both(base, lambda: RosBase(base.robot, limits=limits())) as real:
        drive_until(real, lambda: base.now.linear > 0.4)
        base.move_scanner(Scanner(x=0.004))  # rounded by another node
        drive(real, 0.5)
        assert not real.fault
        base.move_scanner(moved)
        drive_until(real, lambda: bool(real.fault))
        assert real.fault.startswith("bad_messages: /scan: frame 'front_laser_link' is no longer where it was in")
        assert base.gap(FRONT, HALF_WIDTH) > STOP_DISTANCE - NOISE


@pytest.mark.parametrize(
    "values", [5, ["speed_scale"], {"speed_scale": math.nan}, {"acceleration": "fast"}, "0.2", None]
)
def test_limits_of_the_wrong_kind_are_one_sentence(values: Any) -> None:
    with pytest.raises(RobotError, match=r"^limits"):
        RealMir100(
            "rosbridge://127.0.0.1:1", Mir100Simulation(), needs_scan=False, fastest=(0.5, 0.7), limits=values,
            confirm=False,
        )  # fmt: skip
