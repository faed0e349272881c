"""A policy of Stable-Baselines3: its recipe, its network, and `predict` step after step."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations
from torch import Tensor, nn

from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.contract.scores import ACTION_DIST_INPUTS, Q_VALUES
from rlservo.export.recipe.recipe import (
    DistributionKind,
    FrameStack,
    Mode,
    ObservationFilter,
    Recipe,
    StateLeaf,
    Transform,
    Transpose,
)
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.trees import Tree, build
from rlservo.export.sources.restored_policy import RestoredPolicy, diverged_weights
from rlservo.export.sources.source import Notify, RestoreOptions

OBSERVATIONS, ACTION_MASK = "observations", "action_mask"
"""Keys of the observation of a policy with action masks, as RLlib's examples have them."""
MASKED = torch.finfo(torch.float32).min


@dataclass(frozen=True)
class Layout:
    """Steps from an environment's observation to the model's."""

    frame: Any
    """The environment's own observation space: one frame, images in its layout."""
    frames: int
    normalized_first: bool
    """Whether VecNormalize comes before the frames are stacked."""
    steps: tuple[ObservationFilter | FrameStack | Transpose, ...]


def restore_policy(
    file: Path, policy: Any, traced: Any, vec: Any, options: RestoreOptions, notify: Notify
) -> RestoredPolicy:
    """Return the policy for the exporter, `traced` being a second one. `vec` is VecNormalize's statistics, or None."""
    for key in diverged_weights(policy):
        raise CheckpointError(f"{file}: the weights '{key}' are not all finite: training diverged")
    for one in (policy, traced):
        one.set_training_mode(False)
        one.requires_grad_(False)
    layout = find_layout(file, policy.observation_space, vec, options.frame_stack)
    _check_spaces(file, layout.frame, policy.action_space)
    rule = Rule.of(policy, options.value, notify)
    observation_space, steps = layout.frame, layout.steps
    if rule.masked:
        mask = MultiBinary(_choices(policy.action_space))
        if isinstance(layout.frame, Dict):
            if ACTION_MASK in layout.frame.spaces:
                raise UnsupportedError(f"{file}: the observation has a part '{ACTION_MASK}' already: rename it")
            observation_space = Dict({**layout.frame.spaces, ACTION_MASK: mask})
        else:
            observation_space = Dict({OBSERVATIONS: layout.frame, ACTION_MASK: mask})
            steps = tuple(replace(step, leaf=f"obs.{OBSERVATIONS}") for step in steps)
        notify(f"the policy takes action masks: an observation has the key '{ACTION_MASK}', 1 if a choice is allowed")
    state: tuple[StateLeaf, ...] = ()
    if rule.recurrent:
        layers, _, width = policy.lstm_hidden_state_shape
        state = tuple(StateLeaf(name, np.zeros((layers, width), np.float32)) for name in ("h", "c"))
    recipe = Recipe(observation_space, policy.action_space, steps, rule.mode, rule.transform, rule.distribution, state)
    untrained = ""
    if (filtered := recipe.filter) is not None and filtered.count <= 1:
        untrained = f"VecNormalize's statistics come from {filtered.count} observations"
    kind = type(policy)
    return RestoredPolicy(
        recipe,
        Network(traced, rule),
        f"{kind.__module__}.{kind.__qualname__}",
        partial(PredictLoop, policy, rule, Scores(policy, rule), recipe, layout, vec),
        untrained_filter=untrained,
    )


