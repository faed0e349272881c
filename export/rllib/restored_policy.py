"""A policy that RLlib restored: the recipe around its network, the network to trace, and RLlib's own way to act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop
from rlservo.export.recipe.trees import Tree


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
