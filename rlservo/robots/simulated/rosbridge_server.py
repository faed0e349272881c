"""Rosbridge in front of a simulated robot: rosbridge's JSON over WebSocket, without ROS, as ROS 1 and a MiR have it.

Only topics (advertise, publish, subscribe), and rosapi's services about them. A client that is too slow gets the newest
message of each topic.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.ros2.link import Publish
from rlservo.robots.ros2.ros_messages import for_rosbridge, parse

LARGEST_MESSAGE = 1024 * 1024
BRIDGE, ROBOT = "/rosbridge_websocket", "/robot"

log = logging.getLogger("rlservo.robot")
websocket_log = logging.getLogger("rlservo.rosbridge")
websocket_log.setLevel(logging.CRITICAL)  # not every connection that opens and closes


class _Client:
    """One connection: its subscriptions and advertisements, and the messages that wait to be sent."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.subscribed: set[str] = set()
        self.advertised: set[str] = set()
        self._waiting: dict[str, str] = {}
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._write, name="rosbridge-client", daemon=True)
        self._thread.start()

    def send(self, key: str, text: str) -> None:
        """Queue a message; a newer one replaces an older one with the same key."""
        with self._changed:
            self._waiting[key] = text
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join()

    def _write(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._is_closed)
                    if self._is_closed:
                        return
                    texts, self._waiting = list(self._waiting.values()), {}
                for text in texts:
                    self.connection.send(text)


class RosbridgeServer:
    """A link on the robot's side: it publishes to clients, and receives what they publish."""

    def __init__(self, host: str, port: int) -> None:
        """Listen. Raises RobotError if the port is in use."""
        self._clients: set[_Client] = set()
        self._lock = threading.Lock()
        self._types: dict[str, str] = {}
        self._published: set[str] = set()
        self._takers: dict[str, Callable[[Any], None]] = {}
        self._kept: dict[str, str] = {}  # newest messages, by topic
        self._count = 0
        try:
            self._server = serve(
                self._handle, host, port, max_size=LARGEST_MESSAGE, compression=None, logger=websocket_log
            )
        except OSError as error:
            raise RobotError(f"the rosbridge cannot listen on {host}:{port}: {error.strerror}") from error
        self.port: int = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name="rosbridge", daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Return the system's time [s]."""
        return time.time()

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None], *, is_kept: bool = False) -> None:
        """Call `on_message` with the messages that clients publish."""
        del is_kept  # clients publish nothing that is kept
        self._types[topic], self._takers[topic] = kind.replace("/msg/", "/"), on_message

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> Publish:
        """Return a function that sends to the subscribed clients; `is_kept`: the newest also to later ones."""
        self._types[topic] = kind.replace("/msg/", "/")
        self._published.add(topic)

        def publish(values: Mapping[str, Any]) -> None:
            with self._lock:
                takers = [client for client in self._clients if topic in client.subscribed]
                if not takers and not is_kept:
                    return
                text = json.dumps({"op": "publish", "topic": topic, "msg": for_rosbridge(values)})
                if is_kept:
                    self._kept[topic] = text
            for client in takers:
                client.send(topic, text)

        return publish

    def close(self) -> None:
        """Close all connections and the port."""
        self._server.shutdown()
        self._thread.join()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            client.connection.close()

    # -- clients

    def _handle(self, connection: ServerConnection) -> None:
        client = _Client(connection)
        with self._lock:
            self._clients.add(client)
        try:
            for text in connection:
                self._obey(client, text)
        except ConnectionClosed:
            pass
        finally:
            with self._lock:
                self._clients.discard(client)
            client.close()

    def _obey(self, client: _Client, text: str | bytes) -> None:
        try:
            request = json.loads(text)
            op, topic = request["op"], str(request.get("topic", ""))
            kind = self._types.get(topic)
            if op in ("subscribe", "advertise") and kind is not None and request.get("type", kind) != kind:
                raise ValueError(f"{topic} has the type {kind}, not {request['type']}")
            if op == "subscribe":
                with self._lock:
                    client.subscribed.add(topic)
                    kept = self._kept.get(topic)
                if kept is not None:
                    client.send(topic, kept)
            elif op == "unsubscribe":
                client.subscribed.discard(topic)
            elif op == "advertise":
                client.advertised.add(topic)
            elif op == "unadvertise":
                client.advertised.discard(topic)
            elif op == "publish":
                self._forward(topic, request["msg"])
            elif op == "call_service":
                self._answer(client, request)
            else:
                raise ValueError(f"op {op!r} is not supported")
        except Exception as error:  # JSON from any client
            log.warning("rosbridge: a client's message was refused: %s: %s", type(error).__name__, error)
            client.send("status", json.dumps({"op": "status", "level": "error", "msg": str(error)}))

    def _forward(self, topic: str, message: Any) -> None:
        """Give a client's message to the robot, and to all clients that subscribe, its own included."""
        if topic in self._takers:
            self._takers[topic](parse(message))
        with self._lock:
            takers = [client for client in self._clients if topic in client.subscribed]
        self._count += 1
        for client in takers:
            client.send(f"{topic} {self._count}", json.dumps({"op": "publish", "topic": topic, "msg": message}))

    def _answer(self, client: _Client, request: Mapping[str, Any]) -> None:
        service, topic = str(request["service"]), str((request.get("args") or {}).get("topic", ""))
        with self._lock:
            by_clients = {name: [BRIDGE] * any(topic in getattr(one, name) for one in self._clients)
                          for name in ("advertised", "subscribed")}  # fmt: skip
        known: dict[str, dict[str, Any]] = {
            "/rosapi/topics": {"topics": list(self._types), "types": list(self._types.values())},
            "/rosapi/topic_type": {"type": self._types.get(topic, "")},
            "/rosapi/publishers": {"publishers": [ROBOT] * (topic in self._published) + by_clients["advertised"]},
            "/rosapi/subscribers": {"subscribers": [ROBOT] * (topic in self._takers) + by_clients["subscribed"]},
        }
        values = known.get(service)
        answer = {"op": "service_response", "id": request.get("id"), "service": service, "result": values is not None,
                  "values": values if values is not None else f"service {service} does not exist"}  # fmt: skip
        self._count += 1
        client.send(f"answer {self._count}", json.dumps(answer))