@dataclass(frozen=True)
class Rule:
    """Steps from network to action, and the graph's further outputs."""

    mode: Mode
    transform: Transform
    distribution: DistributionKind | None
    names: tuple[str, ...]
    scored_by: str = ""
    """The part of the policy whose output is the scores or means."""
    recurrent: bool = False
    masked: bool = False

    @staticmethod
    def of(policy: Any, value: bool, notify: Notify) -> Rule:
        """Return the rule by the parts of the policy. The gate refuses a class of the user's own with another rule."""
        space = policy.action_space
        transform: Transform = "none"
        if isinstance(space, Box):
            transform = "unsquash" if policy.squash_output else "clip"
        recurrent, masked = hasattr(policy, "lstm_actor"), _is_masked(policy)
        discrete = isinstance(space, Discrete | MultiDiscrete)
        names: tuple[str, ...] = ()
        mode: Mode = "given"
        distribution: DistributionKind | None = None
        scored_by = ""
        # MaskablePPO's policy is not an ActorCriticPolicy, but has the same parts.
        if hasattr(policy, "action_net") and hasattr(policy, "action_dist"):
            scored_by = "action_net"
            if discrete:
                mode, names = "argmax", (ACTION_DIST_INPUTS,)
                distribution = "categorical" if isinstance(space, Discrete) else "multi_categorical"
            elif isinstance(policy.action_dist, DiagGaussianDistribution) and len(space.shape) == 1:
                mode, names, distribution = "mean", (ACTION_DIST_INPUTS,), "diag_gaussian"
        elif isinstance(getattr(policy, "q_net", None), nn.Module):
            mode, names, scored_by = "argmax", (Q_VALUES,), "q_net"
        elif isinstance(getattr(policy, "quantile_net", None), nn.Module):
            mode, names, scored_by = "argmax", (Q_VALUES,), "quantile_net"
        if distribution is None:
            notify(f"the export of a {type(policy).__name__} on {space} cannot explore: only its own action is in it")
        if value and recurrent:
            notify("the value head has a memory of its own, which predict does not carry: the export has no 'value'")
        elif value and hasattr(policy, "predict_values"):
            names = (*names, "value")
        return Rule(mode, transform, distribution, names, scored_by if mode != "given" else "", recurrent, masked)


def _is_masked(policy: Any) -> bool:
    from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy

    return isinstance(policy, MaskableActorCriticPolicy)


def _choices(space: Any) -> int:
    if isinstance(space, Discrete):
        return int(space.n)
    return int(space.nvec.sum()) if isinstance(space, MultiDiscrete) else 2 * int(np.prod(space.shape))


class Scores:
    """The numbers that one part of a policy gave while the policy acted."""

    def __init__(self, policy: Any, rule: Rule) -> None:
        self._policy, self._rule = policy, rule
        self._last: Tensor | None = None
        if rule.scored_by:
            getattr(policy, rule.scored_by).register_forward_hook(self._keep)

    def _keep(self, _module: nn.Module, _inputs: Any, output: Tensor) -> None:
        self._last = output

    def take(self, mask: Tensor | None) -> Tensor:
        """Return them `[batch, n]`: means and log standard deviations, logits, or Q-values."""
        assert self._last is not None
        scores, self._last = self._last, None
        if self._rule.scored_by == "quantile_net":
            scores = scores.mean(dim=1)
        if self._rule.mode == "mean":
            scores = torch.cat((scores, self._policy.log_std.expand_as(scores)), dim=-1)
        return scores if mask is None else torch.where(mask.bool(), scores, torch.tensor(MASKED))


class Network(nn.Module):
    """The policy's deterministic prediction as a module that can be traced."""

    def __init__(self, policy: Any, rule: Rule) -> None:
        super().__init__()
        self.module = policy
        self.names = rule.names
        self._rule = rule
        self._scores = Scores(policy, rule)

    def forward(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]:
        """Return the action if its rule is the policy's own, one tensor for each of `names`, and the next state."""
        policy, rule = self.module, self._rule
        mask: Tensor | None = None
        next_state: list[Tensor] = []
        if rule.masked:
            mask, obs = _unmask(obs, policy.observation_space)
        if rule.recurrent:
            hidden = tuple(leaf.transpose(0, 1).contiguous() for leaf in state[0])
            starts = torch.zeros(hidden[0].shape[1])  # the initial state at an episode's start
            distribution, after = policy.get_distribution(obs, hidden, starts)
            next_state = [leaf.transpose(0, 1) for leaf in after]
        elif rule.masked:
            distribution = policy.get_distribution(obs, action_masks=mask if rule.mode == "given" else None)
        elif hasattr(policy, "get_distribution"):
            distribution = policy.get_distribution(obs)
        else:
            distribution = None
        if distribution is not None:
            action = distribution.get_actions(deterministic=True)
        else:  # ARS has nothing but a deterministic action
            known = "deterministic" in inspect.signature(policy.forward).parameters
            action = policy(obs, deterministic=True) if known else policy(obs)
        actions = [_shaped(action, policy.action_space)] if rule.mode == "given" else []
        named = [
            policy.predict_values(obs).squeeze(-1) if name == "value" else self._scores.take(mask)
            for name in self.names
        ]
        return (*actions, *named, *next_state)


def _unmask(obs: Tree, model_space: Any) -> tuple[Any, Tree]:
    rest = {key: value for key, value in obs.items() if key != ACTION_MASK}
    return obs[ACTION_MASK], rest if isinstance(model_space, Dict) else rest[OBSERVATIONS]


