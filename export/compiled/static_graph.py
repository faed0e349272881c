"""ONNX graph of one observation: every shape known, constants folded, branches chosen, dead nodes dropped.

onnxruntime itself computes what is constant and how large everything is: the graph is run once on a batch of one, with
every intermediate value as an output. So no operator needs a shape rule here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper

from rlservo.export.contract.errors import UnsupportedError
from rlservo.export.contract.ort_session import open_ort_session

RANDOM = {"RandomNormal", "RandomUniform", "RandomNormalLike", "RandomUniformLike", "Multinomial", "Bernoulli"}


@dataclass(frozen=True)
class Node:
    """One operator whose outputs depend on the observation."""

    op: str
    inputs: tuple[str, ...]
    """Names of values; '' where an optional one is absent."""
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    opset: int


@dataclass(frozen=True)
class StaticGraph:
    """Nodes in the order they are computed, and an example of every value; of a constant, its value."""

    nodes: tuple[Node, ...]
    values: Mapping[str, NDArray[Any]]
    constants: Collection[str]
    inputs: tuple[str, ...]
    """Those that something reads."""


def read_static_graph(model_bytes: bytes, outputs: Sequence[str], example: Mapping[str, NDArray[Any]]) -> StaticGraph:
    """Return the part of a serialized model that computes `outputs`, for the one observation in `example`.

    `example` has every input of the graph by name, each `[1, ...]`. Raises UnsupportedError for another domain's
    operators, for branches and loops that depend on the observation, and for values that are no tensors.
    """
    model = onnx.load_model_from_string(model_bytes)
    if model.functions:
        from onnx.inliner import inline_local_functions

        model = inline_local_functions(model)
    graph = model.graph
    opset = next((entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")), 1)
    initial = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    while True:
        _keep_needed(graph, outputs)
        values = {**_run_all(model, example), **initial, **example}
        constants = _constants(graph, set(initial), set(example))
        branch = next((node for node in graph.node if node.op_type == "If" and node.input[0] in constants), None)
        if branch is None:
            break
        _inline(graph, branch, bool(values[branch.input[0]]))
    nodes: list[Node] = []
    for node in graph.node:
        if all(name in constants for name in node.output if name):
            continue
        name = f"{node.domain}.{node.op_type}" if node.domain not in ("", "ai.onnx") else node.op_type
        if name != node.op_type or not all(isinstance(values.get(out), np.ndarray) for out in node.output if out):
            raise UnsupportedError(f"the operator {name} of the policy's graph cannot be compiled to C")
        attributes = {one.name: helper.get_attribute_value(one) for one in node.attribute}
        nodes.append(Node(name, tuple(node.input), tuple(node.output), attributes, opset))
    read = {name for node in nodes for name in node.inputs} | set(outputs)
    return StaticGraph(tuple(nodes), values, constants, tuple(name for name in example if name in read))


def _keep_needed(graph: onnx.GraphProto, outputs: Sequence[str]) -> None:
    """Drop the nodes that no wanted output depends on."""
    needed, kept = set(outputs), []
    for node in reversed(graph.node):
        if not needed.isdisjoint(node.output):
            needed.update(_read_by(node))
            kept.append(node)
    del graph.node[:]
    graph.node.extend(reversed(kept))


def _read_by(node: onnx.NodeProto) -> Iterator[str]:
    yield from node.input
    for attribute in node.attribute:
        for inner in (attribute.g, *attribute.graphs):
            yield from (output.name for output in inner.output)
            for other in inner.node:
                yield from _read_by(other)


def _run_all(model: onnx.ModelProto, example: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return every node's outputs for the example."""
    names = [name for node in model.graph.node for name in node.output if name]
    probe = onnx.ModelProto()
    probe.CopyFrom(model)
    del probe.graph.output[:]
    probe.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    with tempfile.TemporaryDirectory(prefix="rlservo-") as folder:
        file = Path(folder) / "probe.onnx"
        onnx.save(probe, str(file))
        ort_session = open_ort_session(file)
    feed = {node.name: example[node.name] for node in ort_session.get_inputs()}
    computed: Sequence[Any] = ort_session.run(names, feed) if names else []
    return dict(zip(names, computed, strict=True))


def _constants(graph: onnx.GraphProto, initial: set[str], inputs: set[str]) -> set[str]:
    """Return the values that are the same for every observation; sizes are, with a batch of one."""
    constants = {""} | (initial - inputs)
    for node in graph.node:
        sized = node.op_type in ("Shape", "Size")
        if node.op_type not in RANDOM and (sized or all(name in constants for name in _read_outside(node))):
            constants.update(node.output)
    return constants


def _read_outside(node: onnx.NodeProto) -> set[str]:
    """Return what a node reads that it does not make itself, in the graphs inside it."""
    made = {
        name
        for attribute in node.attribute
        for inner in (attribute.g, *attribute.graphs)
        for other in inner.node
        for name in other.output
    }
    return set(_read_by(node)) - made


def _inline(graph: onnx.GraphProto, branch: onnx.NodeProto, chosen: bool) -> None:
    """Put the nodes of the branch that is always taken in the place of an If."""
    inner = next(one.g for one in branch.attribute if one.name == ("then_branch" if chosen else "else_branch"))
    position = list(graph.node).index(branch)
    made = {name for node in inner.node for name in node.output}
    names = {name: f"{branch.output[0]}/{name}" for name in made}
    nodes: list[onnx.NodeProto] = []
    for tensor in inner.initializer:
        nodes.append(helper.make_node("Constant", [], [f"{branch.output[0]}/{tensor.name}"], value=tensor))
        names[tensor.name] = f"{branch.output[0]}/{tensor.name}"
    for node in inner.node:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        copy.input[:] = [names.get(name, name) for name in node.input]
        copy.output[:] = [names.get(name, name) for name in node.output]
        nodes.append(copy)
    for inside, outside in zip(inner.output, branch.output, strict=True):
        nodes.append(helper.make_node("Identity", [names.get(inside.name, inside.name)], [outside]))
    kept = [*list(graph.node)[:position], *nodes, *list(graph.node)[position + 1 :]]
    del graph.node[:]
    graph.node.extend(kept)
