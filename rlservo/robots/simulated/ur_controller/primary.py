"""The primary interface, as far as it is simulated: a client is sent the arm's kinematics when it connects."""

from __future__ import annotations

import struct

from rlservo.robots.simulated.ur_controller.controller import Controller

ROBOT_STATE, KINEMATICS_INFO = 16, 5
NOT_INITIALISED, LINEARISED = 0, 2


def kinematics_package(controller: Controller) -> bytes:
    """Return a robot state with nothing but the kinematics info."""
    values = controller.kinematics.ravel().tolist()
    state = LINEARISED if controller.is_calibrated else NOT_INITIALISED
    info = struct.pack("!6I24dI", *[0] * 6, *values, state)  # the checksums of the joints come first
    part = struct.pack("!IB", 5 + len(info), KINEMATICS_INFO) + info
    return struct.pack("!ib", 5 + len(part), ROBOT_STATE) + part
