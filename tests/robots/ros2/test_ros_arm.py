"""An arm behind ROS 2: the shipped policy through topics, and what stops the arm, with nodes of the real rclpy."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from rlservo.robots.simulated.ur_controller.controller import DEVIATIONS
from rlservo.robots.ur.calibration import data_sheet, deviation_m, frames_of
from ros import STANDS, Process, Ros, SlowServer
from servers import over_uvicorn

ANYWHERE = int(os.environ.get("RLSERVO_ROS_TARGETS", "0"))  # targets all over the workspace, for a long run
TARGETS = 20
START = {"shoulder_pan": 0.0, "shoulder_lift": -2.5, "elbow": 1.5, "wrist_1": -1.5, "wrist_2": -1.4}  # [rad]
START_TOOL = np.array([0.0, 0.12, 0.7])  # [m]
ASIDE, BELOW = START_TOOL + (0.0, 0.25, 0.0), START_TOOL - (0.0, 0.0, 0.25)  # joints turn by 0.9 and 0.8 rad
PREFIX = "left_"
COMMANDS = "/forward_position_controller/commands"
RESEND = "/io_and_status_controller/resend_robot_program"
FAST = 0.2  # [rad/s]
BRAKING_S = 1.0  # at 5 rad/s^2, servoj's lag and a busy machine


@pytest.fixture(scope="module")
def sim(ros: Ros) -> Process:
    """A UR5 whose joints have a prefix; its driver's joint states are in another order than ours."""
    sim = ros.rlservo("ros2-sim", "ur5", "--prefix", PREFIX, "--calibrated")
    sim.wait_for("ur5 on ROS 2")
    ros.watch("/joint_states", "sensor_msgs/msg/JointState")
    return sim


@pytest.fixture
def node(ros: Ros, sim: Process, all_shipped: Path, nodes: list[Process]) -> Process:
    """The node of a shipped policy; tests share it until one ends it."""
    if not nodes or nodes[-1].process.poll() is not None:
        nodes.append(start_node(ros, all_shipped))
    return nodes[-1]


@pytest.fixture
def free_arm(sim: Process, nodes: list[Process]) -> None:
    """An arm that no node commands."""
    for one in nodes:
        one.close()


def start_node(ros: Ros, all_shipped: Path, *options: object, url: str = "") -> Process:
    source = ("--url", url) if url else ("--bundle", all_shipped / "ur_positioning")
    return ros.rlservo(
        "ros2", *source, "--robot", f"ros2:prefix={PREFIX}",
        "--env-arg", "ur_model=ur5", "--env-arg", 'limits={"blend_s": 0.1}', "--unproven", "--autostart", *options,
    )  # fmt: skip


def place(turn: float, radius: float = 0.5, height: float = 0.4) -> tuple[float, float, float]:
    """Return a target [m], `turn` [rad] from where the arm points at its start."""
    return -radius * math.cos(turn), -radius * math.sin(turn), height


def restart(ros: Ros) -> None:
    """Call the start service, as a person does after a fault."""
    ros.ask("call", service="/rlservo/start")
    ros.wait_until(lambda: ros.heartbeat()["state"] == "waiting")


def get_moving(ros: Ros) -> None:
    """Send the arm far to one side and wait until the policy moves it fast."""
    ros.begin_driving(*place(1.2))
    ros.wait_until(lambda: ros.speed() > FAST)


def get_returning(ros: Ros) -> None:
    """Let the arm return to its start and wait until it is fast."""
    ros.drive_to(*ASIDE)
    ros.wait_until(lambda: ros.speed() < STANDS)
    ros.give_target(*place(-1.2))
    ros.wait_until(lambda: ros.speed() > FAST)


def near_start(draw: np.random.Generator) -> tuple[float, float, float]:
    """Return a target [m] that the tool reaches from its start in a second or two: success is 0.1 m."""
    way = draw.normal(size=3)
    x, y, z = START_TOOL + way / np.linalg.norm(way) * draw.uniform(0.12, 0.17)
    return x, y, z


def anywhere(draw: np.random.Generator) -> tuple[float, float, float]:
    return place(draw.uniform(-1.0, 1.0), draw.uniform(0.35, 0.6), draw.uniform(0.15, 0.5))


def was_at_start(ros: Ros, began_s: float) -> bool:
    """Return whether the arm was at the pose in which the policy's episodes begin, since a moment."""
    for _, state in ros.ask("since", topic="/joint_states", time_s=began_s):
        joints = dict(zip(state["name"], state["position"], strict=True))
        if all(abs(joints[f"{PREFIX}{name}_joint"] - angle) < 0.05 for name, angle in START.items()):
            return True
    return False


