"""One question over RTDE, without ur_rtde: the controller's software, by UR's guide to the protocol."""

from __future__ import annotations

import socket
import struct
import time
from contextlib import suppress

PORT, PATIENCE_S = 30004, 2.0
FIRST_X = 10  # PolyScope X's major version


def controller_version(host: str) -> tuple[int, ...] | None:
    """Return the software's version (major, minor, bugfix, build); None if no controller answers."""
    with suppress(OSError, struct.error), socket.create_connection((host, PORT), PATIENCE_S) as link:
        link.settimeout(PATIENCE_S)
        link.sendall(struct.pack(">HB", 3, ord("v")))
        with link.makefile("rb") as stream:
            _size, kind, *version = struct.unpack(">HB4I", stream.read(19))
        return tuple(version) if kind == ord("v") else None
    return None


def round_trip_s(host: str) -> float:
    """Return the time of a new connection, a question and its answer [s]."""
    began = time.monotonic()
    controller_version(host)
    return time.monotonic() - began


def no_answer(host: str, error: Exception) -> str:
    """Return why the dashboard server of a controller does not answer, and what to do."""
    version = controller_version(host)
    if version is None:
        return f"no UR controller answers at {host} ({str(error).strip()}): is it switched on and on this network?"
    number = f"{version[0]}.{version[1]}"
    if version[0] < FIRST_X:
        return f"the dashboard server of the controller at {host} ({number}) does not answer: is port 29999 open?"
    return (
        f"the controller at {host} runs PolyScope X {number}, which has no dashboard server (port 29999): drive it "
        "through ROS 2 (robot=ros2:), with ur_robot_driver and its External Control URCapX"
    )
