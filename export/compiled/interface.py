"""C interface of a compiled policy: its structs, constants and result codes, as the header has them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import REWARD, Contract
from rlservo.bundle.spaces import BoxSpec, LeafSpec, leaf_specs
from rlservo.errors import UnsupportedError
from rlservo.export.compiled.c_program import c_type
from rlservo.export.compiled.names import C_TYPES, Identifiers, comment, prefix_of, string

MAX_ELEMENTS = 1 << 24  # what a result code has room for
KINDS = ("OK", "OUT_OF_BOUNDS", "NOT_FINITE", "NOT_A_CHOICE", "ACTION_NOT_FINITE", "ACTION_OUT_OF_SPACE")
"""Kinds of result codes, counted from 0. The first two come with an action."""
BOUNDS_SHOWN = 8  # elements of an unnamed array whose bounds differ, listed in the header


@dataclass(frozen=True)
class Member:
    """One array of a struct: a leaf of an observation or action, the reward, or a state."""

    tensor: str
    """Its name in the graph."""
    name: str
    dtype: np.dtype[Any]
    size: int
    first: int = 0
    """The number of its first element in result codes."""
    leaf: LeafSpec | None = None


@dataclass(frozen=True)
class Interface:
    """Names and members for one contract."""

    prefix: str
    obs: tuple[Member, ...]
    action: tuple[Member, ...]
    state: tuple[Member, ...]

    @property
    def upper(self) -> str:
        return self.prefix.upper()

    @property
    def inputs(self) -> dict[str, str]:
        """C expressions of the graph's inputs."""
        found = {member.tensor: f"obs->{member.name}" for member in self.obs}
        return {**found, **{f"state_in.{member.tensor}": f"state->{member.name}" for member in self.state}}


def interface_of(contract: Contract) -> Interface:
    """Return the interface. Raises UnsupportedError for types that C lacks and for too many elements."""
    names = Identifiers(("scratch", "values", "unused", REWARD))
    obs = [*_leaves(leaf_specs(contract.observation_space, "obs"), names)]
    if contract.has_reward:
        first = sum(member.size for member in obs)
        obs.append(Member(REWARD, REWARD, np.dtype(np.float32), 1, first))
    action = [*_leaves(leaf_specs(contract.action_space, "action"), names)]
    state = [Member(each.name, names.make("state", each.name), np.dtype(each.dtype), int(np.prod(each.shape)))
             for each in contract.state]  # fmt: skip
    for member in (*obs, *action, *state):
        c_type(member.dtype)
    for what, members in (("an observation", obs), ("an action", action)):
        if (total := sum(member.size for member in members)) > MAX_ELEMENTS:
            raise UnsupportedError(f"{what} of {total:,} numbers cannot be compiled to C: at most {MAX_ELEMENTS:,}")
    return Interface(prefix_of(contract.name), tuple(obs), tuple(action), tuple(state))


def _leaves(leaves: dict[str, LeafSpec], names: Identifiers) -> Iterator[Member]:
    first = 0
    for tensor, leaf in leaves.items():
        name = "values" if "." not in tensor else names.make(*tensor.split(".", 1))
        yield Member(tensor, name, np.dtype(leaf.dtype), leaf.size, first, leaf)
        first += leaf.size


