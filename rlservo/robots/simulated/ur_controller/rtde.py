"""RTDE on the controller's side: a client's recipes, packages in and out.

Source of the protocol: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

from rlservo.robots.simulated.ur_controller.controller import REGISTERS, Controller, RobotMode, SafetyMode

HEADER = struct.Struct(">HB")
LARGEST_PACKAGE = 4096  # [bytes] of a client's package
FORMATS = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip

Field = tuple[str, Callable[[Controller], Any]]


def _constant(kind: str, value: Any) -> Field:
    return kind, lambda _: value


def _register(kind: str, name: str, index: int) -> Field:
    return kind, lambda controller: getattr(controller, name)[index]


SIX_ZEROS = (0.0,) * 6
OUTPUTS: dict[str, Field] = {
    "timestamp": ("DOUBLE", lambda arm: arm.time_s),
    "target_q": ("VECTOR6D", lambda arm: arm.target),
    "target_qd": ("VECTOR6D", lambda arm: arm.target_velocity),
    "target_qdd": ("VECTOR6D", lambda arm: arm.target_acceleration),
    "actual_q": ("VECTOR6D", lambda arm: arm.simulation.data.qpos),
    "actual_qd": ("VECTOR6D", lambda arm: arm.simulation.data.qvel),
    "target_moment": ("VECTOR6D", lambda arm: arm.simulation.data.qfrc_actuator),
    "actual_TCP_pose": ("VECTOR6D", lambda arm: arm.tool.pose(arm.simulation.joint_positions)),
    "target_TCP_pose": ("VECTOR6D", lambda arm: arm.tool.pose(arm.target)),
    "actual_TCP_speed": (
        "VECTOR6D", lambda arm: arm.tool.speed(arm.simulation.joint_positions, arm.simulation.joint_velocities)
    ),
    "target_TCP_speed": ("VECTOR6D", lambda arm: arm.tool.speed(arm.target, arm.target_velocity)),
    "tcp_offset": ("VECTOR6D", lambda arm: arm.tool.offset),
    "robot_mode": ("INT32", lambda arm: int(arm.robot_mode)),
    "safety_mode": ("INT32", lambda arm: int(arm.safety_mode)),
    "safety_status": ("INT32", lambda arm: int(arm.safety_mode)),
    "runtime_state": ("UINT32", lambda arm: int(arm.runtime_state)),
    "robot_status_bits": ("UINT32", lambda arm: _robot_status(arm)),
    "safety_status_bits": ("UINT32", lambda arm: _safety_status(arm)),
    "speed_scaling": ("DOUBLE", lambda arm: arm.speed_scaling),
    "target_speed_fraction": ("DOUBLE", lambda arm: arm.speed_fraction),
    "payload": ("DOUBLE", lambda arm: arm.payload_kg),
    "payload_cog": ("VECTOR3D", lambda arm: arm.payload_centre),
    "actual_digital_output_bits": ("UINT64", lambda arm: arm.digital_outputs),
    "standard_analog_output0": ("DOUBLE", lambda arm: arm.analog_outputs[0]),
    "standard_analog_output1": ("DOUBLE", lambda arm: arm.analog_outputs[1]),
    "analog_io_types": ("UINT32", lambda arm: arm.analog_types << 2),
    **{
        f"output_{kind}_register_{index}": _register(types, f"outputs_{kind}", index)
        for kind, types in (("int", "INT32"), ("double", "DOUBLE"))
        for index in range(REGISTERS)
    },
    # Quantities that are not simulated.
    **{
        name: _constant("VECTOR6D", SIX_ZEROS)
        for name in (
            "target_current", "actual_current", "joint_control_output", "actual_TCP_force", "ft_raw_wrench",
            "payload_inertia",
        )
    },
    "joint_temperatures": _constant("VECTOR6D", (30.0,) * 6),
    "actual_joint_voltage": _constant("VECTOR6D", (48.0,) * 6),
    "joint_mode": _constant("VECTOR6INT32", (253,) * 6),
    "actual_tool_accelerometer": _constant("VECTOR3D", (0.0, 0.0, -9.81)),
    "actual_main_voltage": _constant("DOUBLE", 48.0),
    "actual_robot_voltage": _constant("DOUBLE", 48.0),
    **{
        name: _constant("DOUBLE", 0.0)
        for name in (
            "actual_execution_time", "actual_momentum", "actual_robot_current", "standard_analog_input0",
            "standard_analog_input1", "tool_analog_input0", "tool_analog_input1", "tool_output_current",
        )
    },
    "tool_temperature": _constant("DOUBLE", 30.0),
    "tool_output_voltage": _constant("INT32", 0),
    "tool_mode": _constant("UINT32", 253),
    "tool_analog_input_types": _constant("UINT32", 0),
    "actual_digital_input_bits": _constant("UINT64", 0),
    "output_bit_registers0_to_31": _constant("UINT32", 0),
    "output_bit_registers32_to_63": _constant("UINT32", 0),
}  # fmt: skip
INPUTS: dict[str, str] = {
    **{f"input_int_register_{index}": "INT32" for index in range(REGISTERS)},
    **{f"input_double_register_{index}": "DOUBLE" for index in range(REGISTERS)},
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **{
        f"{output}_digital_output{suffix}": "UINT8"
        for output in ("standard", "configurable", "tool")
        for suffix in ("_mask", "")
    },
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
}


class RtdeSession:
    """One client's connection: `receive` takes its bytes, `sample` gives its data package for this cycle."""

    def __init__(self, controller: Controller, registers_in_use: dict[str, RtdeSession]) -> None:
        self._controller, self._in_use = controller, registers_in_use
        self._buffer = b""
        self.allowance = math.inf  # data packages that may still be accepted in this cycle
        self._inputs: list[tuple[list[str], struct.Struct]] = []
        self._outputs: list[Callable[[Controller], Any]] = []
        self._package = struct.Struct(">")
        self._every = 1
        self._is_started = False

    def receive(self, data: bytes) -> bytes:
        """Take a client's bytes and return the replies. Raises ValueError if they are not RTDE."""
        self._buffer += data
        replies = b""
        while len(self._buffer) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._buffer)
            if not HEADER.size <= size <= LARGEST_PACKAGE:
                raise ValueError(f"a package of {size} bytes: expected {HEADER.size} to {LARGEST_PACKAGE}")
            if len(self._buffer) < size or (chr(kind) == "U" and self.allowance < 1.0):
                break
            self.allowance -= chr(kind) == "U"
            payload, self._buffer = self._buffer[HEADER.size : size], self._buffer[size:]
            replies += self._answer(chr(kind), payload)
        return replies

    @property
    def is_behind(self) -> bool:
        """Whether received bytes wait to be processed."""
        return len(self._buffer) >= HEADER.size

    def sample(self) -> bytes:
        """Return the data package of this control cycle; empty if none is due."""
        if not self._is_started or self._controller.ticks % self._every:
            return b""
        values: list[Any] = []
        for get in self._outputs:
            value = get(self._controller)
            if isinstance(value, (int, float)):
                values.append(value)
            else:
                values.extend(value)
        return _package("U", b"\x01" + self._package.pack(*values))

    def close(self) -> None:
        """Release the input registers."""
        for name in [name for name, user in self._in_use.items() if user is self]:
            del self._in_use[name]

    def _answer(self, kind: str, payload: bytes) -> bytes:
        if kind == "V":
            return _package("V", bytes([payload == b"\x00\x02"]))
        if kind == "v":
            return _package("v", struct.pack(">4I", *self._controller.version))
        if kind == "O":
            return self._set_outputs(payload)
        if kind == "I":
            return self._set_inputs(_names(payload))
        if kind in "SP":
            self._is_started = kind == "S" and bool(self._outputs)
            return _package(kind, bytes([kind == "P" or self._is_started]))
        if kind == "U":
            self._take(payload)
            return b""
        if kind == "M":
            return b""
        raise ValueError(f"package type {kind!r}: expected one of V, v, O, I, S, P, U and M")

    def _set_outputs(self, payload: bytes) -> bytes:
        if len(payload) < 8:
            raise ValueError(f"an output recipe of {len(payload)} bytes: expected a frequency, 8 bytes, and names")
        (frequency,) = struct.unpack_from(">d", payload)
        names = _names(payload[8:])
        kinds = [OUTPUTS[name][0] if name in OUTPUTS else "NOT_FOUND" for name in names]
        is_valid = "NOT_FOUND" not in kinds and 1.0 <= frequency <= self._controller.rate_hz
        self._outputs = [OUTPUTS[name][1] for name in names] if is_valid else []
        if self._outputs:
            self._every = round(self._controller.rate_hz / frequency)
            self._package = struct.Struct(">" + "".join(FORMATS[kind] for kind in kinds))
        self._is_started = False
        return _package("O", bytes([bool(self._outputs)]) + ",".join(kinds).encode())

    def _set_inputs(self, names: list[str]) -> bytes:
        kinds = []
        for name in names:
            is_taken = self._in_use.get(name, self) is not self
            kinds.append("IN_USE" if is_taken else INPUTS.get(name, "NOT_FOUND"))
        if all(kind in FORMATS for kind in kinds):
            self._in_use.update(dict.fromkeys(names, self))
            self._inputs.append((names, struct.Struct(">" + "".join(FORMATS[kind] for kind in kinds))))
            return _package("I", bytes([len(self._inputs)]) + ",".join(kinds).encode())
        return _package("I", b"\x00" + ",".join(kinds).encode())

    def _take(self, payload: bytes) -> None:
        recipe = payload[0] - 1 if payload else -1
        if not 0 <= recipe < len(self._inputs):
            raise ValueError(f"data for recipe {recipe + 1}, but there are {len(self._inputs)}")
        names, layout = self._inputs[recipe]
        if len(payload) - 1 != layout.size:
            raise ValueError(f"{len(payload) - 1} bytes for recipe {recipe + 1}: expected {layout.size}")
        values = dict(zip(names, layout.unpack_from(payload, 1), strict=False))
        for name, value in values.items():
            what, _, index = name.rpartition("_")
            if what == "input_int_register":
                self._controller.inputs_int[int(index)] = value
                self._controller.feed_watchdog(int(index))
            elif what == "input_double_register":
                self._controller.inputs_double[int(index)] = value
        for first, output in enumerate(("standard", "configurable", "tool")):
            mask = values.get(f"{output}_digital_output_mask", 0) << 8 * first
            bits = values.get(f"{output}_digital_output", 0) << 8 * first
            self._controller.digital_outputs = self._controller.digital_outputs & ~mask | bits & mask
        self._set_analog_outputs(values)
        if values.get("speed_slider_mask") and 0.0 <= values.get("speed_slider_fraction", -1.0) <= 1.0:
            self._controller.speed_fraction = values["speed_slider_fraction"]

    def _set_analog_outputs(self, values: dict[str, Any]) -> None:
        """Set those of the mask to a share of 0 to 10 V or, where their bit of the type is 0, of 4 to 20 mA."""
        arm, types = self._controller, values.get("standard_analog_output_type", 0)
        for index in range(2):
            if values.get("standard_analog_output_mask", 0) >> index & 1:
                share, is_voltage = values.get(f"standard_analog_output_{index}", 0.0), types >> index & 1
                arm.analog_outputs[index] = 10.0 * share if is_voltage else 0.004 + 0.016 * share
                arm.analog_types = arm.analog_types & ~(1 << index) | is_voltage << index


def _package(kind: str, payload: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(payload), ord(kind)) + payload


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii", errors="replace").split(",") if name]


def _robot_status(arm: Controller) -> int:
    return int(arm.robot_mode == RobotMode.RUNNING) | int(arm.is_program_running) << 1


def _safety_status(arm: Controller) -> int:
    is_emergency = arm.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP
    is_protective = arm.safety_mode == SafetyMode.PROTECTIVE_STOP
    is_stopped = is_emergency or is_protective
    return int(not is_stopped) | is_protective << 2 | is_emergency << 6 | is_emergency << 7 | is_stopped << 10
