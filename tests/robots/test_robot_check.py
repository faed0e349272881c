"""`rlservo robot-check`: what a robot tells, and why it must not be driven. Nothing moves, no program runs."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from arms import RunningArm, run_arm
from command_line import rlservo
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_process import ArmProcess

pytest.importorskip("rtde_control")


@pytest.fixture
def e_series() -> Iterator[RunningArm]:
    yield from run_arm("ur5e")


def check(arm: RunningArm, *options: Any) -> tuple[int, dict[str, dict[str, str]]]:
    """Return the exit code and the findings by name."""
    done = rlservo("robot-check", f"rtde://{arm.host}", "--limit", "watchdog_hz=1", "--json", *options)
    report = json.loads(done.stdout)
    assert report["may_be_driven"] == (done.returncode == 0)
    return done.returncode, {one["what"]: one for one in report["findings"]}


def test_robot_that_may_be_driven_is_described_and_not_touched(arm: RunningArm) -> None:
    arm.do(lambda: setattr(arm.controller, "speed_fraction", 0.1))
    code, found = check(arm, "--ur-model", "ur5")
    assert code == 0, found
    assert found["model"]["found"] == "ur5" and found["speed slider"]["found"] == "10%"
    assert found["software"]["found"].startswith("3.15")
    assert found["robot mode"]["found"] == "running" and found["safety mode"]["found"] == "normal"
    assert "0.00, -2.50, 1.50, -1.50, -1.40, 0.00 rad" in found["joints"]["found"]
    assert not arm.controller.stop_reasons and not arm.controller.is_program_running


@pytest.mark.parametrize(
    ("model", "reported"),
    [("ur7e", "ur5e"), ("ur12e", "ur10e"), ("ur18", "ur18"), ("ur8long", "ur8long"), ("ur30", "ur30")],
)
def test_models_sold_today_are_known_by_what_their_controller_says(model: str, reported: str) -> None:
    """A UR7e calls itself UR5, whose figures it has."""
    for arm in run_arm(model):
        assert check(arm)[1]["model"]["found"] == reported
        code, found = check(arm, "--ur-model", model)
        assert (code, found["model"]["found"]) == (0, model), found
        assert check(arm, "--ur-model", "ur20")[1]["model"]["problem"] == "ur_model is ur20"
        with closing(ArmProcess(arm.host, model)) as real:
            assert real.arm_state().positions == pytest.approx([0.0, -2.5, 1.5, -1.5, -1.4, 0.0], abs=0.01)
        with pytest.raises(RobotError, match=f"is a {reported}'s, but ur_model is ur20"):
            ArmProcess(arm.host, "ur20")


FAULTS: dict[str, tuple[Callable[[Any], object], str, str]] = {
    "slider": (lambda one: setattr(one, "speed_fraction", 0.0), "speed slider", "raise it on the pendant"),
    "stop": (lambda one: one.stop_protectively("a test"), "safety mode", "find the cause, then unlock it"),
    "local": (lambda one: setattr(one, "is_remote", False), "remote control", "enable remote control on the pendant"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_robot_that_must_not_be_driven_says_why(e_series: RunningArm, fault: str) -> None:
    make, what, why = FAULTS[fault]
    e_series.do(lambda: make(e_series.controller))
    code, found = check(e_series)
    assert code == 1
    assert why in found[what]["problem"]
    assert [name for name, one in found.items() if one["problem"]] == [what]


def test_other_model_joint_outside_and_unproven_bundle_are_named(arm: RunningArm, shipped: Path) -> None:
    low = "position_low=[-6, -2, -3, -6, -6, -6]"
    code, found = check(arm, "--ur-model", "ur5e", "--limit", low, "--bundle", shipped / "ur5")
    assert code == 1
    assert found["model"]["problem"] == "ur_model is ur5e"
    assert "shoulder is at -2.5 rad, outside its limits" in found["joints"]["problem"]
    assert "was never evaluated under latency" in found["bundle"]["problem"]


def test_polyscope_x_is_named_instead_of_the_network() -> None:
    """By UR's RTDE guide; its port 29999 refuses connections."""
    with closing(socket.create_server(("127.4.4.4", 30004))) as server:

        def serve() -> None:
            while True:
                try:
                    client, _ = server.accept()
                except OSError:
                    return
                with client, client.makefile("rb") as stream:
                    while len(head := stream.read(3)) == 3:
                        size, kind = struct.unpack(">HB", head)
                        stream.read(size - 3)
                        if kind == ord("v"):
                            client.sendall(struct.pack(">HBIIII", 19, ord("v"), 10, 13, 0, 0))
                        else:
                            client.sendall(struct.pack(">HBB", 4, kind, 1))

        threading.Thread(target=serve, daemon=True).start()
        done = rlservo("robot-check", "rtde://127.4.4.4")
        assert done.returncode == 2
        assert "127.4.4.4 runs PolyScope X 10.13, which has no dashboard server (port 29999)" in done.stderr
        with pytest.raises(RobotError, match=r"runs PolyScope X 10\.13, .*ros2:"):
            ArmProcess("127.4.4.4", "ur5e")
        server.shutdown(socket.SHUT_RDWR)
    done = rlservo("robot-check", "rtde://127.4.4.5")
    assert done.returncode == 2 and "no UR controller answers at 127.4.4.5" in done.stderr
