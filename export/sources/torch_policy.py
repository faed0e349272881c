"""A policy that is one torch module: its network and its own forward pass as the reference.

For sources whose framework gives a module that decides alone: a module of the user's own, rsl_rl's, skrl's.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor, nn

from rlservo.errors import CheckpointError, UnsupportedError, first_line
from rlservo.export.recipe.kept_values import HOLDERS, changed, kept_values
from rlservo.export.recipe.recipe import Recipe, parameter_count
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.samples import draw_pair
from rlservo.export.recipe.trees import Tree, build_in_order, map_tree, tree_leaves
from rlservo.export.sources.restored_policy import ElementNames, RestoredPolicy, diverged_weights
from rlservo.export.sources.source import Notify


class Act(Protocol):
    """Observation `[batch, ...]` and state, `[batch, ...]` each, to the output and the next state."""

    def __call__(self, obs: Tree, state: list[Tensor]) -> tuple[Tree, list[Tensor]]: ...


@dataclass(frozen=True)
class TorchPolicy:
    """A source's module: the traced form and the framework's own."""

    recipe: Recipe
    """Its mode names the module's output: the action ("given"), or scores to choose by ("argmax")."""
    module: nn.Module
    """Module with all weights."""
    act: Callable[[Any, Tree, list[Tensor]], tuple[Tree, list[Tensor]]]
    """The traced function of module, observation and state: torch operations, without the recipe's steps."""
    reference: Callable[[], Act]
    """Start the framework's own way to act, for observations as the environment gives them, as torch tensors."""
    names: tuple[str, ...] = ()
    """`("q_values",)` or `("action_dist_inputs",)` if the output is scores."""
    send: Callable[[NDArray[Any]], NDArray[Any]] | None = None
    """The reference's own step from its Box action to the environment's; None: it gives the environment's."""


def restored(
    policy: TorchPolicy, elements: ElementNames | None, what: str, module_class: str = "", untrained_filter: str = ""
) -> RestoredPolicy:
    """Return the policy for the exporter; `what` names the checkpoint in errors.

    Raises CheckpointError for weights that are not finite, UnsupportedError for a module that does not run or whose
    output does not fit the action space.
    """
    for key in diverged_weights(policy.module):
        raise CheckpointError(f"{what}: the weights '{key}' are not all finite: training diverged")
    policy.module.eval().requires_grad_(False)
    _check_output(policy, what)
    kind = type(policy.module)
    return RestoredPolicy(
        policy.recipe,
        ActNetwork(policy),
        module_class or f"{kind.__module__}.{kind.__qualname__}",
        lambda: ActLoop(policy),
        elements=elements,
        untrained_filter=untrained_filter,
    )


def _check_output(policy: TorchPolicy, what: str) -> None:
    """Raise UnsupportedError if the module does not run on an observation, or gives another shape."""
    recipe, pair = policy.recipe, draw_pair(policy.recipe)
    try:
        ActLoop(policy).step(pair, np.ones(2, np.bool_))
    except UnsupportedError as error:
        error.prefix(what)
        raise
    except Exception as error:  # a module of the user's own raises anything
        raise UnsupportedError(
            f"{what}: {type(policy.module).__name__} does not run on an observation of {recipe.observation_space}: "
            f"{first_line(error)}"
        ) from error


def _check_shape(recipe: Recipe, values: list[NDArray[Any]], rows: int) -> None:
    """Raise UnsupportedError if a module's output does not have the action space's shape."""
    spaces = list(recipe.action_leaves.values())
    if recipe.mode == "argmax":
        wanted, which = [(rows, sum(parameter_count(space) for space in spaces))], "scores"
    else:
        wanted, which = [(rows, *space.shape) for space in spaces], "an action"
    got = [value.shape for value in values]
    if got != wanted:
        raise UnsupportedError(
            f"for {rows} observations it gives {which} of shape {', '.join(map(str, got))}, the action space "
            f"{recipe.action_space} expects {', '.join(map(str, wanted))}"
        )


class ActNetwork(nn.Module):
    """The module as the exporter traces it."""

    def __init__(self, policy: TorchPolicy) -> None:
        super().__init__()
        self.module = policy.module
        self.names = policy.names
        self._act = policy.act

    def forward(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]:
        """Return the action or the scores, then the next state."""
        output, after = self._act(self.module, obs, list(state[0]) if state else [])
        return (*tree_leaves(output), *after)


