"""Dashboard commands as UR's "Dashboard Server e-Series, port 29999" documents them.

Expected replies are the patterns of UR's client library, where it has one.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator

import pytest

from outside_arm import PATIENCE_S, OutsideArm, outside_arm

PATTERNS = {
    "version": r"5\.\d+\.\d+\.\d+",
    "get operational mode": "NONE|MANUAL|AUTOMATIC",
    "load nothing.urp": "File not found: nothing.urp",
    "load installation nothing.installation": "File not found: nothing.installation",
    "popup The gripper is open": "showing popup",
    "close popup": "closing popup",
    "play": "Failed to execute: play",
    "pause": "Failed to execute: pause",
}


@pytest.fixture(scope="module")
def arm() -> Iterator[OutsideArm]:
    with outside_arm("ur5e") as arm:
        yield arm


@pytest.mark.parametrize(("command", "pattern"), PATTERNS.items())
def test_commands_are_answered_as_documented(arm: OutsideArm, command: str, pattern: str) -> None:
    reply = arm.dashboard(command)
    assert re.fullmatch(pattern, reply), reply


def test_quit_ends_the_connection(arm: OutsideArm) -> None:
    with socket.create_connection((arm.host, 29999), PATIENCE_S) as client, client.makefile("rw") as stream:
        stream.readline()
        stream.write("quit\n")
        stream.flush()
        assert stream.readline() == "Disconnected\n"
        assert stream.readline() == ""
