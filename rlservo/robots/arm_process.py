"""A real UR arm: the policy's side of the command stream's process."""

from __future__ import annotations

import contextlib
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rlservo.robots.arm_interface import STOP_NAMES, ArmState, RobotError, Vector
from rlservo.robots.arm_port import ServoSettings
from rlservo.robots.control_law import Order, Phase
from rlservo.robots.limits import COUNTED, Limits
from rlservo.robots.servo_loop import FAILED, ORDERS, READY, REPORT
from rlservo.robots.shared_block import SharedBlock, make_file

CONNECT_TIMEOUT_S = 60.0
END_TIMEOUT_S = 8.0
SILENCE_S = 5.0  # [s] without a report, after which the process counts as dead
REACHED = 0.01  # [rad]
AT_REST = 0.01  # [rad/s]
LOOK_S = 0.01
LINE_S = 2.0  # [s] to wait for the message of a known fault


class ArmProcess:
    """An arm behind a UR controller. `close` stops it and ends the process."""

    def __init__(
        self,
        host: str,
        ur_model: str,
        *,
        velocity_scale: float = 0.1,
        setpoint_timeout_s: float = 0.25,
        limits: Limits | None = None,
    ) -> None:
        """Connect and check the robot. Raises RobotError if it is a different one, not ready or unreachable.

        `velocity_scale` scales the data sheet's velocities; after `setpoint_timeout_s` without a `command` it holds.
        """
        self.host, self.limits = host, limits or Limits()
        orders, report = make_file(ORDERS), make_file(REPORT)
        self._orders, self._report = SharedBlock(orders, ORDERS), SharedBlock(report, REPORT)
        settings = ServoSettings(host, ur_model, velocity_scale, setpoint_timeout_s, self.limits, orders, report)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rlservo.robots.servo_loop", settings.to_json()],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(orders, report),
            env={"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **os.environ},
            start_new_session=True,  # this process handles Ctrl-C in the terminal
        )
        os.close(orders)
        os.close(report)
        self._number, self._fault = 0, ""
        try:
            line = self._read_line(CONNECT_TIMEOUT_S)
            if line != READY:
                raise RobotError(
                    line.removeprefix(FAILED) or f"the command stream to {host} ended, or was silent for 60 s"
                )
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """The command stream's process id."""
        return self._process.pid

    @property
    def frames(self) -> Vector | None:
        """The arm's own kinematics, as in calibration.py; None if it does not tell them."""
        frames: Vector = self._report.read()["frames"]
        return frames if frames.any() else None

    def arm_state(self) -> ArmState:
        """Return the newest state."""
        report = self._report.read()
        safety, mode = int(report["safety_mode"]), int(report["robot_mode"])
        return ArmState(
            positions=report["positions"],
            velocities=report["velocities"],
            time_s=float(report["time_s"]),
            received_s=float(report["received_s"]),
            age_s=float(report["age_s"]),
            mode="running" if mode == 7 else f"robot mode {mode}",
            safety={1: "normal", 2: "reduced"}.get(safety) or STOP_NAMES.get(safety, f"safety mode {safety}"),
        )

    def command(self, joint_positions: ArrayLike, duration_s: float = 0.5) -> None:
        """Replace the setpoint: reach joint positions [rad] (6,) in `duration_s` [s], as far as limits allow.

        Raises ValueError if they are not finite.
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        if goal.shape != (6,) or not np.isfinite(goal).all():
            raise ValueError(f"the setpoint is {goal.tolist()}: expected 6 finite joint positions [rad]")
        self._give(Order.FOLLOW, goal=goal, duration_s=duration_s)

    def hold(self) -> None:
        """Decelerate and hold."""
        self._give(Order.HOLD)

    def free(self) -> None:
        """Let a person lead the arm by hand, once it is at rest."""
        self._give(Order.FREE)

    def blend_in(self, *, at_once: bool = False) -> None:
        """Hold, and let the speed of later commands grow from 0, or be full `at_once`."""
        self._give(Order.HOLD, blend_from_s=-time.monotonic() if at_once else time.monotonic())

    def go_to(self, joint_positions: ArrayLike, is_interrupted: Callable[[], bool] = lambda: False) -> None:
        """Move slowly to joint positions [rad] (6,) and wait until the arm is at rest there, or interrupted.

        Raises RobotError if it does not arrive.
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        slowest = self.limits.start_speed * self.limits.speed_scale
        left_s = 10.0 + self.limits.blend_s + 5.0 * float(np.abs(goal - self.arm_state().positions).max()) / slowest
        looked_s = time.monotonic()
        while not is_interrupted():
            self._give(Order.GO, goal=goal)  # each time: the arm holds when this process stops
            state = self.arm_state()
            if np.abs(state.positions - goal).max() < REACHED and np.abs(state.velocities).max() < AT_REST:
                break
            if fault := self.fault:
                raise RobotError(f"the robot stopped on the way to its start: {fault}")
            now = time.monotonic()
            left_s -= (now - looked_s) * self.scale  # at a slider of 10% it may take ten times as long
            looked_s = now
            if left_s < 0.0:
                away = float(np.abs(state.positions - goal).max())
                self.hold()
                raise RobotError(
                    f"the robot did not reach its start: a joint is {away:.3f} rad away; check the speed slider and "
                    "the limits"
                )
            time.sleep(LOOK_S)
        self.hold()

    # -- the stream's reports

    @property
    def phase(self) -> Phase:
        """The stream's activity."""
        return Phase(int(self._report.read()["phase"]))

    @property
    def blend(self) -> float:
        """The policy's share of the speed, 0 to 1."""
        return float(self._report.read()["blend"])

    @property
    def scale(self) -> float:
        """The controller's speed scaling, 0 to 1: the slider's part, and what the controller leaves of it."""
        return float(self._report.read()["scale"])

    def setpoint(self) -> Vector:
        """Return the joint positions [rad] (6,) that the stream commands now."""
        setpoint: Vector = self._report.read()["setpoint"]
        return setpoint

    def target(self) -> Vector:
        """Return the joint positions [rad] (6,) of the controller's own setpoint; measured ones where it tells none."""
        target: Vector = self._report.read()["target"]
        return target

    def limited(self) -> dict[str, int]:
        """Return the number of cycles in which each limit was applied, by element, without zeros."""
        counts = self._report.read()["limited"]
        return {name: int(count) for name, count in zip(COUNTED, counts, strict=True) if count}

    def periods(self) -> tuple[Vector, float]:
        """Return the number of the stream's periods by their length, in bins of PERIOD_S, and the longest [s]."""
        report = self._report.read()
        return report["periods"], float(report["longest_period_s"])

    @property
    def fault(self) -> str:
        """The reason why the arm no longer accepts commands; empty if it does."""
        if not self._fault:
            if self._process.poll() is not None or self.phase == Phase.FAULT:
                line = self._read_line(LINE_S)
                self._fault = line.removeprefix(FAILED) or "stream_ended: the command stream's process was killed"
            elif time.monotonic() - float(self._report.read()["written_s"]) > SILENCE_S:
                self._fault = "stream_silent: the command stream's process does not respond"
        return self._fault

    def close(self) -> None:
        """Stop the arm and end the process; if that hangs, kill it, and the watchdog stops the arm."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _give(self, order: Order, **values: Any) -> None:
        self._number += 1
        self._orders.write({"order": order, "given_s": time.monotonic(), "number": self._number, **values})

    def _read_line(self, timeout_s: float) -> str:
        """Return the process's next line; empty if it ended without one, or nothing came in time."""
        assert self._process.stdout is not None
        pipe, output, limit = self._process.stdout.fileno(), b"", time.monotonic() + timeout_s
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while b"\n" not in output and selector.select(max(0.0, limit - time.monotonic())):
                part = os.read(pipe, 4096)
                if not part:
                    break
                output += part
        return output.decode(errors="replace").strip()
