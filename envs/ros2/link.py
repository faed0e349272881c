"""Link to a ROS graph: the interface to rclpy or a rosbridge for the backends, the node and the simulators."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from rlservo.envs.robots.arm import RobotError
from rlservo.envs.ros2.address import RosAddress

SAID_AFTER_S = 10.0
FIRST_MESSAGES_S = 30.0
CLOCK_TOLERANCE_S = 5.0  # older than this at the first message: the clocks differ, no link is so slow
LOOK_S = 0.02
# In which every node of the graph is discovered: Fast DDS repeats its announcements every 3 s, and one may be lost.
DISCOVERY_S = 4.0
LEAVING_S = 1.0  # until an ended node has left the graph, or a new one's name is known

Publish = Callable[[Mapping[str, Any]], None]
log = logging.getLogger("rlservo.robot")


class Endpoint(NamedTuple):
    """A publisher or subscriber of another node."""

    node: str
    type: str  # "geometry_msgs/msg/Twist"


class Topics(Protocol):
    """Topics of a graph. Callbacks run in a thread of their own, one at a time."""

    def now_s(self) -> float:
        """Return ROS's time [s]."""
        ...

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None]) -> None:
        """Call `on_message` with each new message."""
        ...

    def advertise(self, topic: str, kind: str) -> Publish:
        """Return a function that publishes a message given as a dictionary."""
        ...

    def close(self) -> None:
        """Leave the graph."""
        ...


class Link(Topics, Protocol):
    """A connection to the graph, which knows its other nodes."""

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the publishers of other nodes."""
        ...

    def rivals(self, topic: str) -> list[Endpoint]:
        """Return the publishers that compete for the topic."""
        ...

    def subscribers(self, topic: str) -> list[Endpoint]:
        """Return the subscribers of other nodes."""
        ...


def open_link(address: RosAddress, name: str) -> Link:
    """Return the link for an address. Raises RobotError without rclpy, or if no rosbridge answers."""
    if address.host:
        from rlservo.envs.ros2.rosbridge_link import RosbridgeLink

        return RosbridgeLink(address.host, address.port)
    from rlservo.envs.ros2.rclpy_link import RclpyLink

    return RclpyLink(name)


def wait_until(condition: Callable[[], bool], what: Callable[[], str] | str, timeout_s: float) -> None:
    """Wait for a condition, and report it after 10 s. Raises RobotError when it does not come true in time."""
    began, said = time.monotonic(), False
    while not condition():
        waited_s = time.monotonic() - began
        reason = what if isinstance(what, str) else what()
        if waited_s > timeout_s:
            raise RobotError(f"{reason}, for {timeout_s:g} s")
        if waited_s > SAID_AFTER_S and not said:
            said = True
            log.warning("still waiting: %s", reason)
        time.sleep(LOOK_S)


def check_clock(topic: str, age_s: float) -> None:
    """Raise RobotError for stamps that come from another clock."""
    if age_s > CLOCK_TOLERANCE_S:
        raise RobotError(f"{topic} has stamps {age_s:.1f} s old: synchronise the clocks (chrony), or set clock=robot")


def take_command(link: Link, topic: str, *kinds: str) -> tuple[str, Publish]:
    """Advertise a command topic exclusively, with the one of `kinds` that its subscribers use; return that too.

    Raises RobotError, which names a node that publishes on it already.
    """
    types: set[str] = set()

    def refuse() -> None:
        if not link.rivals(topic):
            return
        time.sleep(LEAVING_S)
        if others := link.rivals(topic):
            names = ", ".join(sorted({one.node for one in others}))
            raise RobotError(f"{topic} is already commanded by {names}: end it first, as a robot obeys one node")

    def is_listened_to() -> bool:
        refuse()
        types.update(one.type for one in link.subscribers(topic))
        return not types.isdisjoint(kinds)

    try:
        wait_until(
            is_listened_to, f"nothing subscribes to {topic} ({' or '.join(kinds)}): is its controller running", 20.0
        )
    except RobotError:
        if types:
            what = f"{topic} takes {', '.join(sorted(types))}, not {' or '.join(kinds)}"
            raise RobotError(f"{what}: name another topic or type") from None
        raise
    kind, *others = types.intersection(kinds)
    if others:
        raise RobotError(f"{topic} has subscribers of the types {', '.join(sorted(types))}: set twist=TYPE")
    publish = link.advertise(topic, kind)
    # If two start at once, each sees the other, and neither commands.
    until = time.monotonic() + DISCOVERY_S
    while time.monotonic() < until:
        refuse()
        time.sleep(LOOK_S)
    return kind, publish


def safely(on_message: Callable[[Any], None], topic: str) -> Callable[[Any], None]:
    """Return a callback that survives malformed messages: neither its thread nor the robot's control ends."""
    said = ""

    def take(message: Any) -> None:
        nonlocal said
        try:
            on_message(message)
        except Exception as error:  # a message from any node
            if (why := f"{type(error).__name__}: {error}") != said:  # not at the rate of the messages
                log.warning("a message on %s cannot be understood: %s", topic, why)
            said = why

    return take
