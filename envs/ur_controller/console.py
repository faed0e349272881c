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
    controller = server.controller
    plain: dict[str, Callable[[], object]] = {
        "protective": lambda: controller.stop_protectively("requested at the console"),
        "emergency": controller.stop_in_emergency,
        "unlock": lambda: "" if controller.unlock_protective_stop() else "not before 5 s have passed",
        "release": controller.recover_from_emergency_stop,
        "remote": lambda: setattr(controller, "is_remote", True),
        "local": lambda: setattr(controller, "is_remote", False),
        "state": lambda: _state(server),
        "help": lambda: HELP,
    }
    if word in plain and not rest:
        return str(plain[word]() or "")
    if word == "slider":
        try:
            controller.speed_fraction = _number(word, rest, 1.0)
        except ValueError as error:
            return str(error)
        return ""
    return obey_link(server.link, line)


def obey_link(link: Link, line: str) -> str:
    """Carry out a line about the link's faults and return what to print."""
    word, _, rest = line.strip().partition(" ")
    try:
        if word in ("down", "up") and not rest:
            link.is_down = word == "down"
        elif word == "drop":
            link.drop = _number(word, rest, 1.0)
        elif word in ("latency", "jitter"):
            setattr(link, f"{word}_s", _number(word, rest, 10_000.0, " ms") / 1e3)
        else:
            return f"{line.strip()[:100]!r} is not a command; help lists them"
    except ValueError as error:
        return str(error)
    return ""


def _number(word: str, text: str, most: float, unit: str = "") -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= most:
        raise ValueError(f"{word} {text[:100]}: expected 0 to {most:g}{unit}")
    return value


def _state(server: Simulated) -> str:
    controller = server.controller
    positions = " ".join(f"{value:.3f}" for value in controller.simulation.joint_positions)
    speed = abs(controller.simulation.joint_velocities).max()
    program = "program runs" if controller.is_program_running else "no program"
    return (
        f"{controller.time_s:.3f} s, {controller.robot_mode.name}, {controller.safety_mode.name}, {program}, "
        f"joints {positions} rad, fastest {speed:.4f} rad/s"
    )
