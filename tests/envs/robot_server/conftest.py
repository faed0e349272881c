"""A client for the wire, as thin as robo-gym's, and servers to talk to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import grpc
import pytest

from rlservo.envs.robot_server import robo_gym_messages as messages
from rlservo.envs.robot_server.manager import RobotServers, ServerManager
from rlservo.envs.robot_server.robo_gym_messages import ROBOT_SERVER, SERVER_MANAGER
from rlservo.envs.robot_server.robot_server import RobotServer
from rlservo.envs.robot_server.robot_server_settings import Settings

JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
ROS_JOINTS = ("elbow", "shoulder", "base", "wrist_1", "wrist_2", "wrist_3")
ANSWERS = {
    "GetState": messages.State,
    "SetState": messages.Success,
    "SendAction": messages.Success,
    "SendActionGetState": messages.State,
    "StartNewServer": messages.ServerRequest,
    "KillServer": messages.ServerRequest,
    "KillAllServers": messages.ServerRequest,
    "VerifyConnection": messages.ManagerStatus,
}


class WireClient:
    """Calls one service; requests are messages, or bytes sent as they are."""

    def __init__(self, service: str, port: int) -> None:
        self._service, self.port = service, port
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}")

    def call(self, name: str, request: Any = None, timeout: float = 20.0) -> Any:
        body = request if isinstance(request, bytes) else (request or messages.Empty()).SerializeToString()
        method = self.channel.unary_unary(f"/{self._service}/{name}", response_deserializer=ANSWERS[name].FromString)
        return method(body, timeout=timeout)

    def close(self) -> None:
        self.channel.close()


class RobotClient(WireClient):
    """The four calls of a robot server."""

    def __init__(self, port: int) -> None:
        super().__init__(ROBOT_SERVER, port)

    def state(self) -> Any:
        return self.call("GetState")

    def set_state(self, **fields: Any) -> bool:
        return bool(self.call("SetState", messages.State(**fields)).success)

    def send(self, action: list[float]) -> bool:
        return bool(self.call("SendAction", messages.Action(action=action)).success)

    def step(self, action: list[float]) -> Any:
        return self.call("SendActionGetState", messages.Action(action=action))


class ManagerClient(WireClient):
    """The four calls of a server manager."""

    def __init__(self, port: int) -> None:
        super().__init__(SERVER_MANAGER, port)

    def start(self, line: str, *, gui: bool = False) -> Any:
        return self.call("StartNewServer", messages.ServerRequest(cmd=line, gui=gui), timeout=60)

    def kill(self, port: int) -> Any:
        return self.call("KillServer", messages.ServerRequest(port=port))

    def kill_all(self) -> Any:
        return self.call("KillAllServers", messages.ServerRequest())


Serve = Callable[[Settings], RobotClient]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Start a robot server in this process and return a client of it."""
    parts: list[Any] = []

    def start(settings: Settings) -> RobotClient:
        server = RobotServer(settings)
        client = RobotClient(server.port)
        parts.extend([client.close, server.stop])
        return client

    yield start
    for end in parts:
        end()


@pytest.fixture
def manager() -> Iterator[ServerManager]:
    """A server manager in this process, off the ports where robo-gym's clients look."""
    running = ServerManager(port=0, servers=RobotServers())
    yield running
    running.close()


@pytest.fixture
def client(manager: ServerManager) -> Iterator[ManagerClient]:
    connected = ManagerClient(manager.port)
    yield connected
    connected.close()
