"""ONNX graph of one observation: every shape known, constants folded, branches chosen, dead nodes dropped.

onnxruntime itself does this: with a batch of one, its simplified graph has no operator left that computes a size. It
then runs the graph once with every intermediate value as an output, so no operator needs a shape rule here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from rlservo.errors import UnsupportedError
from rlservo.policy.ort_session import open_ort_session


@dataclass(frozen=True)
class Node:
    """One operator whose outputs depend on the observation."""

    op: str
    inputs: tuple[str, ...]
    """Names of values; '' for an absent optional one."""
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    """Defaults included."""
    proto: onnx.NodeProto
    opset: int


@dataclass(frozen=True)
class StaticGraph:
    """Nodes in the order they are computed, and an example of every value; of a constant, its value."""

    nodes: tuple[Node, ...]
    values: Mapping[str, NDArray[Any]]
    constants: Collection[str]


def refused(op: str, why: str = "") -> UnsupportedError:
    """Return the error for an operator that has no C."""
    what = f"the operator {op} of the policy's graph cannot be compiled to C"
    return UnsupportedError(f"{what}{f': {why}' if why else ''}", {"operator": op})


def read_static_graph(model_bytes: bytes, outputs: Sequence[str], example: Mapping[str, NDArray[Any]]) -> StaticGraph:
    """Return the part of a serialized model that computes `outputs`, for the one observation in `example`.

    `example` has every input of the graph by name, each `[1, ...]`. Raises UnsupportedError for another domain's
    operators and for values that are not tensors, such as those of branches and loops that depend on the observation.
    """
    model = onnx.load_model_from_string(model_bytes)
    wanted = [output for output in model.graph.output if output.name in outputs]
    del model.graph.output[:]
    model.graph.output.extend(wanted)
    for given in model.graph.input:
        given.type.tensor_type.shape.dim[0].dim_value = 1
    with tempfile.TemporaryDirectory(prefix="rlservo-") as folder:
        file, simplified = Path(folder) / "policy.onnx", Path(folder) / "simplified.onnx"
        onnx.save(model, str(file))
        open_ort_session(file, simplified=simplified)
        model = onnx.load(str(simplified))
        kept = _needed(model.graph, outputs)
        names = [name for node in kept for name in node.output if name]
        del model.graph.output[:]
        model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
        onnx.save(model, str(file))
        ort_session = open_ort_session(file)
    feed = {each.name: example[each.name] for each in ort_session.get_inputs()}
    computed: Sequence[Any] = ort_session.run(names, feed) if names else []
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    values = {**dict(zip(names, computed, strict=True)), **constants, **example}
    opset = next((each.version for each in model.opset_import if each.domain in ("", "ai.onnx")), 1)
    return StaticGraph(tuple(_node(each, values, opset) for each in kept), values, {"", *constants})


def _needed(graph: onnx.GraphProto, outputs: Sequence[str]) -> list[onnx.NodeProto]:
    needed, kept = set(outputs), []
    for node in reversed(graph.node):
        if not needed.isdisjoint(node.output):
            needed.update(node.input)
            kept.append(node)
    return kept[::-1]


def _node(node: onnx.NodeProto, values: Mapping[str, Any], opset: int) -> Node:
    foreign = node.domain not in ("", "ai.onnx")
    if foreign or not all(isinstance(values[name], np.ndarray) for name in node.output if name):
        raise refused(f"{node.domain}.{node.op_type}" if foreign else node.op_type)
    known = onnx.defs.get_schema(node.op_type, opset).attributes.values()
    attributes = {
        each.name: helper.get_attribute_value(each.default_value) for each in known if each.default_value.name
    }
    attributes |= {each.name: helper.get_attribute_value(each) for each in node.attribute}
    return Node(node.op_type, tuple(node.input), tuple(node.output), attributes, node, opset)
