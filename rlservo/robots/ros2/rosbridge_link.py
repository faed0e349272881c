"""Link through a rosbridge (WebSocket), with roslibpy: it needs no ROS here. A MiR has one on port 9090.

A MiR's is ROS 1, which refuses ROS 2's names of types and times; a rosbridge of ROS 2 takes ROS 1's.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.ros2.link import Endpoint, Publish, safely
from rlservo.robots.ros2.ros_messages import for_rosbridge, parse

CONNECT_S = 10.0
CALL_S = 5.0
OWN_MESSAGES = 100  # that may be on their way through the bridge and back


class RosbridgeLink:
    """A client of a rosbridge. All clients share the bridge's node."""

    knows_quality = False

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
                f"no rosbridge answers at {host}:{port} ({reason}): is the robot switched on and on this network?"
            ) from error
        self._ros: Any = roslibpy.Ros(host, port)
        self._topics: list[Any] = []
        self._foreign_s: dict[str, float] = {}  # time.monotonic() of others' newest messages on our own topics
        try:
            self._ros.run(timeout=CONNECT_S)
        except Exception as error:
            self.close()
            raise RobotError(f"the server at {host}:{port} is not a rosbridge: {error}") from error

    def now_s(self) -> float:
        """Return the system's time [s]."""
        return time.time()

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None], *, is_kept: bool = False) -> None:
        """Subscribe to the newest message, or to all that publishers keep."""
        one = self._library.Topic(self._ros, topic, kind.replace("/msg/", "/"), queue_length=0 if is_kept else 1)
        one.subscribe(safely(lambda message: on_message(parse(message)), topic))
        self._topics.append(one)

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> Publish:
        """Publish only the newest message."""
        one = self._library.Topic(self._ros, topic, kind.replace("/msg/", "/"), queue_size=1, latch=is_kept)
        one.advertise()
        self._topics.append(one)
        own: deque[Mapping[str, Any]] = deque(maxlen=OWN_MESSAGES)
        self._foreign_s[topic] = -math.inf

        def look(message: Mapping[str, Any]) -> None:
            if not any(_is_part(sent, message) for sent in list(own)):
                self._foreign_s[topic] = time.monotonic()

        def publish(values: Mapping[str, Any]) -> None:
            if self._ros.is_connected:
                own.append(values)
                one.publish(self._library.Message(for_rosbridge(values)))

        # All clients are one node of the graph: others are known only by their messages.
        echo = self._library.Topic(self._ros, topic, kind.replace("/msg/", "/"))
        echo.subscribe(safely(look, topic))
        self._topics.append(echo)
        return publish

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the nodes that publish, with the topic's type; the bridge stands for its other clients."""
        return self._nodes("publishers", topic)

    def rivals(self, topic: str, since_s: float = 0.0) -> list[Endpoint]:
        """Return the bridge if another client of it publishes; a robot's own nodes may, while they send nothing.

        Once the topic is advertised: whether messages came that are not ours.
        """
        if topic in self._foreign_s:
            return [Endpoint("another node", "")] if self._foreign_s[topic] > since_s else []
        nodes = [one for one in self.publishers(topic) if "rosbridge" in one.node]
        return [Endpoint(f"another client of {one.node}", one.type) for one in nodes]

    def subscribers(self, topic: str) -> list[Endpoint]:
        """Return the nodes that subscribe, with the topic's type."""
        return self._nodes("subscribers", topic)

    def strings(self, node: str, parameter: str) -> list[str] | None:
        """Return None: an arm, whose controller has such a parameter, is not reached by a rosbridge."""
        del node, parameter
        return None

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


def _is_part(sent: Any, message: Any) -> bool:
    """Return whether a message, as a rosbridge sends it, has the values of one of ours."""
    if not isinstance(sent, Mapping):
        return bool(sent == message)
    names = {"sec": "secs", "nanosec": "nsecs"}  # ROS 1's
    return all(_is_part(one, message.get(name, message.get(names.get(name, "")))) for name, one in sent.items())
