"""States of an arm's driver as its connection takes them, without ROS."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_port import ServoSettings
from rlservo.robots.limits import Limits
from rlservo.robots.ros2 import ros_messages as messages
from rlservo.robots.ros2.address import ARM_OPTIONS, COMMAND_TOPICS
from rlservo.robots.ros2.arm_driver import RosArmConnection
from rlservo.robots.ros2.link import Endpoint, Publish
from rlservo.robots.servo_loop import ORDERS, REPORT, ServoLoop
from rlservo.robots.shared_block import make_file
from rlservo.robots.simulated.ros2_arm import description
from rlservo.robots.ur.calibration import data_sheet, frames_of
from rlservo.robots.ur.simulation import URSimulation

SETTINGS = ServoSettings("ros2:", "ur5", 0.1, 0.25, Limits(), 0, 0)
JOINTS = list(messages.JOINT_NAMES.values())


class Driver:
    """A link to a driver that publishes at once what is subscribed to."""

    knows_quality = True

    def __init__(self) -> None:
        self.takers: dict[str, Callable[[Any], None]] = {}
        self.sent: list[Mapping[str, Any]] = []
        self.stamped_s = 0.0  # of a clock of its own
        self.controller_joints: list[str] | None = None
        self.nodes, self.commanders, self.clocks = ["/driver"], list[str](), list[str]()
        self.values: dict[str, dict[str, Any]] = {
            "joint_states": {"name": [*JOINTS, "finger"], "position": [0.5] * 7, "velocity": [0.0] * 7},
            "speed_scaling": {"data": 100.0}, "program_running": {"data": True}, "robot_mode": {"data": 7},
            "safety_mode": {"data": 1}, "robot_description": {"data": description(data_sheet("ur5"), JOINTS, "")},
        }  # fmt: skip

    def now_s(self) -> float:
        return time.time()

    def send(self, name: str) -> None:
        header = {"header": {"stamp": messages.stamp(self.stamped_s or self.now_s())}}
        self.takers[ARM_OPTIONS[name]](messages.parse(header | self.values[name]))

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None], *, is_kept: bool = False) -> None:
        self.takers[topic] = on_message
        name = next(name for name, one in ARM_OPTIONS.items() if one == topic)
        if name in self.values:
            self.send(name)

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> Publish:
        return self.sent.append

    def publishers(self, topic: str) -> list[Endpoint]:
        names = self.commanders if topic in COMMAND_TOPICS.values() else self.nodes
        names = self.clocks if topic == "/clock" else names
        return [Endpoint(name, messages.INT8) for name in names]

    def rivals(self, topic: str, since_s: float = 0.0) -> list[Endpoint]:
        return self.publishers(topic)

    def subscribers(self, topic: str) -> list[Endpoint]:
        is_trajectory = topic == COMMAND_TOPICS["trajectory"]
        return [Endpoint("/controller", messages.JOINT_TRAJECTORY if is_trajectory else messages.NUMBERS)]

    def strings(self, node: str, parameter: str) -> list[str] | None:
        return self.controller_joints if (node, parameter) == ("/forward_position_controller", "joints") else None

    def close(self) -> None: ...


def replace_guard(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Start a guard that needs no ROS; return the guards that were started."""
    start = subprocess.Popen
    guards: list[Any] = []

    def start_guard(_: object, **options: Any) -> subprocess.Popen[bytes]:
        guards.append(start([sys.executable, "-c", "print('ready', flush=True); input()"], **options))
        return guards[0]

    monkeypatch.setattr("rlservo.robots.ros2.arm_driver.subprocess.Popen", start_guard)
    return guards


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Driver]:
    driver = Driver()
    monkeypatch.setattr("rlservo.robots.ros2.arm_driver.RclpyLink", lambda _: driver)
    monkeypatch.setattr("rlservo.robots.ros2.arm_driver.FIRST_MESSAGES_S", 0.1)
    monkeypatch.setattr("rlservo.robots.ros2.link.DISCOVERY_S", 0.0)
    return driver


def test_numbers_that_are_not_finite_never_replace_a_state(driver: Driver) -> None:
    arm = RosArmConnection(SETTINGS)
    driver.values["speed_scaling"]["data"] = 50.0
    driver.send("speed_scaling")
    driver.values["speed_scaling"]["data"] = math.nan
    driver.send("speed_scaling")
    assert arm.read().scaling == 0.5  # a NaN would become the next setpoint
    driver.values["joint_states"]["position"] = [math.nan] * 7
    driver.send("joint_states")
    assert arm.read().positions.tolist() == [0.5] * 6


