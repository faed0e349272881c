"""Port between the servo loop and an arm: what a driver reads and does, and the settings of both."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import NamedTuple, Protocol

from rlservo.robots.arm_interface import Vector
from rlservo.robots.following_error import FollowingBound
from rlservo.robots.limits import Limits

ZERO_SCALE = 0.005  # a speed scaling that is no motion


@dataclass(frozen=True)
class ServoSettings:
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
    def from_json(cls, line: str) -> ServoSettings:
        values = json.loads(line)
        return cls(**{**values, "limits": Limits.of(values["limits"])})


class ArmReading(NamedTuple):
    """What an arm says about itself at one moment."""

    timestamp: float  # [s], of the robot's own clock
    age_s: float | None  # at its arrival; None if the clocks cannot be compared
    positions: Vector  # [rad], (6,), base to wrist_3
    velocities: Vector  # [rad/s], (6,)
    targets: Vector  # [rad], (6,), where its controller wants the joints; the positions if it does not tell
    scaling: float  # of every speed, 0 to 1: the slider's part, and what the controller leaves of it
    is_program_running: bool  # the program that obeys us
    is_program_paused: bool
    robot_mode: int  # RUNNING, or another of arm_interface's
    safety_mode: int  # one of SAFE_MODES, or of STOP_NAMES


class ArmDriver(Protocol):
    """A connection to an arm. Its methods raise RobotError when the arm can no longer be commanded."""

    rate_hz: float  # of setpoints
    following: FollowingBound  # of the newest reading's targets
    hint: str  # what to look at when the arm does not follow
    frames: Vector | None  # of its own kinematics (calibration.py); None if they are the data sheet's, for all it tells

    def read(self) -> ArmReading: ...  # the newest state
    def silence(self) -> str: ...  # why no new state comes, as a fault
    def send(self, setpoint: Vector) -> bool: ...  # the next joint positions [rad] (6,); whether the arm takes them
    def hand_over(self, *, to_person: bool) -> None: ...  # of an arm at rest; or hold it again where it is
    def keep_alive(self) -> None: ...  # show, while a person leads the arm, that this process lives
    def close(self) -> None: ...  # stop the arm and disconnect
