"""Link through a rosbridge (WebSocket), with roslibpy: it needs no ROS here. A MiR has one on port 9090.

A MiR's is ROS 1, which refuses ROS 2's names of types and times; a rosbridge of ROS 2 takes ROS 1's.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

from rlservo.envs.robots.arm import RobotError
from rlservo.envs.ros2.link import Endpoint, Publish, safely
from rlservo.envs.ros2.messages import for_rosbridge, parse

CONNECT_S = 10.0
CALL_S = 5.0


class RosbridgeLink:
    """A client of a rosbridge. All clients share the bridge's node."""

    def __init__(self, host: str, port: int) -> None:
        """Connect. Raises RobotError without roslibpy, or if no rosbridge answers."""
        try:
            import roslibpy
        except ImportError as error:
            how = "pip install '.[rosbridge]' in the checkout of rlservo"
            raise RobotError(f"a rosbridge needs roslibpy ({error}): {how}") from error
        self._library: Any = roslibpy
        try:
            socket.create_connection((host, port), CONNECT_S).close()  # roslibpy retries repeatedly and silently
        except OSError as error:
            reason = error.strerror or "no answer"
            raise RobotError(
                f"no rosbridge answers at {host}:{port} ({reason}): is the robot switched on and on this network"
            ) from error
        self._ros: Any = roslibpy.Ros(host, port)
        self._topics: list[Any] = []
        try:
            self._ros.run(timeout=CONNECT_S)
        except Exception as error:
            self.close()
            raise RobotError(f"the server at {host}:{port} is not a rosbridge: {error}") from error

    def now_s(self) -> float:
        """Return the system's time [s]."""
        return time.time()

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None]) -> None:
        """Subscribe to the newest message."""
        one = self._library.Topic(self._ros, topic, kind.replace("/msg/", "/"), queue_length=1)
        one.subscribe(safely(lambda message: on_message(parse(message)), topic))
        self._topics.append(one)

    def advertise(self, topic: str, kind: str) -> Publish:
        """Publish only the newest message."""
        one = self._library.Topic(self._ros, topic, kind.replace("/msg/", "/"), queue_size=1)
        one.advertise()
        self._topics.append(one)

        def publish(values: Mapping[str, Any]) -> None:
            if self._ros.is_connected:
                one.publish(self._library.Message(for_rosbridge(values)))

        return publish

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the nodes that publish, with the topic's type; the bridge stands for its other clients."""
        return self._nodes("publishers", topic)

    def rivals(self, topic: str) -> list[Endpoint]:
        """Return the bridge if another client of it publishes; a robot's own nodes always may."""
        if any(one.name == topic and one.is_advertised for one in self._topics):
            return []
        nodes = [one for one in self.publishers(topic) if "rosbridge" in one.node]
        return [Endpoint(f"another client of {one.node}", one.type) for one in nodes]

    def subscribers(self, topic: str) -> list[Endpoint]:
        """Return the nodes that subscribe, with the topic's type."""
        return self._nodes("subscribers", topic)

    def close(self) -> None:
        """Unsubscribe and close the connection."""
        for one in self._topics:
            one.unadvertise() if one.is_advertised else one.unsubscribe()
        self._ros.call_later(0.0, self._ros.factory.stopTrying)  # else it would connect again, and advertise
        with contextlib.suppress(Exception):  # a bridge that has stopped answering; its error is not public
            self._ros.close(timeout=1.0)

    def _nodes(self, which: str, topic: str) -> list[Endpoint]:
        nodes = self._call(which, topic).get(which) or []
        kind = (self._call("topic_type", topic).get("type") or "") if nodes else ""
        if "/msg/" not in kind:  # ROS 1's spelling
            kind = kind.replace("/", "/msg/")
        return [Endpoint(node, kind) for node in nodes]

    def _call(self, service: str, topic: str) -> Mapping[str, Any]:
        kind = f"rosapi/{service.title().replace('_', '')}"
        caller = self._library.Service(self._ros, f"/rosapi/{service}", kind)
        try:
            answer: Mapping[str, Any] = caller.call(self._library.ServiceRequest({"topic": topic}), timeout=CALL_S)
        except Exception as error:  # a timeout or the bridge's refusal
            raise RobotError(f"the rosbridge does not answer /rosapi/{service} for {topic}: {error}") from error
        return answer
