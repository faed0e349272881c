"""A mobile base of another maker behind a rosbridge, for tests: its own kinematics, scanners, frames and bridge.

Written from the outside: sensor_msgs/LaserScan, nav_msgs/Odometry, REP 103, 105 and 117, rosbridge protocol v2. It
imports nothing from rlservo. `truth` holds where the base really was.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

STEP_S = 0.01
ODOM_STEPS, SCAN_STEPS = 2, 8  # 50 Hz, 12.5 Hz
TIMEOUT_S = 0.5  # of commands
MAX_ACCELERATION = (2.0, 2.5)  # [m/s^2], [rad/s^2]
MAX_VELOCITY = (1.0, 1.5)  # [m/s], [rad/s]
TYPES = {
    "/odom": "nav_msgs/Odometry", "/tf_static": "tf2_msgs/TFMessage", "/cmd_vel": "geometry_msgs/Twist",
}  # fmt: skip


@dataclass
class Scanner:
    """A planar scanner: `x`, `y` [m] and `yaw` [rad] are its true place in base_link, as is `is_inverted`."""

    topic: str = "/scan"
    frame: str = "front_laser_link"
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    is_inverted: bool = False  # mounted upside down
    count: int = 720
    half_angle: float = math.pi
    range_max: float = 25.0
    blind: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None  # of own angles [rad]: those that are NaN

    @property
    def angles(self) -> NDArray[np.float64]:
        return np.linspace(-self.half_angle, self.half_angle, self.count)

    def transform(self, parent: str) -> dict[str, Any]:
        """Return its TransformStamped; upside down is half a turn about x."""
        cos, sin = math.cos(self.yaw / 2.0), math.sin(self.yaw / 2.0)
        turn = (
            {"x": cos, "y": sin, "z": 0.0, "w": 0.0} if self.is_inverted else {"x": 0.0, "y": 0.0, "z": sin, "w": cos}
        )
        return transform(parent, self.frame, (self.x, self.y, 0.2), turn)


def transform(parent: str, child: str, place: tuple[float, float, float], turn: dict[str, float]) -> dict[str, Any]:
    x, y, z = place
    return {
        "header": {"seq": 0, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y, "z": z}, "rotation": turn},
    }


NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


@dataclass
class Moment:
    """Where the base was, and how fast."""

    time_s: float  # time.monotonic()
    x: float
    y: float
    yaw: float
    linear: float
    angular: float


@dataclass(eq=False)
class Connection:
    """A client of the bridge."""

    socket: ServerConnection
    subscribed: set[str] = field(default_factory=set)
    advertised: set[str] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def send(self, message: dict[str, Any]) -> None:
        try:
            with self.lock:
                self.socket.send(json.dumps(message))
        except ConnectionClosed:
            pass


class ForeignBase:
    """A differential base with scanners, among boxes (x from, x to, y from, y to) [m]; `odom` is where it began."""

    def __init__(
        self,
        scanners: Sequence[Scanner],
        boxes: Sequence[tuple[float, float, float, float]] = (),
        *,
        transforms: Sequence[dict[str, Any]] | None = None,
        odom_frame: str = "odom",
        child_frame: str = "base_link",
        child_offset: float = 0.0,  # [m], of the child frame's origin ahead of base_link's
        has_null: bool = False,  # what is not finite becomes null, as rosbridge_suite sends it
    ) -> None:
        self.scanners, self.boxes = list(scanners), list(boxes)
        self.transforms = [one.transform("base_link") for one in scanners] if transforms is None else list(transforms)
        self.odom_frame, self.child_frame, self.child_offset = odom_frame, child_frame, child_offset
        self.has_null = has_null
        self.truth: list[Moment] = [Moment(time.monotonic(), 0.0, 0.0, 0.0, 0.0, 0.0)]
        self.commands: list[tuple[float, float, float]] = []  # time.monotonic(), [m/s], [rad/s]
        self.odom_error: Callable[[dict[str, Any]], None] = lambda _: None  # changes an Odometry before it is sent
        self.scan_error: Callable[[dict[str, Any]], None] = lambda _: None  # a LaserScan
        self.silent: set[str] = set()  # topics that are not published
        self._types = TYPES | {one.topic: "sensor_msgs/LaserScan" for one in scanners}
        self._wanted, self._wanted_s = (0.0, 0.0), 0.0
        self._connections: set[Connection] = set()
        self._lock, self._is_over = threading.Lock(), threading.Event()
        quiet = logging.getLogger("foreign_base")
        quiet.setLevel(logging.CRITICAL)  # a port that is only looked at is no fault
        self._server = serve(self._handle, "127.0.0.1", 0, compression=None, logger=quiet)
        self.port: int = self._server.socket.getsockname()[1]
        self._threads = [threading.Thread(target=one, daemon=True) for one in (self._server.serve_forever, self._run)]
        for one in self._threads:
            one.start()

    @property
    def robot(self) -> str:
        return f"rosbridge://127.0.0.1:{self.port}"

    @property
    def now(self) -> Moment:
        return self.truth[-1]

    def gap(self, front: float, half_width: float) -> float:
        """Return the smallest true distance [m] that the body's front edge ever had to a box, negative inside.

        For a base that moves along x.
        """
        ahead = [low for low, _, right, left in self.boxes if low > 0.0 and right < half_width and left > -half_width]
        return min(ahead) - front - max(one.x for one in self.truth)

    def move_scanner(self, scanner: Scanner) -> None:
        """Publish another place of a scanner's frame, while it stays where it is."""
        self._publish("/tf_static", {"transforms": [scanner.transform("base_link")]})

    def without_commands(self) -> float:
        """Return the longest time [s] between two commands while it drove."""
        return max((later[0] - one[0] for one, later in pairwise(self.commands) if one[1]), default=0.0)

    def since(self, time_s: float) -> list[Moment]:
        return [one for one in self.truth if one.time_s >= time_s]

    def close(self) -> None:
        self._is_over.set()
        self._server.shutdown()
        for one in self._threads:
            one.join()

    # -- the world

    def _run(self) -> None:
        steps, due = 0, time.monotonic()
        while not self._is_over.is_set():
            time.sleep(max(0.0, due - time.monotonic()))
            due = max(due, time.monotonic()) + STEP_S  # its world stands still while a busy machine gives it no time
            steps += 1
            self._move()
            if steps % ODOM_STEPS == 0:
                self._publish("/odom", self._odometry())
            if steps % SCAN_STEPS == 0:
                for one in self.scanners:
                    self._publish(one.topic, self._scan(one))

    def _move(self) -> None:
        before, now = self.truth[-1], time.monotonic()
        wanted = self._wanted if now - self._wanted_s < TIMEOUT_S else (0.0, 0.0)
        speeds = []
        for was, want, most, change in zip(
            (before.linear, before.angular), wanted, MAX_VELOCITY, MAX_ACCELERATION, strict=True
        ):
            step = change * STEP_S
            speeds.append(was + min(max(min(max(want, -most), most) - was, -step), step))
        linear, angular = speeds
        yaw = before.yaw + angular * STEP_S
        middle = (before.yaw + yaw) / 2.0
        x, y = before.x + linear * math.cos(middle) * STEP_S, before.y + linear * math.sin(middle) * STEP_S
        self.truth.append(Moment(now, x, y, yaw, linear, angular))

    def _odometry(self) -> dict[str, Any]:
        one = self.now
        x, y = one.x + self.child_offset * math.cos(one.yaw), one.y + self.child_offset * math.sin(one.yaw)
        message = {
            "header": self._header(self.odom_frame),
            "child_frame_id": self.child_frame,
            "pose": {
                "pose": {
                    "position": {"x": x, "y": y, "z": 0.0},
                    "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(one.yaw / 2.0), "w": math.cos(one.yaw / 2.0)},
                },
                "covariance": [0.0] * 36,
            },
            "twist": {
                "twist": {
                    "linear": {"x": one.linear, "y": one.angular * self.child_offset, "z": 0.0},
                    "angular": {"x": 0.0, "y": 0.0, "z": one.angular},
                },
                "covariance": [0.0] * 36,
            },
        }
        self.odom_error(message)
        return message

    def _scan(self, scanner: Scanner) -> dict[str, Any]:
        one = self.now
        cos, sin = math.cos(one.yaw), math.sin(one.yaw)
        x, y = one.x + cos * scanner.x - sin * scanner.y, one.y + sin * scanner.x + cos * scanner.y
        own = scanner.angles
        ranges = self._cast(x, y, one.yaw + scanner.yaw + (-own if scanner.is_inverted else own))
        ranges[ranges > scanner.range_max] = math.inf
        if scanner.blind is not None:
            ranges[scanner.blind(own)] = math.nan
        values = [None if self.has_null and not math.isfinite(value) else value for value in ranges.tolist()]
        message = {
            "header": self._header(scanner.frame),
            "angle_min": -scanner.half_angle,
            "angle_max": scanner.half_angle,
            "angle_increment": 2.0 * scanner.half_angle / (scanner.count - 1),
            "time_increment": 0.0,
            "scan_time": SCAN_STEPS * STEP_S,
            "range_min": 0.05,
            "range_max": scanner.range_max,
            "ranges": values,
            "intensities": [],
        }
        self.scan_error(message)
        return message

    def _cast(self, x: float, y: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance to the nearest box in each direction [m], by slabs."""
        nearest = np.full(len(angles), math.inf)
        with np.errstate(divide="ignore"):
            along_x, along_y = 1.0 / np.cos(angles), 1.0 / np.sin(angles)
        for low, high, right, left in self.boxes:
            first, second = np.sort([(low - x) * along_x, (high - x) * along_x], axis=0)
            third, fourth = np.sort([(right - y) * along_y, (left - y) * along_y], axis=0)
            enter, leave = np.maximum(first, third), np.minimum(second, fourth)
            hit = (enter <= leave) & (enter > 0.0)
            nearest[hit] = np.minimum(nearest[hit], enter[hit])
        return nearest

    @staticmethod
    def _header(frame: str) -> dict[str, Any]:
        now = time.time()
        return {"seq": 0, "stamp": {"secs": int(now), "nsecs": int(now % 1.0 * 1e9)}, "frame_id": frame}

    # -- the bridge

    def _publish(self, topic: str, message: dict[str, Any]) -> None:
        if topic in self.silent:
            return
        with self._lock:
            takers = [one for one in self._connections if topic in one.subscribed]
        for one in takers:
            one.send({"op": "publish", "topic": topic, "msg": message})

    def _handle(self, socket: ServerConnection) -> None:
        client = Connection(socket)
        with self._lock:
            self._connections.add(client)
        try:
            for text in socket:
                self._obey(client, json.loads(text))
        except ConnectionClosed:
            pass
        finally:
            with self._lock:
                self._connections.discard(client)

    def _obey(self, client: Connection, request: dict[str, Any]) -> None:
        op, topic = request["op"], request.get("topic", "")
        if op == "subscribe":
            client.subscribed.add(topic)
            if topic == "/tf_static" and self.transforms:  # latched
                client.send({"op": "publish", "topic": topic, "msg": {"transforms": self.transforms}})
        elif op == "advertise":
            client.advertised.add(topic)
        elif op in ("unsubscribe", "unadvertise"):
            (client.subscribed if op == "unsubscribe" else client.advertised).discard(topic)
        elif op == "publish":
            message = request["msg"]
            if topic == "/cmd_vel":
                linear = float(message.get("linear", {}).get("x", 0.0))
                angular = float(message.get("angular", {}).get("z", 0.0))
                self._wanted, self._wanted_s = (linear, angular), time.monotonic()
                self.commands.append((self._wanted_s, linear, angular))
                axes = {"x": 0.0, "y": 0.0, "z": 0.0}
                message = {"linear": axes | {"x": linear}, "angular": axes | {"z": angular}}
            self._publish(topic, message)
        elif op == "call_service":
            self._answer(client, request)

    def _answer(self, client: Connection, request: dict[str, Any]) -> None:
        service, topic = request["service"], request.get("args", {}).get("topic", "")
        with self._lock:
            bridged = {
                name: ["/rosbridge_websocket"] * any(topic in getattr(one, name) for one in self._connections)
                for name in ("advertised", "subscribed")
            }
        published = topic in self._types and topic != "/cmd_vel" and (topic != "/tf_static" or bool(self.transforms))
        known: dict[str, dict[str, Any]] = {
            "/rosapi/publishers": {"publishers": ["/driver"] * published + bridged["advertised"]},
            "/rosapi/subscribers": {"subscribers": ["/driver"] * (topic == "/cmd_vel") + bridged["subscribed"]},
            "/rosapi/topic_type": {"type": self._types.get(topic, "")},
        }
        values: Any = known.get(service, {})
        client.send(
            {"op": "service_response", "id": request.get("id"), "service": service, "values": values,
             "result": service in known}
        )  # fmt: skip
