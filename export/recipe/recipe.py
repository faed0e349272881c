"""Recipe of a policy: the observation steps before the network and the action rule after it, as numbers.

`export/rllib` reads a `Recipe` off RLlib's saved connectors and `policy_graph.py` turns it into a graph.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
from gymnasium.spaces import Box, MultiBinary, MultiDiscrete
from numpy.typing import NDArray

from rlservo.export.recipe.trees import space_leaves

# ray/rllib/utils/numpy.py (ray 2.60): keeps the filter from dividing by zero.
SMALL_NUMBER = 1e-6


@dataclass(frozen=True)
class ObservationFilter:
    """A running filter, frozen: `clip((x - mean) / (std + epsilon), -clip, clip)`.

    RLlib's MeanStdFilter (ray/rllib/utils/filter.py), Stable-Baselines3's VecNormalize, skrl's RunningStandardScaler.
    """

    count: int
    """Number of observations the statistics were gathered from."""
    mean: NDArray[np.float64]
    """Mean, of the observation's shape, in its units."""
    std: NDArray[np.floating[Any]]
    """Standard deviation; RLlib's is unbiased (n - 1), zero for n <= 1, and in single precision."""
    clip: float | None
    demean: bool = True
    """Whether the mean is subtracted at all (`de_mean_to_zero`)."""
    destd: bool = True
    """Whether the standard deviation divides at all (`de_std_to_one`)."""
    epsilon: float = SMALL_NUMBER
    """Number added to the standard deviation."""
    leaf: str = "obs"
    """The filtered part of the observation, by input name."""
    keeps_integers: bool = True
    """Whether filtered integers are cut back to integers, as RLlib does it."""

    def offset(self) -> NDArray[np.float64]:
        """Return the subtrahend, of the observation's shape."""
        return self.mean if self.demean else np.zeros_like(self.mean)

    def divisor(self) -> NDArray[np.floating[Any]]:
        """Return the divisor, of the observation's shape."""
        return self.std + self.std.dtype.type(self.epsilon) if self.destd else np.ones_like(self.std)


@dataclass(frozen=True)
class Flatten:
    """RLlib's FlattenObservations: one float32 row, discrete parts one-hot, Dict keys in sorted order.

    `space` is what comes in; None is a single Box. `without` are top-level keys that are left out.
    """

    space: Any = None
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class FrameStack:
    """FrameStacking: the last `frames` observations, `every` steps apart, side by side on the last axis, zeros before.

    RLlib's own stacks images `[height, width, 1]`, the batched connectors' vectors.
    """

    frames: int
    shape: tuple[int, ...]
    dtype: str
    every: int = 1
    leaf: str = "obs"
    """The stacked part of the observation, by input name."""
    channels_first: bool = False
    """Whether the frames are side by side on the first axis."""

    @property
    def state_name(self) -> str:
        return "frames" + self.leaf.removeprefix("obs")

    @property
    def past_shape(self) -> tuple[int, ...]:
        """The shape of the kept frames."""
        kept = (self.frames - 1) * self.every
        if self.channels_first:
            return (kept * self.shape[0], *self.shape[1:])
        return (*self.shape[:-1], kept * self.shape[-1])


@dataclass(frozen=True)
class Transpose:
    """Images from `[height, width, channel]`, as environments give them, to `[channel, height, width]`."""

    leaf: str = "obs"


@dataclass(frozen=True)
class Logarithm:
    """The batched connectors' Logarithm: `log(max(x, lowest))` of some elements of a vector."""

    elements: tuple[int, ...]
    lowest: float


@dataclass(frozen=True)
class SineAndCosine:
    """The batched connectors' SineAndCosine: some elements' sines in their place, their cosines after all others."""

    elements: tuple[int, ...]


@dataclass(frozen=True)
class Previous:
    """RLlib's PrevActionsPrevRewards: a dict of the observation, the last actions' one-hot codes and last rewards."""

    actions: int
    choices: int
    """Number of actions to choose from: the width of a one-hot code."""
    rewards: int
    keys: tuple[str, str, str] = ("_orig_obs", "prev_n_actions", "prev_n_rewards")


@dataclass(frozen=True)
class UserStep:
    """A stateless connector of the user's own, as a function of torch tensors `[batch, ...]` in the space's form."""

    name: str
    function: Callable[[Any], Any] = field(compare=False)


@dataclass(frozen=True)
class Preprocess:
    """The old API stack's preprocessor: one float32 row of the space's leaves, Dict keys in sorted order.

    Discrete leaves are one-hot from their start on. A Box of shape (128,) is treated as an Atari console's memory:
    `(x - 128) / 128` (ray/rllib/models/preprocessors.py, ray 2.60).
    """

    space: Any


ObservationStep: TypeAlias = (
    ObservationFilter | Flatten | FrameStack | Transpose | Logarithm | SineAndCosine | Previous | UserStep | Preprocess
)

Mode: TypeAlias = Literal["mean", "tanh_mean", "argmax", "given"]
"""Rule from the distribution's parameters (or Q-values) to the deterministic action; or the action is given."""

Transform: TypeAlias = Literal["none", "unsquash", "clip"]
"""RLlib's step from that action to `env.step`; Box leaves that are not bounded on all sides are not unsquashed."""

DistributionKind: TypeAlias = Literal["diag_gaussian", "squashed_gaussian", "categorical", "multi_categorical", "multi"]


@dataclass(frozen=True)
class StateLeaf:
    """One array that a policy carries from step to step, and its initial value."""

    name: str
    initial: NDArray[Any]
    kind: Literal["recurrent", "frames", "previous_actions", "previous_rewards"] = "recurrent"


