"""Addresses, conversions of messages, and places of elements: no ROS is needed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from rlservo.bundle.spaces import BoxSpec, Element
from rlservo.deploy.ros2.mapped_elements import ElementInputs, ElementOutputs, Place, places
from rlservo.errors import UsageError
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.mir100.parameters import BACK_SCANNER, FRONT_SCANNER
from rlservo.robots.mir100.simulation import Mir100Simulation
from rlservo.robots.ros2 import ros_messages as messages
from rlservo.robots.ros2.address import ARM_OPTIONS, BASE_OPTIONS, RosAddress
from rlservo.robots.ros2.base_driver import BaseLimits
from rlservo.robots.simulated.ros2_base import SimulatedBase
from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults as LinkFaults


def test_address_names_its_options() -> None:
    address = RosAddress.parse("ros2:prefix=left_,command=trajectory", ARM_OPTIONS)
    assert (address.host, address["prefix"], address["command"]) == ("", "left_", "trajectory")
    assert RosAddress.parse("ros2:", ARM_OPTIONS)["joint_states"] == "/joint_states"
    bridge = RosAddress.parse("rosbridge://10.0.0.1,scan=/scan", BASE_OPTIONS)
    assert (bridge.host, bridge.port, bridge["scan"]) == ("10.0.0.1", 9090, "/scan")


@pytest.mark.parametrize(
    ("robot", "sentence"),
    [
        ("ros2:speed=3", "'speed=3': expected NAME=VALUE with one of prefix, command"),
        ("ros2:command=torque", "command is 'torque', expected position or velocity or trajectory"),
        ("rosbridge://", "expected rosbridge://HOST:9090"),
        ("tcp://x", "expected ros2:, ros2:NAME=VALUE"),
        ("ros2:joint_states=/arm 1/states", "joint_states is '/arm 1/states', expected a topic's name"),
        ("ros2:joint_states=", "joint_states is '', expected a topic's name"),
    ],
)
def test_address_that_is_wrong_is_refused_in_a_sentence(robot: str, sentence: str) -> None:
    with pytest.raises(RobotError, match=sentence):
        RosAddress.parse(robot, ARM_OPTIONS)


def test_joints_are_ordered_by_name_and_a_missing_one_is_noticed() -> None:
    state = SimpleNamespace(name=["c", "a", "b"], position=[3.0, 1.0, 2.0], velocity=[0.3, float("nan"), 0.2])
    assert messages.in_order(state, ("a", "b", "c"), "position") == pytest.approx([1.0, 2.0, 3.0])
    assert messages.in_order(state, ("a", "d"), "position") is None
    assert messages.in_order(state, ("a", "b"), "velocity") is None
    twice = SimpleNamespace(name=["a", "b", "a"], position=[1.0, 2.0, 3.0])
    assert messages.in_order(twice, ("a", "b"), "position") is None


def test_stamps_of_ros_1_and_2_are_read_and_a_zero_is_none() -> None:
    assert messages.stamp_of(messages.parse({"header": {"stamp": messages.stamp(12.25)}})) == 12.25
    assert messages.stamp_of(messages.parse({"header": {"stamp": {"secs": 3, "nsecs": 500_000_000}}})) == 3.5
    assert messages.stamp_of(messages.parse({"header": {"stamp": {"sec": 0, "nanosec": 0}}})) is None
    assert messages.stamp_of(messages.parse({"data": 1})) is None


class Outlet:
    """A link that keeps what is published."""

    def __init__(self) -> None:
        self.sent: dict[str, object] = {}
        self.takers: dict[str, Callable[[object], None]] = {}

    def now_s(self) -> float:
        return 1.0

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> object:
        return lambda values: self.sent.__setitem__(topic, messages.parse(json.loads(json.dumps(values))))

    def subscribe(self, topic: str, kind: str, on_message: Callable[[object], None]) -> None:
        self.takers[topic] = on_message

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def scans() -> tuple[Mir100Simulation, dict[str, object]]:
    """Messages of the simulated base in the room, and the simulation itself."""
    outlet = Outlet()
    base = SimulatedBase([outlet], world="lab_6x8", is_stamped=False, faults=LinkFaults())  # type: ignore[list-item]
    for _ in range(4):
        base.tick()
    return base.simulation, outlet.sent


def test_own_scans_become_the_readings_that_the_policy_was_trained_with(
    scans: tuple[Mir100Simulation, dict[str, object]],
) -> None:
    simulation, sent = scans
    points = [
        messages.read_scan(sent[topic], messages.place_of(scanner)).points
        for topic, scanner in (("/f_scan", FRONT_SCANNER), ("/b_scan", BACK_SCANNER))
    ]
    own = messages.seen_by(FRONT_SCANNER, points[0])
    assert own == pytest.approx(simulation.scan[: FRONT_SCANNER.count])
    together = messages.readings(np.concatenate(points))
    assert np.mean(np.abs(together - simulation.scan) < 0.05) > 0.9


def test_one_scan_around_the_base_gives_nearly_the_same(scans: tuple[Mir100Simulation, dict[str, object]]) -> None:
    simulation, sent = scans
    readings = messages.readings(messages.read_scan(sent["/scan"], np.eye(4)).points)
    assert np.median(np.abs(readings - simulation.scan)) < 0.03
    assert np.mean(np.abs(readings - simulation.scan) < 0.15) > 0.8


def test_scan_is_read_in_any_direction_and_a_blind_one_is_no_free_way() -> None:
    def points(ranges: list[float], **header: float) -> list[list[float]]:
        known = {"angle_min": math.pi, "angle_increment": -math.pi / 2, "range_min": 0.1, "range_max": 10.0}
        scan = SimpleNamespace(ranges=ranges, **(known | header))
        return np.round(messages.read_scan(scan, np.eye(4)).points, 6).tolist()

    assert points([1.0, 2.0, 3.0]) == [[-1.0, 0.0], [0.0, 2.0], [3.0, 0.0]]  # clockwise from behind
    assert points([math.nan, math.inf, -math.inf, 12.0, 0.0]) == [[0.1, 0.0]]
    assert points([math.inf, math.nan]) == []
    for ranges, header in (
        ([], {}), ([math.nan] * 3, {}), ([0.0] * 3, {}), ([1.0] * 3, {"range_max": math.nan}),
        ([1.0] * 3, {"range_min": math.nan}), ([1.0] * 3, {"angle_increment": math.nan}),
        ([1.0] * 3, {"angle_min": math.inf}),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f"no beam of {len(ranges)} has a reading and an angle"):
            points(ranges, **header)


def test_yaw_of_an_odometry_needs_a_quaternion_of_any_length() -> None:
    def state(**orientation: float) -> Any:
        pose = {"position": {"x": 1.0, "y": 2.0}, "orientation": orientation}
        velocity = {"linear": {"x": 0.5, "y": 0.0}, "angular": {"z": 0.1}}
        return messages.planar_state(messages.parse({"pose": {"pose": pose}, "twist": {"twist": velocity}}))

    third = messages.quaternion(2.0)
    assert state(**{name: 3.0 * value for name, value in third.items()})[0] == pytest.approx((1.0, 2.0, 2.0))
    assert state(x=0.0, y=0.0, z=0.0, w=0.0) is None


def test_place_of_an_element_reads_a_joint_by_name_and_converts_units() -> None:
    place = Place.parse("angle", "/imu sensor_msgs/msg/Imu orientation.x * 2 + 1")
    assert place.read(SimpleNamespace(orientation=SimpleNamespace(x=3.0))) == 7.0
    joint = Place.parse("slider", "/joint_states sensor_msgs/msg/JointState position[slider]")
    assert joint.read(SimpleNamespace(name=["hinge", "slider"], position=[1.0, 2.0])) == 2.0
    assert joint.read(SimpleNamespace(name=["hinge"], position=[1.0])) is None
    named = Place.parse("hip", "/joint_states sensor_msgs/msg/JointState position[left-leg/hip.1] * -1 + 0.5")
    assert named.read(SimpleNamespace(name=["left-leg/hip.1"], position=[2.0])) == -1.5
    for text in ("/topic", "/imu sensor_msgs/msg/Imu orientation.x * nan", "/1 std_msgs/msg/Float64 data"):
        sentence = re.escape(f"element 'x' is mapped to {text!r}: expected TOPIC TYPE FIELD")
        with pytest.raises(UsageError, match=sentence):
            Place.parse("x", text)


def test_joints_of_one_topic_may_come_from_several_publishers() -> None:
    outlet = Outlet()
    mapped = [
        Place.parse(name, f"/joint_states sensor_msgs/msg/JointState position[{name}]") for name in ("hip", "finger")
    ]
    inputs = ElementInputs(outlet, mapped, 0.5)  # type: ignore[arg-type]
    header = {"stamp": messages.stamp(outlet.now_s())}

    def send(positions: dict[str, float], age_s: float = 0.0) -> None:
        made = {"stamp": messages.stamp(outlet.now_s() - age_s)} if age_s else header
        message = {"header": made, "name": list(positions), "position": list(positions.values())}
        outlet.takers["/joint_states"](messages.parse(message))

    send({"hip": 1.0})
    assert inputs.observe() == (None, "no message on /joint_states with position[finger]")
    send({"finger": 2.0, "other": 0.0})
    send({"hip": 3.0})
    observation, why = inputs.observe()
    assert observation is not None, why
    assert observation.tolist() == [3.0, 2.0]
    send({"finger": math.nan})
    assert inputs.observe() == (None, "a message on /joint_states has no finite position[finger]")
    send({"finger": 2.0}, age_s=-0.9)  # from the future is no better than old
    assert inputs.observe()[1].startswith("the newest message on /joint_states with position[finger] is 0.9")


def test_mapping_that_contradicts_itself_is_refused() -> None:
    names = ("a", "b")
    space = BoxSpec(shape=(2,), dtype="float32", low=-1.0, high=1.0, elements=[Element(name=one) for one in names])
    contract: Any = SimpleNamespace(name="p", observation_space=space, action_space=space)
    twist = "/cmd_vel geometry_msgs/msg/Twist linear.x"
    with pytest.raises(UsageError, match=r"'a' and 'b' are both mapped to linear\.x of /cmd_vel"):
        places(contract, {"action.a": twist, "action.b": twist})
    stamped = "/cmd_vel geometry_msgs/msg/TwistStamped twist.angular.z"
    with pytest.raises(UsageError, match="/cmd_vel is mapped as both geometry_msgs/msg/Twist and geometry_msgs"):
        places(contract, {"action.a": twist, "action.b": stamped})


def test_action_is_one_message_per_topic_stamped_by_the_graphs_clock() -> None:
    sent: list[object] = []
    places = [
        Place.parse(name, f"/cmd_vel geometry_msgs/msg/TwistStamped twist.{name}") for name in ("linear.x", "angular.z")
    ]
    ElementOutputs(places, {"/cmd_vel": sent.append}, lambda: 12.25).act(np.array([0.5, -0.25]))
    header = {"stamp": {"sec": 12, "nanosec": 250_000_000}}
    assert sent == [{"twist": {"linear": {"x": 0.5}, "angular": {"z": -0.25}}, "header": header}]


def test_action_names_each_joint_of_a_joint_state_once() -> None:
    sent: list[dict[str, object]] = []
    fields = ("position[a]", "position[b]", "velocity[b]", "velocity[a]")
    mapped = [Place.parse(one, f"/command sensor_msgs/msg/JointState {one}") for one in fields]
    ElementOutputs(mapped, {"/command": sent.append}, lambda: 1.0).act(np.array([1.0, 2.0, 3.0, 4.0]))  # type: ignore[dict-item]
    assert {name: sent[0][name] for name in ("name", "position", "velocity")} == {
        "name": ["a", "b"], "position": [1.0, 2.0], "velocity": [4.0, 3.0]
    }  # fmt: skip


def test_limits_of_a_base_are_checked_by_name() -> None:
    assert BaseLimits.of({"speed_scale": 0.2}).speed_scale == 0.2
    with pytest.raises(RobotError, match="limits: speed does not exist: expected some of speed_scale"):
        BaseLimits.of({"speed": 1.0})
    with pytest.raises(RobotError, match="stop_distance is -1: expected a number from 0 to 2"):
        BaseLimits.of({"stop_distance": -1})


def test_package_depends_on_every_interface_that_is_used() -> None:
    source = Path(__file__).parents[3]
    used = {
        package
        for folder in ("rlservo/robots/ros2", "deploy/ros2")
        for file in (source / folder).glob("*.py")
        for package in re.findall(r'"(\w+)/(?:msg|srv|action)/\w+"', file.read_text())
    }
    package = ElementTree.parse(source / "deploy/ros2/package.xml").getroot()
    assert used | {"rclpy"} == {one.text for one in package.findall("exec_depend")}
