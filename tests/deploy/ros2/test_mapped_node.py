"""A policy for an unknown robot as a node: elements by name or by a parameter file, from other nodes' messages."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from bundles import write_box_policy
from environments import environment_with
from rlservo.bundle.bundle import read_contract, write_contract
from rlservo.bundle.spaces import Element
from rlservo.policy.policy import Policy
from ros import PYTHON, Process, Ros, SlowServer
from servers import free_ports, over_uvicorn

JOINTS = ("shoulder", "elbow", "wrist")
COMMANDS, REST, TARGET = "/forward_command_controller/commands", "/rest", "/target_polar"
MAX_AGE_S = 1.0


def mapping(path: Path) -> Path:
    """The first elements are joints, one of them in degrees; the others are one array."""
    lines = [
        f'    observation.element_{index}: "/joint_states sensor_msgs/msg/JointState position[{joint}]{unit}"'
        for index, (joint, unit) in enumerate(zip(JOINTS, ("", "", " * 57.29577951308232"), strict=True))
    ]
    lines += [
        f'    observation.element_{index}: "{REST} std_msgs/msg/Float64MultiArray data[{index - 3}]"'
        for index in range(3, 27)
    ]
    path.write_text("\n".join(["/**:", "  ros__parameters:", *lines]))
    return path


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that says that its third element is in degrees."""
    path = write_box_policy(tmp_path_factory.mktemp("mapped"))
    contract = read_contract(path)
    elements = list(contract.observation_space.elements)
    elements[2] = elements[2].model_copy(update={"unit": "deg"})
    space = contract.observation_space.model_copy(update={"elements": tuple(elements)})
    write_contract(path, contract.model_copy(update={"observation_space": space}))
    return path


@pytest.fixture
def moving(bundle: Path, tmp_path: Path) -> Path:
    """The same, whose first two actions are velocities."""
    path = shutil.copytree(bundle, tmp_path / "ur5" / "1")
    contract = read_contract(path)
    velocities = (
        Element(name="joint_0", quantity="linear velocity", unit="m/s", scale=0.5, offset=0.1),
        Element(name="joint_1", quantity="angular velocity", unit="rad/s"),
    )
    space = contract.action_space.model_copy(update={"elements": (*velocities, *contract.action_space.elements[2:])})
    write_contract(path, contract.model_copy(update={"action_space": space}))
    return path