class ActLoop:
    """The framework's own way to act, step after step."""

    def __init__(self, policy: TorchPolicy) -> None:
        self._policy = policy
        self._act = policy.reference()
        self._state: list[Tensor] = []

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return the framework's outputs for one step of every row, by name."""
        recipe = self._policy.recipe
        leaves = {name: torch.from_numpy(values) for name, values in inputs.items()}
        begins = torch.from_numpy(restart)
        state = []
        for number, leaf in enumerate(recipe.network_state):
            start = torch.from_numpy(leaf.initial).expand(len(restart), *leaf.initial.shape)
            last = self._state[number] if self._state else start
            state.append(torch.where(begins.reshape(-1, *[1] * leaf.initial.ndim), start, last))
        with torch.no_grad():
            output, self._state = self._act(build_in_order(recipe.observation_space, leaves), state)
        for leaf, after in zip(recipe.network_state, self._state, strict=True):
            wanted = ((len(restart), *leaf.initial.shape), torch.from_numpy(leaf.initial).dtype)
            if (tuple(after.shape), after.dtype) != wanted:
                raise UnsupportedError(
                    f"for {len(restart)} observations it gives the state '{leaf.name}' as {after.dtype} of shape "
                    f"{tuple(after.shape)}, expected {wanted[1]} of shape {wanted[0]}"
                )
        values = [leaf.numpy().copy() for leaf in tree_leaves(output)]
        _check_shape(recipe, values, len(restart))
        outputs: Outputs = {}
        if recipe.mode == "argmax":
            outputs[self._policy.names[0]] = values[0]
            values = [_choose(recipe, values[0])]
        for (name, space), value in zip(recipe.action_leaves.items(), values, strict=True):
            send = self._policy.send if isinstance(space, Box) else None
            sent = value if send is None else send(value)
            outputs[name] = sent.astype(np.int64 if np.dtype(space.dtype).kind in "iu" else space.dtype)
        for leaf, tensor in zip(recipe.network_state, self._state, strict=True):
            outputs[f"state_out.{leaf.name}"] = tensor.numpy().copy()
        return outputs


def _choose(recipe: Recipe, scores: NDArray[Any]) -> NDArray[Any]:
    """Return the choices with the largest scores `[batch, n]`."""
    nvec = getattr(recipe.action_space, "nvec", None)
    if nvec is None:
        return np.asarray(scores.argmax(axis=-1))
    parts = np.split(scores, np.cumsum(nvec)[:-1], axis=-1)
    return np.stack([part.argmax(axis=-1) for part in parts], axis=-1)


def second(module: nn.Module, what: str) -> nn.Module:
    """Return a copy of a module, so that what is traced and what acts as the reference share nothing."""
    try:
        copied = copy.deepcopy(module)
    except Exception as error:
        raise UnsupportedError(
            f"{what}: {_uncopied(module)} cannot be copied, and copies are what is exported and proven: "
            f"{first_line(error)}"
        ) from error
    if kept := changed(dict(kept_values(module)), dict(kept_values(copied))).removeprefix("."):
        raise UnsupportedError(
            f"{what}: a copy of the {type(module).__name__} has a different '{kept}', and copies are what is exported "
            "and proven: correct its __deepcopy__ or __getstate__"
        )
    return copied


def _uncopied(module: nn.Module) -> str:
    """Return the attribute that cannot be copied, such as a lock or a pool of threads, or else the module."""
    for prefix, part in module.named_modules():
        for name, value in vars(part).items():
            try:
                copy.deepcopy(None if name in HOLDERS else value)
            except Exception:  # what a class raises
                return f"its '{f'{prefix}.{name}'.lstrip('.')}' (a {type(value).__name__})"
    return type(module).__name__


def notify_mode(policy: TorchPolicy, module: nn.Module, notify: Notify) -> None:
    """Say that a module is in training mode, if it acts otherwise in it than the policy's own in evaluation mode."""
    recipe, pair = policy.recipe, draw_pair(policy.recipe)
    obs = build_in_order(recipe.observation_space, {name: torch.from_numpy(leaf) for name, leaf in pair.items()})
    obs = map_tree(lambda leaf: leaf.float() if leaf.is_floating_point() else leaf, obs)
    state = [torch.from_numpy(leaf.initial).expand(2, *leaf.initial.shape) for leaf in recipe.network_state]
    with torch.random.fork_rng(devices=()), torch.no_grad():
        training, evaluating = (tree_leaves(policy.act(one, obs, state)[0]) for one in (module, policy.module))
    if not all(torch.equal(*pair) for pair in zip(training, evaluating, strict=True)):
        notify(
            f"the {type(module).__name__} is in training mode, in which it acts otherwise (dropout, batch "
            "normalization): it is exported in evaluation mode"
        )
