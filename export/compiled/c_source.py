"""C file of a compiled policy: checks of the observation, the network, checks of the action, memory."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import BoxSpec
from rlservo.export.compiled.c_operators import emit_node
from rlservo.export.compiled.c_program import Program
from rlservo.export.compiled.interface import Interface, Member, bounds_of, range_of
from rlservo.export.compiled.names import C_TYPES, array_text, comment, number, string
from rlservo.export.compiled.static_graph import StaticGraph
from rlservo.policy.input_numbers import rounding_slack


@dataclass(frozen=True)
class CSource:
    """The C file, and the scratch memory its state needs."""

    text: str
    scratch: dict[str, int]


def write_source(face: Interface, contract: Contract, graph: StaticGraph) -> CSource:
    """Return the C file. Raises UnsupportedError, naming an operator."""
    outputs = [(member, "action", member.tensor) for member in face.action]
    outputs += [(member, "state", f"state_out.{member.tensor}") for member in face.state]
    program = Program(graph, face.inputs, [tensor for _, _, tensor in outputs])
    for member in face.obs:
        _check_observation(program, face, member)
    for node in graph.nodes:
        emit_node(program, node)
    program.begin("the action, checked; then it and the memory, where nothing can fail any more")
    copies = []
    for member, struct, tensor in outputs:
        result = program.temporary(member.dtype, member.size)
        program.emit(f"memcpy({result}, {program.ref(tensor)}, {member.size} * sizeof({result.c_type}));")
        copies.append(f"memcpy({struct}->{member.name}, {result}, sizeof {struct}->{member.name});")
        if struct == "action":
            _check_action(program, face, member, f"({result})[i]")
    program.emit("\n".join(copies))
    p, u = face.prefix, face.upper
    text = f"""\
/* Policy '{comment(contract.name)}', version {contract.version}, compiled by rlservo. {p}.h says how to call it. */
#include "{p}.h"

#include <limits.h>
#include <math.h>
#include <string.h>

#ifdef __FAST_MATH__
#error "the checks for what is not a number need IEEE arithmetic: compile without -ffast-math"
#endif
#if INT_MAX < 2147483647
#error "int must have 32 bits"
#endif
#ifdef __GNUC__
#define ALIGNED __attribute__((aligned(64)))
#else
#define ALIGNED
#endif

const char {p}_bundle[] = {u}_BUNDLE;
const size_t {p}_state_size = sizeof({p}_state);

{program.constants_text()}

{_kernels(program.kernels)}{_reset(face, contract)}
int32_t {p}_act(const {p}_obs *obs, {p}_state *state, {p}_action *action) {{
    int32_t notice = {u}_OK;
    (void)state;
{chr(10).join(program.lines)}
    return notice;
}}

{_names(face)}"""
    return CSource(text, program.scratch)


def _kernels(wanted: set[str]) -> str:
    """Return the functions that the program calls."""
    text = files("rlservo.export.compiled").joinpath("kernels.c").read_text(encoding="utf-8")
    parts = re.split(r"^//: (\w+)\n", text, flags=re.MULTILINE)[1:]
    return "".join(f"{body}\n" for name, body in zip(parts[::2], parts[1::2], strict=True) if name in wanted)


def _check_observation(program: Program, face: Interface, member: Member) -> None:
    """Check as the runtime does: numbers must be finite, choices must exist; a Box's bounds are only reported."""
    u, x, loop = face.upper, f"obs->{member.name}[i]", f"i < {member.size}; i++)"
    if member.dtype.kind == "f":
        program.emit(f"for (int i = 0; {loop}\n    if ({_infinite(member, x)}) {_code(face, 'NOT_FINITE', member)}")
    if member.leaf is None:
        return
    tests = _outside(program, x, bounds_of(member, rounding_slack(*member.leaf.bounds(), member.dtype)))
    if tests and isinstance(member.leaf, BoxSpec) and member.dtype != np.bool_:
        notice = _code(face, "OUT_OF_BOUNDS", member).replace("return", "notice =")
        program.emit(f"for (int i = 0; notice == {u}_OK && {loop}\n    if ({tests}) {notice}")
    elif tests:
        program.emit(f"for (int i = 0; {loop}\n    if ({tests}) {_code(face, 'NOT_A_CHOICE', member)}")


