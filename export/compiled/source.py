"""C file of a compiled policy: checks of the observation, the network, checks of the action, memory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.interface import Interface, Member, bounds_of
from rlservo.export.compiled.names import comment, number, string
from rlservo.export.compiled.operators import emit_node
from rlservo.export.compiled.program import Program, Ref
from rlservo.export.compiled.static_graph import StaticGraph
from rlservo.export.contract.contract import Contract
from rlservo.export.contract.spaces import BoxSpec
from rlservo.serve_app.runtime.input_numbers import rounding_slack

SMALLEST_IN_BIN = 256  # elements of a constant that goes into the file of weights, where there is one
NODES_TOGETHER = 24


@dataclass(frozen=True)
class Source:
    """The C file, the scratch memory its state needs, and the weights that it takes from a file of their own."""

    text: str
    scratch: dict[str, int]
    weights: NDArray[np.float32] | None


def write_source(face: Interface, contract: Contract, graph: StaticGraph, *, weights_in_file: bool) -> Source:
    """Raises UnsupportedError, naming an operator."""
    program = Program(graph, face.inputs)
    for member in face.obs:
        _check_observation(program, face, member)
    for node in graph.nodes:
        emit_node(program, node)
    program.begin("the action, checked; then it and the memory, where nothing can fail any more")
    actions = {member.name: _in_scratch(program, member.tensor, member) for member in face.action}
    states = {member.name: _in_scratch(program, f"state_out.{member.tensor}", member) for member in face.state}
    for member in face.action:
        _check_action(program, face, member, actions[member.name])
    for struct, members, refs in (("action", face.action, actions), ("state", face.state, states)):
        for member in members:
            program.emit(f"memcpy({struct}->{member.name}, {refs[member.name]}, sizeof {struct}->{member.name});")
    before, *nodes, after = program.texts()
    p, u = face.prefix, face.upper
    functions, calls = _functions(p, nodes)
    constants, weights = program.constants_text(p, SMALLEST_IN_BIN if weights_in_file else None)
    text = f"""\
/* Policy '{comment(contract.name)}', version {contract.version}, compiled by rlservo. {p}.h says how to call it. */
#include "{p}.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

#ifdef __FAST_MATH__
#error "the checks for what is not a number need IEEE arithmetic: compile without -ffast-math"
#endif
#if INT_MAX < 2147483647
#error "int must have 32 bits"
#endif
#if defined(__GNUC__)
#define ALIGNED __attribute__((aligned(64)))
#define APART __attribute__((noinline))
#else
#define ALIGNED
#define APART
#endif

const char {p}_bundle[] = {u}_BUNDLE;
const size_t {p}_state_size = sizeof({p}_state);

{constants}

{_kernels(program.kernels)}{functions}{_reset(face, contract)}
int32_t {p}_act(const {p}_obs *obs, {p}_state *state, {p}_action *action) {{
    int32_t notice = {u}_OK;
    (void)state;
{before}
{calls}
{after}
    return notice;
}}

