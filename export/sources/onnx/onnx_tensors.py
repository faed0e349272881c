"""Use of an ONNX graph's tensors: observations, the action, and the state that each step gives to the next."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import UnsupportedError, UsageError
from rlservo.export.sources.leapp_description import Description, LeappStage, StageTensor

STAGE = "graph"
ACTIONS = ("actions", "action")
ENDS = {"in": "out", "input": "output", "h0": "hn", "c0": "cn"}
"""A part of an input's name, and of the output's that is its value at the next step."""


@dataclass(frozen=True)
class Tensors:
    """The graph as a description of one stage, and its tensors by use."""

    description: Description
    action: StageTensor
    states: Mapping[str, tuple[StageTensor, StageTensor]]
    """Input and output by the state's name, in the order of the graph's inputs."""
    zeros: tuple[StageTensor, ...]
    """Inputs that begin with zeros: the states', and those that the action does not depend on."""
    unused: tuple[str, ...]
    """Inputs and outputs of no use."""


def describe_graph(
    file: Path,
    graph: Any,
    inputs: Mapping[str, NDArray[Any]],
    outputs: Mapping[str, NDArray[Any]],
    uses: Mapping[str, str],
    defaults: Mapping[str, Sequence[Any]],
) -> Tensors:
    """Return the tensors of an ONNX graph, given an example of each, one row, and what the user says of outputs.

    `defaults` are the shapes of inputs that have a value of their own, such as weights. `uses` has for an output
    `action`, `none`, or the input that gets it at the next step. Raises UnsupportedError for tensors other than
    float32, UsageError where names do not tell an output's use.
    """
    for name, target in uses.items():
        if name not in outputs or target not in ("action", "none", *inputs):
            raise UsageError(
                f"--output {name}={target}: {file.name} has the outputs {', '.join(outputs)} and the inputs "
                f"{', '.join(inputs)}; expected OUTPUT=action, OUTPUT=none or OUTPUT=INPUT"
            )
    pairs = dict(_pairs(inputs, outputs, uses))
    left = [name for name in outputs if name not in pairs.values() and uses.get(name) != "none"]
    chosen = (
        [name for name, use in uses.items() if use == "action"] or [name for name in left if name in ACTIONS] or left
    )
    if len(chosen) != 1:
        raise UsageError(
            f"{file.name} has the outputs {', '.join(left) or 'of a state only'}: --output NAME=action says which is "
            "the action"
        )
    for name in left:
        valued = [one for one, shape in defaults.items() if tuple(shape) == outputs[name].shape]
        if name != chosen[0] and valued and name not in uses:
            raise UsageError(
                f"{file.name}: the output '{name}' has the shape of '{valued[0]}', an input with a value of its own: "
                "if the output is that input at the next step, export the model without the value; otherwise give "
                f"--output {name}=none"
            )
        twins = [one for one in inputs if one not in pairs and inputs[one].shape == outputs[name].shape]
        if name != chosen[0] and twins and name not in uses:
            raise UsageError(
                f"{file.name}: the output '{name}' has the shape of the input '{twins[0]}': if it is that input at "
                f"the next step, give --output {name}={twins[0]}, otherwise --output {name}=none"
            )
    read = _inputs_of(graph, [chosen[0], *pairs.values()])
    used = {
        "input": {name: values for name, values in inputs.items() if name in read},
        "output": {name: outputs[name] for name in (chosen[0], *pairs.values())},
    }
    for side, tensors in used.items():
        if wrong := [f"'{name}' is {values.dtype}" for name, values in tensors.items() if values.dtype != np.float32]:
            raise UnsupportedError(f"{file.name}: the {side} {wrong[0]}: only float32 tensors are exported")
    given, gives = ({name: _tensor(name, values) for name, values in each.items()} for each in (inputs, outputs))
    observed: dict[str | None, StageTensor] = {
        name: tensor for name, tensor in given.items() if name not in pairs and name in read
    }
    if not observed:
        raise UnsupportedError(f"{file.name} has no observation: '{chosen[0]}' depends on no input but the state")
    action = gives[chosen[0]]
    for tensor in observed.values():
        if len(tensor.shape) == len(action.shape) == 2 and tensor.shape[0] == action.shape[0] > 1:
            raise UnsupportedError(
                f"{file.name} has a fixed batch of {action.shape[0]} rows ({tensor.name} {list(tensor.shape)}): export "
                "it with one row, or a free batch"
            )
    description = Description(
        file,
        (LeappStage(STAGE, file, "onnx", tuple(given.values()), tuple(gives.values())),),
        observed if len(observed) > 1 else {None: next(iter(observed.values()))},
        {None: action},
        {gives[output].key: (given[name].key,) for name, output in pairs.items()},
        None,
        {},
    )
    states = {_state_name(name): (given[name], gives[pairs[name]]) for name in given if name in pairs}
    zeros = tuple(tensor for name, tensor in given.items() if name not in observed)
    unused = (*(name for name in given if name not in {*pairs, *observed}), *(n for n in left if n != chosen[0]))
    return Tensors(description, action, states, zeros, unused)


def _inputs_of(graph: Any, outputs: Sequence[str]) -> set[str]:
    """Return the names that some outputs are computed from, the graph's inputs among them."""
    needed = set(outputs)
    for node in reversed(graph.node):  # in the order of the computation, by ONNX's specification
        if not needed.isdisjoint(node.output):
            needed.update(node.input)
    return needed


def _pairs(
    inputs: Mapping[str, NDArray[Any]], outputs: Mapping[str, NDArray[Any]], uses: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    """Yield the inputs with the outputs that are their values at the next step."""
    named = {target: name for name, target in uses.items() if target in inputs}
    for name, values in inputs.items():
        output = named.get(name, next((one for one in _next_names(name) if one in outputs and one not in uses), None))
        if output is None:
            continue
        if outputs[output].shape != values.shape:
            if name in named:
                raise UsageError(
                    f"--output {output}={name}: the output has the shape {outputs[output].shape}, the input "
                    f"{values.shape}"
                )
            continue
        yield name, output


def _next_names(name: str) -> Iterator[str]:
    """Yield the names that an output has which is an input's value at the next step: h_out for h_in."""
    parts = re.split(r"([^A-Za-z0-9]+)", name)
    for place, part in enumerate(parts):
        if part in ENDS and (len(parts) > 1 or part in ("h0", "c0")):
            yield "".join([*parts[:place], ENDS[part], *parts[place + 1 :]])


def _state_name(name: str) -> str:
    parts = [part for part in re.split(r"[^A-Za-z0-9]+", name) if part and part not in ("in", "input", "state")]
    return "_".join(parts) or "state"


def _tensor(name: str, values: NDArray[Any]) -> StageTensor:
    return StageTensor(f"{STAGE}/{name}", values.shape, str(values.dtype), "", (), {})
