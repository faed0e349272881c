"""A UR arm behind ROS 2, for the command stream: topics of Universal_Robots_ROS2_Driver."""

from __future__ import annotations

import math
import subprocess
import sys
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.robots.arm import RUNNING, Reading, RobotError
from rlservo.envs.ros2.address import ARM_OPTIONS, COMMAND_TOPICS, RosAddress
from rlservo.envs.ros2.link import check_clock, take_command, wait_for
from rlservo.envs.ros2.messages import (
    FLAG,
    INT8,
    JOINT_NAMES,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    NUMBER,
    NUMBERS,
    in_order,
    stamp_of,
    trajectory,
)
from rlservo.envs.ros2.rclpy_link import RclpyLink

if TYPE_CHECKING:
    from rlservo.envs.robots.command_stream import StreamSettings

RATE_HZ = {"position": 125.0, "velocity": 125.0, "trajectory": 50.0}  # of commands, if the limits name none
MODES = ("program_running", "robot_mode", "safety_mode")
# Distance of a joint from its setpoint beyond which it does not follow: at rest, plus this much of its velocity.
FOLLOWING_ERROR, FOLLOWING_LAG_S = 0.15, 0.5  # [rad], [s]
AHEAD_S = 0.1  # of a trajectory's point: the controller begins each new one at the arm's lagging position
DRIFT_GAIN = 2.0  # [1/s], of velocity commands
KINDS = {"position": NUMBERS, "velocity": NUMBERS, "trajectory": JOINT_TRAJECTORY}

Vector = NDArray[np.float64]


