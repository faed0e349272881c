"""Observation and action spaces as the contract writes them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

Size: TypeAlias = Annotated[int, Field(ge=1)]
Shape: TypeAlias = tuple[Size, ...]


class FrozenModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Axis: TypeAlias = Literal["", "x", "y", "z", "w"]
Quantity: TypeAlias = Literal[
    "joint position", "relative joint position", "joint velocity", "joint effort", "position", "quaternion",
    "direction", "distance", "linear velocity", "angular velocity", "gravity", "last action", "raw",
]  # fmt: skip


class Element(FrozenModel):
    """Name, unit and conventions of one number of an observation or an action; what is left out is unknown."""

    name: str
    unit: str = Field(default="", description="SI unit such as 'rad', 'm/s'; '1' when dimensionless, '' when unknown")
    quantity: Quantity | None = Field(
        default=None,
        description="For an action, the command ('relative joint position': added to the present one; 'raw': the "
        "network's own numbers). A twist is a linear and an angular velocity",
    )
    joint: str = Field(default="", description="Joint, by its name in the robot's description (URDF)")
    axis: Axis = Field(default="", description="Part of a vector or a quaternion")
    frame: str = Field(
        default="", description="Frame that a position, direction, velocity or quaternion is expressed in"
    )
    scale: float | None = Field(default=None, description="The quantity in SI units is element * scale + offset")
    offset: float | None = Field(default=None, description="In SI units. A clip is given by the space's low and high")

    @model_serializer(mode="wrap")
    def _without_unknown(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out unknown conventions: an observation may have hundreds of elements."""
        known = serialize(self)
        return {key: value for key, value in known.items() if key in ("name", "unit") or value not in ("", None)}


class BoxSpec(FrozenModel):
    """A Gymnasium Box.

    Bounds are one number for all elements or one per element in row-major order; null is unbounded.
    """

    kind: Literal["box"] = "box"
    shape: Shape
    dtype: str
    low: float | tuple[float | None, ...] | None
    high: float | tuple[float | None, ...] | None
    elements: tuple[Element, ...] = Field((), description="Empty, or one per element in row-major order")

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), each of the space's shape, with infinities where unbounded."""

        def fill(bound: float | tuple[float | None, ...] | None, infinity: float) -> NDArray[np.float64]:
            if isinstance(bound, tuple):
                flat = np.array([infinity if b is None else b for b in bound], dtype=np.float64)
                return flat.reshape(self.shape)
            return np.full(self.shape, infinity if bound is None else bound, dtype=np.float64)

        return fill(self.low, -math.inf), fill(self.high, math.inf)


class DiscreteSpec(FrozenModel):
    """A Gymnasium Discrete: the integers start .. start + n - 1."""

    kind: Literal["discrete"] = "discrete"
    n: int = Field(ge=1)
    start: int = 0
    dtype: str = "int64"
    elements: tuple[Element, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    @property
    def size(self) -> int:
        return 1

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), both inclusive and of shape ()."""
        return np.array(self.start, np.float64), np.array(self.start + self.n - 1, np.float64)


class MultiDiscreteSpec(FrozenModel):
    """A Gymnasium MultiDiscrete: element i is one of `nvec[i]` integers from `start[i]` on, in row-major order."""

    kind: Literal["multi_discrete"] = "multi_discrete"
    shape: Shape
    nvec: tuple[Size, ...]
    start: tuple[int, ...]
    dtype: str = "int64"
    elements: tuple[Element, ...] = ()

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), both inclusive and of the space's shape."""
        low = np.array(self.start, np.float64).reshape(self.shape)
        return low, low + np.array(self.nvec, np.float64).reshape(self.shape) - 1


class MultiBinarySpec(FrozenModel):
    """A Gymnasium MultiBinary: every element is 0 or 1."""

    kind: Literal["multi_binary"] = "multi_binary"
    shape: Shape
    dtype: str = "int8"
    elements: tuple[Element, ...] = ()

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), both inclusive and of the space's shape."""
        return np.zeros(self.shape), np.ones(self.shape)


class _NestedSpec(FrozenModel):
    """Common base of the contract's Dict and Tuple."""

    @property
    def shape(self) -> tuple[int, ...]:
        """A nested space is not an array."""
        return ()

    @property
    def size(self) -> int:
        """The elements of all leaves."""
        assert isinstance(self, DictSpec | TupleSpec)
        return sum(leaf.size for leaf in leaf_specs(self, "").values())

    @property
    def elements(self) -> tuple[Element, ...]:
        """Only leaves name elements."""
        return ()


class DictSpec(_NestedSpec):
    """A Gymnasium Dict; its leaves are tensors of their own, called `obs.<key>` or `action.<key>`."""

    kind: Literal["dict"] = "dict"
    spaces: dict[str, SpaceSpec]
    ignored: tuple[str, ...] = Field((), description="Keys of the environment's own space that the graph does not read")


class TupleSpec(_NestedSpec):
    """A Gymnasium Tuple; its leaves are tensors of their own, called `obs.<index>` or `action.<index>`."""

    kind: Literal["tuple"] = "tuple"
    spaces: tuple[SpaceSpec, ...]


LeafSpec: TypeAlias = BoxSpec | DiscreteSpec | MultiDiscreteSpec | MultiBinarySpec
SpaceSpec = Annotated[
    BoxSpec | DiscreteSpec | MultiDiscreteSpec | MultiBinarySpec | DictSpec | TupleSpec, Field(discriminator="kind")
]


def leaf_specs(space: SpaceSpec, name: str) -> dict[str, LeafSpec]:
    """Return every leaf of a space by tensor name, `name` or `name.<path>`: Dict keys sorted, as RLlib has them."""
    if space.kind == "dict":  # `isinstance` with a pydantic class runs Python code, once per request
        inside = {key: space.spaces[key] for key in sorted(space.spaces)}
    elif space.kind == "tuple":
        inside = {str(index): child for index, child in enumerate(space.spaces)}
    else:
        return {name: space}
    return {path: leaf for key, child in inside.items() for path, leaf in leaf_specs(child, f"{name}.{key}").items()}


def element_label(space: LeafSpec, index: int) -> str:
    """Return an element's label for error messages: its index in row-major order, with its name where known."""
    return f"{index} ({space.elements[index].name})" if index < len(space.elements) else str(index)
