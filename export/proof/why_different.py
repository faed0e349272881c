"""Reasons why an exported graph differs from the trainer's own numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rlservo.export.proof.parity import ATOL, RTOL, Reference
from rlservo.export.recipe.runners import Loop, first_step

ALONE = 4  # samples that are also shown to the framework one at a time


def why_different(start_loop: Callable[[], Loop], references: Sequence[Reference], frozen: Sequence[str]) -> str:
    """Return a clause on why a graph may differ from the framework's own numbers; '' if nothing is found."""
    if sample := _depends_on_batch(start_loop, references):
        return (
            f"{references[0].framework}'s own action for sample {sample[0]} changes when it is computed alone: the "
            "network's result depends on the other observations of the batch, which cannot be exported"
        )
    if frozen:
        return (
            f"tracing froze what the network does outside torch at {', '.join(frozen[:3])}: use torch's own operations "
            "there (torch.where for an 'if')"
        )
    return ""


def _depends_on_batch(start_loop: Callable[[], Loop], references: Sequence[Reference]) -> list[int]:
    """Return a sample whose action changes without the rest of its batch, if there is one."""
    for reference in references:
        batch = reference.batch
        if batch.restart is not None or len(batch) < ALONE:
            continue
        for row in range(ALONE):
            inputs = {name: values[row : row + 1].copy() for name, values in batch.inputs.items()}
            alone = first_step(start_loop(), inputs)
            for name, expected in reference.outputs.items():
                if not np.allclose(
                    np.nan_to_num(alone[name][0].astype(np.float64)),
                    np.nan_to_num(expected[row].astype(np.float64)),
                    rtol=100 * RTOL,
                    atol=100 * ATOL,
                ):
                    return [row]
        break
    return []
