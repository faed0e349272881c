"""Every fault during motion, and time and way until the arm stands still; `pytest -s` prints them.

Stopping times are the controller's own: from the cycle of the fault to the one in which the last joint stood.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arms import LIMITS, RunningArm, serving
from rlservo.client.policy_client import PolicyClient
from rlservo.drive.control_loop import rollout
from rlservo.errors import RlservoError
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.limits import Limits
from rlservo.robots.simulated.ur_controller.controller import START_JOINTS, Controller
from rlservo.robots.simulated.ur_controller.controller_server import ControllerServer
from servers import launched

pytest.importorskip("rtde_control")

WATCHDOG_S = 1.0 / LIMITS["watchdog_hz"]
LATE_S = 0.25  # 2.5 control cycles
BRAKING_S = 0.6  # from full speed here, by the slowest of all ways to stop, with the follower's lag
NEW_NETWORK = 0x40000000  # CLONE_NEWNET


def move(arm: RunningArm) -> Iterator[ArmProcess]:
    """An arm whose base turns, and is given setpoints by no one any more: they last half a minute."""
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=30.0, limits=Limits.of(LIMITS))
    try:
        real.command(np.array(START_JOINTS) + np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 10.0)
        arm.wait_until(lambda: abs(arm.controller.simulation.joint_velocities[0]) > 0.25)
        yield real
    finally:
        real.close()


@pytest.fixture
def moving(arm: RunningArm) -> Iterator[ArmProcess]:
    yield from move(arm)


def time_to_stand(arm: RunningArm, fault: Callable[[], object]) -> float:
    """Return how long the arm moved on after a fault [s], in its own time, less what the machine held it up."""
    controller = arm.controller
    began, held_up_s, where = controller.time_s, controller.held_up_s, controller.simulation.joint_positions.copy()
    fault()
    arm.wait_until(
        lambda: controller.time_s > began + 0.1 and bool(abs(controller.simulation.joint_velocities).max() < 0.01)
    )
    moved = arm.last_motion()
    stood_s = moved.time_s - began - (moved.held_up_s - held_up_s)
    print(f"stood after {stood_s:.3f} s and {abs(controller.simulation.joint_positions - where).max():.3f} rad")
    return stood_s


def test_killed_command_stream_is_stopped_by_the_watchdog(arm: RunningArm, moving: ArmProcess) -> None:
    assert time_to_stand(arm, lambda: os.kill(moving.pid, signal.SIGKILL)) < WATCHDOG_S + BRAKING_S
    arm.wait_until(lambda: not arm.controller.is_program_running)
    assert "watchdog" in arm.controller.stop_reasons[-1][1]
    assert "killed" in moving.fault


def test_suspended_command_stream_is_stopped_by_the_watchdog(arm: RunningArm, moving: ArmProcess) -> None:
    try:
        assert time_to_stand(arm, lambda: os.kill(moving.pid, signal.SIGSTOP)) < WATCHDOG_S + BRAKING_S
        arm.wait_until(lambda: not arm.controller.is_program_running)
    finally:
        os.kill(moving.pid, signal.SIGCONT)
    arm.wait_until(lambda: bool(moving.fault))
    # Which of them is seen first: the program that ended, or what it no longer takes.
    assert moving.fault.partition(":")[0] in ("program_stopped", "connection_lost", "command_refused")


def test_link_that_is_down_is_stopped_by_the_watchdog(arm: RunningArm, moving: ArmProcess) -> None:
    link = arm.server.link
    assert time_to_stand(arm, lambda: setattr(link, "is_down", True)) < WATCHDOG_S + BRAKING_S
    arm.wait_until(lambda: bool(moving.fault))
    link.is_down = False


def test_emergency_stop_is_a_fault_that_is_named(arm: RunningArm, moving: ArmProcess) -> None:
    assert time_to_stand(arm, lambda: arm.do(arm.controller.stop_in_emergency)) < BRAKING_S
    arm.wait_until(lambda: bool(moving.fault))
    assert moving.fault.startswith("emergency_stop")
    with pytest.raises(RobotError, match="emergency stop"):
        ArmProcess(arm.host, "ur5")


def test_policy_process_that_dies_or_is_suspended_leaves_a_standing_arm(arm: RunningArm) -> None:
    program = f"""
import time
import numpy as np
from rlservo.robots.limits import Limits
from rlservo.robots.arm_process import ArmProcess
arm = ArmProcess({arm.host!r}, "ur5", limits=Limits.of({LIMITS!r}))
while True:
    arm.command(np.array([3.0, -2.5, 1.5, -1.5, -1.4, 0.0]), 10.0)
    time.sleep(0.05)
