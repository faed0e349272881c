"""Process that commands a real arm at the arm's own rate: setpoints in, joint targets within limits out.

`python -m rlservo.envs.robots.command_stream '<settings>'` runs it; `rtde_arm.py` starts it. It reports on standard
output that it is ready or why not, reads setpoints from shared memory, and decelerates and exits when its standard
input closes. If it dies, the controller's watchdog ends the program there, and the arm stops.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.robots.arm import ROS2, STOP_NAMES, RobotError
from rlservo.envs.robots.limits import COUNTED, LATE, Limits, MotionLimiter
from rlservo.envs.robots.link_delay import LinkDelay
from rlservo.envs.robots.shared_block import SharedBlock
from rlservo.envs.ur.simulation import URSimulation

READY, FAILED = "ready", "failed: "  # lines on standard output; a fault after READY is also FAILED
FIRST_STATE_S = 5.0
RUNNING, SAFE_MODES = 7, (1, 2)  # robot_mode, safety_mode: normal and reduced
STARTUP_MODES = ("disconnected", "confirm safety", "booting", "power off", "power on", "idle", "backdrive")
LOST_S = 1.0  # [s] without a package, after which the connection counts as lost
SLOW_CALL_S = 0.3  # [s] for one command; beyond it, ur_rtde has lost the script or reconnected
AGE_BOUND_S = 0.1  # [s] oldest state that may be acted on
AT_REST = 1e-3  # [rad/s]
CLOSE_S = 4.0  # [s], for closing the connections
VARIABLES = [
    "timestamp", "actual_q", "actual_qd", "target_q", "robot_mode", "safety_mode", "robot_status_bits",
    "target_speed_fraction",
]  # fmt: skip

Vector = NDArray[np.float64]


class Order(IntEnum):
    """Order of the arm's process."""

    HOLD = 0
    FOLLOW = 1  # follow setpoints while new ones come
    GO = 2  # move to a pose, slowly
    FREE = 3  # let a person lead the arm by hand


class Phase(IntEnum):
    """Activity of the command stream."""

    HOLD = 0
    FOLLOW = 1
    LATE = 2  # holds, because no setpoint has come
    STALE = 3  # holds, because the newest state is too old
    GO = 4
    FREE = 5
    FAULT = 6


ORDERS = np.dtype(
    [("order", "f8"), ("goal", "f8", 6), ("duration_s", "f8"), ("given_s", "f8"), ("number", "f8"),
     ("blend_from_s", "f8")]
)  # fmt: skip
REPORT = np.dtype(
    [("phase", "f8"), ("received_s", "f8"), ("time_s", "f8"), ("age_s", "f8"), ("positions", "f8", 6),
     ("velocities", "f8", 6), ("robot_mode", "f8"), ("safety_mode", "f8"), ("setpoint", "f8", 6), ("blend", "f8"),
     ("written_s", "f8"), ("limited", "f8", len(COUNTED))]
)  # fmt: skip


@dataclass(frozen=True)
class StreamSettings:
    """Settings that the process is started with."""

    host: str
    ur_model: str
    velocity_scale: float  # of the data sheet's velocities
    setpoint_timeout_s: float  # after which the arm holds
    limits: Limits
    orders_descriptor: int
    report_descriptor: int

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> StreamSettings:
        values = json.loads(line)
        return cls(**{**values, "limits": Limits.of(values["limits"])})


