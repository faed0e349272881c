"""The simulated controller: the arm, its safety stops, its registers and its program.

One call of `tick` is one control cycle. The controller has its own time: cycles since its start.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.robots.simulated.ur_controller.motion import Motion, MoveJ, Ramp, Servo
from rlservo.robots.simulated.ur_controller.tool import Tool
from rlservo.robots.ur.calibration import data_sheet, frames_of
from rlservo.robots.ur.parameters import CB3, JOINTS, POSITION_LIMITS, rate_hz_of
from rlservo.robots.ur.simulation import URSimulation

log = logging.getLogger("rlservo.ur_controller")

START_JOINTS = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)  # [rad]
LIMITS: NDArray[np.float64] = np.array(POSITION_LIMITS)
# From the data sheet's theta, a, d and alpha, of the size that real arms have.
DEVIATIONS: NDArray[np.float64] = np.array(
    [
        [0.0, 0.002, -0.003, 0.002, 0.0, 0.0],
        [1e-4, 3e-4, 1e-3, 0.0, 0.0, 0.0],
        [2e-4, 1e-3, -1e-3, 3e-4, 1e-4, -3e-4],
        [-5e-4, -0.002, 0.004, -5e-4, -5e-4, 0.0],
    ]
)
STOP_DECELERATION = 10.0  # [rad/s^2], of every stop that is not requested by a program
LARGEST_ACCELERATION = 40.0  # [rad/s^2] of a setpoint; more counts as a jump and causes a protective stop
SCALING_RATE = 5.0  # [1/s], at which a changed speed, a pause and its end take effect
UNLOCK_S = 5.0  # [s] after a protective stop before it can be unlocked, as on the arm
REGISTERS = 48
TRACE = 60_000  # control cycles
HISTORY = 600

Vector = NDArray[np.float64]


class RobotMode(IntEnum):
    """RTDE's `robot_mode`, as far as it is simulated."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """RTDE's `safety_mode`, as far as it is simulated."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


