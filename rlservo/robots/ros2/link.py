"""Link to a ROS graph: the interface to rclpy or a rosbridge for the backends, the node and the simulators."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from rlservo.robots.arm_interface import RobotError

SAID_AFTER_S = 10.0
FIRST_MESSAGES_S = 30.0
CLOCK_TOLERANCE_S = 5.0  # older than this at the first message: the clocks differ, no link is so slow
LOOK_S = 0.02
# In which every node of the graph is discovered: Fast DDS repeats its announcements every 3 s, and one may be lost.
DISCOVERY_S = 4.0
WATCH_S = 0.1  # between two looks at who else commands
PAUSE_S = 0.3  # without a command of ours, after which commands of others before the next one are nothing new
PASSING_S = 0.2  # in which the last of those still arrives
LEAVING_S = 1.0  # until an ended node has left the graph, or a new one's name is known

Publish = Callable[[Mapping[str, Any]], None]
log = logging.getLogger("rlservo.robot")


class Endpoint(NamedTuple):
    """A publisher or subscriber of another node."""

    node: str
    type: str  # "geometry_msgs/msg/Twist"
    mismatch: str = ""  # of a subscriber: why the quality of service keeps our messages from it


class Topics(Protocol):
    """Topics of a graph. Callbacks run in a thread of their own, one at a time."""

    def now_s(self) -> float:
        """Return ROS's time [s]."""
        ...

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None], *, is_kept: bool = False) -> None:
        """Call `on_message` with each new message; `is_kept`: also with those that publishers keep for late comers."""
        ...

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> Publish:
        """Return a function that publishes a message given as a dictionary; `is_kept`: for late comers, too."""
        ...

    def close(self) -> None:
        """Leave the graph."""
        ...


class Link(Topics, Protocol):
    """A connection to the graph, which knows its other nodes."""

    knows_quality: bool  # whether it knows the subscribers' quality of service, and at once

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the publishers of other nodes."""
        ...

    def rivals(self, topic: str, since_s: float = 0.0) -> list[Endpoint]:
        """Return the publishers that compete for the topic.

        If they are known only by their messages: those that sent one after `since_s` by time.monotonic().
        """
        ...

    def subscribers(self, topic: str) -> list[Endpoint]:
        """Return the subscribers of other nodes."""
        ...

    def strings(self, node: str, parameter: str) -> list[str] | None:
        """Return a parameter of another node that is a list of strings; None if it cannot be read."""
        ...


def wait_until(condition: Callable[[], bool], what: Callable[[], str] | str, timeout_s: float) -> None:
    """Wait for a condition, and report it after 10 s. Raises RobotError when it does not come true in time."""
    began, said = time.monotonic(), False
    while not condition():
        waited_s = time.monotonic() - began
        reason = what if isinstance(what, str) else what()
        if waited_s > timeout_s:
            raise RobotError(f"waited {timeout_s:g} s: {reason}")
        if waited_s > SAID_AFTER_S and not said:
            said = True
            log.warning("still waiting: %s", reason)
        time.sleep(LOOK_S)


def check_clock(link: Link, topic: str, age_s: float) -> None:
    """Raise RobotError for stamps that come from another clock."""
    if age_s > CLOCK_TOLERANCE_S and link.publishers("/clock"):
        how = "start this node with --ros-args -p use_sim_time:=true, or set clock=robot"
        raise RobotError(f"{topic} has stamps of simulated time, which is on /clock: {how}")
    if age_s > CLOCK_TOLERANCE_S:
        raise RobotError(f"{topic} has stamps {age_s:.1f} s old: synchronise the clocks (chrony), or set clock=robot")


def check_publisher(link: Link, topic: str) -> None:
    """Raise RobotError if a robot's state has two publishers."""
    names = sorted({one.node for one in link.publishers(topic)})
    if len(names) > 1:
        raise RobotError(f"second_publisher: {topic} comes from {' and '.join(names)}: end one, or name another topic")


def take_command(link: Link, topic: str, *kinds: str, rest: Mapping[str, Any] | None = None) -> tuple[str, Publish]:
    """Advertise a command topic exclusively, with the one of `kinds` that its subscribers use; return that too.

    Raises RobotError, which names a node that publishes on it already. Publishing raises it too, from the moment on in
    which another node does; `rest`, a command to stand, is sent before.
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
    time.sleep(DISCOVERY_S / 4)  # its subscribers may be known before the node that commands it, which must not fault
    refuse()
    publish = link.advertise(topic, kind)
    # If two start at once, each sees the other, and neither commands.
    until = time.monotonic() + DISCOVERY_S
    while time.monotonic() < until:
        refuse()
        time.sleep(LOOK_S)
    if why := _unheard(link, topic, kind):
        raise RobotError(why)
    return kind, _watched(link, topic, kind, publish, rest)


def _unheard(link: Link, topic: str, kind: str) -> str:
    """Return why our commands reach no subscriber; empty if they reach one, or none is there."""
    listeners = [one for one in link.subscribers(topic) if one.type == kind]
    if not listeners or not all(one.mismatch for one in listeners):
        return ""
    nodes = " and ".join(f"{one.node} ({one.mismatch})" for one in listeners)
    return (
        f"{topic}: the quality of service keeps our commands from {nodes}: change its own, or ours (-p "
        f"qos_overrides.{topic}.publisher...)"
    )


def _watched(link: Link, topic: str, kind: str, publish: Publish, rest: Mapping[str, Any] | None) -> Publish:
    """Return a function that publishes as long as no other node commands the topic, and one can hear it."""
    looked_s = began_s = sent_s = -math.inf
    problem = ""

    def send(values: Mapping[str, Any]) -> None:
        nonlocal looked_s, began_s, sent_s, problem
        now = time.monotonic()
        if now - sent_s > PAUSE_S:  # a person may have driven meanwhile
            began_s = now
        if now - looked_s > WATCH_S and not problem:
            looked_s = now
            if others := link.rivals(topic, began_s + PASSING_S):
                names = ", ".join(sorted({one.node for one in others}))
                problem = f"second_commander: {topic} is also commanded by {names}: end it, as a robot obeys one node"
            elif link.knows_quality and (why := _unheard(link, topic, kind)):
                problem = f"unheard: {why}"
            if problem and rest is not None:
                publish(rest)
        if problem:
            raise RobotError(problem)
        sent_s = now
        publish(values)

    return send


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
