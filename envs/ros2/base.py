"""A mobile base behind ROS: state in, velocities within limits out, at 20 Hz from its own thread.

If its process dies, the base's own timeout of velocity commands stops it (diff_drive_controller and the MiR100: 0.5 s),
as it does if the network fails.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.mir100.parameters import (
    BACK_SCANNER,
    BODY_CENTRE,
    FRONT_SCANNER,
    LENGTH,
    MAX_ANGULAR_ACCELERATION,
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_VELOCITY,
    WIDTH,
)
from rlservo.envs.robots.arm import RobotError
from rlservo.envs.robots.command_stream import Order, Phase
from rlservo.envs.robots.limits import CheckedLimits
from rlservo.envs.robots.link_delay import LinkDelay
from rlservo.envs.ros2.address import BASE_OPTIONS, RosAddress
from rlservo.envs.ros2.link import FIRST_MESSAGES_S, check_clock, open_link, take_command, wait_until
from rlservo.envs.ros2.messages import (
    FLAG,
    LASER_SCAN,
    ODOMETRY,
    TWIST,
    TWIST_STAMPED,
    planar_state,
    readings,
    scan_points,
    scanner_pose,
    stamp_of,
    twist,
)

RATE_HZ = 20.0
AGE_BOUND_S = 0.3  # [s] oldest input that may be acted on: scans come at 12.5 Hz, or 10
LOST_S = 2.0  # [s] without odometry, after which the connection counts as lost
DEADMAN_S = 0.5  # [s], oldest dead-man message
TWISTS = {"auto": (TWIST, TWIST_STAMPED), "Twist": (TWIST,), "TwistStamped": (TWIST_STAMPED,)}
SCALES = (1.0, 0.75, 0.5, 0.25)  # of a velocity, tried in order if something is in the way
INSTANTS = 5  # points checked on the path to a standstill

Vector = NDArray[np.float64]
Twist2 = tuple[float, float]  # [m/s], [rad/s]


@dataclass(frozen=True)
class BaseLimits(CheckedLimits):
    """Limits of a base's motion, inside those of its own safety scanners."""

    speed_scale: float = 1.0  # of both velocities; use 0.2 for a first run
    acceleration: float = 1.5  # [m/s^2], also to stop
    angular_acceleration: float = MAX_ANGULAR_ACCELERATION  # [rad/s^2]
    stop_distance: float = 0.1  # [m], between the body and a scan's points; 0: the scan is not used
    blend_s: float = 0.5  # [s] in which the policy's share of the speed grows from 0 to 1

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "speed_scale": (0.01, 1.0), "acceleration": (0.1, 2.0), "angular_acceleration": (0.1, 2.5),
        "stop_distance": (0.0, 2.0), "blend_s": (0.0, 60.0),
    }  # fmt: skip


class BaseState(NamedTuple):
    """State of a base at one moment."""

    pose: tuple[float, float, float]  # [m], [m], [rad], of base_link in the odometry's frame
    velocity: Twist2
    readings: Vector | None  # [m], (1012,), of the MiR100's scanners; None without a scan
    received_s: float  # time.monotonic() at the arrival of its oldest message
    age_s: float  # that message's age then


class _Input:
    """The newest message of one topic, and its age by its stamp."""

    def __init__(self, now_s: Callable[[], float], *, has_own_clock: bool) -> None:
        self._now_s, self._has_own_clock = now_s, has_own_clock
        self.value: Any = None
        self.received_s, self.age_s, self._made_s = 0.0, 0.0, 0.0
        self._delay = LinkDelay()

    def take(self, message: Any, value: Any) -> None:
        """Take a message, unless it is older than the last one."""
        made_s, now = stamp_of(message), time.monotonic()
        if value is None or made_s is None or made_s <= self._made_s:
            return
        now_s = self._now_s()
        self._made_s, self.value, self.received_s = made_s, value, now
        self.age_s = self._delay.excess_s(made_s, now_s) if self._has_own_clock else abs(now_s - made_s)

    def age(self) -> float:
        """Return the newest message's present age [s]."""
        return math.inf if self.value is None else time.monotonic() - self.received_s + self.age_s


