"""A base behind ROS 2: the shipped policy through topics, and what stops the base, with nodes of the real rclpy."""

from __future__ import annotations

import math
import os
import signal
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.policy.policy import Policy
from ros import STANDS, Process, Ros

EPISODES = int(os.environ.get("RLSERVO_ROS_TARGETS", "0"))  # of each policy beside the simulator, for a long run
TARGETS = 20
FAST = 0.2  # [m/s]
TIMEOUT_S = 0.5  # of the base's own drive
BRAKING_S = 1.0  # from 0.5 m/s, and a busy machine


@pytest.fixture(scope="module")
def sim(ros: Ros) -> Process:
    sim = ros.rlservo("ros2-sim", "mir100", "--twist", "TwistStamped")
    sim.wait_for("mir100 on ROS 2")
    ros.watch("/odom", "nav_msgs/msg/Odometry")
    return sim


def start_node(ros: Ros, all_shipped: Path, *options: object) -> Process:
    return ros.rlservo(
        "ros2", "--bundle", all_shipped / "mir100_navigation", "--env-arg", 'limits={"stop_distance": 0}', "--unproven",
        "--autostart", *options,
    )  # fmt: skip


def position(graph: Ros) -> tuple[float, float]:
    """Return where the base is [m]."""
    states = graph.ask("since", topic="/odom", time_s=0.0, count=1)
    place = states[-1][1]["pose"]["pose"]["position"] if states else {"x": math.nan, "y": math.nan}
    return place["x"], place["y"]


@pytest.mark.skipif(not EPISODES, reason="takes minutes: RLSERVO_ROS_TARGETS=100 asks for 100 episodes")
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(
    ("name", "env_id", "world"),
    [
        ("mir100_navigation", "NoObstacleNavigationMir100Sim-v0", "empty"),
        ("mir100_obstacle_avoidance", "ObstacleAvoidanceMir100Sim-v0", "lab_6x8"),
    ],
)
def test_policy_succeeds_through_topics_as_often_as_in_the_simulator(
    name: str, env_id: str, world: str, all_shipped: Path
) -> None:
    env = gym.make(f"rlservo.envs:rlservo/{env_id}", disable_env_checker=True)
    simulation: Any = env.unwrapped.simulation  # type: ignore[attr-defined]
    policy = Policy.load(all_shipped / name / "1")
    outcomes: Counter[tuple[str, str]] = Counter()
    with policy, closing(env), closing(Ros()) as graph:
        sim = graph.rlservo("ros2-sim", "mir100", "--world", world)
        sim.wait_for("mir100 on ROS 2")
        graph.watch("/odom", "nav_msgs/msg/Odometry")
        node = graph.rlservo("ros2", "--bundle", all_shipped / name, "--unproven", "--autostart")
        node.wait_for("check -> ready")
        for seed in range(EPISODES):
            observation, _ = env.reset(seed=seed)
            policy.reset()
            start, (x, y, _) = simulation.pose, simulation.target
            graph.wait_until(lambda: graph.speed() < STANDS)
            for index, cube in enumerate(simulation.cubes):
                sim.type(" ".join(map(str, ("cube", index, *cube))))
            sim.type("place " + " ".join(map(str, start)))
            graph.wait_until(lambda start=start: position(graph) == pytest.approx(start[:2], abs=1e-3))
            is_over, info = False, {}
            while not is_over:
                observation, _, terminated, truncated, info = env.step(policy.act(observation))
                is_over = terminated or truncated
            there = graph.drive_to(x, y, frame="odom")["message"]
            outcomes[info["final_status"], there] += 1
            print(seed, info["final_status"], there, flush=True)
    print(name, dict(outcomes))
    simulated = sum(count for (status, _), count in outcomes.items() if status == "success")
    through_topics = sum(count for (_, message), count in outcomes.items() if message == "arrived: success")
    assert through_topics >= simulated - 0.02 * EPISODES, outcomes


def get_moving(ros: Ros, side: float) -> None:
    ros.drive_to(-1.5 * side, 0.0, frame="odom")
    ros.give_target(1.5 * side, 0.0, frame="odom")
    ros.wait_until(lambda: ros.speed() > FAST)


