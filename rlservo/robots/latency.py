"""Latency of a real arm: from a command to the first measured motion, over small steps of one wrist."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rlservo.robots.arm_interface import ROS2, RobotError, Vector
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.servo_loop import PERIOD_S
from rlservo.robots.ur.parameters import JOINTS

JOINT = JOINTS.index("wrist_3")  # turns the tool in place: the only joint whose motion cannot hit anything
STEP = 0.05  # [rad], back and forth
STEP_S = 0.4  # [s], for it
NOTICED = 0.02  # [rad/s], a sixth of the motion's speed
FULL = 0.9  # speed scaling from which on the motion itself is timed
TARGET_NOTICED = 1e-6  # [rad], of the controller's setpoint, which has no noise
PAUSE_S = 0.5
TIMEOUT_S = 2.0
LOOK_S = 0.001
REALTIME = Path("/sys/kernel/realtime")  # 1 with PREEMPT_RT
AGAIN_S = 0.05  # [s], between two setpoints of the same motion


@dataclass(frozen=True)
class Histogram:
    """Durations, counted in bins of `bin_ms` from 0 on. A percentile is the end of its bin, at most the longest."""

    p50_ms: float
    p99_ms: float
    p999_ms: float
    longest_ms: float
    bin_ms: float
    counts: list[int]

    @classmethod
    def of(cls, counts: Vector, bin_ms: float, longest_ms: float) -> Histogram:
        """Return the histogram of these counts; the last bin has no end."""
        summed = counts.cumsum()

        def end_ms(share: float) -> float:
            place = int(np.searchsorted(summed, share * summed[-1]))
            return min(bin_ms * (place + 1), longest_ms) if place < counts.size - 1 else longest_ms

        kept = [int(count) for count in np.trim_zeros(counts, "b")]
        return cls(end_ms(0.5), end_ms(0.99), end_ms(0.999), longest_ms, bin_ms, kept)


@dataclass(frozen=True)
class LatencyReport:
    """Latencies in ms, over `steps` steps, with their meaning for a policy at `control_rate_hz`."""

    steps: int
    p50_ms: float
    p95_ms: float
    max_ms: float
    jitter_ms: float  # p95 minus p5
    state_period_ms: float  # between two states of the robot, median
    noise: float  # [rad], standard deviation of a joint at rest
    control_rate_hz: float
    cycles: int
    latencies: Histogram
    periods: Histogram  # of the command stream: between two setpoints
    is_realtime: bool  # the kernel has PREEMPT_RT
    fault: str  # which ended the measurement early; empty if none did

    @property
    def disturbance(self) -> str:
        """Argument of `rlservo verify --disturb`: the worst latency in whole cycles, and a real sensor's noise."""
        return f"latency={self.cycles},noise=real"


class _Measured(NamedTuple):
    latencies_s: list[float]
    periods_s: list[float]  # between two states of the robot
    still: list[Vector]  # positions at rest


def measure_latency(
    arm: ArmProcess,
    *,
    steps: int = 20,
    hours: float = 0.0,
    control_rate_hz: float = 10.0,
    on_step: Callable[[int], None] = lambda _: None,
) -> LatencyReport:
    """Move a wrist back and forth by 0.05 rad and time each start, `steps` times and at least for these `hours`.

    Raises RobotError if nothing moves.

    A reduced speed scaling stretches the arm's motions, its lag too. Then the start of the controller's setpoint is
    timed, and half of the look-ahead time added, the lag at full scaling.
    """
    is_full = arm.scale >= FULL
    if not is_full and arm.host.startswith(ROS2):
        raise RobotError(f"the speed scaling is {arm.scale:.0%}: set the slider to 100% for this measurement")
    measured, fault = _Measured([], [], []), ""
    try:
        _turn(arm, measured, steps, time.monotonic() + 3600 * hours, on_step, is_full=is_full)
    except RobotError as error:
        if len(measured.latencies_s) < steps:
            raise
        fault = str(error)  # what was measured for hours is told all the same
    latencies_s, periods_s, still = measured
    counts, longest_s = arm.periods()
    p5, p50, p95 = (1e3 * float(value) for value in np.percentile(latencies_s, (5, 50, 95)))
    worst = 1e3 * max(latencies_s)
    motions = np.bincount([int(1e3 * latency_s) for latency_s in latencies_s]).astype(np.float64)
    return LatencyReport(
        steps=len(latencies_s),
        p50_ms=p50,
        p95_ms=p95,
        max_ms=worst,
        jitter_ms=p95 - p5,
        state_period_ms=1e3 * float(np.median(periods_s)) if periods_s else math.nan,
        noise=float(np.std([one[:JOINT] for one in still], axis=0).max()),
        control_rate_hz=control_rate_hz,
        cycles=max(1, math.ceil(worst / 1e3 * control_rate_hz)),
        latencies=Histogram.of(motions, 1.0, worst),
        periods=Histogram.of(counts, 1e3 * PERIOD_S, 1e3 * longest_s),
        is_realtime=REALTIME.is_file() and REALTIME.read_text().strip() == "1",
        fault=fault,
    )