class RosBase:
    """A base that is commanded by velocities. `close` stops it and leaves the graph."""

    def __init__(
        self, robot: str, *, limits: BaseLimits | None = None, setpoint_timeout_s: float = 0.25, needs_scan: bool = True
    ) -> None:
        """Wait for every input, then take the command topic. Raises RobotError."""
        self.address = address = RosAddress.parse(robot, BASE_OPTIONS)
        self.limits = limits or BaseLimits()
        self._setpoint_timeout_s = setpoint_timeout_s
        self._order, self._blend_from_s = Order.HOLD, 0.0
        self._setpoint: tuple[float, Twist2] = (0.0, (0.0, 0.0))  # when it was given, [m/s], [rad/s]
        self._velocity: Twist2 = (0.0, 0.0)  # that is commanded
        self._counts: Counter[str] = Counter()
        self.phase, self.blend, self.fault = Phase.HOLD, 0.0, ""
        self._deadman = (0.0, False)
        self._link = link = open_link(address, "rlservo_base")
        has_own_clock = (address["clock"] or ("robot" if address.host else "ros")) == "robot"
        self._inputs: dict[str, _Input] = {}
        self._is_closed = threading.Event()
        self._thread: threading.Thread | None = None
        try:
            scans = self._scan_topics() if needs_scan or self.limits.stop_distance else {}
            for topic in (address["odom"], *scans):
                self._inputs[topic] = _Input(link.now_s, has_own_clock=has_own_clock)
            odometry = self._inputs[address["odom"]]
            link.subscribe(address["odom"], ODOMETRY, lambda one: odometry.take(one, planar_state(one)))
            for topic, pose in scans.items():
                self._subscribe_scan(topic, pose)
            if address["deadman"]:
                link.subscribe(address["deadman"], FLAG, self._take_deadman)
            wait_until(self._is_complete, self._missing, FIRST_MESSAGES_S)
            for topic, one in self._inputs.items():
                check_clock(topic, one.age_s)
                names = {one.node for one in link.publishers(topic)} if not address.host else set()
                if len(names) > 1:  # behind a rosbridge any number may be registered
                    raise RobotError(f"{topic} comes from {' and '.join(sorted(names))}: end one, or name another")
            kind, self._publish = take_command(link, address["cmd_vel"], *TWISTS[address["twist"]])
            self._is_stamped = kind == TWIST_STAMPED
        except BaseException:
            link.close()
            raise
        self._thread = threading.Thread(target=self._run, name="base-commands", daemon=True)
        self._thread.start()

    def state(self) -> BaseState:
        """Return the newest state."""
        odometry, *scans = self._inputs.values()
        pose, velocity = odometry.value
        oldest = max(self._inputs.values(), key=_Input.age)
        seen = readings(self._points()) if scans else None
        return BaseState(pose, velocity, seen, oldest.received_s, oldest.age_s)

    def command(self, linear: float, angular: float) -> None:
        """Replace the velocities [m/s], [rad/s]; they hold for `setpoint_timeout_s`."""
        if not (math.isfinite(linear) and math.isfinite(angular)):
            raise ValueError(f"the velocity command is ({linear} m/s, {angular} rad/s): expected finite numbers")
        self._setpoint, self._order = (time.monotonic(), (linear, angular)), Order.FOLLOW

    def hold(self) -> None:
        """Decelerate and hold."""
        self._order = Order.HOLD

    def free(self) -> None:
        """Stop publishing, so that a person may drive."""
        self._order = Order.FREE

    def blend_in(self) -> None:
        """Hold, and let the speed of later commands grow from 0."""
        self._order, self._blend_from_s = Order.HOLD, time.monotonic()

    def limited(self) -> dict[str, int]:
        """Return the number of commands in which each limit was applied."""
        return {name: count for name, count in self._counts.items() if count}

    def close(self) -> None:
        """Decelerate, stop and leave the graph."""
        self._is_closed.set()
        if self._thread is not None:
            self._thread.join()
        self._link.close()

    # -- inputs

    def _scan_topics(self) -> dict[str, tuple[float, float, float]]:
        """Return the scans' topics and their poses in base_link [m], [m], [rad]."""
        address = self.address
        both = {
            address["front_scan"]: scanner_pose(FRONT_SCANNER),
            address["back_scan"]: scanner_pose(BACK_SCANNER),
        }
        found: dict[str, tuple[float, float, float]] = {}

        def look() -> bool:
            single = address["scan"] or "/scan"
            if not address["scan"] and all(self._link.publishers(topic) for topic in both):
                found.update(both)
            elif self._link.publishers(single):
                found[single] = (0.0, 0.0, 0.0)
            return bool(found)

        names = address["scan"] or f"{' and '.join(both)}, or /scan"
        wait_until(look, f"nothing publishes {names} (limit stop_distance=0 works without it)", FIRST_MESSAGES_S)
        return found

    def _subscribe_scan(self, topic: str, pose: tuple[float, float, float]) -> None:
        one = self._inputs[topic]
        self._link.subscribe(topic, LASER_SCAN, lambda message: one.take(message, scan_points(message, pose)))

    def _take_deadman(self, message: Any) -> None:
        self._deadman = (time.monotonic(), bool(message.data))

    def _is_complete(self) -> bool:
        return all(one.value is not None for one in self._inputs.values())

    def _missing(self) -> str:
        missing = [topic for topic, one in self._inputs.items() if one.value is None]
        return f"no message with a stamp on {', '.join(missing)}: is the base's driver running"

    def _points(self) -> Vector:
        scans = list(self._inputs.values())[1:]
        return np.concatenate([one.value for one in scans]) if scans else np.zeros((0, 2))

    # -- commands

    def _run(self) -> None:
        due = time.monotonic()
        while not (self._is_closed.is_set() and self._velocity == (0.0, 0.0)):
            due = max(due + 1.0 / RATE_HZ, time.monotonic())
            try:
                self._velocity = self._next()
                if self.phase != Phase.FREE:
                    made_s = self._link.now_s() if self._is_stamped else None
                    self._publish(twist(*self._velocity, stamped_s=made_s))
            except Exception as error:  # of the link: without commands the base stops by its timeout
                self.fault, self._velocity = f"command_failed: {type(error).__name__}: {error}", (0.0, 0.0)
            time.sleep(max(0.0, due - time.monotonic()))

    def _next(self) -> Twist2:
        """Return the velocities of the next command, within the limits; set the phase."""
        want, dt, limits = self._wanted(), 1.0 / RATE_HZ, self.limits
        if self.phase == Phase.FREE:
            return 0.0, 0.0
        changed = []
        most_change = (limits.acceleration * dt, limits.angular_acceleration * dt)
        for name, now, wanted, most in zip(("linear", "angular"), self._velocity, want, most_change, strict=True):
            step = min(max(wanted - now, -most), most)
            self._counts[f"acceleration.{name}"] += abs(wanted - now) > 2.0 * most
            changed.append(now + step)
        linear, angular = changed
        if self._is_clear(linear, angular):
            return linear, angular
        self._counts["stop_distance"] += 1
        for scale in SCALES[1:]:
            if self._is_clear(linear * scale, angular * scale):
                return linear * scale, angular * scale
        return 0.0, 0.0

    def _wanted(self) -> Twist2:
        now = time.monotonic()
        given_s, (linear, angular) = self._setpoint
        odometry = next(iter(self._inputs.values()))
        if odometry.age() > LOST_S and not self.fault:
            self.fault = f"connection_lost: no odometry on {self.address['odom']} for {LOST_S:g} s: check its network"
        if self.fault:
            self.phase = Phase.FAULT
        elif self._order == Order.FREE:
            self.phase = Phase.FREE
        elif self._order == Order.HOLD or self._is_closed.is_set():
            self.phase = Phase.HOLD
        elif max(one.age() for one in self._inputs.values()) > AGE_BOUND_S:
            self._note(Phase.STALE, "stale_observation")
        elif now - given_s > self._setpoint_timeout_s:
            self._note(Phase.LATE, "late_setpoint")
        elif self.address["deadman"] and not (self._deadman[1] and now - self._deadman[0] < DEADMAN_S):
            self._note(Phase.LATE, "deadman_released")
        else:
            self.phase = Phase.FOLLOW
            limits = self.limits
            blend = (now - self._blend_from_s) / limits.blend_s if limits.blend_s else 1.0
            self.blend = min(max(blend, 0.0), 1.0)
            scale = limits.speed_scale * self.blend
            fastest = (MAX_LINEAR_VELOCITY, MAX_ANGULAR_VELOCITY)
            return (
                min(max(linear, -fastest[0]), fastest[0]) * scale,
                min(max(angular, -fastest[1]), fastest[1]) * scale,
            )
        return 0.0, 0.0

    def _note(self, phase: Phase, why: str) -> None:
        self._counts[why] += self.phase != phase
        self.phase = phase

    def _is_clear(self, linear: float, angular: float) -> bool:
        """Return whether the body keeps its distance until standstill, or at least comes no nearer to close points."""
        points = self._points()
        if not self.limits.stop_distance or not len(points) or not (linear or angular):
            return True
        stop_s = 2.0 / RATE_HZ + max(
            abs(linear) / self.limits.acceleration, abs(angular) / self.limits.angular_acceleration
        )
        before = _distances(points, 0.0, 0.0, 0.0)
        near = before < self.limits.stop_distance + stop_s * (abs(linear) + LENGTH * abs(angular))
        points, before = points[near], before[near]
        for share in np.linspace(1.0 / INSTANTS, 1.0, INSTANTS).tolist():
            time_s = share * stop_s * (1.0 - share / 2.0)  # decelerating, it covers half of that distance
            yaw = angular * time_s
            x = linear * time_s * math.cos(yaw / 2.0)
            y = linear * time_s * math.sin(yaw / 2.0)
            distances = _distances(points, x, y, yaw)
            if ((distances < self.limits.stop_distance) & (distances < before - 1e-4)).any():
                return False
        return True


def _distances(points: Vector, x: float, y: float, yaw: float) -> Vector:
    """Return each point's distance [m] from the body of a base at a pose, negative inside."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy = points[:, 0] - x, points[:, 1] - y
    ahead = np.abs(cos * dx + sin * dy - BODY_CENTRE[0]) - LENGTH / 2.0
    left = np.abs(cos * dy - sin * dx) - WIDTH / 2.0
    outside: Vector = np.hypot(np.maximum(ahead, 0.0), np.maximum(left, 0.0))
    return outside + np.minimum(np.maximum(ahead, left), 0.0)
