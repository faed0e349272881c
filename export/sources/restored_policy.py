"""A restored policy: the recipe around its network, the network to trace, and the framework's own way to act."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor, nn

from rlservo.bundle.spaces import Element
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop
from rlservo.export.recipe.trees import Tree


def diverged_weights(module: nn.Module) -> Iterator[str]:
    """Yield the names of weights that show that training diverged: NaN, or infinite where training changes them.

    A mask or a bound may be infinite. Call it before the module is frozen.
    """
    trained = {name for name, weights in module.named_parameters() if weights.requires_grad}
    for name, weights in module.state_dict().items():
        if weights.isnan().any() or (name in trained and not torch.isfinite(weights).all()):
            yield name


class RestoredNetwork(Protocol):
    """A network that can be traced (`policy_graph.TracedNetwork`), and the torch module in it."""

    module: Any
    names: tuple[str, ...]

    def __call__(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]: ...


Elements: TypeAlias = tuple[Element, ...] | Mapping[str, tuple[Element, ...]]


@dataclass(frozen=True)
class ElementNames:
    """Element names in row-major order, empty where unknown, and the environment's control rate [Hz].

    For a nested space, names are grouped by the leaf's tensor name.
    """

    observation: Elements = ()
    action: Elements = ()
    control_rate_hz: float | None = None


@dataclass(frozen=True)
class RestoredPolicy:
    """A policy of any source."""

    recipe: Recipe
    network: RestoredNetwork
    module_class: str
    start_loop: Callable[[], Loop]
    """Start the framework acting step after step, exploration off and filter frozen: the export's reference."""
    agents: tuple[str, ...] = ()
    """The agents it is for, if the environment has several; empty if there is one, or all are alike."""
    elements: ElementNames | None = None
    """Names of its elements in the checkpoint; None if the environment's class has them."""
    untrained_filter: str = ""
    """Reason why the observation filter's statistics are not training's; '' if they are or there is no filter."""
    reference: str = ""
    """What `start_loop` starts, if it is not what the source's own `reference` says."""
    one_by_one: Callable[[], None] | None = None
    """Let the network compute one observation after the other, if it can also compute all at once."""