class _Connection:
    """The two connections of ur_rtde's client. Raises RobotError with what to do."""

    def __init__(self, settings: StreamSettings) -> None:
        try:
            import dashboard_client
            import rtde_control
            import rtde_receive
        except ImportError as error:
            how = "pip install '.[ur]' in the checkout of rlservo"
            raise RobotError(f"a real UR arm needs ur_rtde ({error}): {how}") from error
        self.control: Any = None
        host = settings.host
        try:
            dashboard = dashboard_client.DashboardClient(host)
            dashboard.connect()
            self._check_model(settings, dashboard.getRobotModel(), dashboard.polyscopeVersion())
            dashboard.disconnect()
        except RuntimeError as error:
            raise RobotError(
                f"no UR controller answers at {host} ({str(error).strip()}): is it switched on and on this network?"
            ) from error
        self.is_e_series = settings.ur_model.endswith("e")
        self.rate_hz = settings.limits.rate_hz or (500.0 if self.is_e_series else 125.0)
        try:
            self.receive = rtde_receive.RTDEReceiveInterface(host, self.rate_hz, VARIABLES)
            self._check_modes(host)
            self.control = rtde_control.RTDEControlInterface(host, self.rate_hz)
            # It has seen the program run on a connection of its own; on a busy machine the other one is behind.
            _wait_until(lambda: bool(self.receive.getRobotStatus() & 2))
        except RobotError:
            raise
        except Exception as error:  # RuntimeError, logic_error as RuntimeError, boost's own
            hint = "enable remote control on the pendant (local, top right)" if self.is_e_series else "see the pendant"
            raise RobotError(f"the controller at {host} accepts no program ({str(error).strip()}): {hint}") from error
        self.control.setWatchdog(settings.limits.watchdog_hz)  # from here on commands must follow immediately

    def age_s(self) -> float | None:
        """Return None: the age of a new state is unknown, because the robot has its own clock."""
        return None

    def _check_model(self, settings: StreamSettings, model: str, version: str) -> None:
        is_e_series = not version.startswith("3.")
        found = model.strip().lower() + ("e" if is_e_series else "")
        if found != settings.ur_model:
            raise RobotError(f"the controller at {settings.host} is a {found}'s, but ur_model is {settings.ur_model}")

    def _check_modes(self, host: str) -> None:
        _wait_until(lambda: self.receive.getTimestamp() != 0.0)
        mode, safety = self.receive.getRobotMode(), self.receive.getSafetyMode()
        if safety not in SAFE_MODES:
            name = STOP_NAMES.get(safety, f"safety mode {safety}").replace("_", " ")
            raise RobotError(f"the robot at {host} is in {name}: find the cause, then unlock it on the pendant")
        if mode != RUNNING:
            raise RobotError(f"the robot at {host} is in {_mode_name(mode)}: power it on and release the brakes")

    def close(self) -> None:
        if self.control is not None:
            self.control.stopScript()
            self.control.disconnect()
        self.receive.disconnect()


def _wait_until(condition: Callable[[], bool]) -> None:
    limit = time.monotonic() + FIRST_STATE_S
    while not condition() and time.monotonic() < limit:
        time.sleep(0.005)


class Connection(Protocol):
    """A connection to the arm; `receive` and `control` have the ur_rtde methods that the loop calls."""

    rate_hz: float
    receive: Any
    control: Any

    def age_s(self) -> float | None:
        """Return the age of the newest state at its arrival [s]; None if the clocks cannot be compared."""
        ...

    def close(self) -> None:
        """End the program and disconnect."""
        ...


def _mode_name(mode: int) -> str:
    return STARTUP_MODES[mode] if 0 <= mode < len(STARTUP_MODES) else f"robot mode {mode}"


def connect(settings: StreamSettings) -> Connection:
    """Return the connection for the address. Raises RobotError."""
    if settings.host.startswith(ROS2):
        from rlservo.envs.ros2.arm import RosArmConnection

        return RosArmConnection(settings)
    return _Connection(settings)