class RosArmConnection:
    """The arm's topics, as a connection of the command stream."""

    def __init__(self, settings: StreamSettings) -> None:
        """Wait for every input, then take the command topic. Raises RobotError."""
        self._address = address = RosAddress.parse(settings.host, ARM_OPTIONS)
        if address.host:
            raise RobotError(f"robot {settings.host!r}: an arm needs ros2: or rtde://, not a rosbridge")
        self._how = address["command"]
        self._limits = settings.limits
        self.rate_hz = settings.limits.rate_hz or RATE_HZ[self._how]
        self._joints = [address["prefix"] + name for name in JOINT_NAMES.values()]
        self._state: tuple[float, float | None, Vector, Vector] | None = None  # stamp, age, positions, velocities
        self._problem = f"no message on {address['joint_states']}: is the driver running, with this ROS_DOMAIN_ID"
        self._speed_percent = 100.0 if address["status"] == "off" else float("nan")
        self._modes: dict[str, int] = dict(zip(MODES, (1, RUNNING, 1), strict=True))
        self._topic = address["commands"] or COMMAND_TOPICS[self._how]
        self._setpoint: Vector | None = None
        self._fastest = 0.0  # [rad/s], of the latest setpoints
        self._guard: subprocess.Popen[bytes] | None = None
        self._link = RclpyLink("rlservo_arm")
        try:
            self._subscribe()
            if self._how == "velocity":  # its controller repeats the last command indefinitely
                words = [sys.executable, "-m", "rlservo.envs.ros2.velocity_guard", self._topic]
                self._guard = subprocess.Popen(
                    words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
                )
            self._publish = take_command(self._link, self._topic, KINDS[self._how])
            if self._guard is not None and self._guard.stdout is not None and not self._guard.stdout.readline():
                raise RobotError(f"the guard of {self._topic} ended at its start: nothing is commanded without it")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leave the graph; the guard of velocity commands ends with its input, after a final zero."""
        self._link.close()
        if self._guard is not None and self._guard.stdin is not None:
            self._guard.stdin.close()
            self._guard.wait()

    # -- the command stream's

    def read(self) -> Reading:
        """Return the newest state. With trajectories the controller applies the speed scaling itself."""
        assert self._state is not None
        modes, fraction = self._modes, 1.0 if self._how == "trajectory" else self._speed_percent / 100.0
        return Reading(
            *self._state, modes["robot_mode"], modes["safety_mode"], bool(modes["program_running"]), fraction
        )

    def target(self) -> Vector:
        """Return the measured joint positions [rad] (6,)."""
        assert self._state is not None
        return self._state[2]

    def send(self, goal: Vector) -> bool:
        """Publish the next setpoint [rad] (6,). Raises RobotError if the arm does not follow."""
        measured = self.target()
        before = goal if self._setpoint is None else self._setpoint
        velocity = (goal - before) * self.rate_hz
        self._setpoint = goal
        forgotten = self._fastest * (1.0 - 1.0 / (FOLLOWING_LAG_S * self.rate_hz))
        self._fastest = max(float(np.abs(velocity).max()), forgotten)
        away = np.abs(goal - measured)
        if away.max() > FOLLOWING_ERROR + FOLLOWING_LAG_S * self._fastest:
            joint = self._joints[int(away.argmax())]
            raise RobotError(
                f"not_following: {joint} is {away.max():.2f} rad from its setpoint: is the controller of "
                f"{self._topic} active (ros2 control list_controllers)"
            )
        if self._how == "position":
            self._publish({"data": goal.tolist()})
        elif self._how == "velocity":
            self._publish({"data": (velocity + DRIFT_GAIN * (goal - measured) * bool(velocity.any())).tolist()})
            self.keep_alive()
        else:
            self._publish(self._trajectory(goal, velocity))
        return True

    def keep_alive(self) -> None:
        """Feed the guard of velocity commands."""
        if self._guard is not None and self._guard.stdin is not None:
            self._guard.stdin.write(b".")
            self._guard.stdin.flush()

    def free(self) -> None:
        """Stop sending: the arm holds, and another node may command it."""
        self._setpoint = None

    hold = free

    # -- parts

    def _trajectory(self, goal: Vector, velocity: Vector) -> dict[str, Any]:
        """Return two points: the setpoint, and then a stop, the end if no other trajectory comes."""
        stop_s = float(np.abs(velocity).max()) / self._limits.acceleration
        points: list[tuple[float, Vector, Vector]] = [(AHEAD_S, goal + velocity * AHEAD_S, velocity)]
        if stop_s > 0.0:
            at = points[0]
            points.append((at[0] + stop_s, at[1] + velocity * stop_s / 2.0, np.zeros(6)))
        return trajectory(self._joints, points)

    def _subscribe(self) -> None:
        address, link = self._address, self._link
        link.subscribe(address["joint_states"], JOINT_STATE, self._take_state)
        if address["status"] == "on":
            self._modes.clear()
            link.subscribe(address["speed_scaling"], NUMBER, self._take_speed)
            for name in MODES:
                topic = address[name]
                publishers = wait_for(
                    partial(link.publishers, topic),
                    f"nothing publishes {topic}: is the driver's io_and_status_controller active (or use status=off)",
                )
                # ur_dashboard_msgs' own type, or a plain number if that package is not installed.
                kind = FLAG if name == "program_running" else publishers[0].type or INT8
                link.subscribe(topic, kind, partial(self._take_mode, name), is_kept=True)
        wait_for(lambda: not self._missing(), self._missing)
        check_clock(address["joint_states"], self.read().age_s or 0.0)

    def _missing(self) -> str:
        if self._state is None:
            return self._problem
        missing = [name for name in MODES if name not in self._modes]
        missing += ["speed_scaling"] * math.isnan(self._speed_percent)
        topics = ", ".join(self._address[name] for name in missing)
        return f"no message on {topics} (status=off works without it)" if missing else ""

    def _take_state(self, message: Any) -> None:
        positions = in_order(message, self._joints, "position")
        velocities = in_order(message, self._joints, "velocity")
        made_s = stamp_of(message)
        if positions is None or velocities is None:
            names = ", ".join(message.name)
            self._problem = f"{self._address['joint_states']} lacks joints of {', '.join(self._joints)}: it has {names}"
        elif made_s is None:
            self._problem = f"{self._address['joint_states']} has no stamps: its driver must set them"
        elif self._state is None or made_s > self._state[0]:
            age_s = None if self._address["clock"] == "robot" else abs(self._link.now_s() - made_s)
            self._state = (made_s, age_s, positions, velocities)

    def _take_speed(self, message: Any) -> None:
        self._speed_percent = float(message.data)

    def _take_mode(self, name: str, message: Any) -> None:
        self._modes[name] = int(message.data if hasattr(message, "data") else message.mode)
