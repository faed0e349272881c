"""Integer divisions of a graph that could end the process.

The processor traps at a division by zero and when the smallest int32 or int64 is divided by -1; onnxruntime checks for
zero from 1.25 on (Python 3.10 has 1.23 at most), and for -1 never. A divisor is harmless if it is a constant without
these numbers, an absolute value (as in our exports; not where zero is unchecked), a tensor's size, or floating-point.
The types of a graph's values are known to onnxruntime alone: it opens a copy in which each other
divisor passes through an operator for floating-point numbers.
"""

from __future__ import annotations

from collections.abc import Set
from typing import Any

import numpy as np

from rlservo.policy.ort_session import without_telemetry
from rlservo.protobuf_messages import build_messages

# The fields of ONNX's messages (onnx.proto) that are read.
MESSAGES = {
    "Name": ("string name = 1",),
    "Tensor": (
        "int32 data_type = 2",
        "repeated int32 int32_data = 5",
        "repeated int64 int64_data = 7",
        "string name = 8",
        "bytes raw_data = 9",
    ),
    "Node": (
        "repeated string input = 1",
        "repeated string output = 2",
        "string op_type = 4",
        "repeated Attribute attribute = 5",
        "string domain = 7",
    ),
    "Attribute": (
        "string name = 1",
        "int64 i = 3",
        "Tensor t = 5",
        "Graph g = 6",
        "repeated int64 ints = 8",
        "repeated Graph graphs = 11",
        "int32 type = 20",
    ),
    "Graph": ("repeated Node node = 1", "repeated Tensor initializer = 5", "repeated Name input = 11"),
    "Function": ("repeated Node node = 7",),
    "Model": ("Graph graph = 7", "repeated Function functions = 25"),
}
DTYPES: dict[int, np.dtype[Any]] = {6: np.dtype("<i4"), 7: np.dtype("<i8")}  # TensorProto.DataType of those that trap
CHECKS_ZERO = tuple(map(int, without_telemetry().__version__.split(".")[:2])) >= (1, 25)
TRAPPING = (-1,) if CHECKS_ZERO else (-1, 0)
NEVER_TRAPPING = ("Abs", "Shape", "Size") if CHECKS_ZERO else ("Shape", "Size")
SELECTING = ("Gather", "Identity", "Reshape", "Slice", "Squeeze", "Unsqueeze")  # values of their first input
FLOATING_ONLY = "Ceil"
INT = 2  # AttributeProto.AttributeType


def with_floating_divisors(model: bytes) -> bytes | None:
    """Return a serialized ONNX model that onnxruntime opens only if no division in it can trap; None: none can."""
    message = build_messages("rlservo.division", MESSAGES)["Model"].FromString(model)
    bodies = [(message.graph.node, _of_graph(message.graph))]
    bodies += [(function.node, _harmless(function.node)) for function in message.functions]
    changed = 0
    while bodies:
        nodes, harmless = bodies.pop()
        for index, node in reversed([*enumerate(nodes)]):
            inner = [graph for attribute in node.attribute for graph in (attribute.g, *attribute.graphs)]
            bodies += [(graph.node, _of_graph(graph, harmless)) for graph in inner]
            if _is_division(node) and node.input[1] not in harmless:
                changed += 1
                passed, node.input[1] = node.input[1], f"rlservo/divisor{changed}"
                new = type(node)(input=[passed], output=[node.input[1]], op_type=FLOATING_ONLY, domain=node.domain)
                nodes.insert(index, new)
    return message.SerializeToString() if changed else None


def _is_division(node: Any) -> bool:
    if node.domain not in ("", "ai.onnx") or len(node.input) != 2:
        return False
    # With `fmod`, onnxruntime computes in double precision, which does not trap.
    in_floating_point = any(attribute.name == "fmod" and attribute.i for attribute in node.attribute)
    return node.op_type == "Div" or (node.op_type == "Mod" and not in_floating_point)


def _of_graph(graph: Any, outer: Set[str] = frozenset()) -> Set[str]:
    return _harmless(graph.node, outer, graph.initializer, graph.input)


def _harmless(nodes: Any, outer: Set[str] = frozenset(), tensors: Any = (), given: Any = ()) -> Set[str]:
    """Return the names of harmless divisors in a graph; its own names cover those of the graph around it."""
    own = {name for node in nodes for name in node.output} | {value.name for value in given}
    harmless = set(outer) - own - {tensor.name for tensor in tensors}
    harmless |= {tensor.name for tensor in tensors if _lacks_trapping(tensor)} - own
    for node in nodes:
        if _makes_harmless(node, harmless):
            harmless |= set(node.output)
    return harmless


def _makes_harmless(node: Any, harmless: Set[str]) -> bool:
    if node.domain not in ("", "ai.onnx"):
        return False
    if node.op_type in SELECTING:
        return node.input[0] in harmless
    if node.op_type == "Constant":
        return all(_is_harmless(each) for each in node.attribute)
    return node.op_type in NEVER_TRAPPING


def _is_harmless(constant: Any) -> bool:
    """Whether a Constant's attribute holds no trapping number; the field of another kind of attribute reads as 0."""
    numbers = [*constant.ints, *([constant.i] if constant.type == INT else [])]
    return _lacks_trapping(constant.t) and not set(numbers) & set(TRAPPING)


def _lacks_trapping(tensor: Any) -> bool:
    if tensor.data_type not in DTYPES:
        return True
    raw = np.frombuffer(tensor.raw_data, DTYPES[tensor.data_type])
    return not (np.isin(raw, TRAPPING).any() or {*tensor.int32_data, *tensor.int64_data} & {*TRAPPING})