def _check_action(program: Program, face: Interface, member: Member, x: str) -> None:
    """Check as the runtime does: values outside the space are clipped if by rounding only, else refused."""
    assert member.leaf is not None
    loop, (low, high) = f"for (int i = 0; i < {member.size}; i++)", member.leaf.bounds()
    if member.dtype.kind == "f":  # the largest number stands for unbounded, as in the runtime
        program.emit(f"{loop}\n    if ({_infinite(member, x)}) {_code(face, 'ACTION_NOT_FINITE', member)}")
        low, high = (np.clip(each, *range_of(member.dtype)) for each in (low, high))
    tests = _outside(program, x, bounds_of(member, rounding_slack(low, high, member.dtype)))
    if tests:
        program.emit(f"{loop}\n    if ({tests}) {_code(face, 'ACTION_OUT_OF_SPACE', member)}")
    if tests and member.dtype.kind == "f":
        for sign, bound in zip("<>", (low, high), strict=True):
            nearest = _bound(program, bound.ravel().astype(member.dtype))
            program.emit(f"{loop}\n    if ({x} {sign} {nearest}) {x} = {nearest};")


def _code(face: Interface, kind: str, member: Member) -> str:
    return f"return ({face.upper}_{kind} << 24) | ({member.first} + i);"


def _infinite(member: Member, x: str) -> str:
    largest = number(np.finfo(member.dtype).max)
    return f"!({x} >= -{largest} && {x} <= {largest})"


def _outside(program: Program, x: str, bounds: tuple[NDArray[Any], NDArray[Any]]) -> str:
    """Return the test for a number outside its bounds, '' if its type has no such numbers."""
    ends = zip("<>", bounds, range_of(bounds[0].dtype), strict=True)
    return " || ".join(f"{x} {sign} {_bound(program, each)}" for sign, each, own in ends if (each != own).any())


def _bound(program: Program, array: NDArray[Any]) -> str:
    return number(array[0]) if (array == array[0]).all() else f"{program.constant(array, 'bounds')}[i]"


def _reset(face: Interface, contract: Contract) -> str:
    tables, lines = [], []
    for member, spec in zip(face.state, contract.state, strict=True):
        values = spec.initial_value(1).ravel()
        initial = number(values[0])
        if (values != values[0]).any():
            initial = f"initial_{member.name}[i]"
            kind = C_TYPES[member.dtype.name]
            tables.append(f"static const {kind} {initial[:-3]}[] = {{\n{array_text(values)}\n}};\n")
        lines.append(f"    for (int i = 0; i < {member.size}; i++) state->{member.name}[i] = {initial};\n")
    head = f"void {face.prefix}_reset({face.prefix}_state *state) {{\n    (void)state;\n"
    return "".join([*tables, head, *lines, "}\n"])


def _names(face: Interface) -> str:
    """Return the function that names the element of a result code."""
    tables, tests = [], []
    for what, members in (("obs", face.obs), ("action", face.action)):
        for place, member in enumerate(members):
            name, elements = string(member.tensor), member.leaf.elements if member.leaf is not None else ()
            if elements:
                names = ",\n    ".join(string(element.name) for element in elements)
                tables.append(f"static const char *const {what}_names_{place}[] = {{\n    {names},\n}};\n")
                name = f"{what}_names_{place}[element - {member.first}]"
            side = f"code >> 24 {'<' if what == 'obs' else '>='} {face.upper}_ACTION_NOT_FINITE"
            tests.append(f"    if ({side} && element < {member.first + member.size}) return {name};\n")
    head = f"const char *{face.prefix}_element(int32_t code) {{\n    const int32_t element = code & 0xffffff;\n"
    return "".join([*tables, head, '    if (code <= 0) return "";\n', *tests, '    return "";\n}\n'])
