"""Targets as goals of an action, with a client of the real rclpy: result, feedback, cancelling, refusals."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest

from ros import STANDS, Process, Ros

ACTION, KIND = "/rlservo/navigate_to_pose", "nav2_msgs/action/NavigateToPose"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6  # of action_msgs/msg/GoalStatus
NEAR = (0.0, 0.26, 0.7)  # [m], 0.14 m from where the tool starts; success is 0.1 m
ASIDE = (0.0, 0.37, 0.7)  # [m], from where the arm returns to its start by 0.9 rad
FAST = 0.2  # [rad/s]
STOPPING_S = 0.4 + 1.0  # a cycle and a busy machine, and braking


@pytest.fixture(scope="module")
def sim(ros: Ros) -> Process:
    sim = ros.rlservo("ros2-sim", "ur5")
    sim.wait_for("ur5 on ROS 2")
    ros.watch("/joint_states", "sensor_msgs/msg/JointState")
    ros.ask("subscribe", topic="/rosout", kind="rcl_interfaces/msg/Log")
    return sim


@pytest.fixture
def node(ros: Ros, sim: Process, all_shipped: Path, nodes: list[Process]) -> Process:
    """A node whose options are parameters; tests share it until one ends it."""
    if not nodes or nodes[-1].process.poll() is not None:
        options = ("--env-arg", "ur_model=ur5", "--env-arg", 'limits={"blend_s": 0.1}')
        parameters = ("--ros-args", "-p", "unproven:=true", "-p", "autostart:=true")
        nodes.append(ros.rlservo("ros2", "--bundle", all_shipped / "ur_positioning", *options, *parameters))
        nodes[-1].wait_for("check -> ready")
    elif ros.heartbeat()["state"] == "fault":  # of a test before, on a machine that did not run the simulator for 2 s
        restart(ros)
    return nodes[-1]


def far(turn: float) -> tuple[float, float, float]:
    """Return a target [m], `turn` [rad] from where the arm points at its start."""
    return -0.5 * math.cos(turn), -0.5 * math.sin(turn), 0.4


def send(ros: Ros, place: tuple[float, float, float], frame: str = "base_link", **rest: Any) -> int | None:
    x, y, z = place
    pose = {"header": {"frame_id": frame}, "pose": {"position": {"x": x, "y": y, "z": z}}}
    number: int | None = ros.ask("send_goal", action=ACTION, kind=KIND, values={"pose": pose, **rest})
    return number


def begin(ros: Ros, turn: float) -> int:
    """Send a goal and wait until the policy moves the arm fast towards it."""
    number = send(ros, far(turn))
    assert number is not None
    ros.wait_until(lambda: ros.ask("goal", number=number)["count"] > 0 and ros.speed() > FAST)
    return number


def ended(ros: Ros, number: int) -> dict[str, Any]:
    ros.wait_until(lambda: ros.ask("goal", number=number)["ended_s"] is not None)
    goal: dict[str, Any] = ros.ask("goal", number=number)
    return goal


def stood_at(ros: Ros, moment_s: float) -> bool:
    """Return whether the arm stood at a moment, by the two states around it."""
    states = ros.ask("since", topic="/joint_states", time_s=moment_s - 0.1)
    near = [state for at, state in states if abs(at - moment_s) < 0.1]
    return bool(near) and max(abs(speed) for state in near for speed in state["velocity"]) < 5 * STANDS


def restart(ros: Ros) -> None:
    ros.ask("call", service="/rlservo/start")
    ros.wait_until(lambda: ros.heartbeat()["state"] in ("waiting", "arrived", "running"))


def test_goal_is_reached_with_feedback_and_its_result_comes_when_the_arm_stands(ros: Ros, node: Process) -> None:
    number = send(ros, NEAR)
    assert number is not None
    goal = ended(ros, number)
    assert goal["status"] == SUCCEEDED and goal["result"] == {"error_code": 0, "error_msg": "arrived: success"}
    assert stood_at(ros, goal["ended_s"])
    assert goal["count"] > 3
    feedback = goal["feedback"]
    place = feedback["current_pose"]["pose"]["position"]
    assert feedback["current_pose"]["header"]["frame_id"] == "base_link"
    assert feedback["distance_remaining"] == pytest.approx(
        math.dist((place["x"], place["y"], place["z"]), NEAR), abs=1e-4
    )
    assert feedback["distance_remaining"] < 0.1
    assert 0.0 < feedback["navigation_time"]["sec"] + feedback["navigation_time"]["nanosec"] * 1e-9 < 60.0


def test_cancelled_goal_brakes_and_ends_once_the_arm_stands(ros: Ros, node: Process) -> None:
    number = begin(ros, 1.2)
    cancelled = ros.ask("cancel", number=number)
    assert cancelled["count"] == 1
    goal = ended(ros, number)
    assert goal["status"] == CANCELED
    assert stood_at(ros, goal["ended_s"])
    assert ros.moved_for(cancelled["sent_s"]) < STOPPING_S
    assert ros.heartbeat()["message"].startswith("waiting")
    assert ros.ask("cancel", number=number)["count"] == 0  # again


def test_goal_is_cancelled_on_the_way_to_the_start_while_held_and_while_a_person_leads(ros: Ros, node: Process) -> None:
    number = send(ros, ASIDE)
    assert number is not None and ended(ros, number)["status"] == SUCCEEDED
    number = send(ros, far(-1.2))  # the arm returns to its start first
    assert number is not None
    ros.wait_until(lambda: ros.speed() > FAST)
    cancelled = ros.ask("cancel", number=number)
    goal = ended(ros, number)
    assert goal["status"] == CANCELED and goal["count"] == 0  # the policy never drove
    assert ros.moved_for(cancelled["sent_s"]) < STOPPING_S

    number = begin(ros, -1.2)
    ros.ask("call", service="/rlservo/hold")
    ros.wait_until(lambda: ros.heartbeat()["state"] == "holding")
    assert ros.ask("goal", number=number)["ended_s"] is None  # it is due until the node is started
    assert send(ros, NEAR) is None
    assert ros.ask("cancel", number=number)["count"] == 1
    assert ended(ros, number)["status"] == CANCELED
    restart(ros)
    time.sleep(1.0)
    assert ros.speed() < STANDS

    number = begin(ros, 1.2)
    ros.ask("call", service="/rlservo/take_over")
    ros.wait_until(lambda: ros.heartbeat()["state"] == "human")
    assert ros.ask("cancel", number=number)["count"] == 1
    assert ended(ros, number)["status"] == CANCELED
    ros.ask("call", service="/rlservo/hand_back")
    ros.wait_until(lambda: ros.heartbeat()["state"] != "human")
    assert ros.speed() < STANDS


def test_newer_target_of_either_kind_replaces_a_goal(ros: Ros, node: Process) -> None:
    first = begin(ros, 1.2)
    second = begin(ros, 0.9)
    goal = ended(ros, first)
    assert goal["status"] == ABORTED and goal["result"]["error_msg"] == "a newer target replaced it"
    assert ros.ask("goal", number=second)["ended_s"] is None
    ros.give_target(*NEAR)
    assert ended(ros, second)["status"] == ABORTED
    ros.wait_until(lambda: ros.heartbeat()["state"] == "arrived")


def test_goals_that_cannot_be_meant_are_rejected_or_aborted_without_a_motion(ros: Ros, node: Process) -> None:
    ros.wait_until(lambda: ros.speed() < STANDS)  # after the test before
    began_s = time.time()
    assert send(ros, (math.nan, 0.0, 0.4)) is None
    assert send(ros, (0.1, math.inf, 0.4)) is None
    assert send(ros, NEAR, frame="map") is None
    assert send(ros, NEAR, behavior_tree="other.xml") is None
    out_of_reach = send(ros, (0.0, 9.0, 0.4))
    assert out_of_reach is not None
    goal = ended(ros, out_of_reach)
    assert goal["status"] == ABORTED and "outside" in goal["result"]["error_msg"]
    states = ros.ask("since", topic="/joint_states", time_s=began_s)
    assert max(abs(speed) for _, state in states for speed in state["velocity"]) < STANDS

    def said() -> bool:
        lines = [one["msg"] for _, one in ros.ask("since", topic="/rosout", time_s=began_s) if one["name"] == "rlservo"]
        return all(any(text in line for line in lines) for text in ("nan, 0, 0.4 m", "frame 'map'", "'other.xml'"))

    ros.wait_until(said)


def test_stopped_node_aborts_its_goal_and_a_started_one_does_not_resume_it(ros: Ros, node: Process) -> None:
    number = begin(ros, 1.2)
    called = ros.ask("call", service="/rlservo/stop")
    goal = ended(ros, number)
    assert goal["status"] == ABORTED and "stop service" in goal["result"]["error_msg"]
    assert ros.moved_for(called["sent_s"]) < STOPPING_S
    assert send(ros, NEAR) is None
    restart(ros)
    time.sleep(1.0)
    assert ros.speed() < STANDS


def test_fault_aborts_the_goal_with_its_reason(ros: Ros, sim: Process, node: Process) -> None:
    number = begin(ros, -1.2)
    sim.type("protective")
    try:
        goal = ended(ros, number)
        assert goal["status"] == ABORTED and "protective_stop" in goal["result"]["error_msg"]
        ros.wait_until(lambda: ros.heartbeat()["state"] == "fault")
        assert send(ros, NEAR) is None
    finally:
        resend = "/io_and_status_controller/resend_robot_program"
        ros.wait_until(lambda: (sim.type("unlock"), ros.ask("call", service=resend)["success"])[1])
    restart(ros)


def test_goal_of_a_dead_client_goes_on_and_that_of_an_ended_node_is_aborted(
    ros: Ros, node: Process, nodes: list[Process]
) -> None:
    client = ros.python("-c", CLIENT)
    client.wait_for("accepted")
    ros.wait_until(lambda: ros.speed() > FAST)
    client.process.kill()
    ros.wait_until(lambda: ros.heartbeat()["state"] == "arrived")

    number = begin(ros, 1.2)
    began_s = time.time()
    assert node.end() == 0
    assert ros.moved_for(began_s) < STOPPING_S
    assert ended(ros, number)["status"] == ABORTED


def test_killed_node_leaves_a_standing_arm_while_a_goal_runs(ros: Ros, node: Process) -> None:
    begin(ros, 1.2)
    began_s = time.time()
    node.process.kill()
    assert ros.moved_for(began_s) < STOPPING_S


CLIENT = """
import time, rclpy
from rclpy.action import ActionClient
from nav2_msgs.action import NavigateToPose
rclpy.init()
node = rclpy.create_node("client")
client = ActionClient(node, NavigateToPose, "/rlservo/navigate_to_pose")
client.wait_for_server()
goal = NavigateToPose.Goal()
goal.pose.header.frame_id = "base_link"
goal.pose.pose.position.y, goal.pose.pose.position.z = 0.37, 0.7
sent = client.send_goal_async(goal)
rclpy.spin_until_future_complete(node, sent)
print("accepted" if sent.result().accepted else "rejected", flush=True)
time.sleep(60)
"""
