"""A simulated UR arm with the topics and controllers of Universal_Robots_ROS2_Driver."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.ros2.address import ARM_OPTIONS, COMMAND_TOPICS
from rlservo.robots.ros2.rclpy_link import RclpyLink, message_class
from rlservo.robots.ros2.ros_messages import (
    FLAG,
    INT8,
    JOINT_NAMES,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    NUMBER,
    NUMBERS,
    STRING,
    stamp,
)
from rlservo.robots.simulated.ros2_loop import FaultyLink
from rlservo.robots.simulated.ur_controller.console import obey
from rlservo.robots.simulated.ur_controller.controller import Controller, SafetyMode
from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults as LinkFaults

LOOKAHEAD_S = 0.1  # with the driver's own 0.03 s, every pause of a machine that is not real-time becomes a jump
VELOCITY_ACCELERATION = 25.0  # [rad/s^2], of speedj for velocity commands
STATUS_PERIOD_S = 0.1
# The driver's joint states are not in kinematic order.
PUBLISHED_ORDER = ("shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3", "base")
LINKS = ("base_link_inertia", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link",
         "wrist_3_link")  # fmt: skip
RESEND_PROGRAM = "/io_and_status_controller/resend_robot_program"

Vector = NDArray[np.float64]
log = logging.getLogger("rlservo.robot")


class SimulatedArm:
    """The arm with one active controller: position, velocity or trajectory."""

    def __init__(
        self, ur_model: str, *, controller: str, prefix: str, faults: LinkFaults, kinematics: Vector | None = None
    ) -> None:
        """Join the graph; `kinematics` as in `Controller`. Raises RobotError without rclpy, ValueError."""
        self.controller = Controller(ur_model, kinematics=kinematics)
        self.link = faults
        self.messages = FaultyLink(faults)
        self.dt = self.controller.dt
        self._joints = [prefix + JOINT_NAMES[name] for name in JOINT_NAMES]
        self._order = [list(JOINT_NAMES).index(name) for name in PUBLISHED_ORDER]
        self.controller.start_program(repeat(None))  # External Control's: it only takes commands
        self._trajectory: list[tuple[float, Vector, Vector]] = []  # controller time [s], positions, velocities
        self._status_due_s = 0.0
        self._ros = ros = RclpyLink("ur_ros2_driver_sim", is_unique=True)
        mode_kinds = [_dashboard_kind("RobotMode"), _dashboard_kind("SafetyMode")]
        topics = (
            ("joint_states", JOINT_STATE, False), ("speed_scaling", NUMBER, False), ("program_running", FLAG, True),
            ("robot_mode", mode_kinds[0], True), ("safety_mode", mode_kinds[1], True),
        )  # fmt: skip
        self._publish = {
            name: self.messages.outgoing([ros.advertise(ARM_OPTIONS[name], kind, is_kept=is_kept)])
            for name, kind, is_kept in topics
        }
        ros.advertise(ARM_OPTIONS["robot_description"], STRING, is_kept=True)(
            {"data": description(self.controller.kinematics, self._joints, prefix)}
        )
        self._mode_field = "data" if mode_kinds[0] == INT8 else "mode"
        takers = {"position": self._take_position, "velocity": self._take_velocity, "trajectory": self._take_trajectory}
        kind = JOINT_TRAJECTORY if controller == "trajectory" else NUMBERS
        ros.subscribe(COMMAND_TOPICS[controller], kind, self.messages.incoming(takers[controller]))
        ros.serve(RESEND_PROGRAM, self._resend_program)

    def close(self) -> None:
        """Leave the graph."""
        self._ros.close()

    def tick(self) -> None:
        """Let one control cycle pass and publish the state."""
        controller = self.controller
        if not controller.is_program_running:
            self._trajectory = []
        if self._trajectory:
            controller.servo(self._along_trajectory(), LOOKAHEAD_S)
        controller.tick()
        now_s = self._ros.now_s()
        data = controller.simulation.data
        self._publish["joint_states"](
            {
                "header": {"stamp": stamp(now_s), "frame_id": "base_link"},
                "name": [self._joints[index] for index in self._order],
                "position": data.qpos[self._order].tolist(),
                "velocity": data.qvel[self._order].tolist(),
                "effort": [0.0] * 6,
            }
        )
        if controller.time_s >= self._status_due_s:
            self._status_due_s = controller.time_s + STATUS_PERIOD_S
            self._publish["speed_scaling"]({"data": 100.0 * self._speed_scaling()})
            self._publish["robot_mode"]({self._mode_field: int(controller.robot_mode)})
            self._publish["safety_mode"]({self._mode_field: int(controller.safety_mode)})
            self._publish["program_running"]({"data": controller.is_program_running})  # last, as the driver

    def _speed_scaling(self) -> float:
        """Return the product that the driver publishes."""
        controller = self.controller
        return controller.speed_fraction * controller.speed_scaling

    def obey(self, line: str) -> str:
        """Carry out a line of the controller's console."""
        return obey(self, line)

    # -- commands

    def _is_ready(self, values: Sequence[float], size: int) -> bool:
        if len(values) != size or not np.isfinite(values).all():
            log.warning("a command was ignored: expected %d finite numbers, got %s", size, list(values)[:10])
            return False
        return self.controller.is_program_running and not self.controller.is_paused

    def _take_position(self, message: Any) -> None:
        if self._is_ready(message.data, 6):
            self.controller.servo(message.data, LOOKAHEAD_S)

    def _take_velocity(self, message: Any) -> None:
        """Apply a velocity until the next one comes: the controller has no timeout."""
        if self._is_ready(message.data, 6):
            self.controller.speed(message.data, VELOCITY_ACCELERATION)

    def _take_trajectory(self, message: Any) -> None:
        """Replace the trajectory, like the joint trajectory controller; one that ends in motion is rejected."""
        names, now_s = list(message.joint_names), self.controller.time_s
        if sorted(names) != sorted(self._joints) or not message.points:
            log.warning("a trajectory was rejected: its joints are %s", names)
            return
        order = [names.index(joint) for joint in self._joints]
        points = [(now_s, self.controller.target.copy(), self.controller.target_velocity.copy())]
        for point in message.points:
            if not (self._is_ready(point.positions, 6) and self._is_ready(point.velocities, 6)):
                return
            after_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
            if now_s + after_s <= points[-1][0]:
                log.warning("a trajectory was rejected: its times do not increase")
                return
            points.append((now_s + after_s, np.array(point.positions)[order], np.array(point.velocities)[order]))
        if np.abs(points[-1][2]).max() > 1e-6:
            log.warning("a trajectory was rejected: its last velocity is not zero")
            return
        self._trajectory = points

    def _along_trajectory(self) -> Vector:
        """Return the trajectory's state at the end of this cycle, on a cubic between its points."""
        at = self.controller.time_s + self.dt
        points = self._trajectory
        while len(points) > 2 and points[1][0] <= at:
            points.pop(0)
        (t0, p0, v0), (t1, p1, v1) = points[:2]
        span = max(t1 - t0, 1e-6)
        s = min(max((at - t0) / span, 0.0), 1.0)
        position: Vector = (
            (2 * s**3 - 3 * s**2 + 1) * p0
            + (s**3 - 2 * s**2 + s) * span * v0
            + (3 * s**2 - 2 * s**3) * p1
            + (s**3 - s**2) * span * v1
        )
        return position

    def _resend_program(self) -> tuple[bool, str]:
        is_normal = self.controller.safety_mode == SafetyMode.NORMAL
        if is_normal and not self.controller.is_program_running:
            self.controller.start_program(repeat(None))
        return is_normal, "" if is_normal else f"the robot is in {self.controller.safety_mode.name.lower()}"


