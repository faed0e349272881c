"""RTDE as UR's guide describes it and the ROS driver's recipes need it, over a plain socket."""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Iterator

import pytest

from arms import PATIENCE_S, RunningArm, run_arm

# rtde_output_recipe.txt of Universal_Robots_ROS2_Driver 7, with the types of the guide.
DRIVER = {
    "timestamp": "DOUBLE", "actual_q": "VECTOR6D", "actual_qd": "VECTOR6D", "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE", "runtime_state": "UINT32", "actual_TCP_force": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D", "target_TCP_pose": "VECTOR6D", "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64", "standard_analog_input0": "DOUBLE", "standard_analog_input1": "DOUBLE",
    "standard_analog_output0": "DOUBLE", "standard_analog_output1": "DOUBLE", "analog_io_types": "UINT32",
    "tool_mode": "UINT32", "tool_analog_input_types": "UINT32", "tool_analog_input0": "DOUBLE",
    "tool_analog_input1": "DOUBLE", "tool_output_voltage": "INT32", "tool_output_current": "DOUBLE",
    "tool_temperature": "DOUBLE", "robot_mode": "INT32", "safety_mode": "INT32", "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32", "actual_current": "VECTOR6D", "tcp_offset": "VECTOR6D", "payload": "DOUBLE",
    "payload_cog": "VECTOR3D", "payload_inertia": "VECTOR6D",
}  # fmt: skip
SIZES = {"DOUBLE": 8, "UINT64": 8, "UINT32": 4, "INT32": 4, "VECTOR3D": 24, "VECTOR6D": 48}


class Client:
    """A connection with protocol version 2."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, 30004), PATIENCE_S)
        assert self.ask("V", struct.pack(">H", 2)) == b"\x01"

    def send(self, kind: str, payload: bytes = b"") -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def ask(self, kind: str, payload: bytes = b"", *, skip: str = "") -> bytes:
        """Send a package and return the next one's payload, which must be of its kind."""
        self.send(kind, payload)
        return self.package(kind, skip=skip)

    def package(self, kind: str, *, skip: str = "") -> bytes:
        while True:
            size, found = struct.unpack(">HB", self._bytes(3))
            payload = self._bytes(size - 3)
            if chr(found) not in skip:
                assert chr(found) == kind
                return payload

    def close(self) -> None:
        self._socket.close()

    def _bytes(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self._socket.recv(count - len(data))
            assert part, "the controller closed the connection"
            data += part
        return data


@pytest.fixture(scope="module")
def controller() -> Iterator[RunningArm]:
    yield from run_arm("ur5e")


@pytest.fixture
def client(controller: RunningArm) -> Iterator[Client]:
    client = Client(controller.host)
    try:
        yield client
    finally:
        client.close()


def test_ros_drivers_recipe_is_offered_whole(client: Client) -> None:
    reply = client.ask("O", struct.pack(">d", 500.0) + ",".join(DRIVER).encode())
    assert (reply[0], reply[1:].decode().split(",")) == (1, list(DRIVER.values()))
    assert client.ask("S") == b"\x01"
    assert len(client.package("U")) == 1 + sum(SIZES[kind] for kind in DRIVER.values())


def test_start_without_outputs_is_refused(client: Client) -> None:
    assert client.ask("S") == b"\x00"
    client.ask("O", struct.pack(">d", 125.0) + b"timestamp,no_such_output")
    assert client.ask("S") == b"\x00"
    client.ask("O", struct.pack(">d", 125.0))
    assert client.ask("S") == b"\x00"


@pytest.mark.parametrize("frequency", [0.0, -1.0, 501.0, math.nan, math.inf])
def test_frequencies_that_no_controller_has_are_refused(client: Client, frequency: float) -> None:
    assert client.ask("O", struct.pack(">d", 125.0) + b"timestamp")[0] == 1
    assert client.ask("O", struct.pack(">d", frequency) + b"timestamp") == b"\x00DOUBLE"
    assert client.ask("S") == b"\x00"  # the recipe before is not left in place
    assert client.ask("O", struct.pack(">d", 500.0) + b"timestamp") == b"\x01DOUBLE"
    assert client.ask("S") == b"\x01"
    assert len(client.package("U")) == 9


def test_shares_of_the_slider_that_are_none_are_ignored(client: Client) -> None:
    recipe = client.ask("I", b"speed_slider_mask,speed_slider_fraction")
    assert recipe == b"\x01UINT32,DOUBLE"
    assert client.ask("O", struct.pack(">d", 500.0) + b"target_speed_fraction")[0] == 1
    for given, expected in ((0.5, 0.5), (math.nan, 0.5), (1.5, 0.5), (-0.1, 0.5), (1.0, 1.0)):
        client.send("U", struct.pack(">BId", 1, 1, given))
        assert client.ask("S") == b"\x01"
        assert struct.unpack(">Bd", client.package("U")) == (1, expected)
        client.ask("P", skip="U")


def test_half_a_recipe_ends_the_connection_and_not_the_controller(controller: RunningArm) -> None:
    client = Client(controller.host)
    with pytest.raises(AssertionError, match="closed"):
        client.ask("O", b"half")
    client.close()
    Client(controller.host).close()
