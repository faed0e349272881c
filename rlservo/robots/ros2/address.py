"""Address of a robot behind ROS: `ros2:NAME=VALUE,...` or `rosbridge://HOST:PORT,NAME=VALUE,...`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from rlservo.robots.arm_interface import ROS2, ROSBRIDGE, RobotError

ROSBRIDGE_PORT = 9090
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
TOPIC = r"(?:~?/)?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*"
FRAME = r"[A-Za-z_/][\w/.-]*"
POSE = rf"{NUMBER}:{NUMBER}:{NUMBER}"
CHOICES = {
    "command": ("position", "velocity", "trajectory"),
    "status": ("on", "off"),
    "twist": ("auto", "Twist", "TwistStamped"),
    "clock": ("ros", "robot"),
    "unknown_beams": ("stop", "free"),
}
# Options that are neither a choice nor a topic, with what is expected.
FORMS = {
    "prefix": (r".*", ""),
    "base_frame": (FRAME, "a frame's name"),
    **{f"{name}_pose": (POSE, "X:Y:YAW in m, m and rad") for name in ("scan", "front_scan", "back_scan")},
}
# Topics of Universal_Robots_ROS2_Driver; `commands` follows from `command`.
ARM_OPTIONS = {
    "prefix": "",  # prefix of the joint names
    "command": "position",
    "commands": "",
    "status": "on",  # off: a robot without speed scaling, modes and program state
    "clock": "ros",
    "joint_states": "/joint_states",
    "robot_description": "/robot_description",
    "speed_scaling": "/speed_scaling_state_broadcaster/speed_scaling",
    "robot_mode": "/io_and_status_controller/robot_mode",
    "safety_mode": "/io_and_status_controller/safety_mode",
    "program_running": "/io_and_status_controller/robot_program_running",
}
COMMAND_TOPICS = {
    "position": "/forward_position_controller/commands",
    "velocity": "/forward_velocity_controller/commands",
    "trajectory": "/scaled_joint_trajectory_controller/joint_trajectory",
}
# The name since ROS 2 Lyrical, where the controller scales by itself.
LATER_TOPICS = {"trajectory": "/joint_trajectory_controller/joint_trajectory"}
BASE_OPTIONS = {
    "odom": "/odom",
    "cmd_vel": "/cmd_vel",
    "twist": "auto",
    "scan": "",  # empty: both scanners' own topics if they are published, else /scan
    "front_scan": "/f_scan",
    "back_scan": "/b_scan",
    "base_frame": "base_link",  # frame of the body, whose x axis is the direction of linear commands
    "scan_pose": "",  # X:Y:YAW of each scanner in base_frame [m], [m], [rad]; empty: from /tf_static
    "front_scan_pose": "",
    "back_scan_pose": "",
    "unknown_beams": "stop",  # for beams that show nothing; free: of a driver that has NaN, 0 or null for a free way
    "deadman": "",  # a std_msgs/Bool that must be true and fresh while the base moves
    "clock": "",  # ros, or robot: the robot's clock is not ours; empty: ros with `ros2:`, robot with a rosbridge
}


@dataclass(frozen=True)
class RosAddress:
    """A robot's graph or rosbridge, and its topic names."""

    host: str = ""  # rosbridge; empty: ROS 2 itself
    port: int = ROSBRIDGE_PORT
    options: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> str:
        return self.options[name]

    def pose(self, name: str) -> tuple[float, float, float] | None:
        """Return an option's x, y [m] and yaw [rad]; None if it is empty."""
        if not self.options[name]:
            return None
        x, y, yaw = map(float, self.options[name].split(":"))
        return x, y, yaw

    @classmethod
    def parse(cls, robot: str, defaults: Mapping[str, str]) -> RosAddress:
        """Parse an address. Raises RobotError for an unknown option or value."""
        place, *settings = robot.split(",")
        options = dict(defaults)
        host, port = "", ROSBRIDGE_PORT
        if place.startswith(ROSBRIDGE):
            host, _, digits = place.removeprefix(ROSBRIDGE).partition(":")
            if not host or "/" in host or not (digits.isdecimal() or not digits):
                raise RobotError(f"robot {robot!r}: expected {ROSBRIDGE}HOST:{ROSBRIDGE_PORT}")
            port = int(digits or ROSBRIDGE_PORT)
        elif place.startswith(ROS2):
            settings = [one for one in (place.removeprefix(ROS2), *settings) if one]
        else:
            raise RobotError(f"robot {robot!r}: expected {ROS2}, {ROS2}NAME=VALUE,... or {ROSBRIDGE}HOST:PORT")
        for setting in settings:
            name, equals, value = setting.partition("=")
            if not equals or name not in options:
                raise RobotError(f"robot {robot!r}: {setting!r}: expected NAME=VALUE with one of {', '.join(options)}")
            if name in CHOICES and value not in CHOICES[name]:
                raise RobotError(f"robot {robot!r}: {name} is {value!r}, expected {' or '.join(CHOICES[name])}")
            pattern, expected = FORMS.get(name, (TOPIC, "a topic's name"))
            if name not in CHOICES and not re.fullmatch(pattern, value):
                raise RobotError(f"robot {robot!r}: {name} is {value!r}, expected {expected}")
            options[name] = value
        return cls(host, port, options)
