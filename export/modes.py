"""Find out, by asking, how a distribution's deterministic action comes out of its parameters. It knows no RLlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from gymnasium.spaces import Box
from torch import Tensor

from rlservo.export.errors import UnsupportedError, first_line
from rlservo.export.recipe import Mode, parameter_count
from rlservo.export.trees import Tree, space_leaves, tree_leaves


def find_mode(deterministic: Callable[[Tensor], Tree], name: str, action_space: Any) -> Mode:
    """Return how the deterministic action of distribution `name` comes out of its parameters.

    `deterministic` gives it for parameters `[batch, n]`. RLlib 2.60 sends SAC's bare mean on the new API stack where
    the old one and other versions send its tanh: the class in the checkpoint decides.
    """
    spaces = space_leaves(action_space, "action")
    widths = [parameter_count(space) for space in spaces.values()]
    generator = torch.Generator().manual_seed(0)
    probe = 2.0 * torch.randn((7, sum(widths)), generator=generator)
    try:
        actions = tree_leaves(deterministic(probe.clone()))
    except Exception as error:  # a user's distribution may raise anything
        raise UnsupportedError(
            f"the action distribution {name} does not take {sum(widths)} parameters for {action_space}: "
            f"{first_line(error)}"
        ) from error
    found: set[Mode] = set()
    for space, action, part in zip(spaces.values(), actions, torch.split(probe, widths, dim=-1), strict=True):
        mean = part.chunk(2, dim=-1)[0]
        if not isinstance(space, Box):
            sizes = [int(n) for n in space.nvec] if hasattr(space, "nvec") else [int(space.n)]
            best = torch.stack([torch.argmax(one, dim=-1) for one in torch.split(part, sizes, dim=-1)], dim=-1)
            if torch.equal(best.reshape(action.shape), action):
                continue
        elif torch.equal(action, mean):
            found.add("mean")
            continue
        elif torch.allclose(action, torch.tanh(mean), atol=1e-6):
            found.add("tanh_mean")
            continue
        raise UnsupportedError(
            f"the deterministic action of {name} on {space} is neither its mean, nor the mean's tanh, nor the "
            "largest logit: not exported"
        )
    if len(found) > 1:
        raise UnsupportedError(f"{name} squashes some parts of the action and not others: not exported")
    return found.pop() if found else "argmax"