@pytest.fixture(scope="module")
def node(ros: Ros, bundle: Path) -> Process:
    ros.ask("subscribe", topic=COMMANDS, kind="std_msgs/msg/Float64MultiArray")
    ros.ask("subscribe", topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray")
    started = ros.rlservo(
        "ros2", "--bundle", bundle, "--mapping", mapping(bundle / "map.yaml"), "--max-age", MAX_AGE_S,
        "--ros-args", "-r", f"~/action:={COMMANDS}",
    )  # fmt: skip
    until_state(ros, "stopped")  # it commands its topic from here on: of two that come at once either may win
    return started


def send(ros: Ros, positions: dict[str, float], *, age_s: float = 0.0, rest: bool = True) -> None:
    """Publish what the policy observes; `positions` in the order of the message."""
    values: dict[str, Any] = {"name": list(positions), "position": list(positions.values())}
    ros.ask("publish", topic="/joint_states", kind="sensor_msgs/msg/JointState", values=values, age_s=age_s)
    if rest:
        ros.ask("publish", topic=REST, kind="std_msgs/msg/Float64MultiArray", values={"data": [0.5] * 24})


def actions_since(ros: Ros, time_s: float) -> list[list[float]]:
    return [message["data"] for _, message in ros.ask("since", topic=COMMANDS, time_s=time_s)]


def until_state(ros: Ros, text: str, meanwhile: Any = lambda: None, node: str = "rlservo") -> None:
    ros.wait_until(lambda: (meanwhile(), text in ros.heartbeat(node)["message"])[1])


def test_node_waits_for_every_input_and_a_start_then_acts_on_ordered_joints(
    ros: Ros, node: Process, bundle: Path
) -> None:
    assert ros.ask("call", service="/rlservo/start")["success"]
    until_state(ros, "waiting: no message on /joint_states")
    scrambled = {"wrist": 0.1, "other": 9.0, "shoulder": 0.3, "elbow": -0.2}
    until_state(ros, f"waiting: no message on {REST}", lambda: send(ros, scrambled, rest=False))
    assert actions_since(ros, 0.0) == []

    until_state(ros, "running", lambda: send(ros, scrambled))
    ros.wait_until(lambda: (send(ros, scrambled), actions_since(ros, 0.0))[1] != [])
    with Policy.load(bundle) as policy:
        observation = np.array([0.3, -0.2, np.degrees(0.1), *[0.5] * 24], np.float32)
        assert actions_since(ros, 0.0)[-1] == pytest.approx(policy.act(observation).tolist(), abs=1e-6)
    assert ros.ask("call", service="/rlservo/version")["message"] == "ur5 1"


def test_stale_stamps_a_lost_topic_and_a_missing_joint_are_not_acted_on(ros: Ros, node: Process) -> None:
    joints = dict.fromkeys(JOINTS, 0.0)
    assert ros.ask("call", service="/rlservo/start")["success"]
    until_state(ros, "running", lambda: send(ros, joints))
    newest = "holding: the newest message on /joint_states with"
    for publish, why in (
        (lambda: send(ros, joints, age_s=5.0), f"{newest} position[shoulder] is 5."),
        (lambda: send(ros, joints, age_s=-5.0), f"{newest} position[shoulder] is 5."),
        (lambda: send(ros, {"shoulder": 0.0, "elbow": 0.0}), f"{newest} position[wrist]"),
        (lambda: send(ros, {**joints, "wrist": float("nan")}), "holding: a message on /joint_states has no finite"),
        (lambda: None, "holding: the newest message on"),
    ):
        until_state(ros, why, publish)
        began_s = time.time()
        time.sleep(0.3)
        assert actions_since(ros, began_s) == []
        until_state(ros, "running", lambda: send(ros, joints))
    ros.ask("call", service="/rlservo/hold")
    until_state(ros, "holding: asked for", lambda: send(ros, joints))


def test_node_holds_for_a_slow_and_for_a_lost_server_and_goes_on(ros: Ros, bundle: Path) -> None:
    commands, joints = "/served/action", dict.fromkeys(JOINTS, 0.0)
    ros.ask("subscribe", topic=commands, kind="std_msgs/msg/Float64MultiArray")
    ros.ask("subscribe", topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray")
    (port,) = free_ports(1)
    words = ("ros2", "--url", f"http://127.0.0.1:{port}", "--name", "served", "--max-age", MAX_AGE_S, "--autostart")

    def act() -> None:
        send(ros, joints)

    app = SlowServer(bundle.parents[1])
    with over_uvicorn(app, port):
        ros.rlservo(*words, "--mapping", mapping(bundle / "served.yaml"))
        until_state(ros, "running", act, "served")
        app.delay_s = MAX_AGE_S + 0.4
        until_state(ros, "holding: the action took", act, "served")
        before = len(ros.ask("since", topic=commands, time_s=0.0))
        late = int(ros.heartbeat("served")["late"])
        ros.wait_until(lambda: (act(), int(ros.heartbeat("served")["late"]) > late + 2)[1])
        assert len(ros.ask("since", topic=commands, time_s=0.0)) == before
        app.delay_s = 0.0
        until_state(ros, "running", act, "served")
    until_state(ros, "cannot be reached", act, "served")
    with over_uvicorn(SlowServer(bundle.parents[1]), port):
        until_state(ros, "running", act, "served")


def test_velocities_are_zero_and_stops_are_sent_when_the_node_holds_stops_or_ends(ros: Ros, moving: Path) -> None:
    twist, gripper, other = "/cmd_vel_mapped", "/gripper", "/positions"
    kinds = {twist: "geometry_msgs/msg/Twist", gripper: "std_msgs/msg/Float64", other: "std_msgs/msg/Float64MultiArray"}
    for topic, kind in {**kinds, "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray"}.items():
        ros.ask("subscribe", topic=topic, kind=kind)
    lines = [
        f'action.joint_0: "{twist} {kinds[twist]} linear.x * 0.5 + 0.1"',
        f'action.joint_1: "{twist} {kinds[twist]} angular.z"',
        f'action.joint_2: "{gripper} {kinds[gripper]} data"',
        "stop.joint_2: -0.25",
        *(f'action.joint_{index}: "{other} {kinds[other]} data[{index - 3}]"' for index in range(3, 6)),
    ]
    parameters = mapping(moving.parent / "stops.yaml")
    parameters.write_text("\n    ".join([parameters.read_text(), *lines]))
    joints = {"shoulder": 0.3, "elbow": -0.2, "wrist": 0.1}
    node = ros.rlservo(
        "ros2", "--bundle", moving, "--mapping", parameters, "--max-age", MAX_AGE_S, "--name", "stops", "--autostart"
    )
    act = lambda: send(ros, joints)  # noqa: E731
    until_state(ros, "waiting", node="stops")

    def newest() -> list[Any]:
        seen = {topic: ros.ask("since", topic=topic, time_s=0.0) for topic in kinds}
        speeds = seen[twist][-1][1]
        return [speeds["linear"]["x"], speeds["angular"]["z"], seen[gripper][-1][1]["data"], len(seen[other])]

    def run_until_moving() -> None:
        until_state(ros, "running", act, "stops")
        ros.wait_until(lambda: (act(), newest()[0] != 0.0)[1])

    for stop, state in (
        (lambda: ros.ask("call", service="/stops/hold"), "holding: asked for"),
        (lambda: ros.ask("call", service="/stops/stop"), "stopped: asked for"),
        (lambda: None, "holding: the newest message"),
    ):
        run_until_moving()
        stop()
        until_state(ros, state, act if "asked" in state else lambda: None, "stops")
        ros.wait_until(lambda: newest()[:3] == [0.0, 0.0, -0.25])
        standing = newest()
        time.sleep(0.3)
        assert newest() == standing  # positions have no stop that is known: none is sent
        ros.ask("call", service="/stops/start")
    run_until_moving()
    assert node.end() == 0
    ros.wait_until(lambda: newest()[:3] == [0.0, 0.0, -0.25])


def test_mapped_policy_drives_a_base_to_twenty_targets(ros: Ros, all_shipped: Path) -> None:
    places = {
        "observation.target_r": f"{TARGET} std_msgs/msg/Float64MultiArray data[0]",
        "observation.target_theta": f"{TARGET} std_msgs/msg/Float64MultiArray data[1]",
        "observation.linear_velocity": "/odom nav_msgs/msg/Odometry twist.twist.linear.x",
        "observation.angular_velocity": "/odom nav_msgs/msg/Odometry twist.twist.angular.z",
        "action.linear_velocity_normalized": "/cmd_vel geometry_msgs/msg/Twist linear.x * 0.5",
        "action.angular_velocity_normalized": "/cmd_vel geometry_msgs/msg/Twist angular.z * 0.7",
    }
    words = [word for name, place in places.items() for word in ("-p", f"{name}:={place}")]
    sim = ros.rlservo("ros2-sim", "mir100")
    sim.wait_for("mir100 on ROS 2")
    turns = 0.5 * np.arange(20)
    ros.ask("lead", topic=TARGET, targets=np.stack([np.cos(turns), np.sin(turns)], axis=1).tolist())
    ros.rlservo(
        "ros2", "--bundle", all_shipped / "mir100_navigation", "--name", "mapped", "--autostart", "--ros-args", *words
    )
    for number in range(len(turns)):
        ros.wait_until(lambda number=number: ros.ask("arrived", topic=TARGET) > number)


@pytest.mark.parametrize("name", ["second", "rlservo"])
def test_second_node_on_the_same_topic_is_refused(ros: Ros, node: Process, bundle: Path, name: str) -> None:
    second = ros.rlservo("ros2", "--bundle", bundle, "--name", name, "--ros-args", "-r", f"~/action:={COMMANDS}")
    line = second.wait_for("is already commanded by")
    assert "/rlservo: end it first" in line
    assert second.end(0) == 2
    assert node.process.poll() is None
    assert ros.heartbeat()["state"] != "fault"


def test_mapping_of_no_element_is_one_sentence(ros: Ros, bundle: Path) -> None:
    wrong = ros.rlservo(
        "ros2", "--bundle", bundle, "--name", "wrong", "--ros-args", "-p", "observation.speed:=/x std_msgs/msg/Bool a"
    )
    wrong.wait_for("parameter 'observation.speed' maps no element: expected one of observation.element_0")
    assert wrong.end(0) == 2


CHECK = """
import sys
from rlservo.deploy.ros2.mapped_elements import COMMANDED, READ, Place
from rlservo.robots.arm_interface import RobotError
from rlservo.errors import UsageError
for side, text in (line.split(": ") for line in sys.stdin.read().splitlines()):
    try:
        Place.parse("x", text).check(COMMANDED if side == "action" else READ)
        print("good")
    except (UsageError, RobotError) as error:
        print(error)
"""


def test_mapping_to_a_field_that_does_not_exist_or_is_no_number_is_one_sentence(ros: Ros) -> None:
    wrong = {
        "observation: /imu sensor_msgs/msg/Imu angular_velocity.q": "angular_velocity.q is no field: expected one of",
        "observation: /imu sensor_msgs/msg/Imu angular_velocity": "angular_velocity is geometry_msgs/Vector3: expected",
        "observation: /js sensor_msgs/msg/JointState position": "position is sequence<double>: expected one of",
        "observation: /odom nav_msgs/msg/Odometry twist.twist.linear.x[0]": "x is double: expected an array of",
        "action: /go std_msgs/msg/Int32 data": "data is int32: expected one of double, float",
        "action: /cmd_vel geometry_msgs/msg/Twist linear.x.y": "linear.x.y is no field: expected one of",
        "action: /cmd my_msgs/msg/Wheels left": "the ROS 2 interface 'my_msgs/msg/Wheels' is not installed here",
    }
    good = [
        "observation: /go std_msgs/msg/Int32 data", "observation: /imu sensor_msgs/msg/Imu orientation_covariance[0]",
        "observation: /js sensor_msgs/msg/JointState effort[a]", "observation: /s sensor_msgs/msg/LaserScan ranges[9]",
        "action: /cmd_vel geometry_msgs/msg/TwistStamped twist.linear.x", "action: /a std_msgs/msg/Float32 data",
    ]  # fmt: skip
    checked = subprocess.run(
        [str(PYTHON), "-c", CHECK], input="\n".join([*wrong, *good]), capture_output=True, text=True, timeout=120
    )
    assert checked.returncode == 0, checked.stderr
    lines = checked.stdout.splitlines()
    assert all(said in line for said, line in zip(wrong.values(), lines, strict=False)), lines
    assert lines[len(wrong) :] == ["good"] * len(good)


def test_ros_2_finds_the_package_its_executable_and_launch_file(ros: Ros, wheel: Path, tmp_path: Path) -> None:
    """`ros2 run` and `ros2 launch` look for these places; the tools themselves are no packages of PyPI's."""
    prefix = tmp_path / "environment"
    environment_with(wheel, prefix)
    pip = [sys.executable, "-m", "pip", "--python", str(prefix / "bin" / "python"), "install", "-q"]
    subprocess.run([*pip, "--no-deps", "--no-index", "--force-reinstall", str(wheel)], check=True, timeout=300)
    program = (
        "from ament_index_python.packages import get_package_prefix, get_package_share_directory as share; "
        "print(get_package_prefix('rlservo'), share('rlservo'))"
    )
    variables = os.environ | {"AMENT_PREFIX_PATH": str(prefix)}
    told = subprocess.run([str(PYTHON), "-c", program], env=variables, capture_output=True, text=True, timeout=60)
    assert told.stdout.split() == [str(prefix), str(prefix / "share/rlservo")], told.stderr
    launch = ElementTree.parse(prefix / "share/rlservo/launch/policy.launch.xml").getroot()
    [started] = launch.iter("node")
    shown = subprocess.run(
        [prefix / "lib" / started.attrib["pkg"] / started.attrib["exec"], "--help"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert shown.returncode == 0, shown.stderr
    given = [word for word in started.attrib["args"].split() if word.startswith("--")]
    assert given
    assert all(word in shown.stdout for word in given)


def test_colcon_builds_the_package(ros: Ros, tmp_path: Path) -> None:
    source = Path(__file__).parents[3] / "deploy" / "ros2"
    shutil.copytree(source, tmp_path / "src" / "rlservo", ignore=shutil.ignore_patterns("__pycache__"))
    prefix = PYTHON.parents[1]
    variables = os.environ | {
        "AMENT_PREFIX_PATH": str(prefix), "CMAKE_PREFIX_PATH": str(prefix), "HOME": str(tmp_path),
        "PATH": f"{prefix / 'bin'}:{os.environ['PATH']}",
    }  # fmt: skip
    words = ["build", "--cmake-args", f"-DPython3_EXECUTABLE={PYTHON}"]
    built = subprocess.run(
        [prefix / "bin" / "colcon", *words], cwd=tmp_path, env=variables, capture_output=True, text=True, timeout=300
    )
    assert built.returncode == 0, built.stdout + built.stderr
    installed = tmp_path / "install" / "rlservo"
    assert (installed / "share/rlservo/launch/policy.launch.xml").exists()
    assert (installed / "share/ament_index/resource_index/packages/rlservo").exists()
    there = tmp_path / "bin"  # of an active environment
    there.mkdir()
    (there / "rlservo").write_text('#!/bin/sh\necho "$@"\n')
    (there / "rlservo").chmod(0o755)
    said = subprocess.run(
        [installed / "lib/rlservo/policy", "--bundle", "x"],
        env=os.environ | {"PATH": f"{there}:{os.environ['PATH']}"}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert said.stdout == "ros2 --bundle x\n", said.stderr
