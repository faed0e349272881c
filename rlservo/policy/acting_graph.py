"""Graph without the value head, which no action needs.

onnxruntime computes every output of a graph, requested or not. A value head is as large as the rest, and its weights
displace the rest from the processor's cache: with two hidden layers of 256 it took a third of an action's time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rlservo.bundle.contract import VALUE
from rlservo.protobuf_messages import build_messages

# The fields of ONNX's messages (onnx.proto) that are read; other fields are kept unchanged.
MESSAGES = {
    "Name": ("string name = 1",),
    "Tensor": ("string name = 8",),
    "Node": ("repeated string input = 1", "repeated string output = 2", "repeated Attribute attribute = 5"),
    "Attribute": ("Graph g = 6", "repeated Graph graphs = 11"),
    "Graph": (
        "repeated Node node = 1",
        "repeated Tensor initializer = 5",
        "repeated Name input = 11",
        "repeated Name output = 12",
    ),
    "Model": ("Graph graph = 7",),
}


def without_value(model: bytes) -> bytes:
    """Return a serialized ONNX model without its output `value` and its nodes."""
    message = build_messages("rlservo.onnx", MESSAGES)["Model"].FromString(model)
    graph = message.graph
    _drop(graph.output, lambda output: output.name == VALUE)
    makers = {name: node for node in graph.node for name in node.output}
    needed: set[str] = set()
    waiting = [output.name for output in graph.output]
    while waiting:
        name = waiting.pop()
        if name and name not in needed:
            needed.add(name)
            waiting += _inputs(makers[name]) if name in makers else ()
    _drop(graph.node, lambda node: needed.isdisjoint(node.output))
    dropped = {tensor.name for tensor in graph.initializer} - needed
    for tensors in (graph.initializer, graph.input):  # an initializer may also be listed as an input with a default
        _drop(tensors, lambda tensor: tensor.name in dropped)
    serialized: bytes = message.SerializeToString()
    return serialized


def _inputs(node: Any) -> Iterator[str]:
    """Yield a node's inputs, and the possible outer inputs of the graphs inside it."""
    yield from node.input
    for attribute in node.attribute:
        for graph in (attribute.g, *attribute.graphs):
            yield from (output.name for output in graph.output)
            for inner in graph.node:
                yield from _inputs(inner)


def _drop(field: Any, is_to_go: Callable[[Any], bool]) -> None:
    """Delete messages of a repeated field."""
    for index in reversed(range(len(field))):
        if is_to_go(field[index]):
            del field[index]
