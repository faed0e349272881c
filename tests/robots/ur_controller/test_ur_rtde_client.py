"""ur_rtde's unmodified client against the simulated controller.

The client is in a process of its own: it holds Python's interpreter while it waits for the controller.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from arms import PATIENCE_S, RunningArm, run_arm

pytest.importorskip("rtde_control")

CLIENT = """
import json, sys, time
from dashboard_client import DashboardClient
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
receive, control = RTDEReceiveInterface(sys.argv[1]), RTDEControlInterface(sys.argv[1])
def wait_until(condition):
    limit = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.005)
found = {}
BODY
control.disconnect()
receive.disconnect()
print("found", json.dumps(found))
"""


@pytest.fixture
def arm() -> Iterator[RunningArm]:
    yield from run_arm("ur5e")


def drive(arm: RunningArm, body: str) -> dict[str, Any]:
    """Run a client's script and return what it found."""
    ended = subprocess.run(
        [sys.executable, "-c", CLIENT.replace("BODY", body), arm.host],
        capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False,
    )  # fmt: skip
    assert "found " in ended.stdout, ended.stdout + ended.stderr
    found: dict[str, Any] = json.loads(ended.stdout.rpartition("found ")[2])
    return found


def test_client_servos_moves_speeds_and_stops_the_arm(arm: RunningArm) -> None:
    found = drive(
        arm,
        """
found["start"], found["modes"] = receive.getActualQ(), [receive.getRobotMode(), receive.getSafetyMode()]
target = receive.getActualQ()
for _ in range(200):
    target[0] += 0.0005
    assert control.servoJ(target, 0.0, 0.0, 0.002, 0.05, 300.0)
    time.sleep(0.002)
wait_until(lambda: abs(receive.getActualQ()[0] - target[0]) < 1e-3)
found["stopped"] = control.servoStop()
found["moved"] = control.moveJ([0.2, -2.4, 1.4, -1.5, -1.4, 0.1], 1.0, 2.0)
found["there"] = receive.getActualQ()
control.speedJ([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], 2.0)
wait_until(lambda: abs(receive.getActualQd()[2] - 0.3) < 0.01)
found["speed stopped"] = control.speedStop()
wait_until(lambda: abs(receive.getActualQd()[2]) < 1e-3)
""",
    )
    assert found["start"] == pytest.approx([0.0, -2.5, 1.5, -1.5, -1.4, 0.0], abs=1e-3)
    assert found["modes"] == [7, 1]
    assert found["there"] == pytest.approx([0.2, -2.4, 1.4, -1.5, -1.4, 0.1], abs=5e-3)
    assert found["stopped"] and found["moved"] and found["speed stopped"]


def test_watchdog_ends_the_program_and_stops_the_arm(arm: RunningArm) -> None:
    drive(
        arm,
        """
control.setWatchdog(5.0)
control.speedJ([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], 2.0)
wait_until(lambda: not control.isProgramRunning())
wait_until(lambda: abs(receive.getActualQd()[0]) < 1e-3)
""",
    )
    stopped_at_s, why = arm.controller.stop_reasons[0]
    assert "watchdog" in why
    assert arm.last_motion().time_s - stopped_at_s < 0.3


def test_time_that_the_machine_takes_from_the_controller_is_excused_once(arm: RunningArm) -> None:
    began = time.monotonic()
    arm.do(lambda: time.sleep(0.5))
    ticks = arm.controller.ticks
    arm.wait_until(lambda: arm.controller.ticks > ticks + 400)
    assert 0.4 < arm.controller.held_up_s <= time.monotonic() - began


def test_commands_that_waited_while_the_machine_held_the_controller_up_are_no_jump(arm: RunningArm) -> None:
    at_work = lambda: arm.controller.commands > 100  # noqa: E731
    held = threading.Thread(target=lambda: (arm.wait_until(at_work), arm.do(lambda: time.sleep(0.25))))
    held.start()
    drive(
        arm,
        """
target = receive.getActualQ()
for _ in range(400):
    target[0] += 0.002
    assert control.servoJ(target, 0.0, 0.0, 0.002, 0.03, 300.0)
    time.sleep(0.002)
""",
    )
    held.join()
    assert arm.controller.held_up_s > 0.2
    assert arm.controller.safety_mode.name == "NORMAL"


def test_jump_of_the_target_is_a_protective_stop_that_the_dashboard_unlocks_after_5_s(arm: RunningArm) -> None:
    found = drive(
        arm,
        """
dashboard = DashboardClient(sys.argv[1])
dashboard.connect()
control.servoJ([1.0, -2.5, 1.5, -1.5, -1.4, 0.0], 0.0, 0.0, 0.002, 0.05, 300.0)
wait_until(receive.isProtectiveStopped)
found["mode"] = dashboard.safetymode()
try:
    dashboard.unlockProtectiveStop()
except Exception as error:
    found["refused"] = str(error)
time.sleep(5.2)
def unlocked():
    try:
        dashboard.unlockProtectiveStop()
    except Exception:
        return False
    return True
wait_until(unlocked)
wait_until(lambda: not receive.isProtectiveStopped())
""",
    )
    assert found["mode"] == "Safetymode: PROTECTIVE_STOP"
    assert "until 5s" in found["refused"]


def test_cb3_controller_is_driven_at_125_hz() -> None:
    for arm in run_arm("ur5"):
        found = drive(arm, "found['moved'] = control.moveJ([0.1, -2.5, 1.5, -1.5, -1.4, 0.0], 1.0, 2.0)")
        assert arm.controller.rate_hz == 125.0 and found["moved"]
