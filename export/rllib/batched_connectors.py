"""RLlib's default connectors for one agent, as pieces that take all environments of a runner at once.

RLlib (2.60) passes each environment's observation and action through ten pieces, one by one and each timed, which takes
as long as the simulator or longer. These give the same numbers, bit by bit. They work if an observation is a Box, an
action a Box, Discrete or MultiDiscrete, and the network has no memory:

    use_batched_connectors(config, observation_filter=True)

What RLlib does not have are the logarithm of some elements, the sine and cosine of angles, and stacked vectors (its own
stacks images).

Two are called as RLlib's own, whose work they do: a checkpoint keeps a piece's state under its class's name, so that
what was trained with either continues with the other, and `new_stack` exports both alike. Checkpoints name this
module and its classes: under other names they could not be read.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import ray
import torch
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from ray.rllib.connectors import env_to_module, module_to_env
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import TorchDiagGaussian
from ray.rllib.utils.filter import MeanStdFilter as RunningFilter
from ray.rllib.utils.filter import RunningStat
from ray.rllib.utils.numpy import SMALL_NUMBER, convert_to_numpy
from ray.rllib.utils.spaces.space_utils import clip_action, unsquash_action

from rlservo.errors import UsageError

SUMS = ("mean_array", "sum_sq_diff_array")  # of a running filter


def use_batched_connectors(
    config: Any,
    *,
    observation_filter: bool,
    logarithm_of: Sequence[int] = (),
    sine_and_cosine_of: Sequence[int] = (),
    num_frames: int = 1,
    every: int = 1,
) -> None:
    """Replace RLlib's pieces by these in an `AlgorithmConfig`.

    Of the observation's elements `logarithm_of` (their indices) the logarithm is taken, of `sine_and_cosine_of` both;
    `observation_filter` is whether observations then go through a MeanStdFilter; the network sees the last `num_frames`
    of them, `every` steps apart.
    Connectors of the configuration's own are replaced. The configuration must set the scaling of actions before, with
    `environment(normalize_actions=..., clip_actions=...)`.
    """
    # Here, since exports import this module and have no use for RLlib's env runner.
    from rlservo.export.rllib.batched_env_runner import BatchedEnvRunner

    scaling = {"normalize_actions": config.normalize_actions, "clip_actions": config.clip_actions}

    def before(_env: Any, _spaces: Any, device: Any) -> list[ConnectorV2]:
        logarithm = [Logarithm(elements=tuple(logarithm_of))] if logarithm_of else []
        angles = [SineAndCosine(elements=tuple(sine_and_cosine_of))] if sine_and_cosine_of else []
        batched = MeanStdFilter if observation_filter else BatchedObservations
        stacking = [FrameStacking(num_frames=num_frames, every=every, device=device)] if num_frames > 1 else []
        return [*logarithm, *angles, batched(device=device), *stacking]

    def after(_env: Any, _spaces: Any) -> ConnectorV2:
        return NormalizeAndClipActions(**scaling)

    config.env_runners(
        env_to_module_connector=before,
        module_to_env_connector=after,
        add_default_connectors_to_env_to_module_pipeline=False,
        add_default_connectors_to_module_to_env_pipeline=False,
        episode_lookback_horizon=max(config.episode_lookback_horizon, (num_frames - 1) * every),
    )
    if config.env_runner_cls is None:
        config.env_runners(env_runner_cls=BatchedEnvRunner)


def supports(observation_space: Any, action_space: Any) -> bool:
    """Whether these pieces suit an agent with such spaces, if its network has no memory."""
    return isinstance(observation_space, Box) and isinstance(action_space, Box | Discrete | MultiDiscrete)


class BatchedObservations(ConnectorV2):
    """Each episode's last observation, as one tensor `[environments, ...]` for the network."""

    def __init__(
        self, input_observation_space: Any = None, input_action_space: Any = None, *, device: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(input_observation_space, input_action_space, **kwargs)
        self._device = device

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        return super().recompute_output_observation_space(_check_box(input_observation_space), input_action_space)

    def __call__(self, *, rl_module: Any, batch: dict[str, Any], episodes: list[Any], **_: Any) -> dict[str, Any]:
        rows = [episode.observations.data[-1] for episode in episodes]
        batch[Columns.OBS] = _tensor(rows, rl_module, self._device)
        return batch


class MeanStdFilter(env_to_module.MeanStdFilter):
    """The same after RLlib's running filter."""

    def __init__(
        self, input_observation_space: Any = None, input_action_space: Any = None, *, device: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(
            input_observation_space=input_observation_space, input_action_space=input_action_space, **kwargs
        )
        check_filter()
        self._device = device
        self._before: Any = None  # the statistics that were set last

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        return super().recompute_output_observation_space(_check_box(input_observation_space), input_action_space)

    def __call__(self, *, rl_module: Any, batch: dict[str, Any], episodes: list[Any], **_: Any) -> dict[str, Any]:
        if self._filters is None:
            self.get_state()  # makes new ones
        filters: Any = self._filters
        running = filters[None]
        rows = []
        for episode in episodes:
            row = np.asarray(episode.observations.data[-1])
            if self._update_stats:
                push(running.running_stats, row)
            row = _filtered(row, running)
            episode.observations.data[-1] = row  # the learner sees this
            if episode.observation_space is not self.observation_space:
                episode.observation_space = self.observation_space
            rows.append(row)
        batch[Columns.OBS] = _tensor(rows, rl_module, self._device)
        return batch

    def get_state(self, components: Any = None, **kwargs: Any) -> Any:
        if self._filters is not None:
            running: Any = self._filters[None]
            _tell_what_is_new(running.running_stats, self._before)
        return super().get_state(components, **kwargs)

    def set_state(self, state: Any) -> None:
        super().set_state(state)
        filters: Any = self._filters
        self._before = filters[None].running_stats.copy()

    def reset_state(self) -> None:
        super().reset_state()
        self._before = None


class _OfElements(ConnectorV2):
    """A function of some elements of a vector that replaces the observation."""

    WHAT: ClassVar[str]

    def __init__(
        self,
        input_observation_space: Any = None,
        input_action_space: Any = None,
        *,
        elements: tuple[int, ...],
        **kwargs: Any,
    ) -> None:
        self.elements = list(elements)
        super().__init__(input_observation_space, input_action_space, **kwargs)

    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Return the state for a checkpoint; RLlib itself looks for the arguments in the class alone (ray 2.60)."""
        arguments, named = super().get_ctor_args_and_kwargs()
        return arguments, {**named, "elements": tuple(self.elements)}

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        del input_action_space
        space = _check_box(input_observation_space)
        if len(space.shape) != 1 or space.dtype.kind != "f":
            raise UsageError(f"observations are {space}: {self.WHAT}s need a vector of floating-point numbers")
        if wrong := [index for index in self.elements if not 0 <= index < space.shape[0]]:
            raise UsageError(f"{self.WHAT} of element {wrong[0]}: observations have elements 0 to {space.shape[0] - 1}")
        return Box(*self.bounds(space.low, space.high), dtype=space.dtype)

    def __call__(self, *, batch: dict[str, Any], episodes: list[Any], **_: Any) -> dict[str, Any]:
        for episode in episodes:
            seen = episode.observations.data
            seen[-1] = self.changed(seen[-1])
            episode.observation_space = self.observation_space
        return batch

    def changed(self, row: Any) -> Any:
        """Return the replacement of one observation."""
        raise NotImplementedError

    def bounds(self, low: Any, high: Any) -> tuple[Any, Any]:
        """Return the replacement's bounds."""
        raise NotImplementedError


class Logarithm(_OfElements):
    """The natural logarithm of some elements of a vector, of those below LOWEST its own.

    For distances: 5 cm matter at 20 cm and not at 5 m, but a filter divides both alike.
    """

    LOWEST = 0.05
    WHAT = "logarithm"

    def changed(self, row: Any) -> Any:
        changed = row.copy()
        changed[self.elements] = np.log(np.maximum(row[self.elements], self.LOWEST))
        return changed

    def bounds(self, low: Any, high: Any) -> tuple[Any, Any]:
        return self.changed(low), self.changed(high)


class SineAndCosine(_OfElements):
    """The sines of some elements of a vector in their place, and their cosines after all others.

    For directions: behind a robot -pi and pi are the same, but as far apart as two angles can be.
    """

    WHAT = "sine"

    def changed(self, row: Any) -> Any:
        angles = row[self.elements]
        changed = np.concatenate([row, np.cos(angles)])
        changed[self.elements] = np.sin(angles)
        return changed

    def bounds(self, low: Any, high: Any) -> tuple[Any, Any]:
        edges = []
        for bound, edge in ((low, -1.0), (high, 1.0)):
            changed = np.concatenate([bound, np.full(len(self.elements), edge, bound.dtype)])
            changed[self.elements] = edge
            edges.append(changed)
        return edges[0], edges[1]


class FrameStacking(ConnectorV2):
    """The last `num_frames` vectors side by side, `every` steps apart, the newest last; zeros before the episode.

    RLlib's own takes images alone, and stacks them for the learner a second time: here the episode keeps the stack.
    What came before is read from the episode, so that `episode_lookback_horizon` must reach as far back.
    """

    def __init__(
        self,
        input_observation_space: Any = None,
        input_action_space: Any = None,
        *,
        num_frames: int,
        every: int = 1,
        device: Any = None,
        **kwargs: Any,
    ) -> None:
        self.num_frames = num_frames
        self.every = every
        self._device = device
        super().__init__(input_observation_space, input_action_space, **kwargs)

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        del input_action_space
        space = _check_box(input_observation_space)
        if len(space.shape) != 1:
            raise UsageError(
                f"observations are {space}: only frames of vectors are stacked here; RLlib's FrameStacking stacks "
                "images"
            )
        return Box(np.tile(space.low, self.num_frames), np.tile(space.high, self.num_frames), dtype=space.dtype)

    def __call__(self, *, rl_module: Any, batch: dict[str, Any], episodes: list[Any], **_: Any) -> dict[str, Any]:
        space: Any = self.input_observation_space
        size = space.shape[0]
        before_the_start = np.zeros(size, space.dtype)
        ages = range((self.num_frames - 1) * self.every, -1, -self.every)
        rows = []
        for episode in episodes:
            seen = episode.observations.data  # stacks, but for the newest; a stack's last part is its own frame
            frames = [seen[-1 - age][-size:] if age < len(seen) else before_the_start for age in ages]
            seen[-1] = row = np.concatenate(frames)
            episode.observation_space = self.observation_space
            rows.append(row)
        batch[Columns.OBS] = _tensor(rows, rl_module, self._device)
        return batch


class NormalizeAndClipActions(module_to_env.NormalizeAndClipActions):
    """Actions drawn from the network's distribution and scaled for the environments, `[environments, ...]`."""

    def __init__(self, input_observation_space: Any = None, input_action_space: Any = None, **kwargs: Any) -> None:
        self._low: Any = None  # of actions that are scaled
        self._range: Any = None
        self._space: Any = None
        super().__init__(input_observation_space, input_action_space, **kwargs)
        self._get_actions = module_to_env.GetActions()

    def recompute_output_action_space(self, input_observation_space: Any, input_action_space: Any) -> Any:
        self._space = space = super().recompute_output_action_space(input_observation_space, input_action_space)
        if isinstance(space, Box) and space.dtype in (np.float32, np.float64) and space.is_bounded():
            self._low, self._range = space.low, space.high - space.low
        return space

    def __call__(self, *, batch: Any, **kwargs: Any) -> dict[str, Any]:
        if kwargs["explore"] and _is_gaussian(kwargs["rl_module"], batch):
            drawn = {**batch, **_draw(batch[Columns.ACTION_DIST_INPUTS])}
        else:
            drawn = self._get_actions(batch=batch, **kwargs)
        columns = {name: _array(value) for name, value in drawn.items()}
        actions, space = columns[Columns.ACTIONS], self._space
        if self.normalize_actions and self._range is not None:
            scaled = self._low + (actions + 1.0) * self._range / 2.0
            columns[Columns.ACTIONS_FOR_ENV] = scaled.clip(space.low, space.high)
        elif self.normalize_actions:
            columns[Columns.ACTIONS_FOR_ENV] = unsquash_action(actions.copy(), space)
        elif self.clip_actions:
            columns[Columns.ACTIONS_FOR_ENV] = clip_action(actions.copy(), space)
        return columns


HALF_LOG_OF_TWO_PI = math.log(math.sqrt(2.0 * math.pi))


def _draw(inputs: torch.Tensor) -> dict[str, Any]:
    """Draw from normal distributions as RLlib does, from the same random numbers, and round as it does.

    What numpy need not round as torch, exponential, logarithm and sum, torch computes.
    """
    inputs = inputs.detach()
    size = inputs.shape[-1] // 2
    spread = inputs[..., size:].exp()
    mean, std, log_std = inputs.numpy()[..., :size], spread.numpy(), spread.log().numpy()
    actions = torch.randn(std.shape).numpy() * std + mean
    way = actions - mean
    each = -(way * way) / (2 * (std * std)) - log_std - HALF_LOG_OF_TWO_PI
    return {Columns.ACTIONS: actions, Columns.ACTION_LOGP: torch.from_numpy(each).sum(-1)}


def _is_gaussian(module: Any, outputs: dict[str, Any]) -> bool:
    """Return whether `_draw` suits the actions of these network outputs."""
    return (
        Columns.ACTIONS not in outputs
        and module.get_exploration_action_dist_cls() is TorchDiagGaussian
        and outputs[Columns.ACTION_DIST_INPUTS].is_cpu
        and draws_the_same()
    )


@functools.cache
def draws_the_same() -> bool:
    """Return whether these versions of RLlib, torch and numpy draw the same with `_draw`, bit by bit."""
    generator = torch.default_generator  # the processor's: a GPU's random numbers are not touched
    before = generator.get_state()
    try:
        for size in ((1, 6), (5, 12)):  # torch draws fewer than sixteen numbers in another way than more
            inputs = torch.randn(size, generator=generator.manual_seed(1))
            theirs: Any = TorchDiagGaussian.from_logits(inputs)
            generator.manual_seed(0)
            actions = theirs.sample()
            generator.manual_seed(0)
            ours = _draw(inputs)
            same = ours[Columns.ACTIONS].tobytes() == actions.numpy().tobytes()
            if not (same and torch.equal(ours[Columns.ACTION_LOGP], theirs.logp(actions))):
                return False
    finally:
        generator.set_state(before)
    return True


def _check_box(space: Any) -> Any:
    if not isinstance(space, Box):
        raise UsageError(f"observations are {space}: the batched connectors take a Box, RLlib's own take any space")
    return space


def _tensor(rows: list[Any], module: Any, device: Any) -> Any:
    """Return observations as the network's input, or as an array if there is no network."""
    stacked = np.array(rows)
    if module is None:
        return stacked
    if module.training:  # RLlib would walk all layers twice a step, to leave training mode and to enter it again
        if module.is_stateful():
            raise UsageError(
                "the network has memory (such as an LSTM), which the batched connectors do not support: use RLlib's own"
            )
        module.eval()
        module.eval = functools.partial(_evaluate, module)
    tensor = torch.from_numpy(stacked)
    if tensor.dtype == torch.float64:
        tensor = tensor.float()
    return tensor if device is None else tensor.to(device)


def _evaluate(module: Any) -> Any:
    """Put a network into evaluation mode if it is in training mode."""
    return type(module).eval(module) if module.training else module


def _array(value: Any) -> Any:
    """Return a tensor or array as RLlib's `convert_to_numpy` does, and anything else through it."""
    array = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
    if not isinstance(array, np.ndarray) or array.ndim == 0:
        return convert_to_numpy(value)
    kind = array.dtype.kind
    if kind == "f":
        return array.astype(np.float32, copy=False)
    return array.astype(np.int32) if array.dtype == np.int64 else array


def push(stats: RunningStat, row: Any) -> None:
    """Do what `RunningStat.push` does, operation by operation, without copies, checks and what is new (below)."""
    stats.num_pushes += 1
    if stats.num_pushes == 1:
        stats.mean_array[...] = row
        return
    delta = row - stats.mean_array
    stats.mean_array += delta / stats.num_pushes
    delta *= row - stats.mean_array
    stats.sum_sq_diff_array += delta


def _tell_what_is_new(stats: RunningStat, before: RunningStat | None) -> None:
    """Let the deltas be count, mean and spread of the observations since `before`.

    So `RunningStat.update`, which merges several runners, takes them. RLlib's own are by how much all observations'
    mean and spread have changed: merged, they pull the mean towards 0.
    """
    before = RunningStat(stats.shape) if before is None else before
    new = stats.num_pushes - before.num_pushes
    share = stats.num_pushes / new if new else 0.0
    moved = (stats.mean_array - before.mean_array) * share
    spread = stats.sum_sq_diff_array - before.sum_sq_diff_array - moved**2 * (before.num_pushes / (share or 1.0))
    stats.num_pushes_delta = new
    stats.mean_delta_array = before.mean_array + moved
    stats.sum_sq_diff_delta_array = spread


@functools.cache
def check_filter() -> None:
    """Raise UsageError if this Ray's filter does not do what is written here, bit by bit."""
    theirs: Any = RunningFilter((3,))
    ours: Any = RunningFilter((3,))
    try:
        for row in np.random.default_rng(0).normal(2.0, 5.0, (9, 3)).astype(np.float32):
            push(ours.running_stats, row)
            same = theirs(row).tobytes() == _filtered(row, ours).tobytes()
            stats, own = theirs.running_stats, ours.running_stats
            if not same or any(getattr(stats, name).tobytes() != getattr(own, name).tobytes() for name in SUMS):
                raise ValueError
        for name in ("_filters", "_update_stats"):
            if not hasattr(env_to_module.MeanStdFilter(), name):
                raise AttributeError(name)
    except (AttributeError, TypeError, ValueError):
        raise UsageError(f"Ray {ray.__version__} filters observations differently: use its own connectors") from None


def _filtered(row: Any, running: Any) -> Any:
    """Do what RLlib's filter does to one observation, without updating."""
    filtered = row
    stats = running.running_stats
    if running.demean:
        filtered = filtered - stats.mean_array
    if running.destd:
        filtered = filtered / (stats.std + SMALL_NUMBER)
    if running.clip:
        filtered = np.clip(filtered, -running.clip, running.clip)
    return filtered.astype(row.dtype)