def test_policy_reaches_its_targets_through_topics(ros: Ros, sim: Process, node: Process, all_shipped: Path) -> None:
    node.wait_for("check -> ready")
    draw = np.random.default_rng(5)
    targets = [near_start(draw) for _ in range(TARGETS)] + [anywhere(draw) for _ in range(ANYWHERE)]
    outcomes = [ros.drive_to(*target)["message"] for target in targets]
    assert outcomes.count("arrived: success") >= len(outcomes) - len(outcomes) // 20, outcomes

    assert ros.drive_to(*ASIDE)["message"] == "arrived: success"
    began_s = time.time()
    assert ros.drive_to(*BELOW)["message"] == "arrived: success"
    assert was_at_start(ros, began_s)
    assert ros.ask("call", service="/rlservo/version")["message"].split()[1] == "1"

    began_s = time.time()
    ros.give_target(float("nan"), 0.0, 0.4)
    ros.wait_until(lambda: ros.heartbeat()["message"].startswith("refused: the target is nan, 0, 0.4 m"))
    states = [state for _, state in ros.ask("since", topic="/joint_states", time_s=began_s)]
    assert max(abs(speed) for state in states for speed in state["velocity"]) < STANDS
    assert ros.drive_to(*BELOW)["message"] == "arrived: success"

    second = start_node(ros, all_shipped, "--name", "second")
    second.wait_for("commanded by")
    assert second.end(0) == 2
    assert "/forward_position_controller/commands" in second.lines[-1]
    assert ros.heartbeat()["state"] == "arrived"  # the first node continues

    for begin in (get_moving, get_returning):
        begin(ros)
        held = ros.ask("call", service="/rlservo/hold")
        assert ros.moved_for(held["sent_s"]) < 0.4 + BRAKING_S
        ros.wait_until(lambda: ros.heartbeat()["state"] == "holding")
        ros.ask("call", service="/rlservo/start")
        ros.wait_until(lambda: ros.speed() > FAST / 2)

    children = node.children()
    assert node.end(signal.SIGINT) == 0
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]


def test_late_stamps_and_a_lost_topic_stop_the_arm(ros: Ros, sim: Process, node: Process) -> None:
    node.wait_for("check -> ready")
    try:
        get_moving(ros)
        seen, began_s = len(node.lines), time.time()
        sim.type("latency 300")  # the states that come are 0.3 s old, and their stamps say so
        assert ros.moved_for(began_s) < 0.3 + 0.25 + BRAKING_S
        node.wait_for("fault: the robot's newest state is 0.3", after=seen)
        sim.type("latency 0")

        restart(ros)
        get_moving(ros)
        seen, began_s = len(node.lines), time.time()
        sim.type("down")
        node.wait_for("connection_lost", after=seen)
        sim.type("up")
        ros.wait_until(lambda: ros.ask("since", topic="/joint_states", time_s=began_s + 1.0, count=1) != [])
        assert ros.speed() < FAST / 10
        restart(ros)
        get_moving(ros)
    finally:
        sim.type("latency 0")
        sim.type("up")


def test_process_that_does_not_run_stops_the_arm_and_goes_on_later(ros: Ros, sim: Process, node: Process) -> None:
    node.wait_for("check -> ready")
    for begin, is_stream in ((get_moving, False), (get_moving, True), (get_returning, False)):
        begin(ros)
        silence_s = 0.0 if is_stream else 0.25
        pid = node.children()[0] if is_stream else node.process.pid
        began_s = time.time()
        os.kill(pid, signal.SIGSTOP)
        try:
            assert ros.moved_for(began_s) < silence_s + BRAKING_S
        finally:
            os.kill(pid, signal.SIGCONT)
    get_moving(ros)


def test_stopped_robot_does_not_move_again_before_the_start_service_is_called(
    ros: Ros, sim: Process, node: Process
) -> None:
    node.wait_for("check -> ready")
    get_moving(ros)
    seen = len(node.lines)  # of the tests before, which share the node
    sim.type("protective")
    try:
        node.wait_for("fault: protective_stop", after=seen)
        seen = len(node.lines)
        ros.give_target(*place(0.0))
        ros.wait_until(lambda: ros.heartbeat()["message"].startswith("fault: protective_stop"))
    finally:
        ros.wait_until(lambda: (sim.type("unlock"), ros.ask("call", service=RESEND)["success"])[1])
    again = len(node.lines)  # or it is the first target's
    ros.give_target(*place(1.2))
    node.wait_for("call the start service first", after=again)
    assert not [line for line in node.lines[seen:] if "ready" in line]
    assert ros.speed() < STANDS
    restart(ros)
    get_moving(ros)


def test_person_takes_the_arm_over_and_hands_it_back_at_services(ros: Ros, sim: Process, node: Process) -> None:
    get_moving(ros)
    called = ros.ask("call", service="/rlservo/take_over")
    assert called["success"]
    ros.wait_until(lambda: ros.heartbeat()["state"] == "human")
    assert ros.speed() < STANDS
    assert ros.moved_for(called["sent_s"]) < 0.4 + BRAKING_S
    assert ros.ask("call", service="/rlservo/take_over")["success"]  # again: it stays with the person
    assert ros.heartbeat()["state"] == "human"
    assert ros.ask("call", service="/rlservo/hand_back")["success"]
    ros.wait_until(lambda: ros.heartbeat()["state"] not in ("human", "hold"))


