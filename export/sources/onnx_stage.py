"""An ONNX model of a network's usual operators as a torch module, so that it can be traced with the steps around it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, inliner, numpy_helper, shape_inference
from torch import Tensor, nn
from torch.nn import functional

from rlservo.errors import CheckpointError, UnsupportedError, first_line
from rlservo.export.sources.onnx_recurrent import gru, lstm

Attributes = Mapping[str, Any]
Node = tuple[str, list[str], list[str], dict[str, Any]]
"""Operator, names of its inputs and outputs, and attributes."""


def _numbers(values: Any) -> list[int]:
    return [int(value) for value in np.asarray(values).ravel()]


def _gemm(a: Attributes, x: Tensor, w: Tensor, b: Tensor | None = None) -> Tensor:
    x, w = (each.transpose(0, 1) if a.get(key) else each for each, key in ((x, "transA"), (w, "transB")))
    alpha, beta = a.get("alpha", 1.0), a.get("beta", 1.0)
    product = x @ w if alpha == 1.0 else (x @ w) * alpha  # a factor 1.0 hides the type from torch's exporter
    if b is None:
        return product
    return product + (b if beta == 1.0 else b * beta)


def _divide(x: Tensor, y: Tensor) -> Tensor:
    return x / y if x.is_floating_point() else torch.div(x, y, rounding_mode="trunc")


def _slice(_: Attributes, x: Tensor, starts: Any, ends: Any, axes: Any = None, steps: Any = None) -> Tensor:
    every = range(len(starts)) if axes is None else axes.tolist()
    strides = [1] * len(starts) if steps is None else steps.tolist()
    if min(strides) < 1:
        raise UnsupportedError("a Slice that goes backwards is not exported")
    parts = [slice(None)] * x.dim()
    for axis, start, end, step in zip(every, starts.tolist(), ends.tolist(), strides, strict=True):
        parts[axis] = slice(start, end, step)
    return x[tuple(parts)]


def _reshape(a: Attributes, x: Tensor, shape: Any) -> Tensor:
    first, *rest = a["shape"] or [0]
    if first == 1 and all(rest):  # the batch, of which the file has one row
        return x.reshape(-1, *rest)
    kept = not a.get("allowzero")  # a zero keeps the axis
    sizes = [x.shape[axis] if size == 0 and kept else size for axis, size in enumerate(_numbers(shape))]
    return x.reshape(sizes)


def _expand(_: Attributes, x: Tensor, shape: Any) -> Tensor:
    sizes = _numbers(shape)
    new = len(sizes) - x.dim()
    sizes = [-1] * -new + [-1 if size == 1 and axis >= new else size for axis, size in enumerate(sizes)]
    return x.expand(sizes)


def _gather(a: Attributes, x: Tensor, places: Any) -> Tensor:
    axis = a.get("axis", 0) % x.dim()
    if not places.ndim:
        if isinstance(places, Tensor):  # computed from the observation
            return x.index_select(axis, places.reshape(1)).squeeze(axis)
        return x.select(axis, int(places))
    chosen = (*[slice(None)] * axis, _tensor(places))
    return x[chosen]


def _clip(a: Attributes, x: Tensor, low: Any = None, high: Any = None) -> Tensor:
    return x.clamp(a.get("min") if low is None else low, a.get("max") if high is None else high)


def _axes(a: Attributes, axes: Any) -> list[int]:
    return _numbers(a.get("axes", ()) if axes is None else axes)


def _unsqueeze(a: Attributes, x: Tensor, axes: Any = None) -> Tensor:
    for axis in sorted(_axes(a, axes)):
        x = x.unsqueeze(axis)
    return x


def _squeeze(a: Attributes, x: Tensor, axes: Any = None) -> Tensor:
    for axis in sorted(_axes(a, axes), reverse=True):
        x = x.squeeze(axis)
    return x


def _split(a: Attributes, x: Tensor, sizes: Any = None) -> tuple[Tensor, ...]:
    axis = a.get("axis", 0)
    if sizes is None and "split" not in a:
        return torch.split(x, math.ceil(x.shape[axis] / a["outputs"]), axis)
    return torch.split(x, _numbers(a["split"] if sizes is None else sizes), axis)


def _reduction(function: Callable[[Tensor, list[int], bool], Tensor]) -> Callable[..., Tensor]:
    def reduced(a: Attributes, x: Tensor, axes: Any = None) -> Tensor:
        over = _axes(a, axes)
        if not over and a.get("noop_with_empty_axes"):
            return x
        return function(x, over or list(range(x.dim())), bool(a.get("keepdims", 1)))

    return reduced


def _cast(a: Attributes, x: Tensor) -> Tensor:
    if a["to"] in (onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16):
        raise UnsupportedError(
            "a graph that computes with half precision is not exported: its sums depend on the batch"
        )
    return x.to(torch.from_numpy(np.zeros(0, helper.tensor_dtype_to_np_dtype(a["to"]))).dtype)


def _convolution(a: Attributes, x: Tensor, w: Tensor, b: Tensor | None = None) -> Tensor:
    axes = x.dim() - 2
    pads = a.get("pads", [0] * 2 * axes)
    if a.get("auto_pad", b"NOTSET") not in (b"NOTSET", b"VALID") or pads[:axes] != pads[axes:]:
        raise UnsupportedError("a Conv whose padding differs from side to side is not exported")
    convolve: Any = (functional.conv1d, functional.conv2d, functional.conv3d)[axes - 1]
    strides, dilations = (list(a.get(name, [1] * axes)) for name in ("strides", "dilations"))
    result: Tensor = convolve(x, w, b, strides, pads[:axes], dilations, a.get("group", 1))
    return result


def _dropout(_: Attributes, x: Tensor, ratio: Any = None, training: Any = None) -> Tensor:  # noqa: ARG001
    if training is not None and bool(training.any()):
        raise UnsupportedError("a Dropout in training mode is not exported")
    return x


def _batch_normalization(
    a: Attributes, x: Tensor, scale: Tensor, bias: Tensor, mean: Tensor, variance: Tensor
) -> Tensor:
    if a.get("training_mode"):
        raise UnsupportedError("a BatchNormalization in training mode is not exported")
    return functional.batch_norm(x, mean, variance, scale, bias, eps=a.get("epsilon", 1e-5))


PLAIN: dict[str, Callable[..., Tensor]] = {
    "Identity": torch.clone, "Relu": torch.relu, "Tanh": torch.tanh, "Sigmoid": torch.sigmoid,
    "Selu": functional.selu, "Softplus": functional.softplus, "Softsign": functional.softsign, "Mish": functional.mish,
    "HardSwish": functional.hardswish, "Erf": torch.erf, "Exp": torch.exp, "Log": torch.log, "Sqrt": torch.sqrt,
    "Reciprocal": torch.reciprocal, "Neg": torch.neg, "Abs": torch.abs, "Sign": torch.sign, "Floor": torch.floor,
    "Ceil": torch.ceil, "Round": torch.round, "Sin": torch.sin, "Cos": torch.cos, "Tan": torch.tan,
    "Asin": torch.asin, "Acos": torch.acos, "Atan": torch.atan, "Add": torch.add, "Sub": torch.sub, "Mul": torch.mul,
    "Div": _divide, "Pow": torch.pow, "MatMul": torch.matmul, "Equal": torch.eq, "Greater": torch.gt,
    "GreaterOrEqual": torch.ge, "Less": torch.lt, "LessOrEqual": torch.le, "And": torch.logical_and,
    "Or": torch.logical_or, "Xor": torch.logical_xor, "Not": torch.logical_not, "Where": torch.where,
}  # fmt: skip
"""Operators without attributes, by ONNX's name."""
OPERATORS: dict[str, Callable[..., Any]] = {
    "Elu": lambda a, x: functional.elu(x, a.get("alpha", 1.0)),
    "LeakyRelu": lambda a, x: functional.leaky_relu(x, a.get("alpha", 0.01)),
    "Gelu": lambda a, x: functional.gelu(x, approximate=a.get("approximate", b"none").decode()),
    "Gemm": _gemm,
    "Conv": _convolution,
    "Clip": _clip,
    "Dropout": _dropout,
    "BatchNormalization": _batch_normalization,
    "Min": lambda _, *parts: reduce(torch.minimum, parts),
    "Max": lambda _, *parts: reduce(torch.maximum, parts),
    "Sum": lambda _, *parts: reduce(torch.add, parts),
    "Slice": _slice,
    "Split": _split,
    "Reshape": _reshape,
    "Expand": _expand,
    "Gather": _gather,
    "Squeeze": _squeeze,
    "Unsqueeze": _unsqueeze,
    "Concat": lambda a, *parts: torch.cat(parts, dim=a["axis"]),
    "Flatten": lambda a, x: x.flatten(a.get("axis", 1)),
    "Transpose": lambda a, x: x.permute(*a["perm"]),
    "Cast": _cast,
    "ArgMax": lambda a, x: x.argmax(a.get("axis", 0), keepdim=bool(a.get("keepdims", 1))),
    "Einsum": lambda a, *parts: torch.einsum(a["equation"].decode(), *parts),
    "Softmax": lambda a, x: x.softmax(a.get("axis", -1)),
    "LogSoftmax": lambda a, x: x.log_softmax(a.get("axis", -1)),
    "ReduceMean": _reduction(lambda x, axes, keep: x.mean(axes, keepdim=keep)),
    "ReduceSum": _reduction(lambda x, axes, keep: x.sum(axes, keepdim=keep)),
    "ReduceProd": _reduction(
        lambda x, axes, keep: reduce(lambda y, axis: y.prod(axis, keepdim=keep), sorted(axes)[::-1], x)
    ),
    "ReduceMax": _reduction(lambda x, axes, keep: x.amax(axes, keepdim=keep)),
    "ReduceMin": _reduction(lambda x, axes, keep: x.amin(axes, keepdim=keep)),
    "ReduceL2": _reduction(lambda x, axes, keep: x.square().sum(axes, keepdim=keep).sqrt()),
    "ReduceSumSquare": _reduction(lambda x, axes, keep: x.square().sum(axes, keepdim=keep)),
    "LayerNormalization": lambda a, x, w, b=None: functional.layer_norm(x, w.shape, w, b, a.get("epsilon", 1e-5)),
    "LSTM": lstm,
    "GRU": gru,
}
"""Attributes and inputs to the output, or a tuple of outputs, as ONNX's specification has them."""
TAKE_NUMBERS = {"Slice", "Split", "Reshape", "Expand", "Gather", "Squeeze", "Unsqueeze"} | {
    kind for kind in OPERATORS if kind.startswith("Reduce")
}
"""Operators that take shapes, axes and indices, whose constants are numbers and not tensors."""


