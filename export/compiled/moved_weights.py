"""Graph whose weights are moved by their last bit: a measure of the rounding of its sums.

A sum's rounding has the effect of a small change of each of its terms (backward error analysis: N. J. Higham, Accuracy
and Stability of Numerical Algorithms, 2002, section 3.1): of about sqrt(k) roundings for k terms (N. J. Higham and
T. Mary, SIAM J. Sci. Comput. 41, 2019). So what a graph's numbers move by when every weight moves by that much bounds
what another order of addition, or another library, changes. `tolerance.ROUNDING` multiplies it: a weight moves by a
last bit, and by more only in longer sums.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from rlservo.export.compiled.tolerance import MASKED, ROUNDING
from rlservo.policy.ort_session import open_ort_session


def move_by_last_bit(values: NDArray[Any], rng: np.random.Generator, bits: int = 1) -> NDArray[Any]:
    """Return floating-point numbers moved up or down by `bits` times their last bit in single precision."""
    if values.dtype.kind != "f":
        return values
    single, largest = values.astype(np.float32), np.finfo(np.float32).max
    with np.errstate(over="ignore", invalid="ignore"):
        moved = single + rng.choice(np.array([-bits, bits], np.float32), values.shape) * np.spacing(np.abs(single))
    return np.clip(np.where(np.isfinite(single), moved, single), -largest, largest).astype(values.dtype)


def lengths_of_sums(model: onnx.ModelProto, shapes: Mapping[str, Sequence[int]]) -> dict[str, int]:
    """Return for each constant weight of a layer the number of terms of the sums that it is part of."""
    lengths = {}
    for node in model.graph.node:
        for name in node.input[1:]:
            shape = shapes.get(name, ())
            if len(shape) < 2:
                continue
            if node.op_type == "Conv":
                lengths[name] = math.prod(shape[1:])
            elif node.op_type in ("LSTM", "GRU") or any(a.name == "transB" and a.i for a in node.attribute):
                lengths[name] = shape[-1]
            elif node.op_type in ("MatMul", "Gemm"):
                lengths[name] = shape[-2]
    return lengths


class MovedGraph:
    """A graph in onnxruntime with other last bits in all its weights."""

    def __init__(self, model_bytes: bytes, rng: np.random.Generator) -> None:
        model = onnx.load_model_from_string(model_bytes)
        weights = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
        lengths = lengths_of_sums(model, {name: values.shape for name, values in weights.items()})
        for tensor in model.graph.initializer:
            values, bits = weights[tensor.name], math.ceil(math.sqrt(lengths.get(tensor.name, 1)) / ROUNDING)
            if values.dtype == np.float32:
                moved = np.where(np.abs(values) < MASKED, move_by_last_bit(values, rng, bits), values)
                tensor.CopyFrom(numpy_helper.from_array(moved, tensor.name))
        self._names = [output.name for output in model.graph.output]
        with tempfile.TemporaryDirectory(prefix="rlservo-") as folder:
            file = Path(folder) / "policy.onnx"
            onnx.save(model, str(file))
            self._ort_session: Any = open_ort_session(file)

    def __call__(self, feed: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return every output by name."""
        return dict(zip(self._names, self._ort_session.run(self._names, dict(feed)), strict=True))
