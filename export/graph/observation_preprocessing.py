"""RLlib's env-to-module connectors as torch modules: observation preprocessing in the graph.

Each takes the observation so far, a tree of tensors `[batch, ...]`, and the policy's state by name, in which a
stateful one replaces its own entry.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from torch import Tensor, nn

from rlservo.bundle.contract import REWARD
from rlservo.export.recipe.recipe import (
    Flatten,
    FrameStack,
    Logarithm,
    ObservationFilter,
    Preprocess,
    Previous,
    Recipe,
    SineAndCosine,
    Transpose,
    UserStep,
)
from rlservo.export.recipe.trees import Tree, space_leaves, tree_leaves

# The largest part of the filter's mean that may be left out, in units of the filtered observation: below float32's step
# near 1.
NEGLIGIBLE = 1e-7
ATARI_RAM = (128,)


class ObservationNode(nn.Module, abc.ABC):
    """One step before the network."""

    @abc.abstractmethod
    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:
        """Return the next observation."""


def observation_nodes(recipe: Recipe) -> nn.ModuleList:
    """Return one node for each step of the recipe."""
    dtypes = {name: _dtype(space) for name, space in recipe.observation_leaves.items()}
    nodes = nn.ModuleList()
    for step in recipe.steps:
        if isinstance(step, ObservationFilter):
            nodes.append(FilterNode(step, dtypes.get(step.leaf, torch.float32)))
            if not step.keeps_integers:
                dtypes[step.leaf] = torch.float32
        elif isinstance(step, Flatten | Preprocess):
            nodes.append(FlattenNode(step) if isinstance(step, Flatten) else PreprocessNode(step))
            dtypes = {"obs": torch.float32}
        elif isinstance(step, FrameStack):
            nodes.append(FrameStackNode(step))
        elif isinstance(step, Transpose):
            nodes.append(TransposeNode(step))
        elif isinstance(step, Logarithm):
            nodes.append(LogarithmNode(step))
        elif isinstance(step, SineAndCosine):
            nodes.append(SineAndCosineNode(step))
        elif isinstance(step, Previous):
            nodes.append(PreviousNode(step))
        else:
            nodes.append(UserNode(step))
    return nodes


def _dtype(space: Any) -> torch.dtype:
    return torch.from_numpy(np.zeros(0, space.dtype)).dtype if isinstance(space, Box) else torch.int64


def _replace(obs: Tree, leaf: str, function: Callable[[Tensor], Tensor]) -> Tree:
    """Return the observation with `function` applied to one leaf: the whole, or a Dict's key."""
    if leaf == "obs":
        return function(obs)
    key = leaf.removeprefix("obs.")
    return {**obs, key: function(obs[key])}