def read_graph(file: Path) -> Any:
    """Return the model in a file as the graph of one row, with the functions of its own written out.

    Raises UnsupportedError for operators of other domains, CheckpointError for a file that is no model.
    """
    try:
        model = inliner.inline_local_functions(onnx.load(str(file)))
    except Exception as error:  # onnx, protobuf and the file system raise several unrelated types
        raise CheckpointError(f"{file} cannot be read as an ONNX model: {first_line(error)}") from error
    for node in model.graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise UnsupportedError(
                f"{file.name} has the operation {node.domain}::{node.op_type}, a custom one that only its own "
                "library runs: leave it out of the exported graph"
            )
    known = [one for one in model.graph.value_info if all(_sizes(one))]  # the others depend on the batch
    del model.graph.value_info[:]
    model.graph.value_info.extend(known)
    for one in model.graph.output:
        if not all(_sizes(one)):
            one.type.tensor_type.ClearField("shape")
    for one in model.graph.input:
        for axis in one.type.tensor_type.shape.dim:
            axis.dim_value = axis.dim_value or 1
    return shape_inference.infer_shapes(model)


class OnnxStage(nn.Module):
    """The graph of a file; it takes and gives tensors in the order of the graph's inputs and outputs."""

    def __init__(self, file: Path) -> None:
        """Raise UnsupportedError for an operator that is not among those above; see also `read_graph`."""
        super().__init__()
        graph = read_graph(file).graph
        self._constants: dict[str, str] = {}
        self._places: dict[str, Any] = {"": None}  # an input that is left out has no name
        for initializer in graph.initializer:
            self._keep(initializer.name, numpy_helper.to_array(initializer))
        shapes = {one.name: _sizes(one) for one in (*graph.input, *graph.value_info, *graph.output)}
        self._nodes: list[Node] = []
        for node in graph.node:
            self._add(file, node, shapes)
        self._inputs = [one.name for one in graph.input if one.name not in self._constants.keys() | self._places.keys()]
        self._outputs = [one.name for one in graph.output]

    def _add(self, file: Path, node: Any, shapes: Mapping[str, list[int]]) -> None:
        """Keep a node; what depends only on shapes and indices is computed at once."""
        kind, inputs, outputs = node.op_type, list(node.input), list(node.output)
        attributes = {each.name: helper.get_attribute_value(each) for each in node.attribute}
        if kind == "Constant":
            self._keep(outputs[0], _constant(**attributes))
        elif kind == "Shape" and all(sizes := shapes.get(inputs[0], [0])):
            self._keep(outputs[0], np.array(sizes[attributes.get("start", 0) : attributes.get("end")]))
        elif kind not in PLAIN and kind not in OPERATORS:
            raise UnsupportedError(
                f"{file.name} has the operation {kind}, which rlservo cannot convert to torch: export the model "
                "without it (LEAPP: with export_with='jit-trace')"
            )
        else:
            attributes |= {"outputs": len(outputs), "shape": shapes.get(outputs[0], [])}
            if all(name in self._places for name in inputs):
                for name, value in _run(kind, attributes, self._places, inputs, outputs).items():
                    self._keep(name, value.numpy())
            else:
                self._nodes.append((kind, inputs, outputs, attributes))

    def _keep(self, name: str, values: Any) -> None:
        """Keep floats as weights, and integers, which are shapes and indices, as they are."""
        if values.dtype.kind != "f":
            self._places[name] = values
            return
        self._constants[name] = f"constant_{len(self._constants)}"
        self.register_buffer(self._constants[name], torch.from_numpy(values.copy()))

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs."""
        values = {**self._places, **{name: getattr(self, buffer) for name, buffer in self._constants.items()}}
        values.update(zip(self._inputs, given, strict=True))
        for kind, inputs, outputs, attributes in self._nodes:
            values.update(_run(kind, attributes, values, inputs, outputs))
        return tuple(_tensor(values[name]) for name in self._outputs)


def _run(
    kind: str, attributes: Attributes, values: Mapping[str, Any], inputs: list[str], outputs: list[str]
) -> dict[str, Any]:
    first, *rest = (values[name] for name in inputs)
    if kind in TAKE_NUMBERS - {"Gather"} and any(isinstance(one, Tensor) for one in rest):
        raise UnsupportedError(
            f"{kind} '{outputs[0]}' takes a size or an axis that depends on the observation: take fixed ones"
        )
    operands = [_tensor(first), *(rest if kind in TAKE_NUMBERS else map(_tensor, rest))]
    result = PLAIN[kind](*operands) if kind in PLAIN else OPERATORS[kind](attributes, *operands)
    return dict(zip(outputs, result if isinstance(result, tuple) else (result,), strict=False))


def _tensor(value: Any) -> Any:
    return torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value


def _constant(**given: Any) -> Any:
    ((name, value),) = given.items()
    if name == "value":
        return numpy_helper.to_array(value)
    return np.asarray(value, np.float32 if name.startswith("value_float") else np.int64)


def _sizes(one: Any) -> list[int]:
    """Return the shape of a value, zeros for sizes that the file leaves open."""
    return [axis.dim_value for axis in one.type.tensor_type.shape.dim]
