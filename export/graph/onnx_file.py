"""ONNX file of a policy graph: writing and running it.

Of torch's two exporters the TorchScript-based one comes first: for these graphs it takes 0.2 s where the
torch.export-based one takes 3 s, and the result is as small and as fast. If it lacks an operation (sinh), the other
takes over. Opset 17 or 18 with IR version 8 is read by every onnxruntime from 1.14 on.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from rlservo.errors import UnsupportedError
from rlservo.export.graph.operators import exact_operators
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.why_not_exportable import why_not_onnx
from rlservo.export.recipe.runners import Inputs, Runner
from rlservo.policy.ort_session import open_ort_session

TORCHSCRIPT_OPSET = 17
DYNAMO_OPSET = 18  # its lowest
IR_VERSION = 8


def write_onnx(graph: PolicyGraph, example: Inputs, file: Path) -> None:
    """Write `graph` to `file`, weights inside, the graph's inputs and outputs by name, with a dynamic batch.

    Inputs that nothing reads stay. `example` is two rows of every input. Raises UnsupportedError when an operation of
    the network has no ONNX form.
    """
    try:
        _export(graph, example, file, dynamo=False)
        _finish(file, graph, example)
    except OSError:  # of the file, such as a full disk
        raise
    except Exception as first:  # torch.onnx, onnx and onnxruntime raise several unrelated types
        try:
            _export(graph, example, file, dynamo=True)
            _finish(file, graph, example)
        except Exception as error:
            # The second exporter takes no TorchScript.
            errors = [first] if _has_script(graph) else [error, first]
            raise UnsupportedError(why_not_onnx(graph, example, errors)) from error


def _has_script(graph: PolicyGraph) -> bool:
    return any(isinstance(part, torch.jit.ScriptModule) for part in graph.modules())


def inputs_read(file: Path, *, without: str = "") -> set[str]:
    """Return the names that the graph's outputs are computed from, inputs included; `without` leaves one output out."""
    model = onnx.load(str(file))
    makers = {name: node for node in model.graph.node for name in node.output}
    waiting = [output.name for output in model.graph.output if output.name != without]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += reads(makers[name]) if name in makers else ()
    return found


def reads(node: onnx.NodeProto) -> Iterator[str]:
    """Yield a node's inputs, and the outer inputs of the graphs inside it."""
    yield from node.input
    for attribute in node.attribute:
        for graph in (attribute.g, *attribute.graphs):
            yield from (output.name for output in graph.output)
            for inner in graph.node:
                yield from reads(inner)


def _finish(file: Path, graph: PolicyGraph, example: Inputs) -> None:
    """Check torch's output, which is not always valid ONNX (a logarithm of integers), and finish it.

    torch drops inputs that nothing reads, which TorchScript keeps: they are listed again. onnxruntime opens the file;
    it lacks kernels for some of ONNX, such as most double-precision functions.
    """
    model = onnx.load(str(file))
    model.ir_version = IR_VERSION
    model.producer_name, model.producer_version = "rlservo", ""
    written = {one.name: one for one in model.graph.input}
    del model.graph.input[:]
    for name in graph.input_names:
        values = example[name]
        kind = onnx.helper.np_dtype_to_tensor_dtype(values.dtype)
        missing = onnx.helper.make_tensor_value_info(name, kind, ["batch", *values.shape[1:]])
        model.graph.input.append(written.get(name, missing))
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(file))
    open_ort_session(file)


def _export(graph: PolicyGraph, example: Inputs, file: Path, *, dynamo: bool) -> None:
    inputs, outputs = list(graph.input_names), list(graph.output_names)
    how: dict[str, Any] = {"dynamo": False, "opset_version": TORCHSCRIPT_OPSET}
    how["dynamic_axes"] = {name: {0: "batch"} for name in (*inputs, *outputs)}
    if dynamo:
        how = {"dynamo": True, "opset_version": DYNAMO_OPSET, "external_data": False, "verbose": False}
        how["dynamic_shapes"] = {"inputs": tuple({0: torch.export.Dim("batch")} for _ in inputs)}
    arguments = tuple(torch.from_numpy(example[name]) for name in inputs)
    with _quiet(), exact_operators():
        model: Any = graph
        if not dynamo and _has_script(graph):
            # The exporter's own trace calls no TorchScript; a module that was traced before has it inlined.
            model = torch.jit.freeze(torch.jit.trace(graph, arguments, check_trace=False))  # type: ignore[no-untyped-call]
        torch.onnx.export(
            model,
            arguments,
            str(file),
            input_names=inputs,
            output_names=outputs,
            **how,
        )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep torch's exporters from printing graphs, progress and advice; errors still arrive as exceptions."""
    chatty = logging.getLogger("torch.onnx")
    level = chatty.level
    with warnings.catch_warnings(), _silent_descriptors():
        # The parity gate finds constants baked in by tracing (TracerWarning); the rest is about the exporter's age and
        # internals.
        warnings.simplefilter("ignore")
        chatty.setLevel(logging.ERROR)
        try:
            yield
        finally:
            chatty.setLevel(level)


@contextlib.contextmanager
def _silent_descriptors() -> Iterator[None]:
    """Discard standard output and error: torch's C++ prints the whole graph if it cannot convert it."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [(descriptor, os.dup(descriptor)) for descriptor in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for descriptor, _ in saved:
            os.dup2(nowhere, descriptor)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        for descriptor, copy in saved:
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(nowhere)


def add_metadata(file: Path, properties: Mapping[str, str]) -> None:
    """Put `properties` into the model's metadata_props, where viewers such as netron show them."""
    model = onnx.load(str(file))
    onnx.helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


def run_onnx(file: Path) -> Runner:
    """Return a function that runs the file in onnxruntime on one thread, as a server does."""
    ort_session = open_ort_session(file)
    names = [output.name for output in ort_session.get_outputs()]
    wanted = [node.name for node in ort_session.get_inputs()]

    def run(inputs: Inputs) -> dict[str, NDArray[Any]]:
        values = ort_session.run(names, {name: inputs[name] for name in wanted})
        return {name: np.asarray(value) for name, value in zip(names, values, strict=True)}

    return run
