"""Process that commands a real arm at the arm's own rate: setpoints in, joint targets within limits out.

`python -m rlservo.robots.servo_loop '<settings>'` runs it; `arm_process.py` starts it. It reports on standard
output that it is ready or why not, reads setpoints from shared memory, and decelerates and exits when its standard
input closes. If it dies, the controller's watchdog ends the program there, and the arm stops.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rlservo.robots.arm_interface import ROS2, RUNNING, SAFE_MODES, STOP_NAMES, RobotError, Vector, mode_name
from rlservo.robots.arm_port import ZERO_SCALE, ArmDriver, ServoSettings
from rlservo.robots.control_law import ControlLaw, Order, Phase
from rlservo.robots.following_error import Following
from rlservo.robots.limits import COUNTED, LATE, MotionLimiter
from rlservo.robots.link_delay import LinkDelay
from rlservo.robots.rtde_driver import RtdeDriver
from rlservo.robots.shared_block import SharedBlock
from rlservo.robots.ur.parameters import JOINTS
from rlservo.robots.ur.simulation import URSimulation

READY, FAILED = "ready", "failed: "  # lines on standard output; a fault after READY is also FAILED
LOST_S = 1.0  # [s] without a package, after which the connection counts as lost
AGE_BOUND_S = 0.1  # [s] oldest state that may be acted on
SCALE_RISE = 1.0  # [1/s], at which the speed follows a scaling that rises
ZERO_S = 0.2  # [s] of a speed scaling that is no motion, until it is a stop
FORGET_S = 0.5  # [s] of silence or hold, after which the speed grows from 0 again
AT_REST, SLOW = 1e-3, 0.01  # [rad/s], of the setpoint, of the arm
CATCH_UP_S = 1.0  # [s] in which an arm comes to rest behind its setpoint
REASON_S = 0.5  # [s], counted from a refused command, for its cause to become known
CLOSE_S = 4.0  # [s], for closing the connections
PERIOD_S, PERIODS = 1e-4, 500  # [s] width of a bin, and number of bins, of the periods' histogram; the last has no end


ORDERS = np.dtype(
    [("order", "f8"), ("goal", "f8", 6), ("duration_s", "f8"), ("given_s", "f8"), ("number", "f8"),
     ("blend_from_s", "f8")]
)  # fmt: skip
REPORT = np.dtype(
    [("phase", "f8"), ("received_s", "f8"), ("time_s", "f8"), ("age_s", "f8"), ("positions", "f8", 6),
     ("velocities", "f8", 6), ("robot_mode", "f8"), ("safety_mode", "f8"), ("setpoint", "f8", 6), ("blend", "f8"),
     ("scale", "f8"), ("target", "f8", 6), ("written_s", "f8"), ("limited", "f8", len(COUNTED)),
     ("periods", "f8", PERIODS), ("longest_period_s", "f8"), ("frames", "f8", (7, 4, 4))]
)  # fmt: skip


def connect(settings: ServoSettings) -> ArmDriver:
    """Return the connection for the address. Raises RobotError."""
    if settings.host.startswith(ROS2):
        from rlservo.robots.ros2.arm_driver import RosArmConnection

        return RosArmConnection(settings)
    return RtdeDriver(settings)


class ServoLoop:
    """The loop. `run` returns on request, and raises RobotError at a fault."""

    def __init__(self, settings: ServoSettings, connection: ArmDriver, simulation: URSimulation) -> None:
        self._settings, self._limits, self._robot = settings, settings.limits, connection
        self._orders = SharedBlock(settings.orders_descriptor, ORDERS)
        self._report = SharedBlock(settings.report_descriptor, REPORT)
        self._dt = 1.0 / connection.rate_hz
        if connection.frames is not None:
            simulation.calibrate(connection.frames)
            self._report.write({"frames": connection.frames})
        velocities = np.array(simulation.parameters.velocity_limits)
        self._policy_velocities = velocities * settings.velocity_scale * self._limits.speed_scale
        self._start_velocities = np.minimum(velocities, self._limits.start_speed) * self._limits.speed_scale
        self._limiter = MotionLimiter(self._limits, simulation, self._policy_velocities, self._dt)
        self._seen = connection.read()
        self._limiter.restart(self._seen.targets)
        self._limiter.check_start()
        self._goal, self._goal_due_s, self._number = self._limiter.position.copy(), 0.0, -1.0
        self._following = Following(connection.following)
        self._counts = np.zeros(len(COUNTED))
        self._periods, self._longest_period_s = np.zeros(PERIODS), 0.0
        self._law = ControlLaw(
            setpoint_timeout_s=settings.setpoint_timeout_s, blend_s=self._limits.blend_s, forget_s=FORGET_S
        )
        self._scale, self._moved_s, self._end_by_s = 1.0, time.monotonic(), 0.0
        self._robot_s, self._received_s, self._age_s = 0.0, time.monotonic(), 0.0
        self._delay = LinkDelay()
        self.is_asked_to_end = threading.Event()

    def run(self, on_ready: Callable[[], None]) -> None:
        """Command the arm until asked to end, then decelerate; `on_ready` is called after the first cycle."""
        due = cycle_s = time.monotonic()
        is_first = True
        while True:
            now = time.monotonic()
            if now < due:
                time.sleep(due - now)
                now = time.monotonic()
            due = max(due + self._dt, now - self._dt)
            if not is_first:
                self._periods[min(int((now - cycle_s) / PERIOD_S), PERIODS - 1)] += 1
                self._longest_period_s = max(self._longest_period_s, now - cycle_s)
            if now - cycle_s > AGE_BOUND_S:  # this process was suspended: the arm stands at its last setpoint
                self._limiter.restart(self._limiter.position)
                self._law.blend = 0.0
            cycle_s = now
            self._look(now)
            self._check()
            if self.is_asked_to_end.is_set() and self._has_ended(now):
                return
            self._command(now)
            self._publish()
            if is_first:
                on_ready()
            is_first = False

    def _has_ended(self, now: float) -> bool:
        """Return whether the setpoint is at rest, and the arm, which follows it late, as well."""
        if np.abs(self._limiter.velocity).max() > AT_REST:
            self._end_by_s = now + CATCH_UP_S
            return False
        return now > self._end_by_s or bool(np.abs(self._seen.velocities).max() < SLOW)

    def fail(self) -> None:
        """Publish a fault."""
        self._law.phase = Phase.FAULT
        self._publish()

    def _look(self, now: float) -> None:
        """Read the newest state and estimate its age: the link's delay beyond the usual one."""
        self._seen = seen = self._robot.read()
        if seen.timestamp != self._robot_s:
            excess_s = self._delay.excess_s(seen.timestamp, now)
            self._robot_s, self._received_s = seen.timestamp, now
            self._age_s = excess_s if seen.age_s is None else seen.age_s
        scale = min(max(seen.scaling, 0.0), 1.0)
        self._scale = min(scale, self._scale + SCALE_RISE * self._dt)  # the controller applies it in its own time
        if scale >= ZERO_SCALE:
            self._moved_s = now

    def _check(self) -> None:
        seen, now = self._seen, time.monotonic()
        if now - self._received_s > LOST_S:
            raise RobotError(self._robot.silence())
        if seen.safety_mode not in SAFE_MODES:
            name = STOP_NAMES.get(seen.safety_mode, "safety_stop")
            raise RobotError(f"{name}: find the cause, then unlock the robot on its pendant")
        if not seen.is_program_running:
            silence_s = 1.0 / self._limits.watchdog_hz
            raise RobotError(
                f"program_stopped: the controller's watchdog (no command for {silence_s:g} s), its pendant or another "
                "program ended it"
            )
        if seen.robot_mode != RUNNING:
            mode = mode_name(seen.robot_mode)
            raise RobotError(f"not_running: the robot is in {mode}: power it on and release the brakes")
        if seen.is_program_paused:
            raise RobotError("program_paused: someone paused the program")
        if now - self._moved_s > ZERO_S:
            raise RobotError("slider_at_zero: someone set the speed slider to 0, or the controller holds the arm")
        if self._following.is_lost:
            behind = self._following.behind
            joint = int(behind.argmax())
            raise RobotError(f"not_following: {JOINTS[joint]} is {behind[joint]:.2f} rad behind: {self._robot.hint}")

    def _command(self, now: float) -> None:
        """Send the next setpoint. A missed period is not caught up, which would make the arm hurry."""
        dt, orders = self._dt, self._orders.read()
        self._limiter.limited[:] = False
        want, scale = self._wanted(orders, now, dt)
        if self._law.phase == Phase.FREE:
            self._robot.keep_alive()
            return
        setpoint = self._limiter.step(want, dt, scale)
        began = time.monotonic()
        if not self._robot.send(setpoint):
            while time.monotonic() < began + REASON_S:  # its cause comes by another connection
                self._look(time.monotonic())
                self._check()
                time.sleep(self._dt)
            raise RobotError("command_refused: the controller refused a command, or took too long")

    def _wanted(self, orders: Any, now: float, dt: float) -> tuple[Vector, float]:
        """Return the wanted velocity and the share of the limits that it may use; set the phase."""
        order, limiter, law = Order(int(orders["order"])), self._limiter, self._law
        if self.is_asked_to_end.is_set():
            return np.zeros(6), 1.0
        if (order == Order.FREE) != (law.phase == Phase.FREE):
            return self._change_hands(order == Order.FREE), 1.0
        seen_s = self._received_s - self._age_s
        must_wait = self._following.must_wait(now, limiter, seen_s, self._seen.targets, dt)
        law.decide(
            order,
            passed_s=dt,
            blend_from_s=float(orders["blend_from_s"]),
            setpoint_age_s=now - float(orders["given_s"]),
            is_stale=now - seen_s > AGE_BOUND_S,
            other="following_error" if must_wait else "",
        )
        if law.phase not in (Phase.HOLD, Phase.FREE, Phase.STALE) and orders["number"] != self._number:
            self._number = float(orders["number"])
            self._goal = limiter.goal_within(orders["goal"])
            self._goal_due_s = float(orders["given_s"] + orders["duration_s"])
        if law.phase == Phase.BEHIND:
            return limiter.velocity_towards(self._seen.targets, 0.0, dt), 1.0
        if law.phase == Phase.GO:
            limiter.velocity_limits = self._start_velocities
            return limiter.velocity_towards(self._goal, 0.0, dt), self._scale * law.blend
        if law.phase == Phase.FOLLOW:
            limiter.velocity_limits = self._policy_velocities
            return limiter.velocity_towards(self._goal, self._goal_due_s - now, dt), self._scale * law.blend
        return np.zeros(6), 1.0

    def _change_hands(self, to_person: bool) -> Vector:
        """Let a person lead the arm once it is at rest, or hold it again at its position."""
        if not to_person:
            self._robot.hand_over(to_person=False)
            self._limiter.restart(self._robot.read().positions)
            self._following.restart()
            self._law.phase = Phase.HOLD
        elif np.abs(self._limiter.velocity).max() < AT_REST and np.abs(self._seen.velocities).max() < SLOW:
            self._robot.hand_over(to_person=True)
            self._law.phase = Phase.FREE
        return np.zeros(6)

    def _publish(self) -> None:
        self._counts += self._limiter.limited
        self._counts[LATE:] = [self._law.counts[cause] for cause in COUNTED[LATE:]]
        self._report.write(
            {
                "phase": self._law.phase,
                "received_s": self._received_s,
                "time_s": self._robot_s,
                "age_s": self._age_s,
                "positions": self._seen.positions,
                "velocities": self._seen.velocities,
                "robot_mode": self._seen.robot_mode,
                "safety_mode": self._seen.safety_mode,
                "setpoint": self._limiter.position,
                "blend": self._law.blend,
                "scale": self._scale,
                "target": self._seen.targets,
                "written_s": time.monotonic(),
                "limited": self._counts,
                "periods": self._periods,
                "longest_period_s": self._longest_period_s,
            }
        )


