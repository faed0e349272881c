"""Operators whose computing time an observation could decide: sizes, repetitions and branches taken from data.

Every other operator takes about as long for each observation as for the one that is timed when a policy is loaded. A
value depends on data if it is computed from an input of the graph, except by `Shape` and `Size`: without such operators
they depend on the number of observations alone. Where a name is defined twice, any definition counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rlservo.protobuf_messages import build_messages

# The fields of ONNX's messages (onnx.proto) that are read.
MESSAGES = {
    "Name": ("string name = 1",),
    "Node": (
        "repeated string input = 1",
        "repeated string output = 2",
        "string name = 3",
        "string op_type = 4",
        "repeated Attribute attribute = 5",
        "string domain = 7",
    ),
    "Attribute": ("Graph g = 6", "repeated Graph graphs = 11"),
    "Graph": ("repeated Node node = 1", "repeated Name input = 11", "repeated Name output = 12"),
    "Function": (
        "string name = 1",
        "repeated string input = 4",
        "repeated string output = 5",
        "repeated Node node = 7",
        "string domain = 10",
    ),
    "Model": ("Graph graph = 7", "repeated Function functions = 25"),
}
ALL = range(1 << 10)
DECIDING: dict[str, range | tuple[int, ...]] = {
    # By operator, the inputs that decide about sizes, repetitions or a branch, in any version of it.
    "AffineGrid": (1,), "BeamSearch": ALL, "BlackmanWindow": ALL, "CenterCropPad": (1,), "Col2Im": (1, 2),
    "Compress": (1,), "ConstantOfShape": ALL, "CropAndResize": (3,), "DFT": (1, 2), "DynamicTimeWarping": ALL,
    "Expand": (1,), "GreedySearch": ALL, "HammingWindow": ALL, "HannWindow": ALL, "If": ALL, "Loop": (0, 1),
    "MaxUnpool": (2,), "MelWeightMatrix": ALL, "NonMaxSuppression": ALL, "NonZero": ALL, "OneHot": (1,), "Pad": (1, 3),
    "Range": ALL, "Reshape": (1,), "Resize": (1, 2, 3), "STFT": (1, 3), "Sampling": ALL, "SequenceAt": (1,),
    "SequenceErase": (1,), "SequenceInsert": (2,), "Slice": (1, 2, 3, 4), "Split": (1,), "SplitToSequence": (1,),
    "Squeeze": (1,), "StringSplit": ALL, "Tile": (1,), "TopK": (1,), "Unique": ALL, "Unsqueeze": (1,), "Upsample": (1,),
    "WhisperBeamSearch": ALL,
}  # fmt: skip
SIZES = ("Shape", "Size")


def deciding_by_data(model: bytes) -> list[str]:
    """Return the operators of a serialized ONNX model whose time may depend on an observation, each named once."""
    return _Values(build_messages("rlservo.dependence", MESSAGES)["Model"].FromString(model)).deciding()


class _Values:
    """Names of a model's values that depend on data."""

    def __init__(self, model: Any) -> None:
        self._functions = {(function.domain, function.name): function for function in model.functions}
        self._nodes = [*_nodes(model.graph.node)]
        for function in model.functions:
            self._nodes += _nodes(function.node)
        self._dependent = {value.name for value in model.graph.input}
        count = -1
        while count != len(self._dependent):
            count = len(self._dependent)
            for node in self._nodes:
                self._follow(node)

    def deciding(self) -> list[str]:
        found: dict[str, None] = {}
        for node in self._nodes:
            deciding = DECIDING.get(node.op_type, ())
            decides = any(name in self._dependent for at, name in enumerate(node.input) if at in deciding)
            if node.op_type == "Loop":  # whether it goes on
                decides |= any(body.output[0].name in self._dependent for body in _bodies(node) if body.output)
            if decides:
                found[f"{node.op_type} '{node.name or node.output[0]}'"] = None
        return [*found]

    def _any(self, names: Any) -> bool:
        return any(name in self._dependent for name in names)

    def _follow(self, node: Any) -> None:
        """Add the values that depend on data by one node."""
        depends = self._any(node.input) and node.op_type not in SIZES
        for body in _bodies(node):
            self._enter(node, body)
            depends |= self._any(value.name for value in body.output)
        function = self._functions.get((node.domain, node.op_type))
        if function is not None:
            self._dependent.update(
                inner for inner, given in zip(function.input, node.input, strict=False) if given in self._dependent
            )
            depends |= self._any(function.output)
        if depends:
            self._dependent.update(name for name in node.output if name)

    def _enter(self, node: Any, body: Any) -> None:
        """Add the inputs of a loop's body: what is given, and what its last iteration carries."""
        first = (
            1 if node.op_type == "Loop" else 0
        )  # a body's outputs begin with its condition, its inputs with a number
        carried = {at + first: value.name for at, value in enumerate(body.output)}
        for at, value in enumerate(body.input):
            given = node.input[at] if at < len(node.input) else ""
            if given in self._dependent or carried.get(at) in self._dependent:
                self._dependent.add(value.name)


def _bodies(node: Any) -> list[Any]:
    return [graph for attribute in node.attribute for graph in (attribute.g, *attribute.graphs) if graph.ByteSize()]


def _nodes(nodes: Any) -> Iterator[Any]:
    """Yield nodes, and those of graphs inside them."""
    for node in nodes:
        yield node
        for body in _bodies(node):
            yield from _nodes(body.node)
