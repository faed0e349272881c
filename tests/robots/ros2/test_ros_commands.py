"""Commands: the arm keeps up, stands when their process is killed, and what no subscriber gets is a fault."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from ros import ROOT, Ros

BRAKING_S = 2.0  # the guard's 0.1 s of silence, braking, and a busy machine; without a guard it never stops
PROGRAM = """
import sys, time
import numpy as np
from rlservo.robots.limits import Limits
from rlservo.robots.arm_process import ArmProcess
arm = ArmProcess("ros2:command=" + sys.argv[1], "ur5", velocity_scale=0.1, limits=Limits.of({"blend_s": 0.1}))
print("stream", arm.pid, flush=True)
start, began = arm.arm_state().positions, time.monotonic()
while not arm.fault:
    side = 1.0 if (time.monotonic() - began) % 7.0 < 3.5 else -1.0
    arm.command(start + np.array([side * 3.0, 0, 0, 0, 0, 0]), 3.0)
    time.sleep(0.05)
print("fault", arm.fault, flush=True)
arm.close()
"""


@pytest.mark.parametrize("how", ["velocity", "trajectory"])
def test_killed_stream_leaves_a_standing_arm_with(how: str, ros: Ros) -> None:
    sim = ros.rlservo("ros2-sim", "ur5", "--controller", how)
    sim.wait_for(f"{how} controller")
    ros.wait_until(lambda: set(ros.ask("publishers", topic="/joint_states")) == {"ur_ros2_driver_sim"})
    ros.watch("/joint_states", "sensor_msgs/msg/JointState")
    driver = ros.python("-c", PROGRAM, how)
    stream = int(driver.wait_for("stream").split()[1])
    helpers = [int(pid) for pid in Path(f"/proc/{stream}/task/{stream}/children").read_text().split()]
    assert len(helpers) == (1 if how == "velocity" else 0)
    ros.wait_until(lambda: ros.speed() > 0.2)
    time.sleep(4.0)  # it has turned back; if it fell back behind its setpoint, it counts as not following by then
    ros.wait_until(lambda: ros.speed() == pytest.approx(0.1 * np.pi, rel=0.05))
    sim.type("slider 0.5")
    ros.wait_until(lambda: ros.speed() == pytest.approx(0.05 * np.pi, rel=0.05))
    began_s = time.time()
    os.kill(stream, signal.SIGKILL)
    assert ros.moved_for(began_s) < BRAKING_S
    driver.wait_for("was killed")
    assert driver.end(0) == 0
    ros.wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in helpers))
    assert sim.end() == 0
    assert not [line for line in sim.lines if "protective" in line or "rejected" in line]


TOPIC, KIND = "/restarted_controller/commands", "std_msgs/msg/Float64MultiArray"
COMMANDER = f"""
import time
from rlservo.robots.ros2.link import take_command
from rlservo.robots.ros2.rclpy_link import RclpyLink
_, publish = take_command(RclpyLink("commander"), {TOPIC!r}, {KIND!r})
print("commands", flush=True)
while True:
    publish({{"data": [0.0]}})
    time.sleep(0.02)
"""


def test_subscriber_that_comes_back_and_cannot_get_the_commands_is_a_fault(ros: Ros) -> None:
    controller = ros.python(str(ROOT / "tests" / "ros_graph.py"))
    controller.wait_for("ready")
    controller.type(json.dumps(["subscribe", {"topic": TOPIC, "kind": KIND}]))
    commander = ros.python("-c", COMMANDER)
    commander.wait_for("commands")
    ros.ask("subscribe", topic=TOPIC, kind=KIND, is_kept=True)
    time.sleep(1.0)
    assert commander.process.poll() is None  # one subscriber still gets them
    controller.end(signal.SIGKILL)
    why = commander.wait_for("unheard: ")
    assert f"{TOPIC}: the quality of service keeps our commands from /bystander (Volatile publisher" in why
    assert commander.end(signal.SIGKILL)
