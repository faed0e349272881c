"""A simulated MiR100 with its topics, behind ROS 2, a rosbridge or both."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.mir100.model import TIMESTEP
from rlservo.robots.mir100.parameters import (
    BACK_SCANNER,
    COMMAND_TIMEOUT_S,
    FRONT_SCANNER,
    LASER_MAX,
    Scanner,
)
from rlservo.robots.mir100.simulation import Mir100Simulation
from rlservo.robots.ros2.address import BASE_OPTIONS
from rlservo.robots.ros2.link import Topics
from rlservo.robots.ros2.ros_messages import (
    LASER_SCAN,
    ODOMETRY,
    TRANSFORMS,
    TWIST,
    TWIST_STAMPED,
    parse,
    place_of,
    quaternion,
    read_scan,
    scan_message,
    stamp,
    stamp_of,
    transform_message,
)
from rlservo.robots.simulated.ros2_loop import FaultyLink
from rlservo.robots.simulated.ur_controller.console import obey_link
from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults as LinkFaults

SUBSTEPS = 2  # of 0.01 s a tick: odometry at 50 Hz
SCAN_TICKS = 4  # 12.5 Hz, as on the SICK S300
MERGED_BEAMS = 720  # of /scan, all around base_link
STARTS = {"lab_6x8": (0.0, 2.6, 0.0)}  # [m], [m], [rad], clear of the cubes
HELP = """\
place 1 0 3.14     put the robot at: x, y, yaw  state          where it is
cube 0 1 -0.5 0.3  put a cube at: x, y, yaw
latency 20         link: ms each way                   jitter 5       up to so many ms more
drop 0.01          link: share of messages lost        down, up       link: cut and restored"""

log = logging.getLogger("rlservo.robot")


class SimulatedBase:
    """The base: its drive with a timeout and limits, and its scanners."""

    def __init__(self, links: Sequence[Topics], *, world: str, is_stamped: bool, faults: LinkFaults) -> None:
        """Offer the topics on all links. Raises ValueError for an unknown world."""
        self.simulation = Mir100Simulation(world)
        self.simulation.place(STARTS.get(world, (0.0, 0.0, 0.0)))
        self.messages = FaultyLink(faults)
        self.dt = SUBSTEPS * TIMESTEP
        self._links, self._ticks = list(links), 0
        kinds = {"odom": ODOMETRY, "front_scan": LASER_SCAN, "back_scan": LASER_SCAN, "scan": LASER_SCAN}
        topics = {**BASE_OPTIONS, "scan": "/scan"}
        self._publish = {
            name: self.messages.outgoing([one.advertise(topics[name], kind) for one in links])
            for name, kind in kinds.items()
        }
        for one in links:
            _publish_frames(one)
        self._is_stamped = is_stamped
        for one in links:
            one.subscribe(
                topics["cmd_vel"], TWIST_STAMPED if is_stamped else TWIST, self.messages.incoming(self._take_velocity)
            )

    def close(self) -> None:
        """Leave the graph and close the port."""
        for one in self._links:
            one.close()

    def tick(self) -> None:
        """Let 0.02 s pass and publish."""
        self.simulation.advance(SUBSTEPS)
        self._ticks += 1
        now_s = self._links[0].now_s()
        x, y, yaw = self.simulation.pose
        linear, angular = self.simulation.velocity
        self._publish["odom"](
            {
                "header": {"stamp": stamp(now_s), "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": quaternion(yaw)}},
                "twist": {"twist": {"linear": {"x": linear}, "angular": {"z": angular}}},
            }
        )
        if self._ticks % SCAN_TICKS == 0:
            self._publish_scans(now_s)

    def obey(self, line: str) -> str:
        """Carry out a line of the console."""
        word, *rest = line.split()
        if word == "help":
            return HELP
        if word == "state":
            pose = " ".join(f"{value:.3f}" for value in self.simulation.pose)
            return f"pose {pose}, velocity {self.simulation.velocity[0]:.4f} {self.simulation.velocity[1]:.4f}"
        if word not in ("place", "cube"):
            return obey_link(self.messages.faults, line)
        try:
            if word == "place":
                self.simulation.place([float(one) for one in rest])
            else:
                self.simulation.move_cube(int(rest[0]) if rest else -1, [float(one) for one in rest[1:]])
        except ValueError as error:
            return f"{line.strip()[:100]!r}: {error}"
        return ""

    def _take_velocity(self, message: Any) -> None:
        twist = message
        if self._is_stamped:
            twist, made_s = message.twist, stamp_of(message)
            # A zero stamp means now, as in diff_drive_controller.
            if made_s is not None and abs(self._links[0].now_s() - made_s) > COMMAND_TIMEOUT_S:
                log.warning("a velocity was ignored: its stamp is older than %g s", COMMAND_TIMEOUT_S)
                return
        linear, angular = float(twist.linear.x), float(twist.angular.z)
        if math.isfinite(linear) and math.isfinite(angular):
            self.simulation.command(linear, angular)
        else:
            log.warning("a velocity was ignored: it is not finite")

    def _publish_scans(self, now_s: float) -> None:
        scan, count = self.simulation.scan, FRONT_SCANNER.count
        front, back = _whole(FRONT_SCANNER, scan[:count]), _whole(BACK_SCANNER, scan[count:])
        step = 2.0 * Scanner.HALF_ANGLE / (Scanner.BEAMS - 1)
        points = []
        for name, scanner, ranges in (("front", FRONT_SCANNER, front), ("back", BACK_SCANNER, back)):
            message = scan_message(ranges, -Scanner.HALF_ANGLE, step, f"{name}_laser_link", now_s)
            self._publish[f"{name}_scan"](message)
            points.append(read_scan(parse(message), place_of(scanner)).points)
        merged = np.concatenate(points)
        width = 2.0 * math.pi / MERGED_BEAMS
        beams = np.rint(np.arctan2(merged[:, 1], merged[:, 0]) / width).astype(int) + MERGED_BEAMS // 2
        ranges = np.full(MERGED_BEAMS, LASER_MAX)
        np.minimum.at(ranges, beams % MERGED_BEAMS, np.hypot(merged[:, 0], merged[:, 1]))
        self._publish["scan"](scan_message(ranges, -math.pi, width, "base_link", now_s))


def _publish_frames(link: Topics) -> None:
    """Publish the scanners' places in base_link, if the graph's tf2_msgs is installed."""
    frames = [
        transform_message("base_link", f"{one.name}_laser_link", *one.position, one.yaw)
        for one in (FRONT_SCANNER, BACK_SCANNER)
    ]
    try:
        link.advertise("/tf_static", TRANSFORMS, is_kept=True)({"transforms": frames})
    except RobotError as error:
        poses = [f"{one.name}_scan_pose={':'.join(f'{x:.4f}' for x in (*one.position[:2], one.yaw))}"
                 for one in (FRONT_SCANNER, BACK_SCANNER)]  # fmt: skip
        log.warning("no /tf_static: %s; drive this base with %s", error, ",".join(poses))


def _whole(scanner: Scanner, ranges: Any) -> Any:
    """Return all of a scanner's beams [m]; those blocked by the housing read zero."""
    whole = np.zeros(scanner.BEAMS)
    whole[scanner.dropped_first : scanner.BEAMS - scanner.dropped_last] = ranges
    return whole
