"""States of an arm's driver as its connection takes them, without ROS."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rlservo.envs.robots.arm import RobotError
from rlservo.envs.robots.command_stream import ORDERS, REPORT, CommandStream, StreamSettings
from rlservo.envs.robots.limits import Limits
from rlservo.envs.robots.shared_block import make_file
from rlservo.envs.ros2 import messages
from rlservo.envs.ros2.address import ARM_OPTIONS, COMMAND_TOPICS
from rlservo.envs.ros2.arm import RosArmConnection
from rlservo.envs.ros2.link import Endpoint, Publish
from rlservo.envs.ur.simulation import URSimulation

SETTINGS = StreamSettings("ros2:", "ur5", 0.1, 0.25, Limits(), 0, 0)
JOINTS = list(messages.JOINT_NAMES.values())


class Driver:
    """A link to a driver that publishes at once what is subscribed to."""

    def __init__(self) -> None:
        self.takers: dict[str, Callable[[Any], None]] = {}
        self.sent: list[Mapping[str, Any]] = []
        self.values: dict[str, dict[str, Any]] = {
            "joint_states": {"name": [*JOINTS, "finger"], "position": [0.5] * 7, "velocity": [0.0] * 7},
            "speed_scaling": {"data": 100.0}, "program_running": {"data": True}, "robot_mode": {"data": 7},
            "safety_mode": {"data": 1},
        }  # fmt: skip

    def now_s(self) -> float:
        return time.time()

    def send(self, name: str) -> None:
        header = {"header": {"stamp": messages.stamp(self.now_s())}}
        self.takers[ARM_OPTIONS[name]](messages.parse(header | self.values[name]))

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None]) -> None:
        self.takers[topic] = on_message
        self.send(next(name for name, one in ARM_OPTIONS.items() if one == topic))

    def advertise(self, topic: str, kind: str) -> Publish:
        return self.sent.append

    def publishers(self, topic: str) -> list[Endpoint]:
        return [Endpoint("/driver", messages.INT8)] if topic not in COMMAND_TOPICS.values() else []

    rivals = publishers

    def subscribers(self, topic: str) -> list[Endpoint]:
        is_trajectory = topic == COMMAND_TOPICS["trajectory"]
        return [Endpoint("/controller", messages.JOINT_TRAJECTORY if is_trajectory else messages.NUMBERS)]

    def close(self) -> None: ...


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Driver]:
    driver = Driver()
    monkeypatch.setattr("rlservo.envs.ros2.arm.RclpyLink", lambda _: driver)
    monkeypatch.setattr("rlservo.envs.ros2.arm.FIRST_MESSAGES_S", 0.1)
    monkeypatch.setattr("rlservo.envs.ros2.link.DISCOVERY_S", 0.0)
    return driver


def test_numbers_that_are_not_finite_never_replace_a_state(driver: Driver) -> None:
    arm = RosArmConnection(SETTINGS)
    driver.values["speed_scaling"]["data"] = 50.0
    driver.send("speed_scaling")
    driver.values["speed_scaling"]["data"] = math.nan
    driver.send("speed_scaling")
    assert arm.getTargetSpeedFraction() == 0.5  # a NaN would become the next setpoint
    driver.values["joint_states"]["position"] = [math.nan] * 7
    driver.send("joint_states")
    assert arm.getActualQ() == [0.5] * 6


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 500.0])
@pytest.mark.parametrize("speed", [0.0, 1e-9, 0.3, 3.0])
def test_every_trajectory_is_one_that_a_controller_takes(driver: Driver, speed: float, rate_hz: float) -> None:
    limits = Limits(rate_hz=rate_hz, acceleration=5.0)
    arm = RosArmConnection(replace(SETTINGS, host="ros2:command=trajectory", limits=limits))
    arm.servoJ([0.5] * 6)
    arm.servoJ([0.5 + speed / rate_hz] * 6)
    points = driver.sent[-1]["points"]
    times = [point["time_from_start"]["sec"] + point["time_from_start"]["nanosec"] * 1e-9 for point in points]
    assert (np.diff([0.0, *times]) > 0.0).all()
    assert points[-1]["velocities"] == [0.0] * 6
    if speed > 0.1:
        assert times[-2] == pytest.approx(0.1)
        assert points[0]["velocities"] == pytest.approx([speed] * 6)
        assert speed / (times[-1] - times[-2]) == pytest.approx(5.0)
        assert points[-1]["positions"] == pytest.approx([0.5 + speed / rate_hz + speed * 0.1 + speed**2 / 10.0] * 6)


def test_trajectories_that_brake_between_two_commands_are_refused(driver: Driver) -> None:
    with pytest.raises(RobotError, match="rate_hz is 10: trajectories need at least 20 a second"):
        RosArmConnection(replace(SETTINGS, host="ros2:command=trajectory", limits=Limits(rate_hz=10.0)))


def test_velocity_command_is_zero_after_its_guard_was_killed(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    start = subprocess.Popen
    guards: list[Any] = []

    def start_guard(_: object, **options: Any) -> subprocess.Popen[bytes]:
        guards.append(start([sys.executable, "-c", "print('ready', flush=True); input()"], **options))
        return guards[0]

    monkeypatch.setattr("rlservo.envs.ros2.arm.subprocess.Popen", start_guard)
    arm = RosArmConnection(replace(SETTINGS, host="ros2:command=velocity"))
    try:
        arm.servoJ([0.5] * 6)
        arm.servoJ([0.501] * 6)
        assert max(driver.sent[-1]["data"]) > 0.0
        guards[0].kill()
        guards[0].wait()
        with pytest.raises(RobotError, match="guard_ended: nothing is commanded without the guard"):
            arm.servoJ([0.502] * 6)
    finally:
        arm.close()
        guards[0].stdout.close()
    assert driver.sent[-1]["data"] == [0.0] * 6  # the controller would repeat any other


@pytest.mark.parametrize(("mode", "name"), [(5, "idle"), (3, "power off"), (-1, "robot mode -1")])
def test_arm_that_is_not_running_is_a_fault(driver: Driver, mode: int, name: str) -> None:
    driver.values["robot_mode"]["data"] = mode
    settings = replace(SETTINGS, orders_descriptor=make_file(ORDERS), report_descriptor=make_file(REPORT))
    stream = CommandStream(settings, RosArmConnection(settings), URSimulation("ur5", objects=()))
    with pytest.raises(RobotError, match=f"not_running: the robot is in {name}: power it on"):
        stream.run(lambda: None)
    assert driver.sent == []
    for descriptor in (settings.orders_descriptor, settings.report_descriptor):
        os.close(descriptor)


@pytest.mark.parametrize(
    "states", [{"velocity": []}, {"name": [*JOINTS[:5], "finger", "tool"]}, {"name": [*JOINTS, JOINTS[0]]}]
)
def test_driver_without_a_joint_or_velocities_is_refused(driver: Driver, states: dict[str, Any]) -> None:
    driver.values["joint_states"].update(states)
    with pytest.raises(RobotError, match="/joint_states has no finite position and velocity of shoulder_pan_joint, "):
        RosArmConnection(SETTINGS)
