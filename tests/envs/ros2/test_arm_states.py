"""States of an arm's driver as its connection takes them, without ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rlservo.envs.robots.arm import RobotError
from rlservo.envs.robots.command_stream import StreamSettings
from rlservo.envs.robots.limits import Limits
from rlservo.envs.ros2 import messages
from rlservo.envs.ros2.address import ARM_OPTIONS, COMMAND_TOPICS
from rlservo.envs.ros2.arm import RosArmConnection
from rlservo.envs.ros2.link import Endpoint, Publish

SETTINGS = StreamSettings("ros2:", "ur5", 0.1, 0.25, Limits(), 0, 0)
JOINTS = list(messages.JOINT_NAMES.values())


class Driver:
    """A link to a driver that publishes at once what is subscribed to."""

    def __init__(self) -> None:
        self.takers: dict[str, Callable[[Any], None]] = {}
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
        return lambda _: None

    def publishers(self, topic: str) -> list[Endpoint]:
        return [Endpoint("/driver", messages.INT8)] if topic not in COMMAND_TOPICS.values() else []

    rivals = publishers

    def subscribers(self, topic: str) -> list[Endpoint]:
        return [Endpoint("/controller", messages.NUMBERS)]

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


@pytest.mark.parametrize(
    "states", [{"velocity": []}, {"name": [*JOINTS[:5], "finger", "tool"]}, {"name": [*JOINTS, JOINTS[0]]}]
)
def test_driver_without_a_joint_or_velocities_is_refused(driver: Driver, states: dict[str, Any]) -> None:
    driver.values["joint_states"].update(states)
    with pytest.raises(RobotError, match="/joint_states has no finite position and velocity of shoulder_pan_joint, "):
        RosArmConnection(SETTINGS)
