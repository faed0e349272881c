"""A UR arm behind ROS 2, for the command stream: topics of Universal_Robots_ROS2_Driver."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.robots.arm import RobotError
from rlservo.envs.ros2.address import ARM_OPTIONS, COMMAND_TOPICS, RosAddress
from rlservo.envs.ros2.link import FIRST_MESSAGES_S, check_clock, take_command, wait_until
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
RUNNING = 7
# Distance of a joint from its setpoint beyond which it does not follow: at rest, plus this much of its velocity.
FOLLOWING_ERROR, FOLLOWING_LAG_S = 0.15, 0.5  # [rad], [s]
# The controller begins each trajectory where the arm is, behind its setpoint, and the next replaces it after one
# period: of the way to a point n periods ahead the arm has then gone about 3 / n**2.
PERIODS_AHEAD = 2.0
BRAKE_S = 0.1  # from a trajectory's start until it brakes, if no other comes
SLOWEST_HZ = PERIODS_AHEAD / BRAKE_S  # of trajectories
SHORTEST_STOP_S = 1e-6  # the controller refuses points at equal times, in nanoseconds
DRIFT_GAIN = 2.0  # [1/s], of velocity commands
LAST_S = 0.2  # [s] for the last velocity, zero, to leave
KINDS = {"position": NUMBERS, "velocity": NUMBERS, "trajectory": JOINT_TRAJECTORY}

Vector = NDArray[np.float64]


class RosArmConnection:
    """The arm's topics, with the ur_rtde methods that the command stream calls."""

    def __init__(self, settings: StreamSettings) -> None:
        """Wait for every input, then take the command topic. Raises RobotError."""
        self._address = address = RosAddress.parse(settings.host, ARM_OPTIONS)
        if address.host:
            raise RobotError(f"robot {settings.host!r}: an arm needs ros2: or rtde://, not a rosbridge")
        self._how = address["command"]
        self._limits = settings.limits
        self.rate_hz = settings.limits.rate_hz or RATE_HZ[self._how]
        if self._how == "trajectory" and self.rate_hz < SLOWEST_HZ:
            raise RobotError(f"rate_hz is {self.rate_hz:g}: trajectories need at least {SLOWEST_HZ:g} a second")
        self.receive = self.control = self
        self._joints = [address["prefix"] + name for name in JOINT_NAMES.values()]
        self._lock = threading.Lock()
        self._state: tuple[float, float | None, Vector, Vector] | None = None  # stamp, age, positions, velocities
        self._problem = f"no message on {address['joint_states']}: is the driver running, with this ROS_DOMAIN_ID"
        self._speed_percent = 100.0 if address["status"] == "off" else float("nan")
        self._modes: dict[str, int] = {"program_running": 1, "robot_mode": RUNNING, "safety_mode": 1}
        self._setpoint: Vector | None = None
        self._fastest = 0.0  # [rad/s], of the latest setpoints
        self._guard: subprocess.Popen[bytes] | None = None
        self._link = RclpyLink("rlservo_arm")
        try:
            self._subscribe()
            topic = address["commands"] or COMMAND_TOPICS[self._how]
            if self._how == "velocity":  # its controller repeats the last command indefinitely
                words = [sys.executable, "-m", "rlservo.envs.ros2.velocity_guard", topic]
                self._guard = subprocess.Popen(
                    words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
                )
            _, self._publish = take_command(self._link, topic, KINDS[self._how])
            if self._guard is not None and self._guard.stdout is not None and not self._guard.stdout.readline():
                raise RobotError(f"the guard of {topic} ended at its start: nothing is commanded without it")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leave the graph; the guard of velocity commands ends with its input, after a final zero of its own."""
        if self._guard is not None and self._guard.stdin is not None:
            if self._setpoint is not None:
                self._publish({"data": [0.0] * 6})
                time.sleep(LAST_S)
            with contextlib.suppress(OSError):
                self._guard.stdin.close()
        self._link.close()
        if self._guard is not None:
            self._guard.wait()

    def age_s(self) -> float | None:
        """Return the newest state's age at its arrival [s], by its stamp; None with the robot's own clock."""
        assert self._state is not None
        return self._state[1]

    # -- receive

    def isConnected(self) -> bool:
        """Return True: the age of the states is the better sign."""
        return True

    def getTimestamp(self) -> float:
        """Return the newest state's stamp [s]."""
        assert self._state is not None
        return self._state[0]

    def getActualQ(self) -> list[float]:
        """Return the joint positions [rad] (6,)."""
        assert self._state is not None
        return [float(value) for value in self._state[2]]

    getTargetQ = getActualQ

    def getActualQd(self) -> list[float]:
        """Return the joint velocities [rad/s] (6,)."""
        assert self._state is not None
        return [float(value) for value in self._state[3]]

    def getRobotMode(self) -> int:
        """Return the robot mode, 7 if it runs."""
        return self._modes["robot_mode"]

    def getSafetyMode(self) -> int:
        """Return the safety mode, 1 if it is normal."""
        return self._modes["safety_mode"]

    def getRobotStatus(self) -> int:
        """Return ur_rtde's bits: 1 for power, 2 for a running program."""
        return 1 + 2 * self._modes["program_running"]

    def getTargetSpeedFraction(self) -> float:
        """Return the speed scaling, 0 to 1.

        The controller of trajectories scales them as well; alone that would only let the arm lag further behind.
        """
        return self._speed_percent / 100.0

    # -- control

    def servoJ(self, setpoint: Sequence[float], *_: float) -> bool:
        """Publish the next setpoint [rad] (6,); return False if the arm does not follow."""
        goal, measured = np.array(setpoint), np.array(self.getActualQ())
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
                f"{self._address['commands'] or COMMAND_TOPICS[self._how]} active (ros2 control list_controllers)"
            )
        if self._how == "position":
            self._publish({"data": goal.tolist()})
        elif self._how == "velocity":
            self.kickWatchdog()
            self._publish({"data": (velocity + DRIFT_GAIN * (goal - measured) * bool(velocity.any())).tolist()})
        else:
            self._publish(self._trajectory(goal, velocity))
        return True

    def kickWatchdog(self) -> None:
        """Feed the guard of velocity commands. Raises RobotError if it has ended."""
        if self._guard is not None and self._guard.stdin is not None:
            try:
                self._guard.stdin.write(b".")
                self._guard.stdin.flush()
            except OSError as error:
                raise RobotError("guard_ended: nothing is commanded without the guard of velocity commands") from error

    def servoStop(self) -> None:
        """Stop sending: the arm holds, and another node may command it."""
        self._setpoint = None

    teachMode = servoStop
    endTeachMode = servoStop

    # -- parts

    def _trajectory(self, goal: Vector, velocity: Vector) -> dict[str, Any]:
        """Return points that continue the setpoint's motion at its last velocity, and then brake to a stop."""
        ahead_s, stop_s = PERIODS_AHEAD / self.rate_hz, float(np.abs(velocity).max()) / self._limits.acceleration
        if stop_s < SHORTEST_STOP_S:
            return trajectory(self._joints, [(ahead_s, goal, np.zeros(6))])
        points = [(at_s, goal + velocity * at_s, velocity) for at_s in dict.fromkeys((ahead_s, BRAKE_S))]
        points.append((BRAKE_S + stop_s, goal + velocity * (BRAKE_S + stop_s / 2.0), np.zeros(6)))
        return trajectory(self._joints, points)

    def _subscribe(self) -> None:
        address, link = self._address, self._link
        link.subscribe(address["joint_states"], JOINT_STATE, self._take_state)
        if address["status"] == "on":
            self._modes.clear()
            link.subscribe(address["speed_scaling"], NUMBER, self._take_speed)
            # The order in which the driver publishes them: the program is seen to end after what ended it.
            for name, own in (("robot_mode", ""), ("safety_mode", ""), ("program_running", FLAG)):
                topic = address[name]
                wait_until(
                    lambda topic=topic: bool(link.publishers(topic)),  # type: ignore[misc]  # a default is no argument
                    f"nothing publishes {topic}: is the driver's io_and_status_controller active (or use status=off)",
                    FIRST_MESSAGES_S,
                )
                # ur_dashboard_msgs' own type, or a plain number if that package is not installed.
                kind = own or link.publishers(topic)[0].type or INT8
                link.subscribe(topic, kind, lambda message, name=name: self._take_mode(name, message))  # type: ignore[misc]
        wait_until(self._is_complete, self._missing, FIRST_MESSAGES_S)
        check_clock(address["joint_states"], self.age_s() or 0.0)

    def _is_complete(self) -> bool:
        return self._state is not None and len(self._modes) == 3 and self._speed_percent == self._speed_percent

    def _missing(self) -> str:
        if self._state is None:
            return self._problem
        missing = [name for name in ("program_running", "robot_mode", "safety_mode") if name not in self._modes]
        topics = [self._address[name] for name in missing or ["speed_scaling"]]
        return f"no message on {', '.join(topics)} (status=off works without it)"

    def _take_state(self, message: Any) -> None:
        positions = in_order(message, self._joints, "position")
        velocities = in_order(message, self._joints, "velocity")
        made_s = stamp_of(message)
        if positions is None or velocities is None:
            names = ", ".join(message.name)
            wanted = f"finite position and velocity of {', '.join(self._joints)}"
            self._problem = f"{self._address['joint_states']} has no {wanted}: it has {names}"
        elif made_s is None:
            self._problem = f"{self._address['joint_states']} has no stamps: its driver must set them"
        elif self._state is None or made_s > self._state[0]:
            age_s = None if self._address["clock"] == "robot" else abs(self._link.now_s() - made_s)
            self._state = (made_s, age_s, positions, velocities)

    def _take_speed(self, message: Any) -> None:
        if math.isfinite(message.data):
            self._speed_percent = float(message.data)

    def _take_mode(self, name: str, message: Any) -> None:
        self._modes[name] = int(message.data if hasattr(message, "data") else message.mode)
