"""A ROS 2 bag beside the flight recorder's file of the same run."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import numpy as np

from bundles import write_box_policy
from command_line import rlservo_here
from rlservo.policy.policy import Policy
from rlservo.recording.recorded_policy import WithRecording
from ros import PYTHON, Ros

# As `ros2 bag record` does it: rosbag2's own layout, by another implementation of it.
WRITE_BAG = """
import sys, time
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS2_JAZZY)
Text = store.types["std_msgs/msg/String"]
with Writer(sys.argv[1], version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    topic = writer.add_connection("/chatter", Text.__msgtype__, typestore=store)
    for _ in range(3):
        writer.write(topic, time.time_ns(), store.serialize_cdr(Text("x"), Text.__msgtype__))
"""


def test_log_info_tells_a_bag_from_a_recording_and_puts_them_on_one_time(ros: Ros, tmp_path: Path) -> None:
    bag, run = tmp_path / "bag", tmp_path / "run.mcap"
    subprocess.run([str(PYTHON), "-c", WRITE_BAG, str(bag)], check=True, timeout=120)
    with WithRecording(Policy.load(write_box_policy(tmp_path)), run) as policy:
        policy.act(np.zeros(27, np.float32))
    told = rlservo_here("log", "info", run, bag)
    assert told.returncode == 0, told.stderr
    lines = told.stdout.splitlines()
    assert "run.mcap: 1 messages, whole" in lines[0]
    assert "a ROS 2 bag, 3 messages over" in lines[1]
    assert "s of the first decision (/chatter 3), whole" in lines[1]

    facts = json.loads(rlservo_here("log", "info", run, bag, "--json").stdout)
    assert [file["profile"] for file in facts["files"]] == ["rlservo", "ros2"]
    decision_s, bag_s = facts["policies"][0]["first_s"], facts["files"][1]["bag_first_s"]
    assert abs(decision_s - time.time()) < 120
    assert 0.0 <= decision_s - bag_s < 120  # the bag was written first

    refused = rlservo_here("log", "plot", bag)
    assert refused.returncode == 1
    assert "holds no rlservo decisions: its topics are /chatter" in refused.stderr