def description(kinematics: Vector, joints: Sequence[str], prefix: str) -> str:
    """Return the URDF (its links and joints only) of an arm with Denavit-Hartenberg parameters (4, 6)."""
    parts = []

    def add(name: str, parent: str, child: str, xyz: Sequence[float], rpy: Sequence[float], rest: str = "") -> None:
        parts.append(
            f'<link name="{prefix}{child}"/><joint name="{name}" type="{"revolute" if rest else "fixed"}">'
            f'<parent link="{prefix}{parent}"/><child link="{prefix}{child}"/>'
            f'<origin xyz="{" ".join(map(repr, xyz))}" rpy="{" ".join(map(repr, rpy))}"/>{rest}</joint>'
        )

    add(f"{prefix}base_link-base_fixed_joint", "base_link", "base", (0.0, 0.0, 0.0), (0.0, 0.0, math.pi))
    add(f"{prefix}base_link-base_link_inertia", "base_link", LINKS[0], (0.0, 0.0, 0.0), (0.0, 0.0, math.pi))
    moves = '<axis xyz="0 0 1"/><limit lower="-6.3" upper="6.3" effort="150" velocity="3.2"/>'
    xyz, rpy = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    chain = zip(joints, LINKS[:-1], LINKS[1:], kinematics.T.tolist(), strict=True)
    for joint, parent, child, (theta, a, d, alpha) in chain:
        add(joint, parent, child, xyz, rpy, moves)
        xyz, rpy = (a * math.cos(theta), a * math.sin(theta), d), (alpha, 0.0, theta)
    add(f"{prefix}flange-tool0", LINKS[-1], "tool0", xyz, rpy)
    return f'<robot name="ur"><link name="{prefix}base_link"/>{"".join(parts)}</robot>'


def _dashboard_kind(name: str) -> str:
    """Return ur_dashboard_msgs' type, or a plain number if that package is not installed."""
    kind = f"ur_dashboard_msgs/msg/{name}"
    try:
        message_class(kind)
    except RobotError:
        return INT8
    return kind