class CommandStream:
    """The loop. `run` returns on request, and raises RobotError at a fault."""

    def __init__(self, settings: StreamSettings, connection: Connection, simulation: URSimulation) -> None:
        self._settings, self._limits, self._robot = settings, settings.limits, connection
        self._orders = SharedBlock(settings.orders_descriptor, ORDERS)
        self._report = SharedBlock(settings.report_descriptor, REPORT)
        self._dt = 1.0 / connection.rate_hz
        velocities = np.array(simulation.parameters.velocity_limits)
        self._policy_velocities = velocities * settings.velocity_scale * self._limits.speed_scale
        self._start_velocities = np.minimum(velocities, self._limits.start_speed) * self._limits.speed_scale
        self._limiter = MotionLimiter(self._limits, simulation, self._policy_velocities, self._dt)
        self._limiter.restart(connection.receive.getTargetQ())
        self._goal, self._goal_due_s, self._number = self._limiter.position.copy(), 0.0, -1.0
        self._counts = np.zeros(len(COUNTED))
        self._phase, self._blend = Phase.HOLD, 0.0
        self._robot_s, self._received_s, self._age_s = 0.0, time.monotonic(), 0.0
        self._delay = LinkDelay()
        self.is_asked_to_end = threading.Event()

    def run(self, on_ready: Callable[[], None]) -> None:
        """Command the arm until asked to end, then decelerate; `on_ready` is called after the first cycle."""
        due, is_first = time.monotonic(), True
        while True:
            now = time.monotonic()
            if now < due:
                time.sleep(due - now)
                now = time.monotonic()
            due = max(due + self._dt, now - self._dt)
            self._look(now)
            self._check()
            if self.is_asked_to_end.is_set() and np.abs(self._limiter.velocity).max() < AT_REST:
                return
            self._command(now)
            self._publish()
            if is_first:
                on_ready()
            is_first = False

    def fail(self) -> None:
        """Publish a fault."""
        self._phase = Phase.FAULT
        self._publish()

    def _look(self, now: float) -> None:
        """Read the newest state and estimate its age: the link's delay beyond the usual one."""
        robot_s = self._robot.receive.getTimestamp()
        if robot_s != self._robot_s:
            excess_s, known_s = self._delay.excess_s(robot_s, now), self._robot.age_s()
            self._robot_s, self._received_s = robot_s, now
            self._age_s = excess_s if known_s is None else known_s

    def _check(self) -> None:
        receive, now = self._robot.receive, time.monotonic()
        if not receive.isConnected() or now - self._received_s > LOST_S:
            raise RobotError("connection_lost: no state from the controller for 1 s: check its cable and its pendant")
        safety = receive.getSafetyMode()
        if safety not in SAFE_MODES:
            name = STOP_NAMES.get(safety, "safety_stop")
            raise RobotError(f"{name}: find the cause, then unlock the robot on its pendant")
        if not receive.getRobotStatus() & 2:
            silence_s = 1.0 / self._limits.watchdog_hz
            raise RobotError(
                f"program_stopped: the controller's watchdog (no command for {silence_s:g} s) or its pendant ended it"
            )
        if (mode := receive.getRobotMode()) != RUNNING:
            raise RobotError(f"not_running: the robot is in {_mode_name(mode)}: power it on and release the brakes")

    def _command(self, now: float) -> None:
        """Send the next setpoint. A missed period is not caught up, which would make the arm hurry."""
        dt, orders = self._dt, self._orders.read()
        self._limiter.limited[:] = False
        want, scale = self._wanted(orders, now, dt)
        if self._phase == Phase.FREE:
            self._robot.control.kickWatchdog()
            return
        setpoint = self._limiter.step(want, dt, scale)
        began = time.monotonic()
        is_taken = self._robot.control.servoJ(
            setpoint.tolist(), 0.0, 0.0, self._dt, self._limits.lookahead_s, self._limits.gain
        )
        if not is_taken or time.monotonic() - began > SLOW_CALL_S:
            self._look(time.monotonic())
            self._check()
            raise RobotError("command_refused: the controller refused a command, or took too long")

    def _wanted(self, orders: Any, now: float, dt: float) -> tuple[Vector, float]:
        """Return the wanted velocity and the share of the limits that it may use; set the phase."""
        order, number = Order(int(orders["order"])), float(orders["number"])
        limiter, standstill = self._limiter, np.zeros(6)
        fraction = min(max(self._robot.receive.getTargetSpeedFraction(), 0.0), 1.0)
        if self.is_asked_to_end.is_set():
            return standstill, 1.0
        if (order == Order.FREE) != (self._phase == Phase.FREE):
            return self._change_hands(order == Order.FREE), 1.0
        if order in (Order.HOLD, Order.FREE):
            self._phase = Phase.FREE if order == Order.FREE else Phase.HOLD
            return standstill, 1.0
        if now - self._received_s + self._age_s > AGE_BOUND_S:
            self._count_once(Phase.STALE, LATE + 1)
            return standstill, 1.0
        if number != self._number:
            self._number = number
            self._goal = limiter.goal_within(orders["goal"])
            self._goal_due_s = float(orders["given_s"] + orders["duration_s"])
        if now - float(orders["given_s"]) > self._settings.setpoint_timeout_s:
            self._count_once(Phase.LATE, LATE)
            return standstill, 1.0
        if order == Order.GO:
            self._phase, limiter.velocity_limits = Phase.GO, self._start_velocities
            return limiter.velocity_towards(self._goal, 0.0, dt), fraction
        limiter.velocity_limits = self._policy_velocities
        self._phase = Phase.FOLLOW
        blend = (now - float(orders["blend_from_s"])) / self._limits.blend_s if self._limits.blend_s else 1.0
        self._blend = min(max(blend, 0.0), 1.0)
        return limiter.velocity_towards(self._goal, self._goal_due_s - now, dt), fraction * self._blend

    def _change_hands(self, to_person: bool) -> Vector:
        """Let a person lead the arm once it is at rest, or hold it again at its position."""
        if not to_person:
            self._robot.control.endTeachMode()
            self._limiter.restart(self._robot.receive.getActualQ())
            self._phase = Phase.HOLD
        elif np.abs(self._limiter.velocity).max() < AT_REST:
            self._robot.control.servoStop()
            self._robot.control.teachMode()
            self._phase = Phase.FREE
        return np.zeros(6)

    def _count_once(self, phase: Phase, element: int) -> None:
        self._limiter.limited[element] = self._phase != phase
        self._phase = phase

    def _publish(self) -> None:
        receive = self._robot.receive
        self._counts += self._limiter.limited
        self._report.write(
            {
                "phase": self._phase,
                "received_s": self._received_s,
                "time_s": self._robot_s,
                "age_s": self._age_s,
                "positions": receive.getActualQ(),
                "velocities": receive.getActualQd(),
                "robot_mode": receive.getRobotMode(),
                "safety_mode": receive.getSafetyMode(),
                "setpoint": self._limiter.position,
                "blend": self._blend,
                "written_s": time.monotonic(),
                "limited": self._counts,
            }
        )


def main(argv: list[str]) -> None:
    """Run the command stream of an arm; see this file's docstring."""
    settings = StreamSettings.from_json(argv[0])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the starting process handles Ctrl-C in the terminal
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    output = os.dup(1)
    os.dup2(2, 1)  # ur_rtde writes to standard output
    threading.Thread(target=_end_with_standard_input, name="lifeline", daemon=True).start()
    stream = None
    try:
        simulation = URSimulation(settings.ur_model, objects=())  # it takes longer than the watchdog waits
        connection = connect(settings)
        try:
            stream = CommandStream(settings, connection, simulation)
            signal.signal(signal.SIGTERM, lambda *_: stream.is_asked_to_end.set())
            stream.run(lambda: _say(output, READY))
        except RobotError as error:  # reported before anything waits for a connection that may be dead
            if stream is not None:
                stream.fail()
            _say(output, f"{FAILED}{error}")
            raise SystemExit(1) from None
        finally:
            # ur_rtde waits indefinitely for a silent controller.
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
