"""A distribution's kind, and the rule from its parameters to the deterministic action.

If it follows none of the known rules, the distribution itself goes into the graph (mode "given"), if it gives the same
action twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from gymnasium.spaces import Box
from torch import Tensor

from rlservo.errors import UnsupportedError, first_line
from rlservo.export.recipe.recipe import DistributionKind, Mode, parameter_count
from rlservo.export.recipe.trees import Tree, space_leaves, tree_leaves

DISTRIBUTIONS: dict[str, DistributionKind] = {
    "TorchDiagGaussian": "diag_gaussian",
    "TorchSquashedGaussian": "squashed_gaussian",
    "TorchCategorical": "categorical",
    "TorchMultiCategorical": "multi_categorical",
    "TorchMultiDistribution": "multi",
    "TorchMultiActionDistribution": "multi",  # the old API stack's
}
RLLIBS_OWN = ("ray.rllib.core.distribution.", "ray.rllib.models.torch.torch_action_dist")


def distribution_kind(kind: type) -> DistributionKind | None:
    """Return the kind of RLlib's distribution class; None for the user's own, whose samples are not known."""
    return DISTRIBUTIONS.get(kind.__name__) if _is_rllibs(kind) else None


def _is_rllibs(kind: type) -> bool:
    return kind.__module__.startswith(RLLIBS_OWN)


def find_mode(deterministic: Callable[[Tensor], Tree], kinds: Sequence[type], action_space: Any, given: Tensor) -> Mode:
    """Return the rule from a distribution's parameters to its deterministic action.

    `deterministic` gives it for parameters `[batch, n]`, such as the network's own `given`; `kinds` are the
    distribution's class and those of its parts. "given" means that no known rule does, or that a class is the user's
    own, which may follow a rule on few numbers only: the graph evaluates the distribution. Raises UnsupportedError if
    it fails or answers at random.

    RLlib 2.60 sends SAC's bare mean on the new API stack where
    the old one and other versions send its tanh: the class in the checkpoint decides.
    """
    name = kinds[0].__name__
    spaces = space_leaves(action_space, "action")
    widths = [parameter_count(space) for space in spaces.values()]
    generator = torch.Generator().manual_seed(0)
    probe = 2.0 * torch.randn((7, sum(widths)), generator=generator)
    try:
        first, second = (tree_leaves(deterministic(given.clone())) for _ in range(2))
    except Exception as error:  # a user's distribution may raise anything
        raise UnsupportedError(
            f"the action distribution {name} does not take the {given.shape[-1]} numbers that the network gives for "
            f"{action_space}: {first_line(error)}"
        ) from error
    if not all(torch.equal(one, other) for one, other in zip(first, second, strict=True)):
        raise UnsupportedError(
            f"the action distribution {name} draws its deterministic action at random: an export can only be proven if "
            "it gives the same action each time"
        )
    if given.shape[-1] != sum(widths) or not all(map(_is_rllibs, kinds)):
        return "given"
    actions = tree_leaves(deterministic(probe.clone()))
    found: set[Mode] = set()
    for space, action, part in zip(spaces.values(), actions, torch.split(probe, widths, dim=-1), strict=True):
        if (mode := _known(space, action, part)) is None:
            return "given"
        found.add(mode)
    found.discard("argmax")
    if len(found) > 1:
        return "given"
    return found.pop() if found else "argmax"


def _known(space: Any, action: Tensor, part: Tensor) -> Mode | None:
    """Return the rule from the parameters `part` to `action`."""
    if not isinstance(space, Box):
        sizes = [int(n) for n in space.nvec] if hasattr(space, "nvec") else [int(space.n)]
        best = torch.stack([torch.argmax(one, dim=-1) for one in torch.split(part, sizes, dim=-1)], dim=-1)
        return "argmax" if best.numel() == action.numel() and torch.equal(best.reshape(action.shape), action) else None
    mean = part.chunk(2, dim=-1)[0]
    if torch.equal(action, mean):
        return "mean"
    return "tanh_mean" if action.shape == mean.shape and torch.allclose(action, torch.tanh(mean), atol=1e-6) else None