class FlattenNode(ObservationNode):
    """Every leaf as float32 `[batch, n]`, side by side; Discrete and MultiDiscrete leaves one-hot."""

    def __init__(self, step: Flatten) -> None:
        super().__init__()
        self.without = step.without
        space = step.space
        leaves = {"obs": None} if space is None else space_leaves(space, "obs")
        removed = tuple(f"obs.{key}" for key in step.without)
        kept = [
            leaf for name, leaf in leaves.items() if not any(name == r or name.startswith(f"{r}.") for r in removed)
        ]
        # PrevActionsPrevRewards has an empty Box in its space for what it does not add to the observation.
        kept = [leaf for leaf in kept if leaf is None or 0 not in leaf.shape]
        self.codes: list[Callable[[Tensor], Tensor]] = [_code(leaf) for leaf in kept]

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        if self.without:
            obs = {key: value for key, value in obs.items() if key not in self.without}
        given = [leaf for leaf in tree_leaves(obs) if 0 not in leaf.shape[1:]]
        parts = [code(leaf) for code, leaf in zip(self.codes, given, strict=True)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


def _code(space: Any) -> Callable[[Tensor], Tensor]:
    """Return how FlattenObservations turns one leaf into float32 `[batch, n]`."""
    if isinstance(space, Discrete):
        return lambda leaf: _one_hot(leaf, int(space.n), below_zero=int(space.start) < 0)
    if isinstance(space, MultiDiscrete):
        sizes = [int(n) for n in space.nvec]
        below = bool((np.asarray(space.start) < 0).any())
        return lambda leaf: torch.cat([_one_hot(leaf[:, i], n, below_zero=below) for i, n in enumerate(sizes)], dim=-1)
    return lambda leaf: as_dtype(leaf.flatten(1) if leaf.dim() > 1 else leaf.unsqueeze(1), torch.float32)


def _one_hot(leaf: Tensor, depth: int, *, below_zero: bool) -> Tensor:
    """RLlib's numpy indexing: an index below zero counts from the end."""
    index = leaf.long()
    if below_zero:
        index = torch.remainder(index, depth)
    return torch.eq(index.unsqueeze(-1), torch.arange(depth)).float()


class PreprocessNode(ObservationNode):
    """The old API stack's preprocessor."""

    def __init__(self, step: Preprocess) -> None:
        super().__init__()
        self.leaves = list(space_leaves(step.space, "obs").values())

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        parts = [_preprocess(leaf, space) for leaf, space in zip(tree_leaves(obs), self.leaves, strict=True)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


def _preprocess(leaf: Tensor, space: Any) -> Tensor:
    """Return one leaf as float32 `[batch, n]`."""
    if isinstance(space, Discrete):
        return _one_hot(leaf - int(space.start), int(space.n), below_zero=False)
    if isinstance(space, MultiDiscrete):
        index = leaf.flatten(1) - torch.from_numpy(np.asarray(space.start).ravel().astype(np.int64))
        sizes = [int(n) for n in space.nvec.ravel()]
        return torch.cat([_one_hot(index[:, i], n, below_zero=False) for i, n in enumerate(sizes)], dim=-1)
    row = as_dtype(leaf.flatten(1) if leaf.dim() > 1 else leaf.unsqueeze(1), torch.float32)
    return (row - 128.0) / 128.0 if tuple(space.shape) == ATARI_RAM else row


class FilterNode(ObservationNode):
    """RLlib's frozen MeanStdFilter, on an observation that is a single array.

    RLlib subtracts in double precision. With single-precision observations the same is reached by subtracting the mean
    in two parts: the nearest float32, then the remainder (Dekker 1971), if it matters at all. Integers and
    half-precision numbers are filtered in double precision. RLlib cuts integers back to integers; others, whose filter
    does not keep them, give single precision.
    """

    offset: Tensor
    rest: Tensor
    scale: Tensor
    divisor: Tensor

    def __init__(self, frozen: ObservationFilter, dtype: torch.dtype) -> None:
        super().__init__()
        self.clip = frozen.clip
        self.leaf = frozen.leaf
        self.in_double = dtype not in (torch.float32, torch.float64)
        kept = None if dtype.is_floating_point else dtype
        self.result = kept if frozen.keeps_integers else torch.float32
        if self.in_double:
            dtype = torch.float64
        offset, scale = frozen.offset(), 1.0 / frozen.divisor().astype(np.float64)
        rest = offset - offset.astype(np.float32)
        self.has_rest = dtype == torch.float32 and bool(np.max(np.abs(rest) * scale, initial=0.0) > NEGLIGIBLE)
        self.register_buffer("offset", torch.tensor(offset, dtype=dtype))
        self.register_buffer("rest", torch.tensor(rest, dtype=dtype))
        self.register_buffer("scale", torch.tensor(scale, dtype=dtype))
        self.register_buffer("divisor", torch.tensor(frozen.divisor(), dtype=dtype))

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        return _replace(obs, self.leaf, self._filter)

    def _filter(self, obs: Tensor) -> Tensor:
        if self.in_double:
            obs = (obs.double() - self.offset) / self.divisor
        else:
            obs = obs - self.offset
            if self.has_rest:
                obs = obs - self.rest
            obs = obs * self.scale
        if self.clip is not None:
            obs = torch.clamp(obs, -self.clip, self.clip)
        return obs if self.result is None else as_dtype(obs, self.result)


class FrameStackNode(ObservationNode):
    """The last frames side by side; the state holds all but the newest, including those between."""

    def __init__(self, step: FrameStack) -> None:
        super().__init__()
        self.name = step.state_name
        self.leaf = step.leaf
        self.channels_first = step.channels_first
        self.depth = step.shape[0 if step.channels_first else -1]
        self.every = step.every

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:
        return _replace(obs, self.leaf, lambda frame: self._stack(frame, state))

    def _stack(self, frame: Tensor, state: dict[str, Tensor]) -> Tensor:
        if self.channels_first:
            stacked = torch.cat((state[self.name], frame), dim=1)
            state[self.name] = stacked[:, self.depth :]
            return stacked
        stacked = torch.cat((state[self.name], frame), dim=-1)
        state[self.name] = stacked[..., self.depth :]
        if self.every == 1:
            return stacked
        frames = stacked.reshape(*stacked.shape[:-1], -1, self.depth)
        return frames[..., :: self.every, :].flatten(-2)


class TransposeNode(ObservationNode):
    """Images with their channels first."""

    def __init__(self, step: Transpose) -> None:
        super().__init__()
        self.leaf = step.leaf

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        return _replace(obs, self.leaf, lambda image: image.permute(0, 3, 1, 2))


class LogarithmNode(ObservationNode):
    """The logarithm of some elements."""

    def __init__(self, step: Logarithm) -> None:
        super().__init__()
        self.elements = list(step.elements)
        self.lowest = step.lowest

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        taken = torch.zeros(obs.shape[-1], dtype=torch.bool)
        taken[self.elements] = True
        return torch.where(taken, obs.clamp(min=self.lowest).log(), obs)


class SineAndCosineNode(ObservationNode):
    """Some elements' sines in their place, their cosines after all others."""

    def __init__(self, step: SineAndCosine) -> None:
        super().__init__()
        self.elements = list(step.elements)

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        taken = torch.zeros(obs.shape[-1], dtype=torch.bool)
        taken[self.elements] = True
        return torch.cat((torch.where(taken, obs.sin(), obs), obs[..., self.elements].cos()), dim=-1)


class PreviousNode(ObservationNode):
    """The observation with the last actions' codes and the last rewards; the graph itself keeps its action."""

    def __init__(self, step: Previous) -> None:
        super().__init__()
        self.step = step

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:
        original, actions, rewards = self.step.keys
        augmented = {original: obs}
        if self.step.actions:
            augmented[actions] = state["previous_actions"]
        if self.step.rewards:
            latest = state[REWARD].unsqueeze(-1)
            if self.step.rewards > 1:
                latest = torch.cat((state["previous_rewards"], latest), dim=-1)
                state["previous_rewards"] = latest[:, 1:]
            augmented[rewards] = latest
        return augmented


class UserNode(ObservationNode):
    """The user's own function of tensors."""

    def __init__(self, step: UserStep) -> None:
        super().__init__()
        self.function = step.function

    def forward(self, obs: Tree, state: dict[str, Tensor]) -> Tree:  # noqa: ARG002  # it has no state
        return self.function(obs)


def as_dtype(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """Return `tensor` as `dtype`; `to` alone leaves a node in the graph even if nothing changes."""
    return tensor if tensor.dtype == dtype else tensor.to(dtype)