def test_killed_processes_leave_a_standing_arm(ros: Ros, sim: Process, node: Process) -> None:
    node.wait_for("check -> ready")
    get_moving(ros)
    stream = node.children()[0]
    seen, began_s = len(node.lines), time.time()
    os.kill(stream, signal.SIGKILL)
    assert ros.moved_for(began_s) < BRAKING_S
    node.wait_for("was killed", after=seen)
    restart(ros)
    get_moving(ros)  # with a new one
    stream = node.children()[0]
    began_s = time.time()
    node.process.kill()
    assert ros.moved_for(began_s) < BRAKING_S
    ros.wait_until(lambda: not Path(f"/proc/{stream}").exists())


def test_slow_server_holds_the_arm_instead_of_moving_it_late(
    ros: Ros, free_arm: None, all_shipped: Path, tmp_path: Path
) -> None:
    (tmp_path / "ur_positioning").symlink_to(all_shipped / "ur_positioning")
    app = SlowServer(tmp_path)
    with over_uvicorn(app) as port:
        node = start_node(ros, all_shipped, url=f"http://127.0.0.1:{port}")
        node.wait_for("check -> ready")
        get_moving(ros)
        began_s, app.delay_s = time.time(), 0.6
        assert ros.moved_for(began_s) < 0.35 + BRAKING_S  # a cycle, and 2.5 of silence
        ros.wait_until(lambda: ros.heartbeat()["state"] == "hold")
        assert ros.speed() < STANDS
        app.delay_s = 0.0
        ros.wait_until(lambda: ros.speed() > FAST / 2)  # to the same target
    ros.wait_until(lambda: "cannot be reached" in ros.heartbeat()["message"])
    seen, until_s = len(node.lines), time.monotonic() + 2.0
    while time.monotonic() < until_s:
        node.read(0.2)
    assert len(node.lines) <= seen + 3  # not in each cycle
    assert node.end() == 0


def test_latency_of_the_arm_is_measured_through_topics(ros: Ros, free_arm: None) -> None:
    words = ("robot-latency", f"ros2:prefix={PREFIX}", "--ur-model", "ur5", "--steps", 5, "--yes", "--json")
    measuring = ros.rlservo(*words)
    assert measuring.end(0) == 0, measuring.lines
    text = "\n".join(measuring.lines)
    report = json.loads(text[text.index("{\n") :])
    assert report["steps"] == 5
    assert 0.0 < report["p50_ms"] <= report["max_ms"]
    assert report["disturbance"] == f"latency={report['cycles']},noise=real"


def test_second_node_that_comes_later_is_a_fault_of_the_arm(ros: Ros, free_arm: None, all_shipped: Path) -> None:
    states = {"name": [f"{PREFIX}{name}_joint" for name in START], "position": list(START.values())}
    for topic, kind, values, reason in (
        (COMMANDS, "std_msgs/msg/Float64MultiArray", {"data": []}, f"second_commander: {COMMANDS} is also"),
        (
            "/joint_states",
            "sensor_msgs/msg/JointState",
            states,
            "second_publisher: /joint_states comes from /bystander",
        ),
    ):
        node = start_node(ros, all_shipped)
        node.wait_for("check -> ready")
        get_moving(ros)
        ros.ask("publish", topic=topic, kind=kind, values=values)
        node.wait_for(f"fault: {reason}")
        assert node.end() == 0
        ros.ask("withdraw", topic=topic)


def check(ros: Ros, *options: object) -> tuple[int, dict[str, dict[str, str]]]:
    """Return robot-check's exit code and findings by name."""
    process = ros.rlservo("robot-check", f"ros2:prefix={PREFIX}", "--json", *options)
    code = process.end(0)
    text = "\n".join(process.lines)
    return code, {one["what"]: one for one in json.loads(text[text.index("{") :])["findings"]}


def test_robot_check_describes_an_arm_on_ros_and_says_what_is_missing(ros: Ros, sim: Process, free_arm: None) -> None:
    code, found = check(ros, "--ur-model", "ur5")
    assert code == 0, found
    assert found["model"]["found"] == "ur5 (given)" and found["robot mode"]["found"] == "running"
    off = 1e3 * deviation_m("ur5", frames_of(data_sheet("ur5") + DEVIATIONS))
    assert found["calibration"]["found"] == f"description: the flange is up to {off:.1f} mm from the data sheet's"
    process = ros.rlservo("robot-check", f"ros2:prefix={PREFIX}", "--ur-model", "ur10e")
    assert process.end(0) == 2
    assert "m from a ur10e's: expected 0.03 m at most: is the model right" in "".join(process.lines)
    code, found = check(ros, "--ur-model", "ur99")
    assert code == 1 and "expected one of ur3, ur3e" in found["model"]["problem"]
    sim.type("slider 0")
    try:
        code, found = check(ros, "--ur-model", "ur5")
        assert code == 1 and found["speed slider"]["problem"] == "raise it on the pendant"
    finally:
        sim.type("slider 1")
