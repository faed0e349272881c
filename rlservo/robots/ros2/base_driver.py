"""A mobile base behind ROS: state in, velocities within limits out, at 20 Hz from its own thread.

If its process dies, the base's own timeout of velocity commands stops it (diff_drive_controller and the MiR100: 0.5 s),
as it does if the network fails.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from rlservo.robots.arm_interface import RobotError, Vector
from rlservo.robots.control_law import ControlLaw, Order, Phase
from rlservo.robots.limits import CheckedLimits
from rlservo.robots.link_delay import LinkDelay
from rlservo.robots.mir100.parameters import (
    BODY_CENTRE,
    LENGTH,
    MAX_ANGULAR_ACCELERATION,
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_VELOCITY,
    WIDTH,
)
from rlservo.robots.ros2.address import BASE_OPTIONS, RosAddress
from rlservo.robots.ros2.clearance import BaseMotion, Body, Scan
from rlservo.robots.ros2.frames import Frames, Matrix, inverse, plain, planar_pose, planar_transform
from rlservo.robots.ros2.link import (
    FIRST_MESSAGES_S,
    WATCH_S,
    Link,
    check_clock,
    check_publisher,
    take_command,
    wait_until,
)
from rlservo.robots.ros2.plausibility import Progress, ScanChange, moved
from rlservo.robots.ros2.ros_messages import (
    FLAG,
    LASER_SCAN,
    ODOMETRY,
    TRANSFORMS,
    TWIST,
    TWIST_STAMPED,
    planar_state,
    read_scan,
    readings,
    stamp_of,
    twist,
)

RATE_HZ = 20.0
FRAMES_S = 5.0  # [s] in which static transforms arrive after the first messages
AGE_BOUND_S = 0.3  # [s] oldest input that may be acted on: scans come at 12.5 Hz, or 10
SAME_PLACE = 0.01  # [m], [rad], by which a frame's place may differ from the first one
JUMP = (0.1, 0.3)  # [m], [rad], beyond what the base can move, that count as a jump
LOST_S = 2.0  # [s] without odometry, after which the connection counts as lost
DEADMAN_S = 0.5  # [s], oldest dead-man message
TWISTS = {"auto": (TWIST, TWIST_STAMPED), "Twist": (TWIST,), "TwistStamped": (TWIST_STAMPED,)}
FASTEST = np.array([MAX_LINEAR_VELOCITY, MAX_ANGULAR_VELOCITY])
STANDS = 0.01  # [m/s]
AT_REST = 0.05  # [m/s], [rad/s], below which a person may lead the base: an odometry may be noisy
BLOCKED_S = 1.0  # of standing before something, after which the base counts as blocked
OBSTRUCTIONS = {
    "stop_distance": "something is within stop_distance on its way",
    "unseen": "no beam shows what is on its way (unknown_beams=free: NaN, 0 and null are the driver's for a free way)",
}
SCALES = (1.0, 0.75, 0.5, 0.25)  # of a velocity, tried in order if something is in the way
FRONT, BACK, SIDE = BODY_CENTRE[0] + LENGTH / 2.0, BODY_CENTRE[0] - LENGTH / 2.0, WIDTH / 2.0  # [m], of the MiR100
MIR100 = ((FRONT, SIDE), (BACK, SIDE), (BACK, -SIDE), (FRONT, -SIDE))

log = logging.getLogger("rlservo.robot")
OdometryState = tuple[tuple[float, float, float], tuple[float, float]]
Twist2 = tuple[float, float]  # [m/s], [rad/s]


def open_link(address: RosAddress, name: str) -> Link:
    """Return the link for an address. Raises RobotError without rclpy, or if no rosbridge answers."""
    if address.host:
        from rlservo.robots.ros2.rosbridge_link import RosbridgeLink

        return RosbridgeLink(address.host, address.port)
    from rlservo.robots.ros2.rclpy_link import RclpyLink

    return RclpyLink(name)


@dataclass(frozen=True)
class BaseLimits(CheckedLimits):
    """Limits of a base's motion, inside those of its own safety scanners."""

    speed_scale: float = 1.0  # of both velocities; use 0.2 for a first run
    acceleration: float = 1.5  # [m/s^2], also to stop
    angular_acceleration: float = MAX_ANGULAR_ACCELERATION  # [rad/s^2]
    stop_distance: float = 0.1  # [m], between the body and a scan's points; 0: the scan is not used
    footprint: tuple[tuple[float, float], ...] = MIR100  # [m], corners of the body in the base's frame
    blend_s: float = 0.5  # [s] in which the policy's share of the speed grows from 0 to 1

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "speed_scale": (0.01, 1.0), "acceleration": (0.1, 2.0), "angular_acceleration": (0.1, 2.5),
        "stop_distance": (0.0, 2.0), "blend_s": (0.0, 60.0),
    }  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            corners = np.array(self.footprint, dtype=np.float64)
        except (TypeError, ValueError):
            corners = np.zeros((0, 2))
        if corners.shape != (len(np.atleast_1d(corners)), 2) or len(corners) < 3 or not np.isfinite(corners).all():
            raise RobotError(f"limits: footprint is {self.footprint!r}: expected at least 3 corners [x, y] in m")