{_names(face)}"""
    return Source(text, program.scratch, weights)


def _functions(p: str, nodes: list[str]) -> tuple[str, str]:
    """Return (functions, calls of them) for the nodes of a large graph: one large function takes long to compile."""
    if len(nodes) <= NODES_TOGETHER:
        return "", "\n".join(nodes)
    functions, calls = [], []
    for first in range(0, len(nodes), NODES_TOGETHER):
        name = f"nodes_{first}"
        body = "\n".join(nodes[first : first + NODES_TOGETHER])
        head = f"static APART void {name}(const {p}_obs *obs, {p}_state *state) {{\n    (void)obs;\n    (void)state;"
        functions.append(f"{head}\n{body}\n}}\n\n")
        calls.append(f"    {name}(obs, state);")
    return "".join(functions), "\n".join(calls)


def _kernels(wanted: set[str]) -> str:
    """Return the functions that the program calls."""
    text = files("rlservo.export.compiled").joinpath("kernels.c").read_text(encoding="utf-8")
    parts = re.split(r"^//: (\w+)\n", text, flags=re.MULTILINE)[1:]
    return "".join(f"{body}\n" for name, body in zip(parts[::2], parts[1::2], strict=True) if name in wanted)


def _check_observation(program: Program, face: Interface, member: Member) -> None:
    """As the runtime: numbers have to be finite and choices to exist; the bounds of a Box are reported."""
    u, x = face.upper, f"obs->{member.name}[i]"
    loop = f"for (int i = 0; i < {member.size}; i++)"
    is_float = member.dtype.kind == "f"
    if is_float:
        largest = "FLT_MAX" if member.dtype == np.float32 else "DBL_MAX"
        bad = f"!({x} >= -{largest} && {x} <= {largest})"
        program.emit(f"{loop}\n    if ({bad}) return ({u}_NOT_FINITE << 24) | ({member.first} + i);")
    if member.leaf is None:
        return
    slack = rounding_slack(*member.leaf.bounds(), member.dtype)
    tests = _outside(program, bounds_of(member, slack), x)
    if tests and isinstance(member.leaf, BoxSpec) and member.dtype != np.bool_:
        keep = f"{{\n    notice = ({u}_OUT_OF_BOUNDS << 24) | ({member.first} + i);\n    break;\n}}"
        program.emit(f"for (int i = 0; notice == {u}_OK && i < {member.size}; i++)\n    if ({tests}) {keep}")
    elif tests:
        program.emit(f"{loop}\n    if ({tests}) return ({u}_NOT_A_CHOICE << 24) | ({member.first} + i);")


def _check_action(program: Program, face: Interface, member: Member, action: Ref) -> None:
    """As the runtime: what is outside the space by more than rounding is refused, rounding is clipped."""
    assert member.leaf is not None
    u, x = face.upper, f"({action})[i]"
    loop = f"for (int i = 0; i < {member.size}; i++)"
    where = f"({member.first} + i)"
    if member.dtype.kind == "f":
        largest = "FLT_MAX" if member.dtype == np.float32 else "DBL_MAX"
        bad = f"!({x} >= -{largest} && {x} <= {largest})"
        program.emit(f"{loop}\n    if ({bad}) return ({u}_ACTION_NOT_FINITE << 24) | {where};")
    low, high = member.leaf.bounds()
    largest_number = 0.0
    if member.dtype.kind == "f":  # the largest number stands for unbounded, as in the runtime
        largest_number = float(np.finfo(member.dtype).max)
        low, high = np.maximum(low, -largest_number), np.minimum(high, largest_number)
    tests = _outside(program, bounds_of(member, rounding_slack(low, high, member.dtype)), x)
    if tests:
        program.emit(f"{loop}\n    if ({tests}) return ({u}_ACTION_OUT_OF_SPACE << 24) | {where};")
    if tests and member.dtype.kind == "f":
        nearest = [np.clip(each.ravel(), -largest_number, largest_number).astype(member.dtype) for each in (low, high)]
        for sign, bound in zip("<>", _bound_texts(program, nearest), strict=True):
            if bound:
                program.emit(f"{loop}\n    if ({x} {sign} {bound}) {x} = {bound};")


def _outside(program: Program, bounds: tuple[NDArray[np.generic], ...], x: str) -> str:
    """Return the test for a number outside its bounds, '' where its type has no such numbers."""
    texts = zip("<>", _bound_texts(program, bounds), strict=True)
    return " || ".join(f"{x} {sign} {bound}" for sign, bound in texts if bound)


def _bound_texts(
    program: Program, bounds: tuple[NDArray[np.generic], ...] | list[NDArray[np.generic]]
) -> Iterator[str]:
    """Yield the lower and the upper bound of element i, '' where it is the type's own."""
    for array, own in zip(bounds, _own_range(bounds[0].dtype), strict=True):
        if (array == own).all():
            yield ""
        elif (array == array[0]).all():
            yield number(array[0])
        else:
            yield f"{program.constant(array, 'bounds')}[i]"


def _own_range(dtype: np.dtype[Any]) -> tuple[float | int, float | int]:
    if dtype.kind == "f":
        largest = float(np.finfo(dtype).max)
        return -largest, largest
    info = np.iinfo(dtype)
    return int(info.min), int(info.max)


def _in_scratch(program: Program, tensor: str, member: Member) -> Ref:
    """Return where an output lies, copied where that is not scratch memory."""
    ref = program.ref(tensor)
    if ref.in_scratch:
        return ref
    copied = program.temporary(member.dtype, member.size)
    program.emit(f"memcpy({copied}, {ref}, {member.size} * sizeof({copied.c_type}));")
    return copied


def _reset(face: Interface, contract: Contract) -> str:
    lines = [f"void {face.prefix}_reset({face.prefix}_state *state) {{", "    (void)state;"]
    for member, spec in zip(face.state, contract.state, strict=True):
        values = spec.initial_value(1).ravel()
        loop = f"for (int i = 0; i < {member.size}; i++) state->{member.name}[i]"
        if (values == values[0]).all():
            lines.append(f"    {loop} = {number(values[0])};")
        else:
            numbers = ", ".join(number(value) for value in values)
            lines += ["    {", f"        static const {_kind(member)} initial[] = {{{numbers}}};"]
            lines += [f"        {loop} = initial[i];", "    }"]
    return "\n".join([*lines, "}", ""])


def _kind(member: Member) -> str:
    return Ref(member.dtype, "").c_type


def _names(face: Interface) -> str:
    """Return the function that names the element of a result code."""
    lines, tests = [], []
    for what, members in (("obs", face.obs), ("action", face.action)):
        for number_of, member in enumerate(members):
            is_action = f"{face.upper}_KIND(code) >= {face.upper}_ACTION_NOT_FINITE"
            test = f"    if ({'' if what == 'action' else '!'}({is_action}) && element < {member.first + member.size})"
            elements = member.leaf.elements if member.leaf is not None else ()
            if elements:
                table = f"{what}_names_{number_of}"
                names = ",\n    ".join(string(element.name) for element in elements)
                lines.append(f"static const char *const {table}[] = {{\n    {names},\n}};")
                tests.append(f"{test} return {table}[element - {member.first}];")
            else:
                tests.append(f"{test} return {string(member.tensor)};")
    body = [f"const char *{face.prefix}_element(int32_t code) {{",
            f"    const int32_t element = {face.upper}_ELEMENT(code);",
            '    if (code <= 0) return "";', *tests, '    return "";', "}", ""]  # fmt: skip
    return "\n".join([*lines, *body])
