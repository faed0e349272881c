"""An ONNX model of a network's usual operators as a torch module, so that it can be traced with the steps around it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from rlservo.export.contract.errors import UnsupportedError

Attributes = Mapping[str, Any]


def _gemm(a: Attributes, x: Tensor, w: Tensor, b: Tensor | None = None) -> Tensor:
    x, w = (each.transpose(0, 1) if a.get(key) else each for each, key in ((x, "transA"), (w, "transB")))
    product: Tensor = a.get("alpha", 1.0) * (x @ w)
    return product if b is None else product + b * a.get("beta", 1.0)


def _slice(_: Attributes, x: Tensor, starts: Any, ends: Any, axes: Any = None, steps: Any = None) -> Tensor:
    every = range(len(starts)) if axes is None else axes.tolist()
    strides = [1] * len(starts) if steps is None else steps.tolist()
    if min(strides) < 1:
        raise UnsupportedError("a Slice that goes backwards is not exported")
    parts = [slice(None)] * x.dim()
    for axis, start, end, step in zip(every, starts.tolist(), ends.tolist(), strides, strict=True):
        parts[axis] = slice(start, end, step)
    return x[tuple(parts)]


def _reshape(_: Attributes, x: Tensor, shape: Any) -> Tensor:
    first, *rest = shape.tolist()
    return x.reshape(x.shape[0] if first == 1 else first, *rest)  # a stage is traced with one row


def _gather(a: Attributes, x: Tensor, places: Any) -> Tensor:
    axis = a.get("axis", 0)
    return x.select(axis, int(places)) if not places.ndim else x.index_select(axis, torch.from_numpy(places.copy()))


def _clip(a: Attributes, x: Tensor, low: Any = None, high: Any = None) -> Tensor:
    return x.clamp(a.get("min") if low is None else low, a.get("max") if high is None else high)


def _axes(a: Attributes, axes: Any) -> list[int]:
    return [int(axis) for axis in (a["axes"] if axes is None else axes.tolist())]


def _unsqueeze(a: Attributes, x: Tensor, axes: Any = None) -> Tensor:
    for axis in sorted(_axes(a, axes)):
        x = x.unsqueeze(axis)
    return x


def _squeeze(a: Attributes, x: Tensor, axes: Any = None) -> Tensor:
    for axis in sorted(_axes(a, axes), reverse=True):
        x = x.squeeze(axis)
    return x


PLAIN: dict[str, Callable[..., Tensor]] = {
    "Identity": torch.clone, "Relu": torch.relu, "Tanh": torch.tanh, "Sigmoid": torch.sigmoid,
    "Selu": functional.selu, "Softplus": functional.softplus, "Erf": torch.erf, "Exp": torch.exp, "Log": torch.log,
    "Sqrt": torch.sqrt, "Neg": torch.neg, "Abs": torch.abs, "Sin": torch.sin, "Cos": torch.cos, "Add": torch.add,
    "Sub": torch.sub, "Mul": torch.mul, "Div": torch.div, "Pow": torch.pow, "Min": torch.minimum,
    "Max": torch.maximum, "MatMul": torch.matmul,
}  # fmt: skip
"""Operators without attributes, by ONNX's name."""
OPERATORS: dict[str, Callable[..., Tensor]] = {
    "Elu": lambda a, x: functional.elu(x, a.get("alpha", 1.0)),
    "LeakyRelu": lambda a, x: functional.leaky_relu(x, a.get("alpha", 0.01)),
    "Gelu": lambda a, x: functional.gelu(x, approximate=a.get("approximate", b"none").decode()),
    "Gemm": _gemm,
    "Clip": _clip,
    "Slice": _slice,
    "Reshape": _reshape,
    "Gather": _gather,
    "Squeeze": _squeeze,
    "Unsqueeze": _unsqueeze,
    "Concat": lambda a, *parts: torch.cat(parts, dim=a["axis"]),
    "Flatten": lambda a, x: x.flatten(a.get("axis", 1)),
    "Transpose": lambda a, x: x.permute(*a["perm"]),
    "Softmax": lambda a, x: x.softmax(a.get("axis", -1)),
    "LayerNormalization": lambda a, x, w, b=None: functional.layer_norm(x, w.shape, w, b, a.get("epsilon", 1e-5)),
}
"""Attributes and inputs to the output, as ONNX's specification has them."""


class OnnxStage(nn.Module):
    """The graph of a file; it takes and gives tensors in the order of `inputs` and `outputs`."""

    def __init__(self, file: Path, inputs: list[str], outputs: list[str]) -> None:
        """Raise UnsupportedError for an operator that is not among those above."""
        super().__init__()
        graph = onnx.load(str(file)).graph
        self._inputs, self._outputs = inputs, outputs
        self._constants: dict[str, str] = {}
        self._places: dict[str, Any] = {"": None}  # an input that is left out has no name
        self._nodes = [(node.op_type, list(node.input), node.output[0], _attributes(node)) for node in graph.node]
        for initializer in graph.initializer:
            self._keep(initializer.name, initializer)
        for kind, _, output, attributes in self._nodes:
            if kind == "Constant":
                self._keep(output, attributes["value"])
            elif kind not in PLAIN and kind not in OPERATORS:
                raise UnsupportedError(
                    f"{file} has the operation {kind}, of which no torch form is known here: export the stage with "
                    "export_with='jit-trace'"
                )

    def _keep(self, name: str, tensor: Any) -> None:
        """Keep floats as weights, and integers, which are shapes and indices, as they are."""
        values = numpy_helper.to_array(tensor)
        if values.dtype.kind != "f":
            self._places[name] = values
            return
        self._constants[name] = f"constant_{len(self._constants)}"
        self.register_buffer(self._constants[name], torch.from_numpy(values.copy()))

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs for inputs `[batch, ...]`."""
        values = {**self._places, **{name: getattr(self, buffer) for name, buffer in self._constants.items()}}
        values.update(zip(self._inputs, given, strict=True))
        for kind, inputs, output, attributes in self._nodes:
            if kind != "Constant":
                operands = (values[name] for name in inputs)
                values[output] = PLAIN[kind](*operands) if kind in PLAIN else OPERATORS[kind](attributes, *operands)
        return tuple(values[name] for name in self._outputs)


def _attributes(node: Any) -> dict[str, Any]:
    return {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
