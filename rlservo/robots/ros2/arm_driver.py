"""A UR arm behind ROS 2, for the servo loop: topics of Universal_Robots_ROS2_Driver."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
import time
from typing import Any

import numpy as np

from rlservo.robots.arm_interface import RUNNING, RobotError, Vector
from rlservo.robots.arm_port import ArmReading, ServoSettings
from rlservo.robots.following_error import FollowingBound
from rlservo.robots.ros2.address import ARM_OPTIONS, COMMAND_TOPICS, LATER_TOPICS, RosAddress
from rlservo.robots.ros2.link import (
    CLOCK_TOLERANCE_S,
    FIRST_MESSAGES_S,
    LOOK_S,
    WATCH_S,
    check_clock,
    check_publisher,
    log,
    take_command,
    wait_until,
)
from rlservo.robots.ros2.rclpy_link import RclpyLink
from rlservo.robots.ros2.ros_messages import (
    FLAG,
    INT8,
    JOINT_NAMES,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    NUMBER,
    NUMBERS,
    STRING,
    in_order,
    stamp_of,
    trajectory,
)
from rlservo.robots.ur.calibration import checked
from rlservo.robots.ur.description import frames_of_description

RATE_HZ = {"position": 125.0, "velocity": 125.0, "trajectory": 50.0}  # of commands, if the limits name none
# The driver does not publish the controller's own target: the measured positions lag by the drives as well.
FOLLOWING = {
    "position": FollowingBound(0.03, 0.2),
    "velocity": FollowingBound(0.03, 0.2),
    "trajectory": FollowingBound(0.05, 0.4),
}
# The controller begins each trajectory where the arm is, behind its setpoint, and the next replaces it after one
# period: of the way to a point n periods ahead the arm has then gone about 3 / n**2.
PERIODS_AHEAD = 2.0
BRAKE_S = 0.1  # from a trajectory's start until it brakes, if no other comes
SLOWEST_HZ = PERIODS_AHEAD / BRAKE_S  # of trajectories
SHORTEST_STOP_S = 1e-6  # the controller refuses points at equal times, in nanoseconds
JUMP, FASTEST_JOINT = 0.1, 2.0 * math.pi  # [rad], [rad/s], between two states, beyond which they are not one arm's
JUMP_MARGIN_S = 0.5  # [s] by which two stamps may be farther apart than the messages' arrivals
DRIFT_GAIN, DRIFT = 2.0, 0.002  # [1/s], of velocity commands; [rad] that is left at rest
SCALE_FALL, LEAST_SCALE = 1.0, 0.05  # [1/s], by which velocity commands follow a falling speed scaling; its least
LAST_S = 0.2  # [s] for the last velocity, zero, to leave
DESCRIPTION_S = 1.0  # [s] for the robot's description, after everything else has come
KINDS = {"position": NUMBERS, "velocity": NUMBERS, "trajectory": JOINT_TRAJECTORY}


class RosArmConnection:
    """The arm's topics."""

    def __init__(self, settings: ServoSettings) -> None:
        """Wait for every input, then take the command topic. Raises RobotError."""
        self._address = address = RosAddress.parse(settings.host, ARM_OPTIONS)
        if address.host:
            raise RobotError(f"robot {settings.host!r}: an arm needs ros2: or rtde://, not a rosbridge")
        self._how = address["command"]
        self._limits = settings.limits
        self.rate_hz = settings.limits.rate_hz or RATE_HZ[self._how]
        if self._how == "trajectory" and self.rate_hz < SLOWEST_HZ:
            raise RobotError(f"rate_hz is {self.rate_hz:g}: trajectories need at least {SLOWEST_HZ:g} Hz")
        self.following = FOLLOWING[self._how]
        self._joints = [address["prefix"] + name for name in JOINT_NAMES.values()]
        self._state: tuple[float, float | None, Vector, Vector] | None = None  # stamp, age, positions, velocities
        self._problem = f"no message on {address['joint_states']}: is the driver running, with this ROS_DOMAIN_ID"
        self._speed_percent = 100.0 if address["status"] == "off" else float("nan")
        self._modes: dict[str, int] = {"program_running": 1, "robot_mode": RUNNING, "safety_mode": 1}
        self._fault, self._came_s, self._looked_s = "", 0.0, time.monotonic()
        self._heard_s = 0.0  # when the newest message of states came, whatever was in it
        self._setpoint: Vector | None = None
        self._scale = 1.0
        self._guard: subprocess.Popen[bytes] | None = None
        self._description: list[str] = []
        self._link = RclpyLink("rlservo_arm")
        try:
            self._subscribe()
            self.frames, self.without_frames = self._own_kinematics(settings.ur_model)
            topic = self._command_topic()
            name = topic.strip("/").partition("/")[0]
            self.hint = f"is its controller active (ros2 control switch_controllers --activate {name})"
            if self._how == "velocity":  # its controller repeats the last command indefinitely
                words = [sys.executable, "-m", "rlservo.robots.ros2.velocity_guard", topic]
                self._guard = subprocess.Popen(
                    words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
                )
            self._order = self._command_order(topic)
            _, self._publish = take_command(self._link, topic, KINDS[self._how])
            if self._guard is not None and self._guard.stdout is not None and not self._guard.stdout.readline():
                raise RobotError(f"the guard of {topic} exited at startup: nothing is commanded without it")
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

    def read(self) -> ArmReading:
        """Return the newest state, with the measured positions as targets: the driver does not publish the targets.

        A paused program has the speed scaling 0. The controller of trajectories scales them as well; alone that would
        only let the arm lag further behind.
        """
        assert self._state is not None
        made_s, age_s, positions, velocities = self._state
        return ArmReading(
            timestamp=made_s,
            age_s=age_s,
            positions=positions,
            velocities=velocities,
            targets=positions,
            scaling=self._speed_percent / 100.0,
            is_program_running=bool(self._modes["program_running"]),
            is_program_paused=False,
            robot_mode=self._modes["robot_mode"],
            safety_mode=self._modes["safety_mode"],
        )

    def silence(self) -> str:
        """Return why no new state comes, as a fault."""
        topic, silent_s = self._address["joint_states"], time.monotonic() - self._came_s
        if time.monotonic() - self._heard_s > WATCH_S:
            return f"connection_lost: no message on {topic} for {silent_s:.0f} s: is the driver running?"
        if self._problem:
            return f"bad_messages: {self._problem}"
        return f"stale_stamps: {topic} has no new stamp for {silent_s:.1f} s: check its driver's clock"

    def send(self, setpoint: Vector) -> bool:
        """Publish the next joint positions [rad] (6,). Raises RobotError if the states are not those of one arm."""
        self._check_states()
        state = self.read()
        velocity = (setpoint - (setpoint if self._setpoint is None else self._setpoint)) * self.rate_hz
        self._setpoint = setpoint
        if self._how == "position":
            self._publish({"data": setpoint[self._order].tolist()})
        elif self._how == "velocity":
            self.keep_alive()
            drift = setpoint - state.positions
            drift[(np.abs(drift) < DRIFT) & (velocity == 0.0)] = 0.0
            # The driver scales velocities, and the setpoint's is scaled already: at most by what both have seen.
            self._scale = max(state.scaling, self._scale - SCALE_FALL / self.rate_hz, LEAST_SCALE)
            self._publish({"data": ((velocity + DRIFT_GAIN * drift) / self._scale)[self._order].tolist()})
        else:
            self._publish(self._trajectory(setpoint, velocity))
        return True

    def hand_over(self, *, to_person: bool) -> None:  # noqa: ARG002  # its controller holds the arm in both
        """Send nothing before the next setpoint: another node may command the arm meanwhile."""
        self._setpoint = None

    def keep_alive(self) -> None:
        """Feed the guard of velocity commands. Raises RobotError if it has ended."""
        if self._guard is not None and self._guard.stdin is not None:
            try:
                self._guard.stdin.write(b".")
                self._guard.stdin.flush()
            except OSError as error:
                raise RobotError("guard_ended: nothing is commanded without the guard of velocity commands") from error

    # -- parts

    def _check_states(self) -> None:
        """Raise RobotError if the states are not those of one arm."""
        if self._fault:
            raise RobotError(self._fault)
        if (now := time.monotonic()) - self._looked_s > WATCH_S:
            self._looked_s = now
            check_publisher(self._link, self._address["joint_states"])

    def _trajectory(self, goal: Vector, velocity: Vector) -> dict[str, Any]:
        """Return points that continue the setpoint's motion at its last velocity, and then brake to a stop."""
        ahead_s, stop_s = PERIODS_AHEAD / self.rate_hz, float(np.abs(velocity).max()) / self._limits.acceleration
        if stop_s < SHORTEST_STOP_S:
            return trajectory(self._joints, [(ahead_s, goal, np.zeros(6))])
        points = [(at_s, goal + velocity * at_s, velocity) for at_s in dict.fromkeys((ahead_s, BRAKE_S))]
        points.append((BRAKE_S + stop_s, goal + velocity * (BRAKE_S + stop_s / 2.0), np.zeros(6)))
        return trajectory(self._joints, points)

    def _command_topic(self) -> str:
        """Return the topic of commands: the option's, else the one of the possible that a controller subscribes to."""
        topics = [COMMAND_TOPICS[self._how], *([LATER_TOPICS[self._how]] if self._how in LATER_TOPICS else [])]
        if self._address["commands"] or len(topics) == 1:
            return self._address["commands"] or topics[0]
        found: list[str] = []

        def look() -> bool:
            found.extend(topic for topic in topics if self._link.subscribers(topic))
            return bool(found)

        names = " or ".join(topics)
        how = " or ".join(topic.strip("/").partition("/")[0] for topic in topics)
        wait_until(
            look,
            f"nothing subscribes to {names}: load one (ros2 control load_controller --set-state active, {how})",
            20.0,
        )
        return found[0]

    def _command_order(self, topic: str) -> list[int]:
        """Return our joints in the order of the controller's; the kinematic one if its parameter cannot be read."""
        controller = topic.rpartition("/")[0]
        found = None if self._how == "trajectory" else self._link.strings(controller, "joints")
        if found is not None and sorted(found) != sorted(self._joints):
            expected = ", ".join(self._joints)
            raise RobotError(
                f"{controller} commands {', '.join(found)}: expected {expected}; name another topic or prefix"
            )
        return [self._joints.index(name) for name in found or self._joints]

    def _subscribe(self) -> None:
        address, link = self._address, self._link
        link.subscribe(address["joint_states"], JOINT_STATE, self._take_state)
        description = address["robot_description"]
        link.subscribe(description, STRING, lambda message: self._description.append(message.data), is_kept=True)
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
        check_clock(link, address["joint_states"], self.read().age_s or 0.0)
        check_publisher(link, address["joint_states"])

    def _own_kinematics(self, ur_model: str) -> tuple[Vector | None, str]:
        """Return the frames of the robot's description, or why there are none. Raises RobotError for another arm's."""
        until, topic = time.monotonic() + DESCRIPTION_S, self._address["robot_description"]
        while not self._description and time.monotonic() < until:
            time.sleep(LOOK_S)
        if not self._description:
            return None, f"no message on {topic}"
        try:
            frames = frames_of_description(self._description[-1], self._joints, self._address["prefix"])
        except ValueError as error:
            log.warning("kinematics are the data sheet's: %s cannot be used: %s", topic, error)
            return None, f"{topic} cannot be used: {error}"
        return checked(frames, ur_model), ""

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
        made_s, self._heard_s = stamp_of(message), time.monotonic()
        if positions is None or velocities is None:
            names = ", ".join(message.name)
            wanted = f"finite position and velocity of {', '.join(self._joints)}"
            self._problem = f"{self._address['joint_states']} has no {wanted}: it has {names}"
        elif made_s is None:
            self._problem = f"{self._address['joint_states']} has no stamps: its driver must set them"
        elif self._state is None or made_s > self._state[0]:
            self._note_jump(made_s, positions)
            age_s = None if self._address["clock"] == "robot" else abs(self._link.now_s() - made_s)
            if self._state is not None and age_s is not None and age_s > CLOCK_TOLERANCE_S and not self._fault:
                topic, way = self._address["joint_states"], "ahead of" if made_s > self._link.now_s() else "behind"
                self._fault = f"stale_stamps: {topic} has stamps {age_s:.1f} s {way} ours: check its driver's clock"
            self._problem = ""
            self._state = (made_s, age_s, positions, velocities)

    def _note_jump(self, made_s: float, positions: Vector) -> None:
        """Note a motion that no arm can make since the state before."""
        now = time.monotonic()
        if self._state is not None:
            passed_s = min(made_s - self._state[0], now - self._came_s + JUMP_MARGIN_S)
            moved = np.abs(positions - self._state[2])
            if moved.max() > JUMP + FASTEST_JOINT * passed_s and not self._fault:
                joint, topic = self._joints[int(moved.argmax())], self._address["joint_states"]
                self._fault = (
                    f"states_jumped: {joint} on {topic} moved by {moved.max():.2f} rad in {passed_s:.3f} s, as no arm "
                    "can: is it published twice"
                )
        self._came_s = now

    def _take_speed(self, message: Any) -> None:
        if math.isfinite(message.data):
            self._speed_percent = float(message.data)

    def _take_mode(self, name: str, message: Any) -> None:
        self._modes[name] = int(message.data if hasattr(message, "data") else message.mode)
