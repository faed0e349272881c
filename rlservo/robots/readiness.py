"""Readiness of a real robot: what its controller reports, and what prevents driving it. Nothing is commanded."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from rlservo.robots.arm_interface import (
    ROS2,
    ROSBRIDGE,
    RTDE,
    RUNNING,
    SAFE_MODES,
    STOP_NAMES,
    RobotError,
    Vector,
    host_of,
    mode_name,
)
from rlservo.robots.arm_port import ZERO_SCALE, ArmReading, ServoSettings
from rlservo.robots.limits import Limits, MotionLimiter
from rlservo.robots.rtde_driver import VARIABLES, reading_of
from rlservo.robots.rtde_probe import no_answer, round_trip_s
from rlservo.robots.ur.calibration import MOST, deviation_m, frames_of, read_calibration, too_far
from rlservo.robots.ur.parameters import UR_PARAMETERS, model_of, rate_hz_of
from rlservo.robots.ur.simulation import URSimulation

WATCHED_S = 1.0  # [s] of states
FIRST_STATE_S = 5.0
LOOK_S = 0.0005


class Finding(NamedTuple):
    """One fact of a robot."""

    what: str
    found: str
    problem: str = ""  # why it must not be driven, and what to do
    numbers: Sequence[Any] = ()


def look_at(robot: str, ur_model: str | None, limits: Mapping[str, Any]) -> tuple[str, list[Finding], Vector | None]:
    """Return a robot's model, empty for a base, the findings, and the frames of an arm's kinematics if it tells them.

    Raises RobotError if it cannot be reached at all.

    `robot` is 'rtde://HOST', 'ros2:...' (an arm) or 'rosbridge://HOST:PORT' (a base).
    """
    if robot.startswith(ROSBRIDGE):
        return "", _base(robot, limits), None
    checked, host = Limits.of(limits), host_of(robot)
    if host is None:
        raise RobotError(f"robot {robot!r} is simulated: expected rtde://HOST, ros2: or rosbridge://HOST:PORT")
    if host.startswith(ROS2):
        from rlservo.robots.ros2.arm_driver import RosArmConnection

        model = ur_model or "ur5e"
        known = Finding("model", f"{model} ({'given' if ur_model else 'assumed: give --ur-model'})", _unknown(model))
        if known.problem:
            return model, [known], None
        with closing(RosArmConnection(ServoSettings(host, model, 0.1, 0.25, checked, 0, 0))) as driver:
            own, states = driver.frames, _state(driver.read, model, checked, driver.frames)
        calibration = Finding("calibration", f"{driver.without_frames}: kinematics are the data sheet's")
        if own is not None:
            calibration = _compared("description", own, model)
        return model, [known, calibration, *states], own
    model, findings = _dashboard(host, ur_model)
    calibration, own = _calibration(host, model)
    return model, [*findings, calibration, *_over_rtde(host, model, checked, own)], own


def present_state(host: str, ur_model: str, limits: Limits) -> tuple[Vector, float, Vector | None]:
    """Return an arm's joint positions [rad] (6,), its speed scaling and the frames of its kinematics, if it tells them.

    Raises RobotError if it may not be driven.
    """
    _, findings, own = look_at(host if host.startswith(ROS2) else f"{RTDE}{host}", ur_model, dataclasses.asdict(limits))
    found = {one.what: one for one in findings}
    problems = [one for one in findings if one.problem and not (one.what == "states" and "joints" in found)]
    if problems:
        raise RobotError("; ".join(f"{one.what}: {one.found}: {one.problem}" for one in problems))
    return np.array(found["joints"].numbers), found["speed slider"].numbers[0], own


def _dashboard(host: str, ur_model: str | None) -> tuple[str, list[Finding]]:
    import dashboard_client

    dashboard = dashboard_client.DashboardClient(host)
    try:
        dashboard.connect()
        version, family = dashboard.polyscopeVersion(), dashboard.getRobotModel()
        is_e_series = not version.startswith("3.")
        is_remote = dashboard.isInRemoteControl() if is_e_series else True
        dashboard.disconnect()
    except RuntimeError as error:
        raise RobotError(no_answer(host, error)) from error
    model = model_of(family, version)
    problem = _unknown(model)
    if ur_model is not None and not problem:
        if UR_PARAMETERS.get(ur_model) == UR_PARAMETERS[model]:
            model = ur_model  # a ur7e calls itself UR5
        else:
            problem = f"ur_model is {ur_model}"
    return model, [
        Finding("software", version),
        Finding("model", model, problem),
        Finding(
            "remote control",
            ("on" if is_remote else "off (local)") if is_e_series else "CB3 has none",
            "" if is_remote else "enable remote control on the pendant (local, top right)",
        ),
        Finding("round trip", f"{1e3 * round_trip_s(host):.1f} ms"),
    ]


def _unknown(model: str) -> str:
    if model in UR_PARAMETERS:
        return ""
    return f"its kinematics are unknown here: expected one of {', '.join(UR_PARAMETERS)}"


def _calibration(host: str, model: str) -> tuple[Finding, Vector | None]:
    try:
        parameters, state = read_calibration(host)
    except RobotError as error:
        return Finding("calibration", "none", str(error)), None
    if model not in UR_PARAMETERS:
        return Finding("calibration", state), None
    frames = frames_of(parameters)
    return _compared(state, frames, model)._replace(numbers=parameters.tolist()), frames


def _compared(source: str, frames: Vector, model: str) -> Finding:
    off = deviation_m(model, frames)
    found = f"{source}: the flange is up to {1e3 * off:.1f} mm from the data sheet's"
    return Finding("calibration", found, too_far(off, model) if off > MOST else "")


def _over_rtde(host: str, model: str, limits: Limits, own: Vector | None) -> list[Finding]:
    import rtde_receive

    rate_hz = limits.rate_hz or rate_hz_of(model)
    try:
        receive = rtde_receive.RTDEReceiveInterface(host, rate_hz, VARIABLES)
    except Exception as error:  # RuntimeError, boost's own
        return [Finding("states", "none", f"RTDE, port 30004: {str(error).strip()}: is it disabled, or blocked")]
    try:
        program = Finding("program", "none")
        if reading_of(receive).is_program_running:
            program = Finding("program", "runs", "a program runs, and would be ended: end it on the pendant")
        slider = receive.getTargetSpeedFraction
        return [*_state(lambda: reading_of(receive)._replace(scaling=slider()), model, limits, own), program]
    finally:
        receive.disconnect()


def _state(read: Callable[[], ArmReading], model: str, limits: Limits, own: Vector | None) -> list[Finding]:
    """Return what a second of states says."""
    times_s, arrivals_s, began = [0.0], [0.0], time.monotonic()
    while (now := time.monotonic()) < began + (WATCHED_S if len(times_s) > 1 else FIRST_STATE_S):
        if (stamp := read().timestamp) != times_s[-1]:
            began = began if len(times_s) > 1 else now
            times_s.append(stamp)
            arrivals_s.append(now)
        time.sleep(LOOK_S)
    if len(times_s) < 3:
        return [Finding("states", "none", "no states come from the controller: is it switched on")]
    periods, gaps = 1e3 * np.diff(times_s[1:]), 1e3 * np.diff(arrivals_s[1:])
    low, high = np.percentile(gaps, (5, 95))
    states = Finding(
        "states", f"every {np.median(periods):.3g} ms, jitter {high - low:.2g} ms, longest pause {gaps.max():.3g} ms"
    )
    if gaps.max() > 1e3 / limits.watchdog_hz:
        states = states._replace(problem=f"the watchdog waits for {1e3 / limits.watchdog_hz:g} ms: use a cable")
    reading = read()
    mode, safety, slider = reading.robot_mode, reading.safety_mode, reading.scaling
    safe = {1: "normal", 2: "reduced"}.get(safety) or STOP_NAMES.get(safety, f"safety mode {safety}").replace("_", " ")
    return [
        states,
        Finding(
            "robot mode",
            "running" if mode == RUNNING else mode_name(mode),
            "" if mode == RUNNING else "power it on and release the brakes",
        ),
        Finding("safety mode", safe, "" if safety in SAFE_MODES else "find the cause, then unlock it on the pendant"),
        Finding("speed slider", f"{slider:.0%}", "" if slider >= ZERO_SCALE else "raise it on the pendant", (slider,)),
        *_joints(reading.positions, model, limits, own),
    ]


def _joints(joints: Vector, model: str, limits: Limits, own: Vector | None) -> list[Finding]:
    listed = ", ".join(f"{joint:z.2f}" for joint in joints)
    if model not in UR_PARAMETERS:
        return [Finding("joints", f"{listed} rad", "", tuple(joints.tolist()))]
    simulation = URSimulation(model, objects=())
    if own is not None:
        simulation.calibrate(own)
    limiter = MotionLimiter(limits, simulation, np.ones(6), 0.01)
    limiter.restart(joints.tolist())
    problem = ""
    try:
        limiter.check_start()
    except RobotError as error:
        problem = str(error)
    flange = ", ".join(f"{value:z.2f}" for value in simulation.tool_at(joints)[0])
    return [
        Finding("joints", f"{listed} rad", problem, tuple(joints.tolist())),
        Finding("flange", f"{flange} m in base_link"),
    ]


def _base(robot: str, limits: Mapping[str, Any]) -> list[Finding]:
    from rlservo.robots.ros2.base_driver import AGE_BOUND_S, BaseLimits, RosBase

    with closing(RosBase(robot, limits=BaseLimits.of(limits))) as base:
        ages_s, ends_s, state = [], time.monotonic() + WATCHED_S, base.state()
        while (now := time.monotonic()) < ends_s:
            state = base.state()
            ages_s.append(now - state.received_s + state.age_s)
            time.sleep(0.01)
        x, y, yaw = state.pose
        oldest = max(ages_s)
        return [
            Finding("odometry", f"{x:z.2f}, {y:z.2f} m, {yaw:z.2f} rad in {base.frame or 'its frame'}"),
            Finding(
                "states and scans",
                f"at most {1e3 * oldest:.0f} ms old",
                "" if oldest < AGE_BOUND_S else f"expected less than {1e3 * AGE_BOUND_S:g} ms: check its network",
            ),
            Finding("fault", base.fault or "none", base.fault),
        ]