def header_text(face: Interface, contract: Contract, digest: str, scratch: dict[str, int]) -> str:
    """Return the header. `scratch` is the elements of scratch memory by C type."""
    p, u = face.prefix, face.upper
    source = contract.provenance
    about = [
        f"Policy '{contract.name}', version {contract.version}, compiled from a bundle by rlservo.",
        *([contract.description] if contract.description else []),
        f"bundle: {digest}",
        f"trained: {source.algorithm}" + (f" in {source.env_id}" if source.env_id else ""),
        f"in the graph: {', '.join(step.step for step in contract.baked_in) or 'the network'}",
        f"control rate: {f'{contract.control_rate_hz:g} Hz' if contract.control_rate_hz else 'not stated'}",
    ]
    identifiers = Identifiers(tuple(f"{u}_{kind}" for kind in (*KINDS, "H", "KIND", "ELEMENT", "REFUSED", "BUNDLE")))
    lines = ["/*", *(f" * {comment(line)}" for line in about), " */", f"#ifndef {u}_H", f"#define {u}_H", ""]
    lines += ["#include <stddef.h>", "#include <stdint.h>", "", "#ifdef __cplusplus", 'extern "C" {', "#endif", ""]
    lines += [f"#define {u}_BUNDLE {string(digest)}", f"#define {u}_VERSION {string(contract.version)}"]
    if contract.control_rate_hz:
        lines.append(f"#define {u}_CONTROL_RATE_HZ {contract.control_rate_hz!r}")
    for what, members in (("obs", face.obs), ("action", face.action)):
        lines += ["", *_elements(u, what, members, identifiers)]
        lines += ["typedef struct {", *(_declared(member) for member in members), f"}} {p}_{what};"]
    memory = [f"        {kind} {kind.removesuffix('_t')}s[{size}];" for kind, size in sorted(scratch.items())]
    memory = ["    struct {", *memory, "    } scratch; /* means nothing between two calls */"]
    members_text = [*(_declared(member) for member in face.state), *memory]
    remembers = "the episode so far, and " if face.state else ""
    lines += ["", f"/* Memory of one policy: {remembers}room to compute in. One for each robot or thread. */"]
    lines += ["typedef struct {", *members_text, f"}} {p}_state;", ""]
    lines += _codes(p, u)
    lines += ["", "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""]
    return "\n".join(lines)


def _declared(member: Member) -> str:
    return f"    {C_TYPES[member.dtype.name]} {member.name}[{member.size}];"


def _codes(p: str, u: str) -> list[str]:
    return [
        "/* Result of a step: a kind and the element that it is about. */",
        "enum {",
        f"    {u}_OK = 0,",
        f"    {u}_OUT_OF_BOUNDS = 1, /* an action, for an observation outside the space that it was trained in */",
        f"    {u}_NOT_FINITE = 2, /* refused: an observation or reward is not a number, or infinite */",
        f"    {u}_NOT_A_CHOICE = 3, /* refused: a discrete observation is not one of its choices */",
        f"    {u}_ACTION_NOT_FINITE = 4, /* refused: the network computed no number */",
        f"    {u}_ACTION_OUT_OF_SPACE = 5 /* refused: the network computed an action outside the action space */",
        "};",
        f"#define {u}_KIND(code) ((code) >> 24)",
        f"#define {u}_ELEMENT(code) ((code) & 0xffffff)",
        f"#define {u}_REFUSED(code) ((code) >> 24 >= {u}_NOT_FINITE)",
        "",
        "/* Begin an episode: call it once before the first step, and at the start of each further episode. */",
        f"void {p}_reset({p}_state *state);",
        "",
        "/* Compute the action for an observation. A refused one changes neither action nor memory. */",
        f"int32_t {p}_act(const {p}_obs *obs, {p}_state *state, {p}_action *action);",
        "",
        "/* The name of a code's element, or of its array if the element has no name. */",
        f"const char *{p}_element(int32_t code);",
        "",
        "/* For callers without this header: the hash of the bundle, and sizeof the state. */",
        f"extern const char {p}_bundle[];",
        f"extern const size_t {p}_state_size;",
    ]


def _elements(u: str, what: str, members: tuple[Member, ...], identifiers: Identifiers) -> Iterator[str]:
    """Yield a constant for each named element, its index in its array, with unit and bounds."""
    yield f"/* {'Observation' if what == 'obs' else 'Action'}: indices into its arrays. */"
    for member in members:
        stem = f"{u}_{what.upper()}" + ("" if member.name == "values" else f"_{member.name.split('_', 1)[-1].upper()}")
        if member.leaf is None:
            yield "/* reward: the last action's reward, 0 at an episode's start */"
            continue
        shape = " x ".join(map(str, member.leaf.shape)) or "1"
        yield f"#define {identifiers.make(stem, 'size', upper=True)} {member.size}"
        ranges = list(_ranges(member.leaf))
        if not member.leaf.elements:
            same = ranges if len(set(ranges)) > 1 and len(ranges) <= BOUNDS_SHOWN else ranges[:1]
            each = "each " if len(set(ranges)) == 1 and member.size > 1 else ""
            more = ", ..." if len(set(ranges)) > 1 and len(ranges) > BOUNDS_SHOWN else ""
            yield f"/* {comment(member.tensor)}: {shape} numbers without names, {each}{', '.join(same)}{more} */"
            continue
        yield "enum {"
        for index, element in enumerate(member.leaf.elements):
            unit = f" [{element.unit}]" if element.unit else ""
            name = identifiers.make(stem, element.name, upper=True)
            yield f"    {name} = {index}, /* {comment(element.name + unit)}, {ranges[index]} */"
        yield "};"


def _ranges(leaf: LeafSpec) -> Iterator[str]:
    low, high = leaf.bounds()
    for a, b in zip(low.ravel().tolist(), high.ravel().tolist(), strict=True):
        if not np.isfinite([a, b]).any():
            yield "unbounded"
        else:
            whole = "" if isinstance(leaf, BoxSpec) else "one of "
            yield f"{whole}{a:.9g} .. {b:.9g}"


def range_of(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """Return the smallest and the largest number of a type, as numbers of it; C has bytes for booleans."""
    info = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(np.uint8 if dtype == np.bool_ else dtype)
    return info.min, info.max


def bounds_of(member: Member, slack: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return a leaf's bounds, moved apart by `slack`, as numbers of its own type, flat.

    A number is between these exactly when it is between the contract's, which are double precision.
    """
    assert member.leaf is not None
    kind = np.dtype(np.uint8) if member.dtype == np.bool_ else member.dtype
    least, most = range_of(kind)
    low, high = member.leaf.bounds()
    low, high = (low - slack).ravel(), (high + slack).ravel()
    low, high = (np.clip(each, float(least), float(most)) for each in (low, high))
    if kind.kind != "f":  # in Python's integers: the largest 64-bit ones are not doubles
        whole = [map(math.ceil, low.tolist()), map(math.floor, high.tolist())]
        ends = [[min(max(value, int(least)), int(most)) for value in each] for each in whole]
        return np.array(ends[0], kind), np.array(ends[1], kind)
    down, up = low.astype(kind), high.astype(kind)
    down = np.where(down.astype(np.float64) < low, np.nextafter(down, kind.type(np.inf)), down)
    up = np.where(up.astype(np.float64) > high, np.nextafter(up, kind.type(-np.inf)), up)
    return down, up
