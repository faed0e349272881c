"""Mutants of an ONNX graph, by the onnx package alone: every number, attribute, step and order changed in turn."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

SIBLINGS = {
    "Tanh": "Sigmoid", "Sigmoid": "Tanh", "Relu": "Elu", "Elu": "Relu", "Min": "Max", "Max": "Min", "Add": "Sub",
    "Sub": "Add", "Mul": "Div", "Div": "Mul", "ArgMax": "ArgMin", "Sin": "Cos", "Cos": "Sin", "Greater": "Less",
    "Less": "Greater", "Floor": "Ceil", "Ceil": "Floor",
}  # fmt: skip
"""Operators that take each other's place."""
Change = Callable[[onnx.ModelProto], None]


@dataclass(frozen=True)
class GraphMutant:
    """One change of a graph."""

    kind: str
    what: str
    change: Change
    """Make it, in a copy."""

    def of(self, model: onnx.ModelProto) -> onnx.ModelProto:
        """Return the changed graph."""
        changed = copy.deepcopy(model)
        self.change(changed)
        return changed


def graph_mutants(model: onnx.ModelProto, numbers: int) -> Iterator[GraphMutant]:
    """Yield all mutants of a graph; of a tensor with more than `numbers` numbers that many, evenly spread."""
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        for kind, what, changed in _changed_arrays(values, numbers):
            yield GraphMutant(kind, f"{tensor.name} {list(values.shape)}{what}", partial(_set, tensor.name, changed))
    for place, node in enumerate(model.graph.node):
        yield from _node_mutants(place, node, numbers)
    yield from _orders(model)


def _changed_arrays(values: NDArray[Any], numbers: int) -> Iterator[tuple[str, str, NDArray[Any]]]:
    """Yield (kind, place and change, changed array) for one tensor."""
    flat = values.ravel()
    kind = "weight" if values.ndim > 1 else "bias or vector" if values.size > 1 else "constant"
    if values.dtype.kind != "f":
        kind = "shape or index"
    for place in _spread(flat.size, numbers):
        for change, number in _changed_numbers(flat, place):
            changed = flat.copy()
            changed[place] = number
            yield kind, f" at {place}: {change} ({flat[place]} to {number})", changed.reshape(values.shape)
        if place + 1 < flat.size and flat[place] != flat[place + 1]:
            changed = flat.copy()
            changed[[place, place + 1]] = flat[[place + 1, place]]
            yield kind, f" at {place}: swapped with the next", changed.reshape(values.shape)
    if values.ndim > 1 and values.dtype.kind == "f":
        yield from _changed_rows(values, numbers)