def _shaped(action: Tensor, space: Any) -> Tensor:
    action = action.reshape(-1, *space.shape)
    return action if isinstance(space, Box) else action.long()


class PredictLoop:
    """`VecNormalize.normalize_obs`, the frame stack and `policy.predict(deterministic=True)`, step after step."""

    def __init__(self, policy: Any, rule: Rule, scores: Scores, recipe: Recipe, layout: Layout, vec: Any) -> None:
        self._policy, self._rule, self._scores = policy, rule, scores
        self._recipe, self._layout, self._vec = recipe, layout, vec
        self._stacks: list[StackedObservations[Any]] = []
        self._state: Any = None

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return what the model predicts for one step of every row, by output name."""
        policy, rule = self._policy, self._rule
        obs = build(self._recipe.observation_space, [inputs[name] for name in self._recipe.observation_leaves])
        mask = None
        how: dict[str, Any] = {}
        if rule.masked:
            mask, obs = _unmask(obs, policy.observation_space)
            how["action_masks"] = mask
        if self._vec is not None and self._layout.normalized_first:
            obs = self._vec.normalize_obs(obs)
        if self._layout.frames > 1:
            obs = self._stack(obs, restart)
        if self._vec is not None and not self._layout.normalized_first:
            obs = self._vec.normalize_obs(obs)
        if rule.recurrent:
            how |= {"state": self._state, "episode_start": restart}
        actions, self._state = policy.predict(obs, deterministic=True, **how)
        space = self._recipe.action_space
        outputs = {"action": actions if isinstance(space, Box) else actions.astype(np.int64)}
        with torch.no_grad():
            for name in rule.names:
                if name == "value":
                    outputs[name] = policy.predict_values(policy.obs_to_tensor(obs)[0]).squeeze(-1).numpy()
                else:
                    outputs[name] = self._scores.take(None if mask is None else torch.from_numpy(mask)).numpy().copy()
        for leaf, values in zip(self._recipe.network_state, self._state or (), strict=False):
            outputs[f"state_out.{leaf.name}"] = np.swapaxes(values, 0, 1)
        return outputs

    def _stack(self, obs: Tree, restart: NDArray[np.bool_]) -> Tree:
        """Return the stacked observations; each row has a stack of its own."""
        if not self._stacks:
            self._stacks = [
                StackedObservations(1, self._layout.frames, self._layout.frame) for _ in range(len(restart))
            ]
        rows = []
        for row, stack in enumerate(self._stacks):
            frame = _rows(obs, slice(row, row + 1))
            stacked = stack.reset(frame) if restart[row] else stack.update(frame, np.array([False]), [{}])[0]
            rows.append(copy.deepcopy(stacked))
        if isinstance(rows[0], dict):
            return {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
        return np.concatenate(rows)


def _rows(obs: Tree, rows: slice) -> Tree:
    return {key: value[rows] for key, value in obs.items()} if isinstance(obs, dict) else obs[rows]


def find_layout(file: Path, model_space: Any, vec: Any, frames: int) -> Layout:
    """Return the steps from one frame of the environment to the model's observation.

    VecNormalize's own space says whether it comes before the stack, and for images whether their channels are last.
    Raises CheckpointError if the statistics or the number of frames do not fit the model.
    """
    models = _leaves(model_space)
    statistics = _leaves(vec.observation_space) if vec is not None else {}
    if statistics and dict.fromkeys(statistics) != dict.fromkeys(models):
        raise CheckpointError(f"{file}: VecNormalize's statistics cover the parts {', '.join(statistics)}, the model "
                              f"takes {', '.join(models)}: they do not belong together")  # fmt: skip
    stacked: dict[str, tuple[Any, int]] = {}
    frame_spaces: dict[str, Any] = {}
    transposed: list[str] = []
    normalized_first = True
    for key, model in models.items():
        channels_last = is_image_space(model) and is_image_space_channels_first(model)
        whole = _channels_last(model) if channels_last else model
        seen = statistics.get(key)
        if seen is not None and channels_last and _fits(seen.shape, model.shape, axis=0):
            whole, channels_last = model, False  # the environment's images have their channels first
        axis = 0 if is_image_space(model) and not channels_last and is_image_space_channels_first(model) else -1
        if seen is not None and seen.shape != whole.shape:
            if not _fits(seen.shape, whole.shape, axis) or frames not in (1, whole.shape[axis] // seen.shape[axis]):
                raise CheckpointError(
                    f"{file}: VecNormalize's statistics are for observations {seen.shape}, the model's are "
                    f"{model.shape}: they do not belong together"
                )
            frames = whole.shape[axis] // seen.shape[axis]
        elif seen is not None and frames > 1:
            normalized_first = False
        stacked[key], transposed = (whole, axis), [*transposed, *([key] if channels_last else [])]
    for key, (whole, axis) in stacked.items():
        if frames > 1 and (not isinstance(whole, Box) or not whole.shape or whole.shape[axis] % frames):
            raise CheckpointError(f"{file}: {whole} is not a stack of {frames} frames")
        frame_spaces[key] = whole if frames == 1 else _first_frame(whole, axis, frames)
    is_dict = isinstance(model_space, Dict)
    steps = [Transpose(_leaf(key)) for key in transposed]
    stacks = [
        FrameStack(frames, frame_spaces[key].shape, _stack_dtype(vec, key, frame_spaces[key], normalized_first),
                   leaf=_leaf(key), channels_first=axis == 0)
        for key, (_, axis) in stacked.items() if frames > 1
    ]  # fmt: skip
    filters = _filters(vec)
    before: list[ObservationFilter | FrameStack] = [*filters, *stacks] if normalized_first else [*stacks, *filters]
    frame = Dict(frame_spaces) if is_dict else frame_spaces[""]
    return Layout(frame, frames, normalized_first, (*before, *steps))


def _leaves(space: Any) -> dict[str, Any]:
    return dict(space.spaces) if isinstance(space, Dict) else {"": space}


def _leaf(key: str) -> str:
    return f"obs.{key}" if key else "obs"


def _fits(part: Sequence[int], whole: Sequence[int], axis: int) -> bool:
    """Return whether `whole` consists of several `part`s side by side on one axis."""
    if len(part) != len(whole) or not part or whole[axis] % part[axis]:
        return False
    rest, others = list(part), list(whole)
    return rest.pop(axis) > 0 and others.pop(axis) > 0 and rest == others


def _channels_last(space: Any) -> Box:
    low, high = (np.moveaxis(side, 0, -1) for side in (space.low, space.high))
    return Box(low, high, dtype=space.dtype.type)


def _first_frame(space: Any, axis: int, frames: int) -> Box:
    low, high = (np.split(side, frames, axis=axis)[0] for side in (space.low, space.high))
    return Box(low, high, dtype=space.dtype.type)


def _stack_dtype(vec: Any, key: str, space: Box, normalized_first: bool) -> str:
    filtered = vec is not None and normalized_first and vec.norm_obs and (not key or key in vec.norm_obs_keys)
    return "float32" if filtered else str(space.dtype)


def _filters(vec: Any) -> list[ObservationFilter]:
    """Return VecNormalize's statistics: `clip((obs - mean) / sqrt(var + epsilon))`, as single precision."""
    if vec is None or not vec.norm_obs:
        return []
    moments = vec.obs_rms if isinstance(vec.obs_rms, dict) else {"": vec.obs_rms}
    found = []
    for key, running in moments.items():
        std = np.sqrt(np.asarray(running.var, np.float64) + vec.epsilon)
        mean = np.asarray(running.mean, np.float64)
        if not (np.isfinite(mean).all() and np.isfinite(std).all()):
            raise CheckpointError("VecNormalize's mean or variance is not finite: training diverged")
        found.append(
            ObservationFilter(
                int(running.count), mean, std, float(vec.clip_obs), epsilon=0.0, leaf=_leaf(key), keeps_integers=False
            )
        )
    return found


def _check_spaces(file: Path, observation_space: Any, action_space: Any) -> None:
    """Raise UnsupportedError for spaces that have no fixed shape or no tensors."""
    for key, space in _leaves(observation_space).items():
        if not isinstance(space, Box | Discrete | MultiDiscrete | MultiBinary):
            raise UnsupportedError(f"{file}: {_leaf(key)}: the observation space {space} is not exported")
    if not isinstance(action_space, Box | Discrete | MultiDiscrete | MultiBinary):
        raise UnsupportedError(f"{file}: the action space {action_space} is not exported")
    if isinstance(action_space, Box) and action_space.dtype not in (np.float32, np.float64):
        raise UnsupportedError(f"{file}: the action space {action_space} is not exported: only float Boxes are")