def test_base_reaches_its_targets_and_stands_when_its_process_stops_or_dies(
    ros: Ros, sim: Process, all_shipped: Path
) -> None:
    node = start_node(ros, all_shipped)
    node.wait_for("check -> ready")
    draw = np.random.default_rng(5)
    around = [draw.uniform(0.8, 1.2) * np.array([math.cos(turn), math.sin(turn)]) for turn in 0.5 * np.arange(TARGETS)]
    outcomes = [ros.drive_to(*target.tolist(), frame="odom")["message"] for target in around]
    assert outcomes.count("arrived: success") >= len(outcomes) - len(outcomes) // 20, outcomes

    second = start_node(ros, all_shipped, "--name", "second")
    second.wait_for("/cmd_vel is already commanded by")
    assert second.end(0) == 2

    ros.give_target(20.0, 0.0, frame="map")
    node.wait_for("a target in frame 'map' was ignored: expected 'odom'")

    get_moving(ros, 1.0)
    began_s = time.time()
    node.process.send_signal(signal.SIGSTOP)
    try:
        assert ros.moved_for(began_s) < TIMEOUT_S + BRAKING_S
    finally:
        node.process.send_signal(signal.SIGCONT)
    get_moving(ros, 1.0)
    began_s = time.time()
    node.process.kill()
    assert ros.moved_for(began_s) < TIMEOUT_S + BRAKING_S


def test_stale_inputs_are_said_while_they_are_waited_for(ros: Ros, sim: Process, all_shipped: Path) -> None:
    node = start_node(ros, all_shipped)
    node.wait_for("check -> ready")
    get_moving(ros, 1.0)
    began_s = time.time()
    sim.type("latency 900")
    try:
        ros.wait_until(lambda: ros.heartbeat()["state"] == "hold")
        assert time.time() - began_s < 3.0  # a fault comes after 5
        node.wait_for("running -> hold: the robot's newest state is 0.")
    finally:
        sim.type("latency 0")
    ros.wait_until(lambda: ros.heartbeat()["state"] in ("running", "arrived"))
    assert node.end() == 0


def test_second_node_that_comes_later_on_its_commands_or_odometry_is_a_fault(
    ros: Ros, sim: Process, all_shipped: Path
) -> None:
    for topic, kind, values, reason in (
        (
            "/cmd_vel",
            "geometry_msgs/msg/TwistStamped",
            {"twist": {"linear": {"x": 0.8}}},
            "second_commander: /cmd_vel is",
        ),
        ("/odom", "nav_msgs/msg/Odometry", {"child_frame_id": "base_link"}, "second_publisher: /odom comes from /bys"),
    ):
        node = start_node(ros, all_shipped)
        node.wait_for("check -> ready")
        get_moving(ros, 1.0)
        began_s = time.time()
        ros.ask("publish", topic=topic, kind=kind, values=values)
        node.wait_for(f"fault: {reason}")
        ros.wait_until(lambda: ros.heartbeat()["state"] == "fault")
        assert ros.moved_for(began_s) < TIMEOUT_S + 2.0 * BRAKING_S
        assert node.end() == 0
        ros.ask("withdraw", topic=topic)


def test_scans_are_placed_by_static_frames_of_two_nodes_that_come_late(all_shipped: Path) -> None:
    """The scanners hang on a mast of another node's; where they are is from the MiR100's own description."""
    with closing(Ros()) as graph:
        sim = graph.rlservo("ros2-sim", "mir100", "--world", "lab_6x8")  # its base starts at 0, 2.6
        sim.wait_for("mir100 on ROS 2")
        graph.watch("/odom", "nav_msgs/msg/Odometry")
        sim.type("cube 0 1.45 3.0 0")  # its near side is at the target
        node = graph.rlservo(
            "ros2", "--bundle", all_shipped / "mir100_obstacle_avoidance", "--unproven", "--autostart",
            "--ros-args", "-r", "/tf_static:=/frames",
        )  # fmt: skip
        turn = math.pi / 2.0
        graph.ask("send_frames", topic="/frames", parent="base_link", frames={"mast": (0.1, 0.0, turn)})
        time.sleep(1.0)
        # The same places as in base_link: (0.4288, 0.2358) turned by 45 degrees, (-0.3548, -0.2352) by 225.
        front, back = (0.2358, -0.3288, math.pi / 4 - turn), (-0.2352, 0.4548, -3 * math.pi / 4 - turn)
        frames = {"front_laser_link": front, "back_laser_link": back}
        graph.ask("send_frames", topic="/frames", parent="mast", frames=frames)
        node.wait_for("check -> ready")
        graph.give_target(1.2, 3.0, frame="odom")
        node.wait_for("refused: reset option 'target_pose': the scan shows something at the target")
        sim.type("cube 0 -1.2 3.0 0")
        graph.begin_driving(1.2, 3.0, frame="odom")