class BaseState(NamedTuple):
    """State of a base at one moment."""

    pose: tuple[float, float, float]  # [m], [m], [rad], of the base in the odometry's frame
    velocity: Twist2
    readings: Vector | None  # [m], (1012,), of the MiR100's scanners; None without a scan
    received_s: float  # time.monotonic() at the arrival of its oldest message
    age_s: float  # that message's age then


class _Input:
    """The newest message of one topic, and its age by its stamp."""

    def __init__(self, now_s: Callable[[], float], *, has_own_clock: bool) -> None:
        self._now_s, self._has_own_clock = now_s, has_own_clock
        self.value: Any = None
        self.problem = ""  # why the newest message cannot be used
        self.received_s, self.age_s, self.made_s = 0.0, 0.0, 0.0
        self.came_s = 0.0  # time.monotonic() at which any message came
        self._delay = LinkDelay()

    def take(self, message: Any, value: Any) -> None:
        """Take a message, unless it is older than the last one."""
        made_s, now = stamp_of(message), time.monotonic()
        self.came_s = now
        if value is None or made_s is None or made_s <= self.made_s:
            return
        now_s = self._now_s()
        self.made_s, self.value, self.received_s = made_s, value, now
        self.age_s = self._delay.excess_s(made_s, now_s) if self._has_own_clock else abs(now_s - made_s)

    def refuse(self, why: str) -> None:
        """Note why a message that came cannot be used."""
        self.came_s, self.problem = time.monotonic(), why

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
        self._body = Body(np.array(self.limits.footprint, dtype=np.float64))
        self._setpoint_timeout_s = setpoint_timeout_s
        self._order = Order.HOLD
        self._blend_from_s = 0.0  # time.monotonic() from which the speed grows from 0
        self._unblocked_s, self._obstructed_by = time.monotonic(), ""
        self._resumed_s = 0.0  # time.monotonic() at which this process last went on after a suspension
        self._setpoint: tuple[float, Twist2] = (0.0, (0.0, 0.0))  # when it was given, [m/s], [rad/s]
        self._velocity: Twist2 = (0.0, 0.0)  # that is commanded
        self.frame = ""  # the odometry's
        self._law = ControlLaw(setpoint_timeout_s=setpoint_timeout_s, blend_s=self.limits.blend_s, forget_s=0.0)
        self._decided_s = 0.0
        self._counts, self.fault = self._law.counts, ""
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
            self._frames, self._places = Frames(), dict[str, Matrix]()  # places by topic
            self._progress = Progress()
            self._without_frames = self._subscribe_frames()
            link.subscribe(address["odom"], ODOMETRY, self._take_odometry)
            for topic, pose in scans.items():
                self._subscribe_scan(topic, pose)
            if address["deadman"]:
                link.subscribe(address["deadman"], FLAG, self._take_deadman)
            wait_until(self._has_messages, self._missing, FIRST_MESSAGES_S)
            wait_until(self._is_complete, self._missing, FRAMES_S)
            for topic, one in self._inputs.items():
                check_clock(link, topic, one.age_s)
            self._check_publishers()
            kind, self._publish = take_command(link, address["cmd_vel"], *TWISTS[address["twist"]], rest={})
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
        seen = readings(np.concatenate([one.value.points for one in scans])) if scans else None
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
        """Decelerate, then stop publishing, so that a person may drive."""
        self._order = Order.FREE

    def blend_in(self) -> None:
        """Hold, and let the speed of later commands grow from 0."""
        self._order, self._blend_from_s = Order.HOLD, time.monotonic()

    @property
    def phase(self) -> Phase:
        """What the base does now."""
        return self._law.phase

    @property
    def blend(self) -> float:
        """The policy's share of the speed, 0 to 1."""
        return self._law.blend

    @property
    def blocked_by(self) -> str:
        """What has kept the base from driving for a second; empty while it drives, or is not to."""
        is_blocked = self.phase == Phase.FOLLOW and time.monotonic() - self._unblocked_s > BLOCKED_S
        return OBSTRUCTIONS[self._obstructed_by] if is_blocked and self._obstructed_by else ""

    def clearance(self, x: float, y: float) -> float:
        """Return the distance [m] from a place in the odometry's frame to what the scans show; inf without any."""
        (x0, y0, yaw), _ = next(iter(self._inputs.values())).value
        points = [np.zeros((0, 2)), *(one.points for one in self._scans())]
        place = (inverse(planar_transform(x0, y0, yaw)) @ (x, y, 0.0, 1.0))[:2]
        return float(np.min(np.hypot(*(np.concatenate(points) - place).T), initial=math.inf))

    @property
    def half_width(self) -> float:
        """The distance [m] from the base's origin to its body's nearest edge, and to keep from there."""
        return -float(self._body.distances(np.zeros((1, 2)))[0]) + self.limits.stop_distance

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

    def _scan_topics(self) -> dict[str, tuple[float, float, float] | None]:
        """Return the scans' topics and their poses in the base's frame [m], [m], [rad], if they are given."""
        address = self.address
        both = {address[name]: address.pose(f"{name}_pose") for name in ("front_scan", "back_scan")}
        found: dict[str, tuple[float, float, float] | None] = {}

        def look() -> bool:
            single = address["scan"] or "/scan"
            if not address["scan"] and all(self._link.publishers(topic) for topic in both):
                found.update(both)
            elif self._link.publishers(single):
                found[single] = address.pose("scan_pose")
            return bool(found)

        names = address["scan"] or f"{' and '.join(both)}, or /scan"
        wait_until(look, f"nothing publishes {names} (limit stop_distance=0 works without it)", FIRST_MESSAGES_S)
        return found

    def _subscribe_frames(self) -> str:
        """Subscribe to static transforms; return why there are none if their type is not installed."""
        try:
            self._link.subscribe("/tf_static", TRANSFORMS, self._frames.take, is_kept=True)
        except RobotError as error:
            return str(error)
        return ""

    def _subscribe_scan(self, topic: str, pose: tuple[float, float, float] | None) -> None:
        given, option = None if pose is None else planar_transform(*pose), self._pose_option(topic)
        free, change = self.address["unknown_beams"] == "free", ScanChange()

        def take(message: Any) -> None:
            place = self._place(topic, message.header.frame_id, option) if given is None else given
            try:
                seen = None if place is None else read_scan(message, place, unknown_is_free=free)
                if seen is not None and (odometry := self._inputs[self.address["odom"]].value) is not None:
                    change.check(seen.points, odometry[0])
                self._inputs[topic].take(message, seen)
            except ValueError as error:
                self._inputs[topic].refuse(f"{topic} cannot be used: {error}")
                raise

        self._link.subscribe(topic, LASER_SCAN, take)

    def _pose_option(self, topic: str) -> str:
        name = next((one for one in ("front_scan", "back_scan") if self.address[one] == topic), "scan")
        return f"{name}_pose=X:Y:YAW"

    def _take_odometry(self, message: Any) -> None:
        topic, child = self.address["odom"], message.child_frame_id
        place = self._place(topic, child, f"base_frame={child or 'FRAME'}")
        if place is not None:
            self.frame = plain(message.header.frame_id)
            state = planar_state(message, planar_pose(inverse(place)))
            if state is None:
                self._inputs[topic].refuse(f"{topic} has numbers that are not finite, or a quaternion of zeros")
            else:
                self._check_jump(message, state)
                self._inputs[topic].take(message, state)

    def _check_jump(self, message: Any, state: OdometryState) -> None:
        """Note a fault if the base was elsewhere just before."""
        one, made_s = self._inputs[self.address["odom"]], stamp_of(message)
        if one.value is None or made_s is None or made_s <= one.made_s:
            return
        passed_s = min(made_s - one.made_s, time.monotonic() - one.received_s + LOST_S)
        way = moved(state[0], one.value[0])
        if (way > JUMP + 2.0 * FASTEST * passed_s).any():
            jump = f"{way[0]:.2f} m and {way[1]:.2f} rad in {passed_s:.2f} s"
            self.fault = self.fault or (
                f"odometry_jumped: {self.address['odom']} moved by {jump}: is it published twice, or was it or its "
                "clock reset"
            )

    def _check_progress(self, passed_s: float) -> None:
        """Note a fault if the odometry stands while the base is driven, as it was for the last `passed_s` [s]."""
        topic = self.address["odom"]
        why = self._progress.note(self._velocity, passed_s, self._inputs[topic].value[0])
        if why and not self.fault:
            self.fault = f"not_following: {topic} {why}: is it frozen, or the base blocked, or not powered"

    def _place(self, topic: str, frame: str, option: str) -> Matrix | None:
        """Return the transform of a message's frame into the base's; None, and note why, if it is not known."""
        base_frame, one = self.address["base_frame"], self._inputs[topic]
        if frame and (place := self._frames.transform(frame, base_frame)) is not None:
            if np.abs(place - self._places.setdefault(topic, place)).max() <= SAME_PLACE:
                one.problem = ""
                return place
            one.refuse(f"{topic}: frame {frame!r} is no longer where it was in {base_frame!r}: is it published twice")
            return None
        why = f" ({self._without_frames})" if self._without_frames else ""
        one.refuse(
            f"{topic} is in frame {frame!r}, which /tf_static does not connect with {base_frame!r}{why}: publish that, "
            f"or set {option}"
        )
        return None

    def _take_deadman(self, message: Any) -> None:
        self._deadman = (time.monotonic(), bool(message.data))

    def _has_messages(self) -> bool:
        return all(one.value is not None or one.problem for one in self._inputs.values())

    def _is_complete(self) -> bool:
        return all(one.value is not None for one in self._inputs.values())

    def _missing(self) -> str:
        missing = [topic for topic, one in self._inputs.items() if one.value is None]
        for topic in missing:
            if self._inputs[topic].problem:
                return self._inputs[topic].problem
        return f"no message with a stamp on {', '.join(missing)}: is the base's driver running"

    def _scans(self) -> list[Scan]:
        return [one.value for one in self._inputs.values()][1:]

    def _check_publishers(self) -> None:
        for topic in self._inputs if not self.address.host else ():  # behind a rosbridge any number may be registered
            check_publisher(self._link, topic)

    # -- commands

    def _run(self) -> None:
        due = cycle_s = looked_s = time.monotonic()
        while not (self._is_closed.is_set() and self._velocity == (0.0, 0.0)):
            now = time.monotonic()
            due = max(due + 1.0 / RATE_HZ, now)
            if now - cycle_s > self._setpoint_timeout_s:  # this process was suspended, and the base has stopped
                self._resumed_s, self._velocity, self._blend_from_s = now, (0.0, 0.0), now
            passed_s, cycle_s = now - cycle_s, now
            try:
                if now - looked_s > WATCH_S:
                    looked_s = now
                    self._check_publishers()
                self._check_progress(passed_s)
                self._velocity = self._next()
                if time.monotonic() - now > self._setpoint_timeout_s:  # suspended meanwhile: this command is old
                    continue
                if self.phase != Phase.FREE:
                    made_s = self._link.now_s() if self._is_stamped else None
                    self._publish(twist(*self._velocity, self.address["base_frame"], made_s))
            except RobotError as error:
                self.fault, self._velocity = str(error), (0.0, 0.0)
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
        first = ""
        for scale in SCALES:
            if not (why := self._obstruction(linear * scale, angular * scale)):
                if abs(linear) * scale > STANDS or not first:
                    self._unblocked_s = time.monotonic()
                return linear * scale, angular * scale
            first = first or why
            self._counts[why] += scale == 1.0
        self._obstructed_by = first
        return 0.0, 0.0

    def _wanted(self) -> Twist2:
        now, law = time.monotonic(), self._law
        passed_s, self._decided_s = now - self._decided_s, now
        given_s, setpoint = self._setpoint
        late = self._older_than(AGE_BOUND_S)
        if not self.fault and now - self._resumed_s > LOST_S and (lost := self._older_than(LOST_S)):
            self.fault = self._lost(lost, LOST_S)
        if self.fault:
            law.phase = Phase.FAULT
        else:
            before, is_ending = law.phase, self._is_closed.is_set() and self._order != Order.FREE
            is_released = self.address["deadman"] and not (self._deadman[1] and now - self._deadman[0] < DEADMAN_S)
            law.decide(
                Order.HOLD if is_ending or self._brakes_for_a_person() else self._order,
                passed_s=passed_s,
                blend_from_s=self._blend_from_s,
                setpoint_age_s=now - given_s,
                is_stale=bool(late),
                other="deadman_released" if is_released else "",
            )
            if law.phase == Phase.STALE != before:
                log.warning("the base holds: %s", self._lost(late, AGE_BOUND_S).partition(": ")[2])
            if law.phase == Phase.FOLLOW:
                linear, angular = np.clip(setpoint, -FASTEST, FASTEST) * (self.limits.speed_scale * law.blend)
                return float(linear), float(angular)
        self._unblocked_s, self._obstructed_by = now, ""  # after every interruption
        return 0.0, 0.0

    def _brakes_for_a_person(self) -> bool:
        """Return whether a person wants the base, which is not at rest yet."""
        if self._order != Order.FREE or self.phase == Phase.FREE:
            return False
        _, measured = next(iter(self._inputs.values())).value
        return self._velocity != (0.0, 0.0) or max(map(abs, measured)) > AT_REST

    def _older_than(self, age_s: float) -> str:
        """Return the first input whose newest value is older; empty if none is."""
        return next((topic for topic, one in self._inputs.items() if one.age() > age_s), "")

    def _lost(self, topic: str, time_s: float) -> str:
        """Return why an input's newest value is old, as a fault."""
        one = self._inputs[topic]
        comes = time.monotonic() - one.came_s < time_s / 2  # a slow link's last ones come after it was cut
        if comes and one.problem:
            return f"bad_messages: {one.problem}"
        if comes:
            return f"stale_stamps: {topic} has no new stamp for {one.age():.1f} s: check its driver's clock"
        return f"connection_lost: no message on {topic} for {time_s:g} s: check its driver and the network"

    def _obstruction(self, linear: float, angular: float) -> str:
        """Return the name of the count for what is in the way of velocities, or empty."""
        margin, scans = self.limits.stop_distance, self._scans()
        if not margin or not (linear or angular):
            return ""
        oldest_s = max(one.age() for one in list(self._inputs.values())[1:])
        braking_s = max(abs(linear) / self.limits.acceleration, abs(angular) / self.limits.angular_acceleration)
        motion = BaseMotion(linear, angular, oldest_s + 1.0 / RATE_HZ, braking_s)
        points = np.concatenate([one.points for one in scans])
        if not self._body.is_clear(points, motion, margin):
            return "stop_distance"
        return "" if self._body.is_seen(scans, motion, margin) else "unseen"
