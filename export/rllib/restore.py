"""Restore a checkpoint of either API stack into the form that the exporter works with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray
from torch import Tensor, nn

from rlservo.export.checkpoints.location import CheckpointFiles
from rlservo.export.checkpoints.old_location import OldStackFiles
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Inputs, Loop
from rlservo.export.recipe.trees import Tree


class RestoredNetwork(Protocol):
    """A network that can be traced (`policy_graph.TracedNetwork`), and the torch module in it."""

    module: nn.Module
    names: tuple[str, ...]
    given: int

    def __call__(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]: ...


class Restored(Protocol):
    """A restored policy: the recipe around its network, the network for tracing, and RLlib's own way to act."""

    @property
    def recipe(self) -> Recipe: ...

    @property
    def network(self) -> RestoredNetwork: ...

    @property
    def module_class(self) -> str: ...

    @property
    def agents(self) -> tuple[str, ...]:
        """Which agents of an environment with several it is for; empty where there is one, or all are alike."""
        ...

    def reference(self, inputs: Inputs) -> dict[str, NDArray[Any]]:
        """Return what RLlib itself computes for raw observations `[batch, ...]` by input name, by output name."""
        ...

    def loop(self) -> Loop:
        """Return RLlib acting step after step."""
        ...


def restore(
    files: CheckpointFiles | OldStackFiles, app_dir: Path, notify: Callable[[str], None], *, value: bool = True
) -> Restored:
    """Restore one policy; the user's own classes are in `app_dir`. `value` False leaves the value head out.

    Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
    """
    # Here and not at the top: RLlib takes seconds to import, and a wrong path should not have to wait for it.
    if isinstance(files, OldStackFiles):
        from rlservo.export.rllib.old_stack import load_old_stack

        return load_old_stack(files, app_dir, notify, value=value)
    from rlservo.export.rllib.new_stack import load_checkpoint

    return load_checkpoint(files, notify, value=value)
