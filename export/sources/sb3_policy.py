"""A policy of Stable-Baselines3: its recipe, its network, and `predict` step after step."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from torch import Tensor, nn

from rlservo.bundle.scores import ACTION_DIST_INPUTS, Q_VALUES
from rlservo.errors import CheckpointError, UnsupportedError
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
from rlservo.export.recipe.runners import Inputs
from rlservo.export.recipe.trees import Tree, build, build_in_order
from rlservo.export.sources.restored_policy import RestoredPolicy, diverged_weights
from rlservo.export.sources.sb3_reference import PredictLoop, Wrappers, load_acting
from rlservo.export.sources.source import Notify, RestoreOptions

OBSERVATIONS, ACTION_MASK = "observations", "action_mask"
"""Keys of the observation of a policy with action masks, as RLlib's examples have them."""
ACTING = ("predict", "_predict", "obs_to_tensor", "unscale_action")
"""Methods through which predict passes around a policy's networks; `forward` is one of them if nothing else acts."""
CHOOSING = ("get_distribution", "_get_action_dist_from_latent")
"""Methods between the output of `action_net` and the action."""
LIBRARIES = ("stable_baselines3", "sb3_contrib")
EXPORTED = "expected Box, Discrete, MultiDiscrete or MultiBinary"
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
    file: Path, load: Callable[[Any], Any], statistics: Path | None, vec: Any, options: RestoreOptions, notify: Notify
) -> RestoredPolicy:
    """Return the policy for the exporter; `load` gives the model, for an environment or None.

    `vec` is the VecNormalize that the file `statistics` holds, or None.
    """
    policy = load(None).policy
    _check_methods(file, policy)
    for key in diverged_weights(policy):
        raise CheckpointError(f"{file}: the weights '{key}' are not all finite: training diverged")
    layout = find_layout(file, policy.observation_space, vec, options.frame_stack)
    _check_spaces(file, layout.frame, policy.action_space)
    _notify_assumptions(layout, vec, notify)
    acting, wrappers = load_acting(file, load, layout.frame, policy.action_space, statistics, layout.frames)
    _check_order(file, layout, wrappers)
    for one in (policy, acting.policy):
        one.set_training_mode(False)
        one.requires_grad_(False)
    rule = Rule.of(policy, options.value, notify)
    observation_space, steps = layout.frame, layout.steps
    if rule.masked:
        mask = MultiBinary(_choices(policy.action_space))
        if isinstance(layout.frame, Dict):
            if ACTION_MASK in layout.frame.spaces:
                raise UnsupportedError(f"{file}: the observation already has a part '{ACTION_MASK}': rename it")
            observation_space = Dict([*layout.frame.spaces.items(), (ACTION_MASK, mask)])
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
        SB3Network(policy, rule),
        f"{kind.__module__}.{kind.__qualname__}",
        partial(
            PredictLoop,
            acting,
            wrappers,
            layout.frame,
            partial(_read, recipe, rule, policy.observation_space),
            Scores(acting.policy, rule).numbers,
            rule.names,
            tuple(leaf.name for leaf in state),
        ),
        untrained_filter=untrained,
    )


def _notify_assumptions(layout: Layout, vec: Any, notify: Notify) -> None:
    """Say what neither the zip nor the statistics show."""
    shapes = {key: space.shape for key, space in _leaves(layout.frame).items()}
    if layout.frames > 1 and (vec is None or not layout.normalized_first):
        notify(
            f"the zip does not record frames: an observation is taken for {layout.frames} frames of one VecFrameStack, "
            f"of shape {', '.join(map(str, shapes.values()))} each"
        )
    for step in layout.steps:
        if isinstance(step, Transpose):
            notify(f"{step.leaf}: an image is taken with its channels last, as VecTransposeImage takes it")
        if (
            isinstance(step, ObservationFilter)
            and (np.abs(step.mean) < 0.3).all()
            and (abs(np.log(step.std)) < 0.5).all()
        ):
            notify(
                f"{step.leaf}: VecNormalize's statistics are those of numbers that are normalized already: if another "
                "VecNormalize was below it, its file does not hold that one, and the export is wrong"
            )


def _check_methods(file: Path, policy: Any) -> None:
    """Raise UnsupportedError for a class of the user's own that acts outside of its network."""
    for part in policy.modules():
        names = ACTING if hasattr(part, "get_distribution") else (*ACTING, "forward")
        for name in names if isinstance(part, BasePolicy) else ():
            owner = _owner(part, name)
            if not _is_of_a_library(owner):
                raise UnsupportedError(
                    f"{file}: the policy's class {owner.__module__}.{owner.__qualname__} has a '{name}' of its own, "
                    "which is not exported: a graph holds the networks, so put what it does into them or into the "
                    "features extractor"
                )


def _owner(part: Any, name: str) -> type:
    """Return the class that a method of an object is defined in."""
    return next(kind for kind in type(part).__mro__ if name in vars(kind))


def _is_of_a_library(kind: type) -> bool:
    return kind.__module__.partition(".")[0] in LIBRARIES


def _check_order(file: Path, layout: Layout, wrappers: Wrappers) -> None:
    """Raise CheckpointError if the recipe's steps are not in the order that Stable-Baselines3's own wrappers accept."""
    called = {ObservationFilter: "VecNormalize", FrameStack: "VecFrameStack", Transpose: "VecTransposeImage"}
    steps = tuple(dict.fromkeys(called[type(step)] for step in layout.steps))
    accepted = tuple(name for name in wrappers.names if name in steps or name != "VecNormalize")
    if steps != accepted:
        raise CheckpointError(
            f"{file}: by the shapes of model and statistics, its wrappers are {', '.join(steps) or 'none'}, but by "
            f"Stable-Baselines3's own checks {', '.join(accepted) or 'none'}: give the --vecnormalize and "
            "--frame-stack of its training"
        )


