"""Latency of a real arm: from a command to the first measured motion, over small steps of one wrist."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.robots.arm import RobotError
from rlservo.envs.robots.rtde_arm import RtdeArm
from rlservo.envs.ur.parameters import JOINTS

JOINT = JOINTS.index("wrist_3")  # turns the tool in place: the only joint whose motion cannot hit anything
STEP = 0.05  # [rad], back and forth
STEP_S = 0.4  # [s], for it
NOTICED = 0.02  # [rad/s], a tenth of the motion's speed
PAUSE_S = 0.5
TIMEOUT_S = 2.0
LOOK_S = 0.001
AGAIN_S = 0.05  # [s], between two setpoints of the same motion

Vector = NDArray[np.float64]


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

    @property
    def disturbance(self) -> str:
        """Argument of `rlservo verify --disturb`: the worst latency in whole cycles, and a real sensor's noise."""
        return f"latency={self.cycles},noise=real"


def measure_latency(
    arm: RtdeArm, *, steps: int = 20, control_rate_hz: float = 10.0, on_step: Callable[[int], None] = lambda _: None
) -> LatencyReport:
    """Move a wrist back and forth by 0.05 rad and time each start. Raises RobotError if nothing moves."""
    home = arm.arm_state().positions.copy()
    latencies_s: list[float] = []
    periods_s: list[float] = []
    still: list[Vector] = []
    for step in range(steps):
        arm.hold()
        began = time.monotonic()
        while time.monotonic() - began < PAUSE_S or np.abs(arm.arm_state().velocities).max() > NOTICED / 2:
            _check_fault(arm)
            if time.monotonic() - began > PAUSE_S + TIMEOUT_S:
                raise RobotError(f"the robot does not come to rest within {PAUSE_S + TIMEOUT_S:g} s")
            time.sleep(LOOK_S)
        still.append(arm.arm_state().positions)
        goal = home.copy()
        if abs(still[-1][JOINT] - home[JOINT]) < STEP / 2:  # a busy computer may have cut the last motion short
            goal[JOINT] += STEP
        arm.blend_in(at_once=True)
        began = time.monotonic()
        arm.command(goal, STEP_S)
        latencies_s.append(_first_motion(arm, goal, began, periods_s) - began)
        while time.monotonic() - began < STEP_S:
            arm.command(goal, max(began + STEP_S - time.monotonic(), AGAIN_S))
            time.sleep(AGAIN_S)
        on_step(step + 1)
    arm.go_to(home)
    p5, p50, p95 = (1e3 * float(value) for value in np.percentile(latencies_s, (5, 50, 95)))
    worst = 1e3 * max(latencies_s)
    return LatencyReport(
        steps=steps,
        p50_ms=p50,
        p95_ms=p95,
        max_ms=worst,
        jitter_ms=p95 - p5,
        state_period_ms=1e3 * float(np.median(periods_s)) if periods_s else math.nan,
        noise=float(np.std([one[:JOINT] for one in still], axis=0).max()),
        control_rate_hz=control_rate_hz,
        cycles=max(1, math.ceil(worst / 1e3 * control_rate_hz)),
    )


def _first_motion(arm: RtdeArm, goal: Vector, began: float, periods_s: list[float]) -> float:
    """Return the arrival time of the first state with motion [s of time.monotonic]."""
    before, given = arm.arm_state(), began
    while time.monotonic() - began < TIMEOUT_S:
        state = arm.arm_state()
        if state.time_s != before.time_s:
            periods_s.append(state.time_s - before.time_s)
            before = state
        if abs(state.velocities[JOINT]) > NOTICED:
            return state.received_s
        _check_fault(arm)
        if time.monotonic() - given > AGAIN_S:  # a setpoint lasts for half a second
            given = time.monotonic()
            arm.command(goal, max(began + STEP_S - given, AGAIN_S))
        time.sleep(LOOK_S)
    raise RobotError(f"{JOINTS[JOINT]} did not move within {TIMEOUT_S:g} s of a command: check the speed slider")


def _check_fault(arm: RtdeArm) -> None:
    if fault := arm.fault:
        raise RobotError(f"the robot stopped: {fault}")
