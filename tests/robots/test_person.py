"""A real arm moves only when a person wants it to: the command line, and the arm's motion recorded from outside."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from outside_arm import OutsideArm, outside_arm
from servers import HEEDING_CTRL_C

pytest.importorskip("rtde_control")

STANDS = 0.02  # [rad/s]
FASTEST = 0.315  # [rad/s], a tenth of a UR5's data sheet
LIMITS = '{"watchdog_hz": 2, "start_speed": 0.3, "blend_s": 1.0}'
FOREIGN = b"def foreign():\n  sleep(0.1)\nend\n"


@pytest.fixture
def arm() -> Iterator[OutsideArm]:
    with outside_arm() as arm:
        yield arm


@contextmanager
def rollout(arm: OutsideArm, policies: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Drive the arm by the command line, without a terminal."""
    words = [
        *HEEDING_CTRL_C, sys.executable, "-m", "rlservo.deploy.cli", "rollout",
        "rlservo/EndEffectorPositioningURRob-v0", "--bundle", str(policies / "ur5" / "1"), "--env-arg", f"robot=rtde://{arm.host}",
        "--env-arg", "ur_model=ur5",
        "--env-arg", f"limits={LIMITS}", "--episodes", "20", "--seed", "1", "--unproven", *options,
    ]  # fmt: skip
    process = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=os.environ | {"COLUMNS": "400"},
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def streams(process: subprocess.Popen[str]) -> list[int]:
    """Return the processes that it started."""
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def send_foreign_script(arm: OutsideArm, _: subprocess.Popen[str]) -> None:
    with socket.create_connection((arm.host, 30003), 10.0) as client:
        client.sendall(FOREIGN)


def type_and_undo(line: str, undo: str, after_s: float) -> Callable[[OutsideArm, subprocess.Popen[str]], None]:
    def stop(arm: OutsideArm, _: subprocess.Popen[str]) -> None:
        arm.type(line)
        arm.recorder.wait_until(lambda one: one.speed() < STANDS)
        arm.recorder.watch(after_s)
        arm.type(undo)

    return stop


def cut_link(arm: OutsideArm, _: subprocess.Popen[str]) -> None:
    arm.type("down")
    time.sleep(3.0)  # the recorder is cut off as well
    arm.type("up")


STOPS: dict[str, Callable[[OutsideArm, subprocess.Popen[str]], object]] = {
    "dashboard": lambda arm, _: arm.dashboard("stop"),
    "foreign script": send_foreign_script,
    "killed stream": lambda _, process: os.kill(streams(process)[0], signal.SIGKILL),
    "lost link": cut_link,
    "protective": type_and_undo("protective", "unlock", 5.5),
    "emergency": type_and_undo("emergency", "release", 1.0),
    "pause": type_and_undo("pause", "play", 1.0),
    "slider": type_and_undo("slider 0", "slider 1", 4.0),
}


@pytest.mark.parametrize("how", STOPS)
def test_stopped_arm_does_not_start_again_by_itself(arm: OutsideArm, shipped: Path, how: str) -> None:
    with rollout(arm, shipped, "--yes") as process:
        arm.recorder.wait_until(lambda one: one.speed() > 0.1)
        STOPS[how](arm, process)
        arm.recorder.wait_until(lambda one: one.speed() < STANDS)
        stood_s = arm.recorder.now_s()
        output = process.communicate(timeout=60.0)[0]
        assert process.returncode == 1, output
        assert "a person must look at it: start the run again" in " ".join(output.split())
        assert "Traceback" not in output
        arm.recorder.watch(2.0)
    assert arm.recorder.motion().since(stood_s).fastest() < STANDS


def test_nothing_moves_without_a_terminal_or_yes(arm: OutsideArm, shipped: Path) -> None:
    """The arm stands at its start already."""
    with rollout(arm, shipped) as process:
        output = process.communicate(timeout=60.0)[0]
    assert process.returncode == 2
    words = " ".join(output.split())
    assert "from (0.00, -2.50, 1.50, -1.50, -1.40, 0.00) to its start (0.00, -2.50, 1.50" in words
    assert "then the policy moves each joint with at most 0.31 rad/s" in words
    assert "there is no terminal to confirm at" in words
    arm.recorder.watch(0.5)
    assert arm.recorder.motion().fastest() < 0.005


PROGRAM = """
import sys, time
import numpy as np
from rlservo.robots.limits import Limits
from rlservo.robots.arm_process import ArmProcess
arm = ArmProcess(sys.argv[1], "ur5", limits=Limits(watchdog_hz=2.0))
try:
    while True:
        arm.command(np.array([3.0, -2.5, 1.5, -1.5, -1.4, 0.0]), 1.0)
        time.sleep(0.05)
except BaseException:
    arm.close()
"""


@pytest.mark.parametrize(("who", "silence_s"), [("policy", 0.9), ("policy", 3.0), ("stream", 0.4)])
def test_process_that_was_suspended_begins_slowly(arm: OutsideArm, who: str, silence_s: float) -> None:
    """Its stream's silence is within what the controller's watchdog allows here."""
    recorder = arm.recorder
    policy = subprocess.Popen([sys.executable, "-c", PROGRAM, arm.host])
    try:
        recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
        suspended = policy.pid if who == "policy" else streams(policy)[0]
        os.kill(suspended, signal.SIGSTOP)
        time.sleep(silence_s)
        assert recorder.speed() < STANDS
        os.kill(suspended, signal.SIGCONT)
        back_s = recorder.now_s()
        recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
    finally:
        policy.send_signal(signal.SIGINT)
        policy.wait(20.0)
    motion = recorder.motion().since(back_s)
    moved = motion.time_s - motion.time_s[(abs(motion.velocities).max(axis=1) > 0.005).argmax()]
    speed = abs(motion.velocities).max(axis=1)
    assert speed[moved < 0.3].max() < 0.5 * FASTEST  # a second until it is full
    assert speed.max() < 1.1 * FASTEST