def _read(recipe: Recipe, rule: Rule, model_space: Any, inputs: Inputs) -> tuple[Tree, NDArray[Any] | None]:
    """Return the environment's observation of a graph's inputs, and the action masks."""
    if any(isinstance(step, FrameStack) for step in recipe.steps):
        obs = build_in_order(recipe.observation_space, inputs)  # VecFrameStack sorts its space, and not what it gives
    else:
        obs = build(recipe.observation_space, [inputs[name] for name in recipe.observation_leaves])
    if not rule.masked:
        return obs, None
    mask, obs = _unmask(obs, model_space)
    return obs, mask


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
        """Return the rule by the parts of the policy."""
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
        # What a class of the user's own does behind action_net is in the action alone.
        if (
            hasattr(policy, "action_net")
            and hasattr(policy, "action_dist")
            and all(map(_is_of_a_library, (type(policy.action_dist), *(_owner(policy, name) for name in CHOOSING))))
        ):
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
            notify(f"{type(policy).__name__} on {space} is exported without exploring actions")
        if value and recurrent:
            notify("predict carries no memory for a recurrent policy's value: the export has no 'value'")
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

    def numbers(self, mask: NDArray[Any] | None) -> NDArray[Any]:
        """Return them as `take` does, detached from the policy."""
        return np.asarray(self.take(None if mask is None else torch.from_numpy(mask)).detach().numpy().copy())


class SB3Network(nn.Module):
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


def find_layout(file: Path, model_space: Any, vec: Any, frames: int) -> Layout:
    """Return the steps from one frame of the environment to the model's observation.

    VecNormalize's own space says whether it comes before the stack, and for images whether their channels are last.
    Raises CheckpointError if the statistics or the number of frames do not fit the model.
    """
    models = _leaves(model_space)
    statistics = _leaves(vec.observation_space) if vec is not None else {}
    if statistics and dict.fromkeys(statistics) != dict.fromkeys(models):
        raise CheckpointError(
            f"{file}: VecNormalize's statistics cover the parts {', '.join(statistics)}, but the model takes "
            f"{', '.join(models)}: they do not belong together"
        )
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
                    f"{file}: VecNormalize's statistics are for observations {seen.shape}, but the model's are "
                    f"{model.shape}: they do not belong together"
                )
            frames = whole.shape[axis] // seen.shape[axis]
        elif seen is not None and frames > 1:
            normalized_first = False
        stacked[key], transposed = (whole, axis), [*transposed, *([key] if channels_last else [])]
    for key, (whole, axis) in stacked.items():
        if frames > 1 and (not isinstance(whole, Box) or not whole.shape or whole.shape[axis] % frames):
            raise CheckpointError(f"{file}: {whole} is not a stack of {frames} frames")
        frame_spaces[key] = whole if frames == 1 else _first_frame(file, whole, axis, frames)
    is_dict = isinstance(model_space, Dict)
    steps = [Transpose(_leaf(key)) for key in transposed]
    stacks = [
        FrameStack(frames, frame_spaces[key].shape,
                   _stack_dtype(file, key, frame_spaces[key], normalized_first and _is_normalized(vec, key)),
                   leaf=_leaf(key), channels_first=axis == 0)
        for key, (_, axis) in stacked.items() if frames > 1
    ]  # fmt: skip
    filters = _filters(vec)
    before: list[ObservationFilter | FrameStack] = [*filters, *stacks] if normalized_first else [*stacks, *filters]
    frame = Dict(list(frame_spaces.items())) if is_dict else frame_spaces[""]
    return Layout(frame, frames, normalized_first, (*before, *steps))


def _leaves(space: Any) -> dict[str, Any]:
    inside = getattr(space, "spaces", None)  # a Dict of Gym's in older statistics has them too
    return dict(inside) if isinstance(inside, Mapping) else {"": space}


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


def _first_frame(file: Path, space: Any, axis: int, frames: int) -> Box:
    """Return one frame's space: VecFrameStack repeats each bound before the next one (stable-baselines3 2.9)."""
    size = space.shape[axis] // frames
    low, high = (np.take(side, np.arange(size) * frames, axis) for side in (space.low, space.high))
    if any((np.repeat(one, frames, axis) != side).any() for one, side in ((low, space.low), (high, space.high))):
        raise CheckpointError(
            f"{file}: the bounds of {space} are not those that a VecFrameStack of {frames} frames gives: give the "
            "--frame-stack of its training"
        )
    return Box(low, high, dtype=space.dtype.type)


def _is_normalized(vec: Any, key: str) -> bool:
    return vec is not None and vec.norm_obs and (not key or key in vec.norm_obs_keys)


def _stack_dtype(file: Path, key: str, space: Box, normalized: bool) -> str:
    """Return the type of a stack's frames. Raises UnsupportedError for one that does not hold normalized numbers."""
    if normalized and space.dtype not in (np.float32, np.float64):
        raise UnsupportedError(
            f"{file}: {_leaf(key)}: VecFrameStack keeps what VecNormalize gives as {space.dtype}, the environment's "
            "type, and so cuts it off: stack below VecNormalize, or let the environment give float32"
        )
    return "float32" if normalized else str(space.dtype)


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
            raise UnsupportedError(f"{file}: {_leaf(key)}: the observation space {space} is not exported: {EXPORTED}")
    if not isinstance(action_space, Box | Discrete | MultiDiscrete | MultiBinary):
        raise UnsupportedError(f"{file}: the action space {action_space} is not exported: {EXPORTED}")
    if isinstance(action_space, Box) and action_space.dtype not in (np.float32, np.float64):
        raise UnsupportedError(f"{file}: the action space {action_space} is not exported: expected float32 or float64")
