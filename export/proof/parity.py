"""Parity gate: an exported policy gives the framework's own numbers, or it is not written.

Functions from observations to named outputs are compared; with a state, over whole sequences, each side fed with its
own state.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rlservo.bundle.contract import FormatParity, Parity
from rlservo.errors import ParityError
from rlservo.export.proof.differences import ATOL, RTOL, RULE, Comparer, Fault
from rlservo.export.proof.references import Reference
from rlservo.export.recipe.recipe import Recipe, StateLeaf
from rlservo.export.recipe.runners import Inputs, Outputs, Runner
from rlservo.export.recipe.samples import BATCH_SIZES, Batch


class GraphLoop:
    """An exported graph fed with its own state."""

    def __init__(self, run: Runner, state: Sequence[StateLeaf]) -> None:
        self._run = run
        self._state = {f"state_in.{leaf.name}": leaf.initial for leaf in state}
        self._last: Inputs = {}

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return the graph's outputs, its next state among them."""
        outputs = self._run(self.complete(inputs, restart))
        self._last = {name: outputs[name.replace("state_in.", "state_out.", 1)] for name in self._state}
        return outputs

    def complete(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Inputs:
        """Return the inputs with the loop's state."""
        rows = len(restart)
        full = dict(inputs)
        for name, initial in self._state.items():
            start = np.repeat(initial[None], rows, axis=0)
            last = self._last.get(name, start)
            full[name] = np.where(restart.reshape((rows, *[1] * initial.ndim)), start, last).astype(initial.dtype)
        return full


def replay(
    references: Sequence[Reference], run: Runner, state: Sequence[StateLeaf]
) -> Iterator[tuple[Inputs, Outputs]]:
    """Run an exported graph on the reference's batches; yield its full inputs and its outputs for each."""
    loop, size = GraphLoop(run, state), 0
    for reference in references:
        inputs = {name: values.copy() for name, values in reference.batch.inputs.items()}
        restart = reference.batch.restart
        if restart is None:
            yield inputs, run(inputs)
            continue
        if len(restart) != size:
            loop, size = GraphLoop(run, state), len(restart)
        yield loop.complete(inputs, restart), loop.step(inputs, restart)


def prove(
    recipe: Recipe,
    references: Sequence[Reference],
    formats: Mapping[str, Runner],
    labels: Sequence[str] = (),
    reference: str = "",
    comparer: Comparer | None = None,
) -> Parity:
    """Compare every format with the framework's outputs and return the largest differences.

    `labels` name the action's elements for the message; `reference` names the reference for the contract; `comparer`
    compares outputs, by default without an allowance for measured rounding.

    Raises ParityError at the first output that differs, naming element, sample and difference.
    """
    comparer = comparer or Comparer(recipe, references)
    return Parity(
        reference=reference,
        samples=sum(len(reference.batch) for reference in references),
        batch_sizes=BATCH_SIZES,
        rtol=RTOL,
        atol=ATOL,
        rule=RULE,
        formats={name: _prove_format(name, recipe, references, run, comparer, labels) for name, run in formats.items()},
    )


def does_not_run(where: str, error: Exception) -> ParityError:
    """Return the error for a graph that fails on samples."""
    return ParityError(
        f"{where}: the exported graph does not run: {str(error).splitlines()[0]}; as a rule it keeps the number of "
        "observations that it was traced with, as in torch.vmap: compute all rows at once"
    )


def _prove_format(
    name: str,
    recipe: Recipe,
    references: Sequence[Reference],
    run: Runner,
    comparer: Comparer,
    labels: Sequence[str],
) -> FormatParity:
    max_abs = max_rel = 0.0
    replayed = replay(references, run, recipe.state)
    for number, reference in enumerate(references):
        where = f"{name}, a batch of {len(reference.batch)} {reference.batch.kind} observations"
        if reference.batch.restart is not None:
            where += f" (step {number} of the sequences)"
        try:
            got = next(replayed)[1]
        except Exception as error:  # a shape baked into the graph ends in onnxruntime's or torch's own exceptions
            raise does_not_run(where, error) from error
        for output, expected in reference.outputs.items():
            _check_form(where, output, got.get(output), expected, recipe.action_leaves.get(output), reference.framework)
        result = comparer.compare(number, got)
        if result.fault is not None:
            raise _differs(where, result.fault, reference, recipe, labels)
        max_abs, max_rel = max(max_abs, result.max_abs), max(max_rel, result.max_rel)
    return FormatParity(max_abs=max_abs, max_rel=max_rel)


def _check_form(
    where: str, output: str, got: NDArray[Any] | None, expected: NDArray[Any], space: Any, framework: str
) -> None:
    if got is None:
        raise ParityError(f"{where}: the exported graph has no output '{output}'")
    if got.shape != expected.shape:
        raise ParityError(f"{where}: output '{output}' has shape {got.shape}, {framework}'s has {expected.shape}")
    if space is not None:
        dtype = np.dtype(space.dtype) if isinstance(space, Box) else np.dtype(np.int64)
        if got.dtype != dtype:
            raise ParityError(f"{where}: the action is {got.dtype}, the action space has {dtype}")


def _differs(where: str, fault: Fault, reference: Reference, recipe: Recipe, labels: Sequence[str]) -> ParityError:
    details = {
        "output": fault.output, "element": fault.element, "sample": fault.row, "exported": fault.got,
        "reference": fault.expected, "observation": _row(reference.batch, fault.row),
    }  # fmt: skip
    element = "" if fault.element is None else f", element {fault.element}"
    if fault.output == "action" and fault.element is not None and fault.element < len(labels):
        element += f" ({labels[fault.element]})"
    place = f"{where}: output '{fault.output}'{element}, sample {fault.row}"
    own = ", ".join(step.name for step in recipe.user_steps)
    must = f"; torch_forward of {own} must do what the connector does for this agent, and no state may change"
    advice = must if own else ""
    if fault.allowed is None:
        return ParityError(
            f"{place}: the export chooses {fault.got}, {reference.framework} {fault.expected}{advice}", details
        )
    return ParityError(
        f"{place}: the export gives {fault.got:.9g}, {reference.framework} {fault.expected:.9g} (allowed difference "
        f"{fault.allowed:.2g}); {fault.rows} of {len(reference.batch)} samples differ{advice}",
        details,
    )


def _row(batch: Batch, row: int) -> Any:
    rows = {name: values[row].tolist() for name, values in batch.inputs.items()}
    return rows["obs"] if set(rows) == {"obs"} else rows
