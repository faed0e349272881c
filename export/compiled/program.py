"""C program in the making: its constants, its scratch memory, its statements, and loops over arrays.

A value of the graph is a `Ref`: an array constant, a member of what the caller gave, or a place in the scratch memory,
which is a struct of the caller's. Values that are not needed at the same time share a place.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.names import C_TYPES, array_text, comment, number
from rlservo.export.compiled.static_graph import StaticGraph
from rlservo.export.contract.errors import UnsupportedError

ALIGN = 16  # [elements] between places, so that rows start where vector registers like it


@dataclass(frozen=True)
class Ref:
    """Where a value's numbers lie, one after the other in row-major order."""

    dtype: np.dtype[Any]
    base: str
    offset: int = 0

    @property
    def c_type(self) -> str:
        return c_type(self.dtype)

    def __str__(self) -> str:
        if self.in_scratch:
            return f"{self.base[:-1]}+{self.offset}@"
        return f"{self.base} + {self.offset}" if self.offset else self.base

    @property
    def in_scratch(self) -> bool:
        """Whether it is a place, which `Program.texts` decides."""
        return self.base.startswith("@")


@dataclass
class _Place:
    """Scratch memory of one value, from the first statement that uses it to the last."""

    c_type: str
    size: int
    first: int
    last: int


def c_type(dtype: np.dtype[Any]) -> str:
    """Return C's type. Raises UnsupportedError where it has none (half precision, text)."""
    if dtype.name not in C_TYPES:
        raise UnsupportedError(f"values of type {dtype.name} in the policy's graph cannot be compiled to C")
    return C_TYPES[dtype.name]


