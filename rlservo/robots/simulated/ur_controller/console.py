"""Console commands of the simulated controller, typed by a person or written by a test: stops, slider, link faults."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from rlservo.robots.simulated.ur_controller.controller import Controller
from rlservo.robots.simulated.ur_controller.controller_server import ControllerServer, LinkFaults


class Simulated(Protocol):
    """A controller and its link."""

    @property
    def controller(self) -> Controller: ...

    @property
    def link(self) -> LinkFaults: ...


HELP = """\
protective         protective stop          unlock         unlock it, as the dashboard does
emergency          emergency stop           release        pull it out, power on, release the brakes
slider 0.5         speed slider             remote, local  remote control on or off
limiter 0.5        the controller's own     pause, play    pause the program, continue it
stop               end the program
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
        "stop": lambda: controller.stop_program("stopped at the console"),
        "pause": lambda: "" if controller.pause_program() else "no program runs",
        "play": lambda: "" if controller.resume_program() else "no program is paused",
        "remote": lambda: setattr(controller, "is_remote", True),
        "local": lambda: setattr(controller, "is_remote", False),
        "state": lambda: _state(server),
        "help": lambda: HELP,
    }
    if word in plain and not rest:
        return str(plain[word]() or "")
    if word in ("slider", "limiter"):
        try:
            setattr(controller, {"slider": "speed_fraction"}.get(word, word), _number(word, rest, 1.0))
        except ValueError as error:
            return str(error)
        return ""
    return obey_link(server.link, line)


def obey_link(link: LinkFaults, line: str) -> str:
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


def run(
    controller: Controller, host: str, link: LinkFaults, stop: threading.Event, on_ready: Callable[[], None]
) -> None:
    """Serve until `stop` is set, and obey the lines on standard input meanwhile. Raises CannotListenError."""
    server = ControllerServer(controller, host=host, link=link)

    def read_lines() -> None:
        with suppress(OSError):  # its terminal is gone
            for line in filter(str.strip, sys.stdin):
                server.do(lambda line=line: print_reply(obey(server, line)))  # type: ignore[misc]

    def print_reply(reply: str) -> None:
        if reply:
            sys.stdout.write(f"{reply}\n")
            sys.stdout.flush()

    try:
        on_ready()
        threading.Thread(target=read_lines, name="console", daemon=True).start()
        with suppress(PermissionError):  # root's; a real controller has a computer of its own
            os.setpriority(os.PRIO_PROCESS, 0, -10)
        server.serve(stop)
    finally:
        server.close()