@dataclass(frozen=True)
class Affine:
    """An environment's scaling of a policy's numbers: `clip(action, -limit, limit) * scale + offset`."""

    scale: NDArray[np.float32]
    """Scale, of the action's shape, in its units."""
    offset: NDArray[np.float32]
    """Offset, the same."""
    limit: float | None = None

    def apply(self, action: NDArray[Any]) -> NDArray[Any]:
        """Return the action in the environment's units, in numpy: the reference of a graph."""
        limited = action if self.limit is None else np.clip(action, -self.limit, self.limit)
        return np.asarray(limited * self.scale + self.offset)


@dataclass(frozen=True)
class Present:
    """Positions in the observation, a vector, to which an action is relative: their sum is the environment's action."""

    columns: tuple[int, ...]
    """The observation's element for each of the action's."""
    scale: NDArray[np.float32]
    """The position is `observation * scale + offset`, in the action's units; 0 for an action that is not relative."""
    offset: NDArray[np.float32]
    """Offset, of the action's shape."""
    low: NDArray[np.float32]
    """Clip of the relative action, before it is added."""
    high: NDArray[np.float32]
    """The clip's upper side."""

    @property
    def clips(self) -> bool:
        """Whether the relative action is clipped."""
        return bool(np.isfinite([self.low, self.high]).any())

    def positions(self, obs: NDArray[Any]) -> NDArray[Any]:
        """Return the present positions for observations `[..., n]`, in numpy."""
        return np.asarray(obs[..., list(self.columns)] * self.scale + self.offset)


@dataclass(frozen=True)
class Recipe:
    """Everything between a raw observation and `env.step`, except the network."""

    observation_space: Any
    """A Box, Discrete, MultiDiscrete or MultiBinary, or a Dict or Tuple of such, nested at will."""
    action_space: Any
    """A Box, Discrete or MultiDiscrete, or a Dict or Tuple of such; a MultiBinary whose mode is "given"."""
    steps: tuple[ObservationStep, ...]
    mode: Mode
    """Mode of the Box leaves (discrete ones are always argmax), or of the whole action if it is one leaf."""
    transform: Transform
    distribution: DistributionKind | None
    """None if the module picks its action itself and offers no distribution (DQN)."""
    network_state: tuple[StateLeaf, ...] = ()
    """A recurrent network's state, in the order the network takes and gives it."""
    action_steps: tuple[UserStep, ...] = ()
    """The user's own connectors between the distribution's mode and unsquashing."""
    affine: Affine | None = None
    """For an action that is one Box: its transform before it is clipped."""
    present: Present | None = None
    """For a Box action that is relative to a Box observation, last of all."""

    @property
    def filter(self) -> ObservationFilter | None:
        """The observation filter, if there is one."""
        return next((step for step in self.steps if isinstance(step, ObservationFilter)), None)

    @property
    def first_filters(self) -> dict[str, ObservationFilter]:
        """The filters of the raw observation, by leaf."""
        first = itertools.takewhile(lambda step: isinstance(step, ObservationFilter), self.steps)
        return {step.leaf: step for step in first if isinstance(step, ObservationFilter)}

    @property
    def observation_leaves(self) -> dict[str, Any]:
        """The observation's leaf spaces by the graph's input names."""
        return space_leaves(self.observation_space, "obs")

    @property
    def action_leaves(self) -> dict[str, Any]:
        """The action's leaf spaces by the graph's output names."""
        return space_leaves(self.action_space, "action")

    @property
    def state(self) -> tuple[StateLeaf, ...]:
        """All state that is carried from step to step: the observation steps' first, then the network's."""
        carried: list[StateLeaf] = []
        for step in self.steps:
            if isinstance(step, FrameStack):
                carried.append(StateLeaf(step.state_name, np.zeros(step.past_shape, step.dtype), "frames"))
            elif isinstance(step, Previous):
                if step.actions:
                    codes = np.zeros(step.actions * step.choices, np.float32)
                    carried.append(StateLeaf("previous_actions", codes, "previous_actions"))
                if step.rewards > 1:
                    earlier = np.zeros(step.rewards - 1, np.float32)
                    carried.append(StateLeaf("previous_rewards", earlier, "previous_rewards"))
        return (*carried, *self.network_state)

    @property
    def user_steps(self) -> tuple[UserStep, ...]:
        """The user's own connectors."""
        return (*(step for step in self.steps if isinstance(step, UserStep)), *self.action_steps)

    @property
    def needs_reward(self) -> bool:
        """Whether the graph has an input `reward`: the last action's reward, 0 at an episode's start."""
        return any(isinstance(step, Previous) and step.rewards > 0 for step in self.steps)


def parameter_count(space: Any) -> int:
    """Return the number of distribution parameters of one action leaf."""
    if isinstance(space, Box | MultiBinary):
        return 2 * math.prod(space.shape)
    if isinstance(space, MultiDiscrete):
        return int(space.nvec.sum())
    return int(space.n)


def leaf_transform(space: Any, transform: Transform) -> Transform:
    """Return the transform of one action leaf: only for a Box, and unsquashed only if bounded on all sides."""
    if not isinstance(space, Box):
        return "none"
    if transform == "unsquash" and not bool((space.bounded_below & space.bounded_above).all()):
        return "none"
    return transform


def loose_bounds(recipe: Recipe, framework: str) -> list[str]:
    """Return a sentence for each action leaf whose bounds the framework does not enforce."""
    return [
        f"{name}: {framework} sends the network's own numbers, whether inside {space} or not, and so does the graph; "
        "rlservo's runtime refuses an action outside"
        for name, space in recipe.action_leaves.items()
        if isinstance(space, Box)
        and bool((space.bounded_below | space.bounded_above).any())
        and leaf_transform(space, recipe.transform) == "none"
    ]