def test_kinematics_are_those_of_the_robots_description(driver: Driver, caplog: pytest.LogCaptureFixture) -> None:
    own = data_sheet("ur5") + 1e-4
    driver.values["robot_description"] = {"data": description(own, JOINTS, "")}
    frames = RosArmConnection(SETTINGS).frames
    assert frames is not None and np.abs(frames - frames_of(own)).max() < 1e-12
    driver.values["robot_description"] = {"data": "<robot/>"}
    assert RosArmConnection(SETTINGS).frames is None
    assert caplog.messages == [
        "kinematics are the data sheet's: /robot_description cannot be used: it has no link base"
    ]
    driver.values["robot_description"] = {"data": description(data_sheet("ur10e"), JOINTS, "")}
    with pytest.raises(RobotError, match=r"calibration: the flange is up to .* m from a ur5's: expected 0\.03 m"):
        RosArmConnection(SETTINGS)
    del driver.values["robot_description"]
    assert RosArmConnection(SETTINGS).without_frames == "no message on /robot_description"


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 500.0])
@pytest.mark.parametrize("speed", [0.0, 1e-9, 0.3, 3.0])
def test_every_trajectory_is_one_that_a_controller_takes(driver: Driver, speed: float, rate_hz: float) -> None:
    limits = Limits(rate_hz=rate_hz, acceleration=5.0)
    arm = RosArmConnection(replace(SETTINGS, host="ros2:command=trajectory", limits=limits))
    arm.send(np.full(6, 0.5))
    arm.send(np.full(6, 0.5 + speed / rate_hz))
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
    with pytest.raises(RobotError, match="rate_hz is 10: trajectories need at least 20 Hz"):
        RosArmConnection(
            replace(SETTINGS, host="ros2:command=trajectory", limits=Limits(rate_hz=10.0, watchdog_hz=1.0))
        )