class Program:
    """Statements of one function that computes a static graph."""

    def __init__(self, graph: StaticGraph, inputs: Mapping[str, str]) -> None:
        """`inputs` are C expressions for the graph's inputs."""
        self.graph = graph
        self.kernels: set[str] = set()
        self._constants: dict[tuple[str, bytes], tuple[str, NDArray[Any]]] = {}
        self.scratch: dict[str, int] = {}
        """Elements of scratch memory by C type, known after `texts`."""
        self._refs: dict[str, Ref] = {
            name: Ref(graph.values[name].dtype, expression) for name, expression in inputs.items()
        }
        self._places: list[_Place] = []
        self._sections: list[list[str]] = [[]]
        self._now = 0

    def value(self, name: str) -> NDArray[Any]:
        """Return a value's example: of a constant, what it is."""
        return self.graph.values[name]

    def is_constant(self, name: str) -> bool:
        return name in self.graph.constants

    def begin(self, what: str) -> None:
        """Begin the statements of a node, which are called so in a comment."""
        self._now += 1
        self._sections.append([f"    /* {comment(what)} */"])

    def ref(self, name: str) -> Ref:
        """Return where a value lies, in scratch memory up to now at least."""
        if self.is_constant(name):
            array = self.value(name)
            return Ref(array.dtype, self.constant(array))
        found = self._refs[name]
        if found.in_scratch:
            self._places[int(found.base.strip("@"))].last = self._now
        return found

    def new(self, name: str) -> Ref:
        """Return a place for a value that is computed now."""
        array = self.value(name)
        self._refs[name] = self.temporary(array.dtype, array.size)
        return self._refs[name]

    def alias(self, name: str, ref: Ref) -> None:
        """Let a value lie where another does."""
        self._refs[name] = ref

    def temporary(self, dtype: Any, size: int) -> Ref:
        """Return a place for this node alone."""
        self._places.append(_Place(c_type(np.dtype(dtype)), max(size, 1), self._now, self._now))
        return Ref(np.dtype(dtype), f"@{len(self._places) - 1}@")

    def constant(self, array: NDArray[Any], stem: str = "constant") -> str:
        """Return the name of an array constant; equal ones are one."""
        key = (array.dtype.name, array.tobytes())
        if key not in self._constants:
            c_type(array.dtype)
            self._constants[key] = (f"{stem}_{len(self._constants)}", np.ascontiguousarray(array))
        return self._constants[key][0]

    def emit(self, text: str) -> None:
        """Add statements."""
        self._sections[-1] += [f"    {line}" if line else line for line in text.splitlines()]

    def loop(
        self, shape: Sequence[int], reads: Sequence[tuple[Ref | str, Sequence[int]]], out: Ref,
        out_strides: Sequence[int], body: str,
    ) -> None:  # fmt: skip
        """Emit loops over `shape`; in `body`, {y} is the written element and {0}, {1}, ... the read ones.

        A read is an array with a stride per axis, or an expression that is the same everywhere.
        """
        sizes, strides = collapse(shape, [*(stride for _, stride in reads), out_strides])
        pointers, names, lines = [], [], []
        for position, (source, _) in enumerate(reads):
            if isinstance(source, str):
                names.append(source)
                continue
            pointer = f"const {source.c_type} *restrict {{}} = {source};"
            if pointer not in pointers:
                pointers.append(pointer)
            names.append(f"x{pointers.index(pointer)}[{_index(strides[position])}]")
        lines += [pointer.format(f"x{i}") for i, pointer in enumerate(pointers)]
        lines.append(f"{out.c_type} *restrict y = {out};")
        lines += [f"for (int i{d} = 0; i{d} < {size}; i{d}++)" for d, size in enumerate(sizes)]
        lines.append(f"    {body.format(*names, y=f'y[{_index(strides[-1])}]')}")
        self.emit("{\n" + "\n".join(f"    {line}" for line in lines) + "\n}")

    def texts(self) -> list[str]:
        """Return the statements, with every place decided: those before the first `begin`, then each node's."""
        arenas: dict[str, list[tuple[_Place, int]]] = {}
        offsets: list[int] = []
        for place in self._places:
            placed = arenas.setdefault(place.c_type, [])
            taken = sorted(
                (start, start + other.size) for other, start in placed
                if other.last >= place.first and place.last >= other.first
            )  # fmt: skip
            offset = 0
            for start, end in taken:
                if offset + place.size <= start:
                    break
                offset = max(offset, -(-end // ALIGN) * ALIGN)
            placed.append((place, offset))
            offsets.append(offset)
            self.scratch[place.c_type] = max(self.scratch.get(place.c_type, 0), offset + place.size)

        def place_text(match: re.Match[str]) -> str:
            number_of = int(match[1])
            offset = offsets[number_of] + int(match[2])
            member = f"state->scratch.{self._places[number_of].c_type.removesuffix('_t')}s"
            return f"{member} + {offset}" if offset else member

        return [re.sub(r"@(\d+)\+(\d+)@", place_text, "\n".join(lines)) for lines in self._sections]

    def constants_text(self, prefix: str, least_in_file: int | None) -> tuple[str, NDArray[np.float32] | None]:
        """Return (definitions of the array constants, those that are left to a file of weights instead).

        Into that go single-precision ones of `least_in_file` elements or more; None is no such file.
        """
        lines: list[str] = []
        outside: list[NDArray[np.float32]] = []
        begin = 0
        for name, array in self._constants.values():
            if least_in_file is not None and array.dtype == np.float32 and array.size >= least_in_file:
                lines.append(f"#define {name} ({prefix}_weights + {begin})")
                padded = np.zeros(-(-array.size // ALIGN) * ALIGN, np.float32)
                padded[: array.size] = array.ravel()
                outside.append(padded)
                begin += padded.size
                continue
            values = array_text(array) if array.size else "    0"
            size = max(array.size, 1)
            lines.append(f"static const {c_type(array.dtype)} {name}[{size}] ALIGNED = {{\n{values}\n}};")
        weights = np.concatenate(outside) if outside else None
        if weights is not None:
            lines.insert(0, f"extern const float {prefix}_weights[{weights.size}];")
        return "\n".join(lines), weights


def literal(program: Program, name: str) -> str | Ref:
    """Return a constant of one element as a literal, and where anything else lies."""
    array = program.value(name)
    if program.is_constant(name) and array.size == 1:
        return number(array.ravel()[0])
    return program.ref(name)


def row_major(shape: Sequence[int]) -> list[int]:
    """Return the stride of each axis, in elements."""
    strides, step = [], 1
    for size in reversed(shape):
        strides.append(step)
        step *= size
    return strides[::-1]


def broadcast(shape: Sequence[int], to: Sequence[int]) -> list[int]:
    """Return the strides with which an array of `shape` is read as one of shape `to`."""
    own = [0 if size == 1 else stride for size, stride in zip(shape, row_major(shape), strict=True)]
    return [0] * (len(to) - len(shape)) + own


def collapse(shape: Sequence[int], strides: Sequence[Sequence[int]]) -> tuple[list[int], list[list[int]]]:
    """Return fewer, longer axes for the same elements in the same order."""
    sizes: list[int] = []
    kept: list[list[int]] = [[] for _ in strides]
    for axis, size in enumerate(shape):
        if size == 1:
            continue
        now = [stride[axis] for stride in strides]
        if sizes and all(k[-1] == n * size for k, n in zip(kept, now, strict=True)):
            sizes[-1] *= size
            for k, n in zip(kept, now, strict=True):
                k[-1] = n
            continue
        sizes.append(size)
        for k, n in zip(kept, now, strict=True):
            k.append(n)
    return sizes, kept


def affine(places: NDArray[np.int64]) -> tuple[int, list[int]] | None:
    """Return (first, stride per axis) of places that are evenly spaced along every axis; None where they are not."""
    first = int(places.flat[0])
    strides = []
    for axis, size in enumerate(places.shape):
        step = int(np.take(places, 1, axis).flat[0]) - first if size > 1 else 0
        strides.append(step)
    grid = np.full(places.shape, first, np.int64)
    for axis, stride in enumerate(strides):
        grid += (np.arange(places.shape[axis]) * stride).reshape([-1 if a == axis else 1 for a in range(places.ndim)])
    return (first, strides) if np.array_equal(grid, places) else None


def _index(strides: Sequence[int]) -> str:
    terms = [f"i{axis}" if stride == 1 else f"{stride} * i{axis}" for axis, stride in enumerate(strides) if stride]
    return " + ".join(terms) or "0"
