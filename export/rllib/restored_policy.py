"""A policy that RLlib restored: the recipe around its network, the network to trace, and RLlib's own way to act."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop
from rlservo.export.recipe.trees import Tree


def diverged_weights(module: nn.Module) -> Iterator[str]:
    """Yield the names of weights that show that training diverged: NaN, or infinite where training changes them.

    A mask or a bound may be infinite. To be asked before the module is frozen.
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


@dataclass(frozen=True)
class RestoredPolicy:
    """A policy of either API stack."""

    recipe: Recipe
    network: RestoredNetwork
    module_class: str
    start_loop: Callable[[], Loop]
    """Start RLlib acting step after step, exploration off and filter frozen: the truth an export is compared with."""
    agents: tuple[str, ...] = ()
    """The agents of an environment with several that it is for; empty where there is one, or all are alike."""
