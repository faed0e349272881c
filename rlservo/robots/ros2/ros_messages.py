"""Conversions between ROS messages and numbers, shared by the node, the backends and the simulators.

An incoming message has attributes: it is rclpy's own, or a rosbridge's JSON after `parse`. An outgoing message is a
dictionary, which a link converts to either.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.robots.mir100.parameters import BACK_SCANNER, FRONT_SCANNER, LASER_MAX, LASER_MIN, Scanner
from rlservo.robots.ros2.clearance import Scan
from rlservo.robots.ros2.frames import LEVEL, planar_transform
from rlservo.robots.ur import parameters

JOINT_STATE = "sensor_msgs/msg/JointState"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
NUMBERS, NUMBER, FLAG = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float64", "std_msgs/msg/Bool"
INT8, STRING = "std_msgs/msg/Int8", "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

JOINT_NAMES = parameters.JOINT_NAMES  # ROS names by our own, in kinematic order
GAP = 3  # beams of a scanner that may lie between two points of one surface

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


def parse(value: Any) -> Any:
    """Return a rosbridge's JSON with attributes in place of keys."""
    if isinstance(value, Mapping):
        return SimpleNamespace(**{name: parse(one) for name, one in value.items()})
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        return [parse(one) for one in value]
    return value


def for_rosbridge(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a message with ROS 1's names of a time's fields; a rosbridge of ROS 2 takes them as well."""
    names = {"sec": "secs", "nanosec": "nsecs"}

    def convert(value: Any) -> Any:
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            return [for_rosbridge(one) for one in value]
        return for_rosbridge(value) if isinstance(value, Mapping) else value

    return {names.get(name, name): convert(one) for name, one in values.items()}


def stamp(time_s: float) -> dict[str, int]:
    """Return a time [s] in ROS 2's form."""
    whole = math.floor(time_s)
    return {"sec": whole, "nanosec": min(999_999_999, round((time_s - whole) * 1e9))}


def stamp_of(message: Any) -> float | None:
    """Return a message's time [s] from its header (ROS 1 or 2); None if it is missing or zero."""
    made = getattr(getattr(message, "header", None), "stamp", None)
    if made is None:
        return None
    seconds = getattr(made, "sec", None)
    if seconds is None:
        return float(made.secs + made.nsecs * 1e-9) or None
    return float(seconds + made.nanosec * 1e-9) or None


def joint_index(message: Any, name: str) -> int:
    """Return where a joint is in a JointState. Raises ValueError if it is not there exactly once."""
    present = list(message.name)
    if present.count(name) != 1:
        raise ValueError(name)
    return present.index(name)


def in_order(message: Any, names: Sequence[str], field: str) -> Vector | None:
    """Return a JointState's values for the joints `names`, in any order; None if one is missing or there twice."""
    values = getattr(message, field)
    try:
        ordered = np.array([values[joint_index(message, name)] for name in names], dtype=np.float64)
    except (ValueError, IndexError):
        return None
    return ordered if np.isfinite(ordered).all() else None


def yaw_of(orientation: Any) -> float:
    """Return a quaternion's turn about z [rad], of any length; NaN if it is zero, as in an empty message of ROS 1."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z) if any((x, y, z, w)) else math.nan


def quaternion(yaw: float) -> dict[str, float]:
    """Return a turn about z [rad] as a quaternion."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}


def planar_state(
    odometry: Any, frame: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[tuple[float, float, float], tuple[float, float]] | None:
    """Return an Odometry's x, y [m], yaw [rad] and velocities ahead [m/s], [rad/s]; None if not finite.

    They are those of a frame at the pose `frame` ([m], [m], [rad]) in the message's child frame.
    """
    pose, twist = odometry.pose.pose, odometry.twist.twist
    yaw, angular, (dx, dy, turn) = yaw_of(pose.orientation), twist.angular.z, frame
    x = pose.position.x + math.cos(yaw) * dx - math.sin(yaw) * dy
    y = pose.position.y + math.sin(yaw) * dx + math.cos(yaw) * dy
    along, across = twist.linear.x - angular * dy, getattr(twist.linear, "y", 0.0) + angular * dx
    linear = math.cos(turn) * along + math.sin(turn) * across
    state = (x, y, (yaw + turn + math.pi) % (2.0 * math.pi) - math.pi), (linear, angular)
    return state if all(map(math.isfinite, (*state[0], *state[1]))) else None


def transform_message(parent: str, child: str, x: float, y: float, z: float, yaw: float) -> dict[str, Any]:
    """Return the pose of a frame in another one [m], [rad] as a TransformStamped of /tf_static."""
    place = {"translation": {"x": x, "y": y, "z": z}, "rotation": quaternion(yaw)}
    return {"header": {"stamp": stamp(0.0), "frame_id": parent}, "child_frame_id": child, "transform": place}


def twist(linear: float, angular: float, frame: str = "base_link", stamped_s: float | None = None) -> dict[str, Any]:
    """Return velocities [m/s], [rad/s] as a Twist, or with a time [s] as a TwistStamped."""
    plain = {"linear": {"x": linear}, "angular": {"z": angular}}
    if stamped_s is None:
        return plain
    return {"header": {"stamp": stamp(stamped_s), "frame_id": frame}, "twist": plain}


def trajectory(joints: Sequence[str], points: Sequence[tuple[float, ArrayLike, ArrayLike]]) -> dict[str, Any]:
    """Return a JointTrajectory that starts at once, with points (time from its start [s], positions, velocities)."""
    return {
        "joint_names": list(joints),
        "points": [
            {
                "positions": np.asarray(positions).tolist(),
                "velocities": np.asarray(velocities).tolist(),
                "time_from_start": stamp(after_s),
            }
            for after_s, positions, velocities in points
        ],
    }


def scan_message(ranges: Vector, angle_min: float, increment: float, frame: str, made_s: float) -> dict[str, Any]:
    """Return readings [m] counter-clockwise from an angle [rad] of the frame's x axis as a LaserScan."""
    return {
        "header": {"stamp": stamp(made_s), "frame_id": frame},
        "angle_min": angle_min,
        "angle_max": angle_min + increment * (len(ranges) - 1),
        "angle_increment": increment,
        "range_min": LASER_MIN,
        "range_max": LASER_MAX,
        "ranges": ranges.tolist(),
    }


def read_scan(scan: Any, place: Matrix, *, unknown_is_free: bool = False) -> Scan:
    """Return a LaserScan's beams by the transform of its frame.

    By REP 117 inf is a free beam, -inf a hit too near to measure, and NaN or less than `range_min` nothing that is
    known; null is unknown too, as a rosbridge sends it for inf and for NaN. Raises ValueError if no beam is known, as a
    blind scanner sees no way free, or if the scanner's plane is not horizontal.
    """
    if abs(place[2, 2]) < LEVEL:
        raise ValueError(f"its frame {scan.header.frame_id!r} is tilted: expected a scanner with a horizontal plane")
    ranges = np.array([math.nan if one is None else one for one in scan.ranges], dtype=np.float64)
    ranges[np.isneginf(ranges)] = scan.range_min
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    has_reading = ranges >= scan.range_min
    is_known = (has_reading | unknown_is_free) & np.isfinite(angles)
    if not is_known.any() or not math.isfinite(scan.range_min) or math.isnan(scan.range_max):
        raise ValueError(f"no beam of {len(ranges)} has a reading and an angle")
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ place[:2, :2].T
    meets = is_known & has_reading & np.isfinite(ranges) & (ranges < scan.range_max)
    return Scan(place[:2, 3], directions, is_known, place[:2, 3] + ranges[meets, None] * directions[meets])


def readings(points: Vector) -> Vector:
    """Return the readings (1012,) [m] of the MiR100's two scanners for points (n, 2) [m] in base_link."""
    return np.concatenate([seen_by(FRONT_SCANNER, points), seen_by(BACK_SCANNER, points)])


def place_of(scanner: Scanner) -> Matrix:
    """Return the transform of a scanner of the MiR100 into base_link."""
    return planar_transform(*scanner.position[:2], scanner.yaw)


def seen_by(scanner: Scanner, points: Vector) -> Vector:
    """Return the readings [m] of one scanner, without those that it drops."""
    x, y, _ = scanner.position
    ahead = points - (x, y)
    angles = (np.arctan2(ahead[:, 1], ahead[:, 0]) - scanner.yaw + math.pi) % (2.0 * math.pi) - math.pi
    beams = np.rint((angles + scanner.HALF_ANGLE) / (2.0 * scanner.HALF_ANGLE / (scanner.BEAMS - 1))).astype(int)
    inside = (beams >= 0) & (beams < scanner.BEAMS)
    seen = np.full(scanner.BEAMS, np.inf)
    np.minimum.at(seen, beams[inside], np.hypot(ahead[inside, 0], ahead[inside, 1]))
    # A scan from elsewhere leaves gaps between two points of a near surface: a line closes them.
    hit = np.flatnonzero(np.isfinite(seen))
    for left, right in itertools.pairwise(hit):
        if 1 < right - left <= GAP:
            seen[left : right + 1] = np.linspace(seen[left], seen[right], right - left + 1)
    seen[~np.isfinite(seen)] = LASER_MAX
    kept: Vector = np.clip(seen[scanner.dropped_first : scanner.BEAMS - scanner.dropped_last], LASER_MIN, LASER_MAX)
    return kept
