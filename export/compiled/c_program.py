"""C program in the making: its constants, its scratch memory, its statements, and loops over arrays.

A value of the graph is a `Ref`: an array constant, a member of what the caller gave, or a place in the scratch memory,
which is a struct of the caller's. Values that are not needed at the same time share a place.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import UnsupportedError
from rlservo.export.compiled.names import C_TYPES, array_text, comment, number
from rlservo.export.compiled.static_graph import StaticGraph

SPARE = 7  # [elements]
ALIGN = 16  # [elements] between places, so that rows start where vector registers like it


@dataclass(eq=False)
class _Place:
    """Scratch memory of a value, and of those that lie in it."""

    kind: str
    start: int
    end: int
    node: int
    """The node that it was made for."""
    names: set[str] = field(default_factory=set)


@dataclass(frozen=True)
class Ref:
    """Place of a value's numbers, in row-major order."""

    dtype: np.dtype[Any]
    base: str
    offset: int = 0
    place: _Place | None = None

    @property
    def c_type(self) -> str:
        return c_type(self.dtype)

    def __str__(self) -> str:
        return f"{self.base} + {self.offset}" if self.offset else self.base

    def at(self, offset: int) -> Ref:
        """Return the place `offset` elements further on."""
        return replace(self, offset=self.offset + offset)


def c_type(dtype: np.dtype[Any]) -> str:
    """Return C's type. Raises UnsupportedError if there is none (half precision, text)."""
    if dtype.name not in C_TYPES:
        raise UnsupportedError(f"values of type {dtype.name} in the policy's graph cannot be compiled to C")
    return C_TYPES[dtype.name]


