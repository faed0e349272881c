"""TorchScript file of a policy graph: writing and running it.

TorchScript is what C++ programs with libtorch and ROS nodes load; torch itself calls it deprecated in favour of
torch.export.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from rlservo.errors import UnsupportedError, first_line
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.why_not_exportable import frozen_by_tracing, raised_at, tracer_warning
from rlservo.export.recipe.runners import Inputs, Runner


def write_torchscript(graph: PolicyGraph, example: Inputs, file: Path) -> list[str]:
    """Write `graph` to `file`: its inputs in order, a tuple of its outputs; freezing drops what inference does not use.

    Returns where in the user's own code a number left torch, and is therefore a constant in the graph. Raises
    UnsupportedError when the network cannot be traced.
    """
    with warnings.catch_warnings(record=True) as caught:
        # The parity gate finds constants that tracing baked in; these warnings locate them.
        warnings.simplefilter("always", tracer_warning())
        _ignore_deprecation()
        try:
            with torch.no_grad():
                traced = torch.jit.trace(  # type: ignore[no-untyped-call]  # torch annotates it only in part
                    graph, tuple(torch.from_numpy(example[name]) for name in graph.input_names), check_trace=False
                )
                # To memory first: torch ends the process if it cannot write a file, as on a full disk.
                torch.jit.save(torch.jit.freeze(traced), content := io.BytesIO())
        except Exception as error:  # the network's own forward may raise anything
            raise UnsupportedError(f"the network cannot be traced: {first_line(error)}{raised_at(error)}") from error
    file.write_bytes(content.getbuffer())
    return frozen_by_tracing(caught)


def run_torchscript(file: Path, inputs: Sequence[str], outputs: Sequence[str]) -> Runner:
    """Return a function that runs the file, whose inputs and outputs are called so, in this order."""
    with warnings.catch_warnings():
        _ignore_deprecation()
        script = torch.jit.load(str(file))  # type: ignore[no-untyped-call]  # torch annotates it only in part

    def run(given: Inputs) -> dict[str, NDArray[Any]]:
        with torch.no_grad():
            values = script(*(torch.from_numpy(given[name]) for name in inputs))
        return {name: value.numpy() for name, value in zip(outputs, values, strict=True)}

    return run


def _ignore_deprecation() -> None:
    warnings.filterwarnings("ignore", r"`torch\.jit\.\w+` is (deprecated|not supported)", DeprecationWarning)
