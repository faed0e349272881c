"""A policy graph run as plain torch, and the same with every weight moved by its last bit."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.recipe.runners import Inputs, Outputs, Runner


def run_eager(graph: PolicyGraph) -> Runner:
    """Return a function that runs the graph in torch."""

    def run(inputs: Inputs) -> Outputs:
        with torch.no_grad():
            values = graph(*(torch.from_numpy(inputs[name]) for name in graph.input_names))
        return {name: value.numpy().copy() for name, value in zip(graph.output_names, values, strict=True)}

    return run


@contextlib.contextmanager
def moved_weights(graph: PolicyGraph, seed: int) -> Iterator[None]:
    """Move every weight of the graph up or down by its last bit, at random, for the time of the context."""
    generator = torch.Generator().manual_seed(seed)
    weights = [weight for weight in graph.parameters() if weight.is_floating_point()]
    kept = [weight.detach().clone() for weight in weights]
    try:
        with torch.no_grad():
            for weight in weights:
                up = torch.rand(weight.shape, generator=generator) < 0.5
                weight.copy_(torch.nextafter(weight, torch.where(up, torch.inf, -torch.inf).to(weight.dtype)))
        yield
    finally:
        with torch.no_grad():
            for weight, before in zip(weights, kept, strict=True):
                weight.copy_(before)
