"""A UR arm's own kinematics, which the factory measured: read from its controller, and compared with the data sheet.

Source: UR's guide to the primary interface, and KinematicsInfo of Universal_Robots_Client_Library. Denavit-Hartenberg
parameters are theta [rad], a [m], d [m] and alpha [rad] of each joint (4, 6). Those of near parallel axes are no
lengths: a d may be hundreds of metres. So everything here works on frames (7, 4, 4): poses in the controller's base
frame with all joints at 0, of each joint, whose z is its axis, then of the flange.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

from rlservo.robots.arm_interface import RobotError, Vector
from rlservo.robots.ur.parameters import ur_parameters

PORT, PATIENCE_S = 30001, 3.0
HEADER = struct.Struct(">iB")  # of a package and of its parts: size with this header, type
ROBOT_STATE, KINEMATICS = 16, 5
KINEMATICS_INFO = struct.Struct(">6I24dI")  # checksums; theta, a, d, alpha; state of the calibration
LARGEST = 65536
STATES = ("not initialised", "not linearised", "linearised")
MOST = 0.03  # [m], by which a calibrated arm's flange may be off: some millimetres are usual
POSES = 200


def data_sheet(ur_model: str) -> Vector:
    """Return a model's nominal parameters (4, 6)."""
    arm, right = ur_parameters(ur_model), math.pi / 2
    return np.array(
        [
            [0.0] * 6,
            [0.0, arm.a2, arm.a3, 0.0, 0.0, 0.0],
            [arm.d1, 0.0, 0.0, arm.d4, arm.d5, arm.d6],
            [right, 0.0, 0.0, right, -right, 0.0],
        ]
    )


def read_calibration(host: str) -> tuple[Vector, str]:
    """Return an arm's own parameters (4, 6) and the state of its calibration. Raises RobotError."""
    try:
        with socket.create_connection((host, PORT), PATIENCE_S) as link, link.makefile("rb") as stream:
            for kind, content in _parts(stream):
                if kind == KINEMATICS:
                    values = KINEMATICS_INFO.unpack_from(content)
                    parameters, state = np.array(values[6:30]).reshape(4, 6), values[30]
                    if not np.isfinite(parameters).all():
                        raise ValueError(f"it is {parameters.tolist()}")
                    return parameters, STATES[state] if state < len(STATES) else f"state {state}"
        reason = "the controller does not send it"
    except (OSError, ValueError, struct.error) as error:
        reason = str(error)
    raise RobotError(
        f"the calibration of the arm at {host} cannot be read from port {PORT} ({reason}): open it, and enable the "
        "primary client interface (Settings, Security, Services)"
    )


def frames_of(parameters: Vector) -> Vector:
    """Return the frames (7, 4, 4)."""
    frames = [np.eye(4)]
    for theta, a, d, alpha in parameters.T:
        (c, s), (ca, sa) = (math.cos(theta), math.sin(theta)), (math.cos(alpha), math.sin(alpha))
        frames.append(
            frames[-1]
            @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0, 0, 0, 1.0]])
        )
    return np.array(frames)


def deviation_m(ur_model: str, frames: Vector) -> float:
    """Return how far the flange gets at most from where the data sheet has it, over many poses."""
    joints = np.random.default_rng(0).uniform(-math.pi, math.pi, (POSES, 6))
    ours, sheet = (_flange(each, joints) for each in (frames, frames_of(data_sheet(ur_model))))
    return float(np.linalg.norm(ours - sheet, axis=1).max())


def checked(frames: Vector, ur_model: str) -> Vector:
    """Return the frames. Raises RobotError if they are not those of a `ur_model`."""
    if (off := deviation_m(ur_model, frames)) > MOST:
        raise RobotError(f"calibration: {too_far(off, ur_model)}")
    return frames


def too_far(off: float, ur_model: str) -> str:
    """Return what a deviation beyond MOST means."""
    return f"the flange is up to {off:.2g} m from a {ur_model}'s: expected {MOST:g} m at most: is the model right"


def _flange(frames: Vector, joints: Vector) -> Vector:
    """Return the flange's positions [m] (n, 3) with the joints [rad] (n, 6)."""
    poses: Any = frames[0]
    for before, after, angle in zip(frames, frames[1:], joints.T, strict=False):
        turn = np.zeros((len(angle), 4, 4))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
        turn[:, 1, 0] = np.sin(angle)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = turn[:, 3, 3] = 1.0
        poses = poses @ turn @ np.linalg.inv(before) @ after
    flange: Vector = poses[:, :3, 3]
    return flange


def _parts(stream: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield the parts of the robot's states: type and content."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        kind, content = _read(stream)
        while kind == ROBOT_STATE and content:
            size, part = HEADER.unpack_from(content)
            if not HEADER.size <= size <= len(content):
                raise ValueError(f"a part of {size} bytes in {len(content)}")
            yield part, content[HEADER.size : size]
            content = content[size:]


def _read(stream: IO[bytes]) -> tuple[int, bytes]:
    """Return a package: type and content."""
    size, kind = HEADER.unpack(stream.read(HEADER.size))
    if not HEADER.size <= size <= LARGEST:
        raise ValueError(f"a package of {size} bytes")
    return kind, stream.read(size - HEADER.size)
