"""Policy as one torch graph: a raw observation in, an action ready for `env.step` out.

It puts a `Recipe` around a network.

Every node costs a third of a microsecond in onnxruntime, the network itself nine, so constants are folded as far as
single precision allows.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete
from numpy.typing import NDArray
from torch import Tensor, nn

from rlservo.bundle.contract import REWARD
from rlservo.export.graph.observation_preprocessing import ObservationNode, as_dtype, observation_nodes
from rlservo.export.recipe.recipe import Affine, Present, Recipe, leaf_transform, parameter_count
from rlservo.export.recipe.trees import Tree, build, map_tree, named_leaves


class TracedNetwork(Protocol):
    """A module that maps the network's input to one tensor for each name.

    If the recipe's mode is "given", the action's leaves come before the named ones. A recurrent one takes its
    state as a second argument, a list in the order of `Recipe.network_state`, and returns the next state's tensors
    after the named ones.
    """

    names: tuple[str, ...]

    def __call__(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]: ...


class PolicyGraph(nn.Module):
    """Observation steps, network, action rule. Inputs are `input_names`, outputs `output_names`, in that order."""

    def __init__(self, recipe: Recipe, network: TracedNetwork, left_out: Collection[str] = ()) -> None:
        """`left_out` are the observation's leaves that nothing reads: the graph has no such inputs."""
        super().__init__()
        self.space = recipe.observation_space
        self.leaves = recipe.observation_leaves
        self.left_out = frozenset(left_out)
        self.steps: nn.ModuleList = observation_nodes(recipe)
        self.network = network
        self.action = ActionNode(recipe)
        self.present = None if recipe.present is None else PresentNode(recipe.present)
        self.action_count = len(recipe.action_leaves) if recipe.mode == "given" else 0
        self.state_names = [state.name for state in recipe.state]
        self.network_state_names = [state.name for state in recipe.network_state]
        self.needs_reward = recipe.needs_reward
        self.input_names = (
            *(name for name in recipe.observation_leaves if name not in self.left_out),
            *([REWARD] if self.needs_reward else []),
            *(f"state_in.{name}" for name in self.state_names),
        )
        self.output_names = (
            *recipe.action_leaves,
            *network.names,
            *(f"state_out.{name}" for name in self.state_names),
        )
        self.eval()

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs for observation leaves `[batch, ...]` of the space's dtype, then reward and state."""
        rest = list(inputs)
        obs: Tree = build(self.space, [self._unread(leaf, inputs[0]) if name in self.left_out else rest.pop(0)
                                       for name, leaf in self.leaves.items()])  # fmt: skip
        state: dict[str, Tensor] = {REWARD: rest.pop(0)} if self.needs_reward else {}
        state.update(zip(self.state_names, rest, strict=True))
        for step in self.steps:
            assert isinstance(step, ObservationNode)
            obs = step(obs, state)
        # RLlib hands floating-point leaves to the network in single precision, and integers as they are.
        obs = map_tree(lambda leaf: as_dtype(leaf, torch.float32) if leaf.is_floating_point() else leaf, obs)
        network_state = [state[name] for name in self.network_state_names]
        outputs = self.network(obs, network_state) if network_state else self.network(obs)
        chosen, outputs = outputs[: self.action_count], outputs[self.action_count :]
        named, next_state = outputs[: len(self.network.names)], outputs[len(self.network.names) :]
        actions = self.action.finish(chosen) if chosen else self.action(named[0])
        if self.present is not None:
            actions = (self.present(actions[0], inputs[0]),)
        if "previous_actions" in state:
            state["previous_actions"] = _append_code(state["previous_actions"], actions[0], self.action.choices)
        state.update(zip(self.network_state_names, next_state, strict=True))
        return (*actions, *named, *(state[name] for name in self.state_names))

    @staticmethod
    def _unread(leaf: Any, like: Tensor) -> Tensor:
        """Return a placeholder for an unread leaf, in `like`'s batch."""
        one = torch.from_numpy(np.zeros(leaf.shape, leaf.dtype))
        return one.expand(like.shape[0], *leaf.shape)


def _append_code(codes: Tensor, action: Tensor, choices: int) -> Tensor:
    """Return the one-hot codes of the last actions with the oldest dropped and `action` added at the end."""
    latest = torch.eq(action.unsqueeze(-1), torch.arange(choices)).float()
    return torch.cat((codes[:, choices:], latest), dim=-1)