class Program:
    """Statements of one function that computes a static graph."""

    def __init__(self, graph: StaticGraph, inputs: Mapping[str, str], outputs: Collection[str]) -> None:
        """`inputs` are C expressions for the graph's inputs; `outputs` are needed until the end."""
        self.graph = graph
        self.kernels: set[str] = set()
        self.lines: list[str] = []
        self.scratch: dict[str, int] = {}
        """Elements of scratch memory by C type."""
        self._constants: dict[tuple[str, bytes], tuple[str, NDArray[Any]]] = {}
        self._refs = {name: Ref(graph.values[name].dtype, expression) for name, expression in inputs.items()}
        self._places: list[_Place] = []
        self._node = -1
        self._last_read = {name: number for number, node in enumerate(graph.nodes) for name in node.inputs}
        self._last_read |= dict.fromkeys(outputs, len(graph.nodes))

    def value(self, name: str) -> NDArray[Any]:
        """Return a value's example; of a constant, the constant itself."""
        return self.graph.values[name]

    def is_constant(self, name: str) -> bool:
        return name in self.graph.constants

    def begin(self, what: str) -> None:
        """Begin the statements of the next node, with `what` as a comment."""
        self._node += 1
        self.emit(f"/* {comment(what)} */")

    def ref(self, name: str) -> Ref:
        """Return where a value lies."""
        if self.is_constant(name):
            return Ref(self.value(name).dtype, self.constant(self.value(name)))
        return self._refs[name]

    def operand(self, name: str) -> str | Ref:
        """Return a constant of one element as a literal, and the place of anything else."""
        array = self.value(name)
        return number(array.ravel()[0]) if self.is_constant(name) and array.size == 1 else self.ref(name)

    def new(self, name: str) -> Ref:
        """Return a place for a value that is computed now."""
        ref = self.temporary(self.value(name).dtype, self.value(name).size)
        self.alias(name, ref)
        return ref

    def alias(self, name: str, ref: Ref) -> None:
        """Let a value lie where another does."""
        self._refs[name] = ref
        if ref.place is not None:
            ref.place.names.add(name)

    def temporary(self, dtype: Any, size: int) -> Ref:
        """Return a place for this node alone: the first that holds no value needed now or later.

        It has room for SPARE more elements, which a kernel may overwrite.
        """
        kind, start, size = c_type(np.dtype(dtype)), 0, size + SPARE
        for other in sorted(self._places, key=lambda place: place.start):
            last = max((self._last_read.get(name, -1) for name in other.names), default=-1)
            if other.kind == kind and max(last, other.node) >= self._node and other.start < start + size:
                start = max(start, -(-other.end // ALIGN) * ALIGN)
        self._places.append(place := _Place(kind, start, start + size, self._node))
        self.scratch[kind] = max(self.scratch.get(kind, 0), place.end)
        return Ref(np.dtype(dtype), f"state->scratch.{kind.removesuffix('_t')}s", start, place)

    def constant(self, array: NDArray[Any], stem: str = "constant") -> str:
        """Return the name of an array constant; equal ones share it."""
        key = (array.dtype.name, array.tobytes())
        if key not in self._constants:
            c_type(array.dtype)
            self._constants[key] = (f"{stem}_{len(self._constants)}", np.ascontiguousarray(array))
        return self._constants[key][0]

    def emit(self, text: str) -> None:
        """Add statements."""
        self.lines += [f"    {line}" for line in text.splitlines()]

    def loop(
        self, shape: Sequence[int], reads: Sequence[tuple[Ref | str, Sequence[int]]], out: Ref,
        out_strides: Sequence[int], body: str,
    ) -> None:  # fmt: skip
        """Emit loops over `shape`; in `body`, {y} is the written element and {0}, {1}, ... the read ones.

        A read is an array with a stride per axis, or an expression that is the same everywhere.
        """
        sizes, strides = _collapse(shape, [*(stride for _, stride in reads), out_strides])
        names, pointers = [], [f"{out.c_type} *restrict y = {out};"]
        for position, (source, _) in enumerate(reads):
            if isinstance(source, Ref):
                pointers.append(f"const {source.c_type} *restrict x{position} = {source};")
            names.append(source if isinstance(source, str) else f"x{position}[{index(strides[position])}]")
        loops = [f"for (int i{d} = 0; i{d} < {size}; i{d}++)" for d, size in enumerate(sizes)]
        lines = [*pointers, *loops, f"    {body.format(*names, y=f'y[{index(strides[-1])}]')}"]
        self.emit("{\n" + "\n".join(f"    {line}" for line in lines) + "\n}")

    def constants_text(self) -> str:
        """Return the definitions of the array constants."""
        return "\n".join(
            f"static const {c_type(array.dtype)} {name}[{max(array.size, 1)}] ALIGNED = {{\n"
            f"{array_text(array) if array.size else '    0'}\n}};"
            for name, array in self._constants.values()
        )


def row_major(shape: Sequence[int]) -> list[int]:
    """Return the stride of each axis, in elements."""
    return [int(np.prod(shape[axis + 1 :])) for axis in range(len(shape))]


def broadcast(shape: Sequence[int], to: Sequence[int]) -> list[int]:
    """Return the strides with which an array of `shape` is read as one of shape `to`."""
    own = [0 if size == 1 else stride for size, stride in zip(shape, row_major(shape), strict=True)]
    return [0] * (len(to) - len(shape)) + own


def index(strides: Sequence[int]) -> str:
    """Return the place of the loops' i0, i1, ... in an array."""
    terms = [f"i{axis}" if stride == 1 else f"{stride} * i{axis}" for axis, stride in enumerate(strides) if stride]
    return " + ".join(terms) or "0"


def _collapse(shape: Sequence[int], strides: Sequence[Sequence[int]]) -> tuple[list[int], list[list[int]]]:
    """Return fewer, longer axes for the same elements in the same order."""
    axes: list[list[int]] = []  # each with its size, then its strides
    for size, *steps in zip(shape, *strides, strict=True):
        if axes and all(outer == step * size for outer, step in zip(axes[-1][1:], steps, strict=True)):
            axes[-1] = [axes[-1][0] * size, *steps]
        elif size != 1:
            axes.append([size, *steps])
    columns = list(map(list, zip(*axes, strict=True))) or [[] for _ in range(len(strides) + 1)]
    return columns[0], columns[1:]
