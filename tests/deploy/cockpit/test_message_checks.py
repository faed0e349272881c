"""Values that no person could choose, sent to a cockpit's page by a program: nothing stops, no traceback is written."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="the cockpit draws with viser")

import msgspec
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from cockpits import Cockpit, cockpit_of
from rlservo.deploy.cockpit.drive import Drive
from rlservo.deploy.cockpit.message_checks import number_of, point_of
from rlservo.deploy.cockpit.panel import DrivePanel
from rlservo.deploy.cockpit.playback import PlaybackPanel, Tape
from rlservo.deploy.cockpit.policies import BundledPolicies, Choice
from rlservo.drive.control_loop import rollout
from rlservo.policy.policy import Policy
from waiting import wait_for

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection"),  # the clients here leave at once
]

VALUES = (math.nan, math.inf, -math.inf, -1, 0, 1e308, "9" * 400, "abc", "close", None, [], {}, True)
POSITIONS = ([math.nan] * 3, [math.inf] * 3, [1e308] * 3, [1e6, 0.0, 0.0], [1.0, 2.0], ["a", "b", "c"], None)
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
    "fov": 1.0,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 600,
    "image_width": 800,
}


@pytest.mark.parametrize(
    ("value", "used"),
    [(0.5, 0.5), (0, 0.1), (-math.inf, 0.1), (9, 4.0), (1e308, 4.0), (10**400, 4.0), (math.nan, 0.1)],
    ids=range(7),
)
def test_a_sliders_value_is_within_its_range(value: float, used: float) -> None:
    assert number_of(SimpleNamespace(min=0.1, max=4.0, value=value)) == used


def test_a_position_is_three_numbers_within_a_kilometre() -> None:
    assert [point_of(position) for position in POSITIONS] == [None] * len(POSITIONS)
    assert np.array_equal(point_of((1, 2.5, -3)), [1.0, 2.5, -3.0])


def connected(address: str) -> ClientConnection:
    url, protocol = address.replace("http:", "ws:"), f"viser-v{version('viser')}"
    # A full queue of messages that nobody reads here would hold up the server's answers to a ping and to the end.
    return connect(url, subprotocols=[protocol], max_size=None, max_queue=None, proxy=None)


def controls(address: str) -> list[str]:
    """Return the identifiers of a page's controls, of which it tells every browser."""
    messages: list[dict[str, Any]] = []
    with connected(address) as socket:
        while not any(message["type"] == "ReplayDoneMessage" for message in messages):
            told = bytes(socket.recv(10.0))
            size = int.from_bytes(told[8:16], "little")
            messages += msgspec.msgpack.decode(zstandard.decompress(told[16 : 16 + size]))["messages"]
    return [message["uuid"] for message in messages if "value" in message]


def send(address: str, *messages: Any) -> None:
    """Send messages over one connection, as a browser does."""
    with suppress(ConnectionClosed), connected(address) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        for message in messages:
            socket.send(message if isinstance(message, bytes) else msgspec.msgpack.encode(message))
        socket.ping(ack_on_close=True).wait(10)


def send_nonsense(cockpit: Cockpit) -> None:
    """Send every control values that it cannot have, and handles and camera places that are none."""
    uuids = controls(cockpit.address)
    assert len(uuids) > 4
    change = {"type": "GuiUpdateMessage"}
    send(cockpit.address, *({**change, "uuid": uuid, "updates": {"value": bad}} for uuid in uuids for bad in VALUES))
    moved = {"type": "TransformControlsUpdateMessage", "wxyz": CAMERA["wxyz"]}
    for bad in POSITIONS:  # some end their connection
        send(cockpit.address, {**CAMERA, "position": bad})
        for name in ("/target", "/start"):
            send(cockpit.address, {**moved, "name": name, "position": bad})
    for broken in ({"type": "Nothing"}, {"type": "GuiUpdateMessage"}, b"nonsense"):
        send(cockpit.address, broken)


@pytest.fixture
def silent(capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> Callable[[], None]:
    def check() -> None:
        assert "Traceback" not in (written := capfd.readouterr().err), written
        assert [record.exc_info for record in caplog.records if record.exc_info] == []

    return check


def test_a_drive_goes_on_whatever_is_sent_to_its_page(two_versions: Path, silent: Callable[[], None]) -> None:
    source = BundledPolicies(two_versions)
    drive = Drive(source, Choice("ur5", "1"), seed=5)
    drive.start()
    try:
        with cockpit_of(lambda server: DrivePanel(server, drive, source)) as cockpit:
            send_nonsense(cockpit)
            drive.do(drive.play)
            cycles = drive.history[-1].number
            wait_for(lambda: drive.history[-1].number > cycles + 3, "the robot moves")
            wait_for(lambda: "frames/s" in cockpit.panel.status.content, "the page is drawn")
    finally:
        drive.close()
    silent()


def test_a_recording_goes_on_whatever_is_sent_to_its_page(
    two_versions: Path, tmp_path: Path, silent: Callable[[], None]
) -> None:
    with Policy.load(two_versions / "ur5" / "1") as policy:
        rollout(policy, "rlservo/EndEffectorPositioningURSim-v0", episodes=2, seed=3, record=tmp_path / "run.mcap")
    tape = Tape(tmp_path / "run.mcap", bundle=two_versions / "ur5" / "2")
    with cockpit_of(lambda server: PlaybackPanel(server, tape, env_id=None)) as cockpit:
        send_nonsense(cockpit)
        cockpit.panel.status.content = ""
        wait_for(lambda: "frames/s" in cockpit.panel.status.content, "the page is drawn")
    silent()