def main(argv: list[str]) -> None:
    """Run the command stream of an arm; see this file's docstring."""
    settings = ServoSettings.from_json(argv[0])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the starting process handles Ctrl-C in the terminal
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    output = os.dup(1)
    os.dup2(2, 1)  # a driver may write to standard output
    threading.Thread(target=_end_with_standard_input, name="lifeline", daemon=True).start()
    stream = None
    try:
        simulation = URSimulation(settings.ur_model, objects=())  # it takes longer than the watchdog waits
        with contextlib.suppress(PermissionError):  # root's, or with a limit (`ulimit -r`), as UR's driver
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        connection = connect(settings)
        try:
            stream = ServoLoop(settings, connection, simulation)
            signal.signal(signal.SIGTERM, lambda *_: stream.is_asked_to_end.set())
            stream.run(lambda: _say(output, READY))
        except RobotError as error:  # reported before anything waits for a connection that may be dead
            if stream is not None:
                stream.fail()
            _say(output, f"{FAILED}{error}")
            raise SystemExit(1) from None
        finally:
            # A driver may wait indefinitely for a silent controller.
            threading.Thread(target=_end_soon, name="end", daemon=True).start()
            connection.close()
    except RobotError as error:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends by itself; its owner closes its input now
        _say(output, f"{FAILED}{error}")
        raise SystemExit(1) from None


def _say(descriptor: int, line: str) -> None:
    with contextlib.suppress(OSError):
        os.write(descriptor, f"{line}\n".encode())


def _end_soon() -> None:
    time.sleep(CLOSE_S)
    os._exit(1)


def _end_with_standard_input() -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    os.kill(os.getpid(), signal.SIGTERM)  # also while it connects, which may take a minute


if __name__ == "__main__":
    main(sys.argv[1:])