def _turn(
    arm: ArmProcess, measured: _Measured, steps: int, end_s: float, on_step: Callable[[int], None], *, is_full: bool
) -> None:
    """Turn the wrist back and forth, and append what is measured."""
    lag_s = 0.0 if is_full else arm.limits.lookahead_s / 2.0
    home = arm.arm_state().positions.copy()
    latencies_s, periods_s, still = measured
    missed = 0
    while len(latencies_s) < steps or time.monotonic() < end_s:
        if missed >= 2 * max(steps, len(latencies_s)):
            arm.go_to(home)
            raise RobotError(
                f"this computer missed the start of {missed} motions of {STEP_S:g} s: end other work on it, and repeat"
            )
        arm.hold()
        target = _wait_for_rest(arm, is_full=is_full)
        still.append(arm.arm_state().positions)
        goal = home.copy()
        is_near = abs(still[-1][JOINT] - home[JOINT]) < STEP / 2  # the last motion may have been slow, or cut short
        goal[JOINT] = still[-1][JOINT] + (STEP if is_near else -STEP)
        arm.blend_in(at_once=True)
        began = time.monotonic()
        arm.command(goal, STEP_S)
        if moved_s := _first_motion(arm, goal, began, target, periods_s):
            latencies_s.append(moved_s - began + lag_s)
            on_step(len(latencies_s))
        else:
            missed += 1
        while time.monotonic() - began < STEP_S:
            arm.command(goal, max(began + STEP_S - time.monotonic(), AGAIN_S))
            time.sleep(AGAIN_S)
    arm.go_to(home)


def _wait_for_rest(arm: ArmProcess, *, is_full: bool) -> Vector | None:
    """Wait until the arm has been at rest for a while; return the controller's setpoint where that will be timed."""
    began = rests_s = time.monotonic()
    target, patience_s = None if is_full else arm.target(), PAUSE_S + TIMEOUT_S / max(arm.scale, 0.01)
    while time.monotonic() - rests_s < PAUSE_S or np.abs(arm.arm_state().velocities).max() > NOTICED / 2:
        _check_fault(arm)
        if target is not None and np.abs(arm.target() - target).max() > TARGET_NOTICED / 2:
            target, rests_s = arm.target(), time.monotonic()
        if time.monotonic() - began > patience_s:
            raise RobotError(f"the robot does not come to rest within {patience_s:.3g} s")
        time.sleep(LOOK_S)
    return target


def _first_motion(
    arm: ArmProcess, goal: Vector, began: float, target: Vector | None, periods_s: list[float]
) -> float | None:
    """Return the arrival time of the first state with motion [s of time.monotonic]; None if it was missed.

    With `target` it is that of the controller's setpoint, away from there [rad] (6,).
    """
    before, given = arm.arm_state(), began
    while time.monotonic() - began < TIMEOUT_S:
        state = arm.arm_state()
        if state.time_s != before.time_s:
            periods_s.append(state.time_s - before.time_s)
            before = state
        if target is None:
            has_moved = abs(state.velocities[JOINT]) > NOTICED
        else:
            has_moved = abs(arm.target()[JOINT] - target[JOINT]) > TARGET_NOTICED
        if has_moved:
            return state.received_s
        if abs(state.positions[JOINT] - goal[JOINT]) < STEP / 4:
            return None
        _check_fault(arm)
        if time.monotonic() - given > AGAIN_S:  # a setpoint lasts for half a second
            given = time.monotonic()
            arm.command(goal, max(began + STEP_S - given, AGAIN_S))
        time.sleep(LOOK_S)
    raise RobotError(f"{JOINTS[JOINT]} did not move within {TIMEOUT_S:g} s of a command: check the speed slider")


def _check_fault(arm: ArmProcess) -> None:
    if fault := arm.fault:
        raise RobotError(f"the robot stopped: {fault}")