def test_trajectories_go_to_the_controller_that_the_distribution_has(
    driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Since Lyrical it is joint_trajectory_controller."""
    later = "/joint_trajectory_controller/joint_trajectory"
    topics: list[str] = []

    def subscribers(topic: str) -> list[Endpoint]:
        return [Endpoint("/controller_manager", messages.JOINT_TRAJECTORY)] if topic == later else []

    monkeypatch.setattr(driver, "subscribers", subscribers)
    monkeypatch.setattr(driver, "rivals", lambda *_: [])
    monkeypatch.setattr(driver, "advertise", lambda topic, _: topics.append(topic) or driver.sent.append)
    arm = RosArmConnection(replace(SETTINGS, host="ros2:command=trajectory"))
    arm.send(np.full(6, 0.5))
    assert topics == [later] and len(driver.sent) == 1
    assert arm.hint.endswith("(ros2 control switch_controllers --activate joint_trajectory_controller)")


@pytest.mark.parametrize("follows", [0.95, 1.0, 1.05])
def test_velocities_bring_an_arm_to_its_setpoint_that_follows_them_by(
    follows: float, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    guards = replace_guard(monkeypatch)
    arm = RosArmConnection(replace(SETTINGS, host="ros2:command=velocity"))
    position, setpoint = np.full(6, 0.5), np.full(6, 0.5)
    try:
        for step in range(500):  # a second of motion, three at rest
            setpoint = setpoint + (1.0 / 125.0 if step < 125 else 0.0)
            arm.send(setpoint)
            position += follows * np.array(driver.sent[-1]["data"]) / 125.0
            driver.values["joint_states"]["position"] = [*position, 0.0]
            driver.send("joint_states")
        assert np.abs(position - setpoint).max() < 0.005
        assert driver.sent[-1]["data"] == [0.0] * 6  # it does not tremble
    finally:
        arm.close()
        guards[0].stdout.close()


def test_velocity_command_is_zero_after_its_guard_was_killed(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    guards = replace_guard(monkeypatch)
    arm = RosArmConnection(replace(SETTINGS, host="ros2:command=velocity"))
    try:
        arm.send(np.full(6, 0.5))
        arm.send(np.full(6, 0.501))
        assert max(driver.sent[-1]["data"]) > 0.0
        guards[0].kill()
        guards[0].wait()
        with pytest.raises(RobotError, match="guard_ended: nothing is commanded without the guard"):
            arm.send(np.full(6, 0.502))
    finally:
        arm.close()
        guards[0].stdout.close()
    assert driver.sent[-1]["data"] == [0.0] * 6  # the controller would repeat any other


@pytest.mark.parametrize(("mode", "name"), [(5, "idle"), (3, "power off"), (-1, "robot mode -1")])
def test_arm_that_is_not_running_is_a_fault(driver: Driver, mode: int, name: str) -> None:
    driver.values["robot_mode"]["data"] = mode
    settings = replace(SETTINGS, orders_descriptor=make_file(ORDERS), report_descriptor=make_file(REPORT))
    stream = ServoLoop(settings, RosArmConnection(settings), URSimulation("ur5", objects=()))
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


def test_second_publisher_of_joint_states_is_refused(driver: Driver) -> None:
    driver.nodes.append("/other")
    with pytest.raises(RobotError, match="second_publisher: /joint_states comes from /driver and /other: end one, or"):
        RosArmConnection(SETTINGS)


def test_second_publisher_of_joint_states_or_commands_that_comes_later_is_a_fault(driver: Driver) -> None:
    arm = RosArmConnection(SETTINGS)
    arm.send(np.full(6, 0.5))
    driver.nodes.append("/other")
    time.sleep(0.25)
    with pytest.raises(RobotError, match="second_publisher: /joint_states comes from /driver and /other"):
        arm.send(np.full(6, 0.5))
    driver.nodes.remove("/other")
    arm = RosArmConnection(SETTINGS)
    arm.send(np.full(6, 0.5))
    driver.commanders.append("/other")
    time.sleep(0.25)
    sent = len(driver.sent)
    for _ in range(2):
        with pytest.raises(RobotError, match="second_commander: /forward_position_controller/commands is also"):
            arm.send(np.full(6, 0.5))
    assert len(driver.sent) == sent


def test_joint_states_that_jump_as_no_arm_can_are_a_fault(driver: Driver) -> None:
    arm = RosArmConnection(SETTINGS)
    arm.send(np.full(6, 0.5))
    driver.values["joint_states"]["position"][2] = 0.9
    driver.send("joint_states")
    with pytest.raises(RobotError, match=r"states_jumped: elbow_joint on /joint_states moved by 0.40 rad in 0.0"):
        arm.send(np.full(6, 0.5))


def test_commands_are_in_the_order_of_the_controllers_joints(driver: Driver) -> None:
    driver.controller_joints = [JOINTS[2], JOINTS[0], JOINTS[1], *JOINTS[3:]]
    RosArmConnection(SETTINGS).send(np.array([0.51, 0.52, 0.53, 0.54, 0.55, 0.56]))
    assert driver.sent[-1]["data"] == [0.53, 0.51, 0.52, 0.54, 0.55, 0.56]
    driver.controller_joints = JOINTS[:5]
    with pytest.raises(RobotError, match=r"/forward_position_controller commands shoulder_pan_joint, .*: expected "):
        RosArmConnection(SETTINGS)


def not_finite(values: dict[str, Any]) -> None:
    values["position"][1] = math.nan


def renamed(values: dict[str, Any]) -> None:
    values["name"][1] = "left_shoulder_lift_joint"


def jumped_back(values: dict[str, Any]) -> None:
    values["age_s"] = 100.0


def jumped_ahead(values: dict[str, Any]) -> None:
    values["age_s"] = -100.0


def ended(values: dict[str, Any]) -> None:
    values["is_silent"] = True


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (not_finite, "bad_messages: /joint_states has no finite position and velocity of shoulder_pan_joint, "),
        (renamed, "bad_messages: /joint_states has no finite position and velocity of shoulder_pan_joint, "),
        (jumped_back, "stale_stamps: /joint_states has no new stamp for 1"),
        (jumped_ahead, "stale_stamps: /joint_states has stamps 100.0 s ahead of"),
        (ended, "connection_lost: no message on /joint_states for 1 s: is the driver running"),
    ],
)
def test_reason_of_a_fault_is_the_cause_that_is_known(
    driver: Driver, error: Callable[[dict[str, Any]], None], reason: str
) -> None:
    with streaming(driver) as stream:
        timer = threading.Timer(0.3, error, [driver.values["joint_states"]])
        timer.start()
        with pytest.raises(RobotError, match=f"^{reason}"):
            stream.run(lambda: None)
        timer.join()


def test_publishing_that_a_busy_machine_holds_up_is_no_fault(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    """A publisher gets no answer that could be late; the arm stands at its last setpoint, as if we were suspended."""

    def publish(message: Mapping[str, Any]) -> None:
        driver.sent.append(message)
        if len(driver.sent) == 20:
            time.sleep(0.4)
        if len(driver.sent) == 60:
            stream.is_asked_to_end.set()

    monkeypatch.setattr(driver, "advertise", lambda *_: publish)
    with streaming(driver) as stream:
        stream.run(lambda: None)
    assert len(driver.sent) >= 60


@contextmanager
def streaming(driver: Driver) -> Iterator[ServoLoop]:
    """A command stream, while the driver publishes its joint states."""
    states = driver.values["joint_states"]
    settings = replace(SETTINGS, orders_descriptor=make_file(ORDERS), report_descriptor=make_file(REPORT))
    stream = ServoLoop(settings, RosArmConnection(settings), URSimulation("ur5", objects=()))
    is_over = threading.Event()

    def publish() -> None:
        while not is_over.wait(0.008):
            if not states.get("is_silent"):
                stamp = messages.stamp(time.time() - states.get("age_s", 0.0))
                driver.takers["/joint_states"](messages.parse({"header": {"stamp": stamp}} | states))

    publishing = threading.Thread(target=publish)
    publishing.start()
    try:
        yield stream
    finally:
        is_over.set()
        publishing.join()
        for descriptor in (settings.orders_descriptor, settings.report_descriptor):
            os.close(descriptor)


def test_simulated_time_is_named_where_the_clock_is_another(driver: Driver) -> None:
    driver.stamped_s = 12.5
    with pytest.raises(RobotError, match=r"synchronise the clocks \(chrony\)"):
        RosArmConnection(SETTINGS)
    driver.clocks = ["/gazebo"]
    with pytest.raises(RobotError, match=r"/joint_states has stamps of simulated time, .*use_sim_time:=true"):
        RosArmConnection(SETTINGS)