"""
    policy = subprocess.Popen([sys.executable, "-c", program])
    try:
        fast = lambda: bool(abs(arm.controller.simulation.joint_velocities[0]) > 0.25)  # noqa: E731
        arm.wait_until(fast)
        assert time_to_stand(arm, lambda: policy.send_signal(signal.SIGSTOP)) < LATE_S + BRAKING_S
        policy.send_signal(signal.SIGCONT)
        arm.wait_until(fast)
        assert time_to_stand(arm, policy.kill) < LATE_S + BRAKING_S
        arm.wait_until(lambda: not arm.controller.is_program_running)
    finally:
        policy.kill()
        policy.wait()


@pytest.fixture
def far_arm() -> Iterator[tuple[RunningArm, Callable[[str], object]]]:
    """A controller in a network namespace, and what sets the link to it up or down."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("a network namespace needs root and the program ip (Debian package iproute2)")
    name, net = f"rlservo{os.getpid()}", f"198.18.{os.getpid() % 256}"

    def ip(command: str) -> None:
        subprocess.run(["ip", *command.split()], check=True, capture_output=True, text=True)

    try:
        ip(f"netns add {name}")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespace can be made: {error.stderr.strip()}")
    try:
        ip(f"link add {name} type veth peer name arm netns {name}")
        ip(f"addr add {net}.1/30 dev {name}")
        ip(f"link set {name} up")
        ip(f"-n {name} addr add {net}.2/30 dev arm")
        ip(f"-n {name} link set arm up")
        made: list[ControllerServer] = []

        def make() -> None:  # in a thread of its own: sockets stay in the namespace in which they were made
            with Path("/run/netns", name).open() as namespace:
                assert ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), NEW_NETWORK) == 0
            made.append(ControllerServer(Controller("ur5"), host=f"{net}.2"))

        maker = threading.Thread(target=make)
        maker.start()
        maker.join()
        for arm in serving(made[0]):
            yield arm, lambda state: ip(f"link set {name} {state}")
    finally:
        with suppress(subprocess.CalledProcessError):
            ip(f"link del {name}")
        ip(f"netns del {name}")


def test_network_whose_link_goes_down_is_stopped_by_the_watchdog(
    far_arm: tuple[RunningArm, Callable[[str], object]],
) -> None:
    arm, set_link = far_arm
    for moving in move(arm):
        assert time_to_stand(arm, lambda: set_link("down")) < WATCHDOG_S + BRAKING_S
        arm.wait_until(lambda: not arm.controller.is_program_running)
        assert "watchdog" in arm.controller.stop_reasons[-1][1]
        arm.wait_until(lambda moving=moving: bool(moving.fault))  # type: ignore[misc]
        assert moving.fault.startswith("connection_lost")


def test_server_that_hangs_or_is_killed_leaves_a_standing_arm(arm: RunningArm, shipped: Path) -> None:
    fast = lambda: bool(abs(arm.controller.simulation.joint_velocities).max() > 0.1)  # noqa: E731
    arguments: dict[str, Any] = {"robot": f"rtde://{arm.host}", "ur_model": "ur5", "confirm": False, "limits": LIMITS}
    failed: list[str] = []

    def drive() -> None:
        try:
            with PolicyClient(f"http://127.0.0.1:{server.port}", "ur5", deadline_ms=60_000.0) as policy:
                rollout(
                    policy, "rlservo/EndEffectorPositioningURRob-v0", episodes=50, seed=1, unproven=True,
                    env_kwargs=arguments,
                )  # fmt: skip
        except RlservoError as error:
            failed.append(error.message)

    with launched(shipped) as server:
        server.wait_until_ready()
        loop = threading.Thread(target=drive)
        loop.start()
        try:
            arm.wait_until(fast)
            processes = server.processes()

            def send(number: signal.Signals) -> None:
                for pid in processes:
                    os.kill(pid, number)

            assert time_to_stand(arm, lambda: send(signal.SIGSTOP)) < LATE_S + BRAKING_S
            send(signal.SIGCONT)
            arm.wait_until(fast)
            assert time_to_stand(arm, lambda: send(signal.SIGKILL)) < LATE_S + BRAKING_S
        finally:
            for pid in server.processes():
                os.kill(pid, signal.SIGKILL)
            loop.join()
    assert len(failed) == 1
    assert not arm.controller.is_program_running
