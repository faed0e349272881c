"""Addresses, conversions of messages, and places of elements: no ROS is needed."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from rlservo.deploy.ros2.elements import ElementOutputs, Place
from rlservo.envs.mir100.parameters import BACK_SCANNER, FRONT_SCANNER
from rlservo.envs.mir100.simulation import Mir100Simulation
from rlservo.envs.robots.arm import RobotError
from rlservo.envs.ros2 import messages
from rlservo.envs.ros2.address import ARM_OPTIONS, BASE_OPTIONS, RosAddress
from rlservo.envs.ros2.base import BaseLimits
from rlservo.envs.ros2.simulated_base import SimulatedBase
from rlservo.envs.ur_controller.server import Link as LinkFaults
from rlservo.export.contract.errors import UsageError


def test_address_names_its_options() -> None:
    address = RosAddress.parse("ros2:prefix=left_,command=trajectory", ARM_OPTIONS)
    assert (address.host, address["prefix"], address["command"]) == ("", "left_", "trajectory")
    assert RosAddress.parse("ros2:", ARM_OPTIONS)["joint_states"] == "/joint_states"
    bridge = RosAddress.parse("rosbridge://10.0.0.1,scan=/scan", BASE_OPTIONS)
    assert (bridge.host, bridge.port, bridge["scan"]) == ("10.0.0.1", 9090, "/scan")


@pytest.mark.parametrize(
    ("robot", "sentence"),
    [
        ("ros2:speed=3", "'speed=3' is not one of prefix, command"),
        ("ros2:command=torque", "command is 'torque', expected position or velocity or trajectory"),
        ("rosbridge://", "expected rosbridge://HOST:9090"),
        ("tcp://x", "expected ros2:, ros2:NAME=VALUE"),
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


def test_stamps_of_ros_1_and_2_are_read_and_a_zero_is_none() -> None:
    assert messages.stamp_of(messages.parse({"header": {"stamp": messages.stamp(12.25)}})) == 12.25
    assert messages.stamp_of(messages.parse({"header": {"stamp": {"secs": 3, "nsecs": 500_000_000}}})) == 3.5
    assert messages.stamp_of(messages.parse({"header": {"stamp": {"sec": 0, "nanosec": 0}}})) is None
    assert messages.stamp_of(messages.parse({"data": 1})) is None


class Outlet:
    """A link that keeps what is published."""

    def __init__(self) -> None:
        self.sent: dict[str, object] = {}

    def now_s(self) -> float:
        return 1.0

    def advertise(self, topic: str, kind: str) -> object:
        return lambda values: self.sent.__setitem__(topic, messages.parse(json.loads(json.dumps(values))))

    def subscribe(self, topic: str, kind: str, on_message: object) -> None: ...

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
        messages.scan_points(sent[topic], messages.scanner_pose(scanner))
        for topic, scanner in (("/f_scan", FRONT_SCANNER), ("/b_scan", BACK_SCANNER))
    ]
    own = messages._seen_by(FRONT_SCANNER, points[0])
    assert own == pytest.approx(simulation.scan[: FRONT_SCANNER.count])
    together = messages.readings(np.concatenate(points))
    assert np.mean(np.abs(together - simulation.scan) < 0.05) > 0.9


def test_one_scan_around_the_base_gives_nearly_the_same(scans: tuple[Mir100Simulation, dict[str, object]]) -> None:
    simulation, sent = scans
    readings = messages.readings(messages.scan_points(sent["/scan"]))
    assert np.median(np.abs(readings - simulation.scan)) < 0.03
    assert np.mean(np.abs(readings - simulation.scan) < 0.15) > 0.8


def test_place_of_an_element_reads_a_joint_by_name_and_converts_units() -> None:
    place = Place.parse("angle", "/imu sensor_msgs/msg/Imu orientation.x * 2 + 1")
    assert place.read(SimpleNamespace(orientation=SimpleNamespace(x=3.0))) == 7.0
    joint = Place.parse("slider", "/joint_states sensor_msgs/msg/JointState position[slider]")
    assert joint.read(SimpleNamespace(name=["hinge", "slider"], position=[1.0, 2.0])) == 2.0
    assert joint.read(SimpleNamespace(name=["hinge"], position=[1.0])) is None
    with pytest.raises(UsageError, match="element 'x' is mapped to '/topic': expected TOPIC TYPE FIELD"):
        Place.parse("x", "/topic")


def test_action_is_one_message_per_topic_stamped_by_the_graphs_clock() -> None:
    sent: list[object] = []
    places = [
        Place.parse(name, f"/cmd_vel geometry_msgs/msg/TwistStamped twist.{name}") for name in ("linear.x", "angular.z")
    ]
    ElementOutputs(places, {"/cmd_vel": sent.append}, lambda: 12.25).act(np.array([0.5, -0.25]))
    header = {"stamp": {"sec": 12, "nanosec": 250_000_000}}
    assert sent == [{"twist": {"linear": {"x": 0.5}, "angular": {"z": -0.25}}, "header": header}]


def test_limits_of_a_base_are_checked_by_name() -> None:
    assert BaseLimits.of({"speed_scale": 0.2}).speed_scale == 0.2
    with pytest.raises(RobotError, match="limits: speed does not exist: expected some of speed_scale"):
        BaseLimits.of({"speed": 1.0})
    with pytest.raises(RobotError, match="stop_distance is -1: expected a number from 0 to 2"):
        BaseLimits.of({"stop_distance": -1})
