"""Console commands of the simulated controller, typed by a person or written by a test: stops, slider, link faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from rlservo.envs.ur_controller.controller import Controller
from rlservo.envs.ur_controller.server import Link


class Simulated(Protocol):
    """A controller and its link."""

    @property
    def controller(self) -> Controller: ...

    @property
    def link(self) -> Link: ...


HELP = """\
protective         protective stop          unlock         unlock it, as the dashboard does
emergency          emergency stop           release        pull it out, power on, release the brakes
slider 0.5         speed slider             remote, local  remote control on or off
latency 20         link: ms each way        jitter 5       link: up to so many ms more
drop 0.01          link: share of RTDE data packages lost
down, up           link: cut and restored   state          where the arm is"""


def obey(server: Simulated, line: str) -> str:
    """Carry out a line and return what to print. Call it between two control cycles (`ControllerServer.do`)."""
    word, _, rest = line.strip().partition(" ")
    controller, link = server.controller, server.link
    plain: dict[str, Callable[[], object]] = {
        "protective": lambda: controller.stop_protectively("requested at the console"),
        "emergency": controller.stop_in_emergency,
        "unlock": lambda: "" if controller.unlock_protective_stop() else "not before 5 s have passed",
        "release": controller.recover_from_emergency_stop,
        "remote": lambda: setattr(controller, "is_remote", True),
        "local": lambda: setattr(controller, "is_remote", False),
        "down": lambda: setattr(link, "is_down", True),
        "up": lambda: setattr(link, "is_down", False),
        "state": lambda: _state(server),
        "help": lambda: HELP,
    }
    if word in plain and not rest:
        return str(plain[word]() or "")
    scales = {"slider": 1.0, "latency": 1e-3, "jitter": 1e-3, "drop": 1.0}
    try:
        value = float(rest) * scales[word]
    except (KeyError, ValueError):
        return f"{line.strip()[:100]!r} is not a command; help lists them"
    if not 0.0 <= value <= (10.0 if word in ("latency", "jitter") else 1.0):
        return f"{word} {rest}: expected 0 to {'10000 ms' if word in ('latency', 'jitter') else '1'}"
    if word == "slider":
        controller.speed_fraction = value
    else:
        setattr(link, "drop" if word == "drop" else f"{word}_s", value)
    return ""


def _state(server: Simulated) -> str:
    controller = server.controller
    positions = " ".join(f"{value:.3f}" for value in controller.simulation.joint_positions)
    speed = abs(controller.simulation.joint_velocities).max()
    program = "program runs" if controller.is_program_running else "no program"
    return (
        f"{controller.time_s:.3f} s, {controller.robot_mode.name}, {controller.safety_mode.name}, {program}, "
        f"joints {positions} rad, fastest {speed:.4f} rad/s"
    )