class RuntimeState(IntEnum):
    """RTDE's `runtime_state`."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class Sample(NamedTuple):
    """State of the arm at the end of a control cycle."""

    time_s: float
    positions: Vector  # [rad], (6,)
    velocities: Vector  # [rad/s], (6,)
    setpoint_velocity: Vector  # [rad/s], (6,)
    commands: int  # arrived since the start
    held_up_s: float  # since the start, by the machine


@dataclass
class _Watchdog:
    register: int
    period_s: float
    fed_at_s: float


class Controller:
    """One arm and its program. Not thread-safe: one loop calls it."""

    def __init__(self, ur_model: str = "ur5e", *, kinematics: Vector | None = None) -> None:
        """Make an arm; `kinematics` are its own Denavit-Hartenberg parameters (4, 6), as in `calibration.py`."""
        self.ur_model = ur_model
        self.is_e_series = ur_model not in CB3
        self.rate_hz = rate_hz_of(ur_model)
        self.version = (5, 12, 2, 1101534) if self.is_e_series else (3, 15, 8, 106339)
        self.dt = 1.0 / self.rate_hz
        self.simulation = URSimulation(ur_model, max_velocity_scale=1.0, cycle_s=self.dt, objects=())
        self.is_calibrated = kinematics is not None
        self.kinematics = data_sheet(ur_model) if kinematics is None else kinematics
        if self.is_calibrated:
            self.simulation.calibrate(frames_of(self.kinematics))
        self.simulation.place(START_JOINTS)
        self.inputs_int, self.inputs_double = [0] * REGISTERS, [0.0] * REGISTERS
        self.outputs_int, self.outputs_double = [0] * REGISTERS, [0.0] * REGISTERS
        self.robot_mode, self.safety_mode = RobotMode.RUNNING, SafetyMode.NORMAL
        self.is_remote = True
        self.speed_fraction = 1.0  # the slider's
        self.limiter = 1.0  # to which the controller slows motions down by itself, to keep its safety limits
        self.is_paused = False
        self.payload_kg, self.payload_centre = 0.0, [0.0] * 3  # [m]
        self.tool = Tool(self.simulation)
        self.digital_outputs = 0  # bits as in RTDE's `actual_digital_output_bits`
        self.analog_outputs = [0.004, 0.004]  # [A], or [V] of those in `analog_types`
        self.analog_types = 0  # bit n: output n is a voltage
        self.ticks = 0
        self.commands = 0  # packages with a command or a watchdog signal that have arrived
        self.held_up_s = 0.0  # since the start, by the machine
        self.trace: deque[Sample] = deque(maxlen=TRACE)
        self.stop_reasons: list[tuple[float, str]] = []  # time [s], reason
        self._velocity: Vector = np.zeros(6)  # [rad/s], of the setpoint
        self._acceleration: Vector = np.zeros(6)  # [rad/s^2], of the setpoint
        self._motion: Motion | None = None
        self._scaling = 1.0  # at which the program's time passes
        self._is_free = False
        self._program: Iterator[None] | None = None
        self._watchdog: _Watchdog | None = None
        self._stopped_at_s = 0.0

    # -- reading

    @property
    def time_s(self) -> float:
        """Time since the controller was started [s]."""
        return self.ticks * self.dt

    @property
    def is_program_running(self) -> bool:
        """Whether a program runs."""
        return self._program is not None

    @property
    def runtime_state(self) -> RuntimeState:
        """What the program does."""
        if self._program is None:
            return RuntimeState.STOPPING if self.is_moving else RuntimeState.STOPPED
        if self.is_paused:
            return RuntimeState.PAUSING if self._scaling else RuntimeState.PAUSED
        return RuntimeState.PLAYING

    @property
    def speed_scaling(self) -> float:
        """RTDE's: what the trajectory limiter leaves of the speed, without the slider's part; 0 without motion."""
        return self.limiter if self.runtime_state == RuntimeState.PLAYING else 0.0

    @property
    def is_free(self) -> bool:
        """Whether a person leads the arm by hand."""
        return self._is_free

    @property
    def is_moving(self) -> bool:
        """Whether the setpoint moves or is about to move."""
        return self._motion is not None or bool(self._velocity.any())

    @property
    def target(self) -> Vector:
        """The joint setpoint [rad] (6,)."""
        setpoint: Vector = self.simulation.data.act
        return setpoint

    @property
    def target_velocity(self) -> Vector:
        """The setpoint's velocity [rad/s] (6,)."""
        return self._velocity

    @property
    def target_acceleration(self) -> Vector:
        """The setpoint's acceleration [rad/s^2] (6,) in the last cycle."""
        return self._acceleration

    def positions_before(self, cycles: int) -> list[float]:
        """Return the joint positions [rad] of a given number of control cycles ago."""
        index = max(len(self.trace) - 1 - min(max(cycles, 0), HISTORY), 0)
        positions: list[float] = (self.trace[index].positions if self.trace else np.array(START_JOINTS)).tolist()
        return positions

    # -- programs

    def start_program(self, program: Iterator[None]) -> None:
        """Run a program, of which each `next` is one cycle. A running one is ended."""
        self.stop_program("another program was loaded")
        self._program = program

    def stop_program(self, why: str) -> None:
        """End the program; the arm decelerates to a halt."""
        if self._program is not None:
            log.info("%.3f s: the program ends: %s", self.time_s, why)
            self.stop_reasons.append((self.time_s, why))
        self._program, self._watchdog, self._is_free, self.is_paused = None, None, False, False
        self.stop(STOP_DECELERATION)

    def pause_program(self) -> bool:
        """Let the program and its motion come to rest where they are; return whether there is one."""
        self.is_paused = self._program is not None
        return self.is_paused

    def resume_program(self) -> bool:
        """Continue a paused program; return whether there is one."""
        is_resumed = self.is_paused and self.safety_mode == SafetyMode.NORMAL
        self.is_paused = self.is_paused and not is_resumed
        return is_resumed

    def set_watchdog(self, register: int, min_frequency_hz: float) -> None:
        """End the program when an input register is not written for 1 / `min_frequency_hz`; 0 turns this off."""
        period_s = 1.0 / min_frequency_hz if min_frequency_hz > 0.0 else 0.0
        self._watchdog = _Watchdog(register, period_s, self.time_s) if period_s else None

    def feed_watchdog(self, register: int) -> None:
        """Note that an input register was written."""
        self.commands += 1
        if self._watchdog is not None and self._watchdog.register == register:
            self._watchdog.fed_at_s = self.time_s

    def excuse(self, held_up_s: float) -> None:
        """Exclude time [s] for which the controller itself was delayed and which it now catches up."""
        self.held_up_s += held_up_s
        if self._watchdog is not None:
            self._watchdog.fed_at_s += held_up_s

    # -- motions

    def servo(self, target: ArrayLike, lookahead_s: float) -> None:
        """Follow a target [rad] (6,)."""
        goal = np.asarray(target, dtype=np.float64)
        if isinstance(self._motion, Servo):
            self._motion.retarget(goal, lookahead_s)
        else:
            self._motion = Servo(goal, lookahead_s)

    def speed(self, velocity: ArrayLike, acceleration: float) -> None:
        """Accelerate to a velocity [rad/s] (6,)."""
        self._motion = Ramp(np.asarray(velocity, dtype=np.float64), acceleration)

    def move(self, goal: ArrayLike, speed: float, acceleration: float) -> None:
        """Move to joint positions [rad] (6,) and hold there."""
        self._motion = MoveJ(self.target, np.asarray(goal, dtype=np.float64), speed, acceleration)

    def stop(self, deceleration: float) -> None:
        """Decelerate to a halt."""
        self._motion = Ramp(np.zeros(6), deceleration)

    def set_free(self, is_free: bool) -> None:
        """Let a person lead the arm by hand, or hold it again."""
        self._is_free = is_free
        if is_free:
            self._motion, self._velocity = None, np.zeros(6)

    # -- stops

    def stop_protectively(self, why: str) -> None:
        """Stop the arm and end the program."""
        if self.safety_mode != SafetyMode.NORMAL:
            return
        log.warning("%.3f s: protective stop: %s", self.time_s, why)
        self.safety_mode, self._stopped_at_s = SafetyMode.PROTECTIVE_STOP, self.time_s
        self.stop_program(f"protective stop: {why}")

    def stop_in_emergency(self) -> None:
        """Press the emergency stop: the arm stops and loses power."""
        log.warning("%.3f s: emergency stop", self.time_s)
        self.safety_mode, self.robot_mode = SafetyMode.ROBOT_EMERGENCY_STOP, RobotMode.POWER_OFF
        self.stop_program("emergency stop")

    def recover_from_emergency_stop(self) -> None:
        """Release the emergency stop, power the arm on and release its brakes."""
        if self.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety_mode, self.robot_mode = SafetyMode.NORMAL, RobotMode.RUNNING

    def unlock_protective_stop(self) -> bool:
        """Unlock a protective stop that is at least five seconds old; return whether none is left."""
        if self.safety_mode == SafetyMode.PROTECTIVE_STOP:
            if self.time_s - self._stopped_at_s < UNLOCK_S:
                return False
            self.safety_mode = SafetyMode.NORMAL
            self.simulation.in_collision = False
        return True

    # -- time

    def tick(self) -> None:
        """Let one control cycle pass."""
        watchdog = self._watchdog
        if watchdog is not None and self.time_s - watchdog.fed_at_s > watchdog.period_s:
            self.stop_program(f"watchdog: no command for {watchdog.period_s:g} s")
        goal = 0.0 if self.is_paused else self.speed_fraction * self.limiter
        most = SCALING_RATE * self.dt
        self._scaling += min(max(goal - self._scaling, -most), most)
        if self._program is not None and not self.is_paused:
            try:
                next(self._program)
            except StopIteration:
                self.stop_program("it reached its end")
        before = self._velocity
        if self._is_free:
            self.simulation.hold()
        else:
            self._velocity = self._next_velocity()
        self._acceleration = (self._velocity - before) / self.dt
        self.simulation.drive(self._velocity)
        self.ticks += 1
        q, qd = self.simulation.data.qpos.copy(), self.simulation.data.qvel.copy()
        self.trace.append(Sample(self.time_s, q, qd, self._velocity.copy(), self.commands, self.held_up_s))
        if self.simulation.in_collision:
            self.stop_protectively(f"{' and '.join((self.simulation.contacts() or [('?', '?')])[0])} touch")

    def _next_velocity(self) -> Vector:
        if self._motion is None:
            return np.zeros(6)
        velocity = self._motion.velocity(self.target, self._velocity, self.dt, self._scaling)
        why = self._violation(velocity) if self.safety_mode == SafetyMode.NORMAL else None
        if why is not None:
            self.stop_protectively(why)
            velocity = self._motion.velocity(self.target, self._velocity, self.dt, self._scaling)
        if self._motion.is_done and not velocity.any():
            self._motion = None
        elif self._motion.is_done and isinstance(self._motion, MoveJ):
            self._motion = Ramp(np.zeros(6), LARGEST_ACCELERATION)
        return velocity

    def _violation(self, velocity: Vector) -> str | None:
        for joint, value, limit in zip(JOINTS, velocity, self.simulation.max_velocity, strict=True):
            if not abs(value) <= limit * 1.001:
                return f"{joint} moves at {value:.3g} rad/s, over its limit of {limit:.3g}"
        acceleration = (velocity - self._velocity) / self.dt
        if not np.abs(acceleration).max() <= LARGEST_ACCELERATION * 1.001:
            joint = JOINTS[int(np.abs(acceleration).argmax())]
            return f"the target of {joint} jumps ({np.abs(acceleration).max():.0f} rad/s^2)"
        outside = np.abs(self.target + velocity * self.dt) > LIMITS
        if outside.any():
            return f"{JOINTS[int(outside.argmax())]} at its position limit"
        return None