class ActionNode(nn.Module):
    """The distribution's mode, then RLlib's transform before `env.step`, for every leaf of the action."""

    def __init__(self, recipe: Recipe) -> None:
        super().__init__()
        spaces = recipe.action_leaves
        self.space = recipe.action_space
        self.leaves = nn.ModuleList(ActionLeaf(recipe, space) for space in spaces.values())
        self.widths = [parameter_count(space) for space in spaces.values()]
        self.user_steps = [step.function for step in recipe.action_steps]
        self.affine = None if recipe.affine is None else AffineNode(recipe.affine)
        self.choices = self.widths[0]

    def forward(self, parameters: Tensor) -> tuple[Tensor, ...]:
        """Return one tensor per action leaf, given the distribution's parameters (or Q-values) `[batch, n]`."""
        parts = [parameters] if len(self.widths) == 1 else torch.split(parameters, self.widths, dim=-1)
        return self.finish([leaf.choose(part) for leaf, part in zip(self._leaves(), parts, strict=True)])

    def finish(self, chosen: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the environment's action, given the leaves that the policy chose."""
        if self.user_steps:
            tree = build(self.space, chosen)
            for function in self.user_steps:
                tree = function(tree)
            chosen = list(named_leaves(tree, "action").values())
        if self.affine is not None:
            chosen = [self.affine(one) for one in chosen]
        return tuple(leaf.finish(one) for leaf, one in zip(self._leaves(), chosen, strict=True))

    def _leaves(self) -> list[ActionLeaf]:
        return [leaf for leaf in self.leaves if isinstance(leaf, ActionLeaf)]


class AffineNode(nn.Module):
    """The policy's numbers in the environment's units."""

    scale: Tensor
    offset: Tensor

    def __init__(self, affine: Affine) -> None:
        super().__init__()
        self.limit = affine.limit
        self.register_buffer("scale", torch.tensor(affine.scale))
        self.register_buffer("offset", torch.tensor(affine.offset))

    def forward(self, action: Tensor) -> Tensor:
        """Return actions `[batch, *shape]`."""
        if self.limit is not None:
            action = torch.clamp(action, -self.limit, self.limit)
        return action * self.scale + self.offset


class PresentNode(nn.Module):
    """Relative actions as targets: clipped, then added to the positions in the observation."""

    scale: Tensor
    offset: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, present: Present) -> None:
        super().__init__()
        self.columns, self.clips = list(present.columns), present.clips
        self.is_plain = bool((present.scale == 1).all() and (present.offset == 0).all())
        for name in ("scale", "offset", "low", "high"):
            self.register_buffer(name, torch.tensor(getattr(present, name)))

    def forward(self, action: Tensor, obs: Tensor) -> Tensor:
        """Return targets `[batch, n]` for relative actions, the same, and observations `[batch, elements]`."""
        if self.clips:
            action = torch.minimum(torch.maximum(action, self.low), self.high)
        first, last = self.columns[0], self.columns[-1] + 1
        run = self.columns == list(range(first, last))
        positions = obs[:, first:last] if run else obs[:, self.columns]
        return action + (positions if self.is_plain else positions * self.scale + self.offset)


class ActionLeaf(nn.Module):
    """One leaf of the action.

    Unsquashing is `low + (a + 1) * (high - low) / 2`, clipped (`unsquash_action`, ray 2.60), here as
    `a * half_range + middle`.
    """

    half_range: Tensor
    middle: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, recipe: Recipe, space: Any) -> None:
        super().__init__()
        self.mode, self.transform = recipe.mode, leaf_transform(space, recipe.transform)
        self.box = isinstance(space, Box)
        self.nvec = space.nvec.ravel().tolist() if isinstance(space, MultiDiscrete) else None
        if not isinstance(space, Box):
            return
        self.integer = np.dtype(space.dtype).kind in "iu"
        if self.integer:
            self.dtype = torch.from_numpy(np.zeros(0, space.dtype)).dtype
            self.register_buffer("low", torch.tensor(space.low.astype(np.int64)))
            self.register_buffer("high", torch.tensor(space.high.astype(np.int64)))
            return
        self.dtype = torch.float64 if space.dtype == np.float64 else torch.float32
        self.width = int(np.prod(space.shape))
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        with np.errstate(invalid="ignore"):  # infinite bounds are never unsquashed
            half, middle = (high - low) / 2, (high + low) / 2
        self.is_scaled, self.is_moved = bool((half != 1).any()), bool((middle != 0).any())
        self.limits = _same_everywhere(low, high)
        for name, values in (("half_range", half), ("middle", middle), ("low", low), ("high", high)):
            self.register_buffer(name, torch.tensor(values, dtype=self.dtype))

    def choose(self, parameters: Tensor) -> Tensor:
        """Return the distribution's mode."""
        if self.nvec is not None:
            parts = torch.split(parameters, self.nvec, dim=-1)
            return torch.stack([torch.argmax(part, dim=-1) for part in parts], dim=-1)
        if not self.box:
            return torch.argmax(parameters, dim=-1)
        action = torch.split(parameters, [self.width, self.width], dim=-1)[0]
        return torch.tanh(action) if self.mode == "tanh_mean" else action

    def finish(self, action: Tensor) -> Tensor:
        """Return what goes to the environment."""
        if not self.box:
            return action
        if self.integer:
            return self._count(action)
        action = as_dtype(action, self.dtype)
        if self.transform == "unsquash" and self.is_scaled:
            action = action * self.half_range
        if self.transform == "unsquash" and self.is_moved:
            action = action + self.middle
        return action if self.transform == "none" else self._clip(action)

    def _count(self, choice: Tensor) -> Tensor:
        """Return integers: a choice counted from the lower bound (`unsquash_action`), or clipped, or as it is."""
        if self.transform == "unsquash":
            choice = choice + self.low
        elif self.transform == "clip":
            choice = torch.minimum(torch.maximum(choice, self.low), self.high)
        return as_dtype(choice, self.dtype)

    def _clip(self, action: Tensor) -> Tensor:
        if self.limits is not None:
            return torch.clamp(action, *self.limits)
        return torch.minimum(torch.maximum(action, self.low), self.high)


def _same_everywhere(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the bounds as two numbers if all elements share finite ones: one node instead of two."""
    first_low, first_high = float(low.flat[0]), float(high.flat[0])
    shared = bool(
        (low == first_low).all() and (high == first_high).all() and np.isfinite([first_low, first_high]).all()
    )
    return (first_low, first_high) if shared else None
