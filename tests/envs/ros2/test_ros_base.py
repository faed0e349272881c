"""A base behind ROS 2: the shipped policy through topics, and what stops the base, with nodes of the real rclpy."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from ros import Process, Ros

TARGETS = int(os.environ.get("RLSERVO_ROS_TARGETS", "2"))
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


def get_moving(ros: Ros, side: float) -> None:
    ros.drive_to(-1.5 * side, 0.0, frame="odom")
    ros.give_target(1.5 * side, 0.0, frame="odom")
    ros.wait_until(lambda: ros.speed() > FAST)


def test_base_reaches_its_targets_and_stands_when_its_process_stops_or_dies(
    ros: Ros, sim: Process, all_shipped: Path
) -> None:
    node = start_node(ros, all_shipped)
    node.wait_for("check -> ready")
    draw, outcomes = np.random.default_rng(5), []
    for _ in range(TARGETS):
        outcomes.append(ros.drive_to(*draw.uniform(-1.0, 1.0, 2).tolist(), frame="odom")["message"])
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