def _spread(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` places, evenly spread."""
    return sorted({int(place) for place in np.linspace(0, count - 1, min(count, most))})


def _changed_numbers(flat: NDArray[Any], place: int) -> Iterator[tuple[str, Any]]:
    """Yield (change, number) for one number that differ from it."""
    value = flat[place]
    if flat.dtype.kind == "b":
        yield "inverted", not value
    elif flat.dtype.kind != "f":
        yield from (("1 more", value + 1), ("1 less", value - 1))
    elif not np.isfinite(value) or abs(value) > 1e30:
        yield "a finite number", flat.dtype.type(np.sign(value))
    elif value == 0:
        yield "moved by a tenth of the tensor's spread", flat.dtype.type(0.1 * (np.nan_to_num(flat).std() or 1.0))
    else:
        yield from (("1% more", value * flat.dtype.type(1.01)), ("10% more", value * flat.dtype.type(1.1)))
        yield from (("the other sign", -value), ("zero", flat.dtype.type(0)))


def _changed_rows(values: NDArray[Any], numbers: int) -> Iterator[tuple[str, str, NDArray[Any]]]:
    for axis in range(values.ndim):
        rows = np.moveaxis(values, axis, 0)
        if len(rows) < 2:
            continue
        for row in _spread(len(rows) - 1, max(2, numbers // 8)):
            zeroed, swapped = values.copy(), values.copy()
            np.moveaxis(zeroed, axis, 0)[row] = 0
            np.moveaxis(swapped, axis, 0)[[row, row + 1]] = rows[[row + 1, row]]
            for change, changed in (("dropped", zeroed), ("swapped with the next", swapped)):
                if (changed != values).any():
                    yield "row", f" row {row} of axis {axis}: {change}", changed


def _set(name: str, values: NDArray[Any], model: onnx.ModelProto) -> None:
    (tensor,) = (one for one in model.graph.initializer if one.name == name)
    tensor.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(values), name))


# Steps


def _node_mutants(place: int, node: onnx.NodeProto, numbers: int) -> Iterator[GraphMutant]:
    name = f"step {place} ({node.op_type})"
    for number, attribute in enumerate(node.attribute):
        if attribute.type == onnx.AttributeProto.TENSOR:
            for kind, what, changed in _changed_arrays(numpy_helper.to_array(attribute.t), numbers):
                kind = "constant" if kind == "bias or vector" and changed.size < 2 else kind
                yield GraphMutant(kind, f"{name}{what}", partial(_set_tensor, place, number, changed))
        else:
            for what, setter in _changed_attributes(attribute):
                change = partial(_set_attribute, place, number, setter)
                yield GraphMutant("attribute", f"{name}: {attribute.name} {what}", change)
    if node.op_type in SIBLINGS:
        sibling = SIBLINGS[node.op_type]
        yield GraphMutant("step", f"{name}: {sibling} in its place", partial(_rename, place, sibling))
    if node.op_type != "Constant" and node.input:
        yield GraphMutant("step", f"{name}: left out", partial(_leave_out, place))
    if node.op_type in ("Sub", "Div", "MatMul", "Concat", "Less", "Greater") and len(node.input) > 1:
        yield GraphMutant("step", f"{name}: its first two inputs exchanged", partial(_exchange, place))


def _changed_attributes(attribute: onnx.AttributeProto) -> Iterator[tuple[str, Callable[[onnx.AttributeProto], None]]]:
    if attribute.type == onnx.AttributeProto.FLOAT:
        for change, number in _changed_numbers(np.array([attribute.f], np.float32), 0):
            yield change, lambda one, number=float(number): setattr(one, "f", number)  # type: ignore[misc]
    elif attribute.type == onnx.AttributeProto.INT and attribute.name != "to":
        for step in (-1, 1):
            yield f"{step:+}", lambda one, step=step: setattr(one, "i", one.i + step)  # type: ignore[misc]
    elif attribute.type == onnx.AttributeProto.INTS:
        for index in range(len(attribute.ints)):
            for step in (-1, 1):
                yield f"[{index}] {step:+}", partial(_add, index, step)


def _add(index: int, step: int, attribute: onnx.AttributeProto) -> None:
    attribute.ints[index] += step


def _set_attribute(
    place: int, number: int, setter: Callable[[onnx.AttributeProto], None], model: onnx.ModelProto
) -> None:
    setter(model.graph.node[place].attribute[number])


def _set_tensor(place: int, number: int, values: NDArray[Any], model: onnx.ModelProto) -> None:
    model.graph.node[place].attribute[number].t.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(values)))


def _rename(place: int, op: str, model: onnx.ModelProto) -> None:
    node = model.graph.node[place]
    node.op_type = op
    if op in ("Relu", "Elu"):
        del node.attribute[:]


def _leave_out(place: int, model: onnx.ModelProto) -> None:
    node = model.graph.node[place]
    passed = helper.make_node("Identity", [node.input[0]], [node.output[0]])
    node.CopyFrom(passed)


def _exchange(place: int, model: onnx.ModelProto) -> None:
    node = model.graph.node[place]
    node.input[0], node.input[1] = node.input[1], node.input[0]


# Order


def _orders(model: onnx.ModelProto) -> Iterator[GraphMutant]:
    """Yield mutants that exchange neighbours of an input's or output's last axis, or reverse it, or exchange inputs."""
    initializers = {tensor.name for tensor in model.graph.initializer}
    inputs = [each for each in model.graph.input if each.name not in initializers]
    for tensors, change in ((inputs, _permute_input), (list(model.graph.output), _permute_output)):
        for tensor in tensors:
            sizes = [dim.dim_value for dim in tensor.type.tensor_type.shape.dim]
            if len(sizes) > 1 and sizes[-1] > 1:
                for what, order in _permutations(sizes[-1]):
                    yield GraphMutant("order", f"{tensor.name}: {what}", partial(change, tensor.name, order))
    for first, second in itertools.pairwise(inputs):
        if first.type == second.type:
            yield GraphMutant(
                "order", f"{first.name} and {second.name} exchanged", partial(_exchange_inputs, first.name, second.name)
            )


def _permutations(size: int) -> Iterator[tuple[str, NDArray[np.int64]]]:
    for place in _spread(size - 1, 12):
        order = np.arange(size)
        order[[place, place + 1]] = order[[place + 1, place]]
        yield f"elements {place} and {place + 1} exchanged", order
    if size > 2:
        yield "reversed", np.arange(size)[::-1].copy()


def _permute_input(name: str, order: NDArray[np.int64], model: onnx.ModelProto) -> None:
    for node in model.graph.node:
        _replace(node.input, name, f"{name}_permuted")
    model.graph.node.insert(0, _gather(model, name, f"{name}_permuted", order))


def _permute_output(name: str, order: NDArray[np.int64], model: onnx.ModelProto) -> None:
    """The output alone: other steps go on reading what they read."""
    for node in model.graph.node:
        _replace(node.output, name, f"{name}_in_order")
        _replace(node.input, name, f"{name}_in_order")
    model.graph.node.append(_gather(model, f"{name}_in_order", name, order))


def _gather(model: onnx.ModelProto, source: str, result: str, order: NDArray[np.int64]) -> onnx.NodeProto:
    model.graph.initializer.append(numpy_helper.from_array(order, f"{result}_order"))
    return helper.make_node("Gather", [source, f"{result}_order"], [result], axis=-1)


def _exchange_inputs(first: str, second: str, model: onnx.ModelProto) -> None:
    for node in model.graph.node:
        for old, new in ((first, "exchanged"), (second, first), ("exchanged", second)):
            _replace(node.input, old, new)


def _replace(names: Any, old: str, new: str) -> None:
    for index, name in enumerate(names):
        if name == old:
            names[index] = new
