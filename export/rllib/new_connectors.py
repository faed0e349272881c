"""Read off RLlib's new-stack connector pipelines what they do to an observation and to an action.

A piece that is not known is refused by its class name, because leaving it out would change the policy. The pieces are
known by name and by coming from RLlib itself. A piece of the user's own is taken where it offers `torch_forward`, a
function of torch tensors `[batch, ...]` that does the same as the piece.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete

from rlservo.export.checkpoints.location import CheckpointFiles
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.recipe.recipe import (
    Flatten,
    FrameStack,
    ObservationFilter,
    ObservationStep,
    Previous,
    Transform,
    UserStep,
)
from rlservo.export.recipe.trees import space_leaves

# Pieces that move data about without changing a number.
PLUMBING = frozenset({
    "AddObservationsFromEpisodesToBatch",
    "AddTimeDimToBatchAndZeroPad",
    "AddStatesFromEpisodesToBatch",
    "AgentToModuleMapping",
    "BatchIndividualItems",
    "NumpyToTensor",
    "WriteObservationsToEpisodes",
    "GetActions",
    "TensorToNumpy",
    "UnBatchToIndividualItems",
    "ModuleToAgentUnmapping",
    "RemoveSingleTsTimeRankFromBatch",
    "ListifyDataForVectorEnv",
})  # fmt: skip
TAKES_OBSERVATION = frozenset({"AddObservationsFromEpisodesToBatch", "FrameStacking"})
"""Pieces that put the observation into the batch: what a later one changes in the episode comes too late."""

HOOK = "torch_forward"
DTYPES = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")


@dataclass(frozen=True)
class Seat:
    """Whose part is read of pipelines that serve several agents; `agent` None where there is only one."""

    agent: Any = None
    module: str = ""
    agents: tuple[str, ...] = ()
    """All agents for whom this one stands."""

    def part(self, space: Any) -> Any:
        """Return the agent's own part of a space, which behind the mapping is its module's."""
        if self.agent is None:
            return space
        return space[self.agent] if self.agent in space.spaces else space[self.module]


ALONE = Seat()


def check_spaces(observation_space: Any, action_space: Any, *, integer_actions: bool = False) -> None:
    """Raise UnsupportedError unless every leaf of both spaces is of a kind that is exported.

    `integer_actions` allows Boxes of integers as actions, for which only RLlib's old stack has a distribution.
    """
    for name, space in space_leaves(observation_space, "obs").items():
        if not isinstance(space, Box | Discrete | MultiDiscrete | MultiBinary):
            raise UnsupportedError(f"{name}: the observation space {space} is not exported: it has no fixed shape")
        if isinstance(space, Box) and str(space.dtype) not in DTYPES:
            raise UnsupportedError(
                f"{name}: {space} is not exported: torch has no {space.dtype} tensors to compute with"
            )
    for name, space in space_leaves(action_space, "action").items():
        if not isinstance(space, Box | Discrete | MultiDiscrete):
            raise UnsupportedError(
                f"{name}: the action space {space} is not exported: RLlib has no action distribution for it"
            )
        whole = integer_actions and np.dtype(space.dtype).kind in "iu"
        if isinstance(space, Box) and space.dtype not in (np.float32, np.float64) and not whole:
            raise UnsupportedError(f"{name}: the action space {space} is not exported: only float Boxes are")
        if isinstance(space, MultiDiscrete) and space.nvec.ndim != 1:
            raise UnsupportedError(f"{name}: the action space {space} is not exported: only one-dimensional ones are")


def read_observation_steps(
    env_to_module: Any, files: CheckpointFiles, seat: Seat = ALONE
) -> tuple[ObservationStep, ...]:
    """Return what the env-to-module pipeline does to an observation of whoever has the seat, and freeze the pipeline.

    Raises UnsupportedError for a piece that is not known, CheckpointError when a filter's statistics are missing.
    """
    steps: list[ObservationStep] = []
    taken_by = ""
    for piece in env_to_module.connectors:
        step = _observation_step(piece, files, seat)
        name = type(piece).__name__
        if step is not None and taken_by:
            raise UnsupportedError(
                f"the env-to-module connector {name} comes after {taken_by}, which has handed the observation on "
                "already: what RLlib does then depends on the step before, which is not exported"
            )
        if name in TAKES_OBSERVATION and _is_rllibs(type(piece)):
            taken_by = name
        if step is not None:
            steps.append(step)
    for kind in (ObservationFilter, FrameStack, Previous):
        if sum(isinstance(step, kind) for step in steps) > 1:
            raise UnsupportedError(
                f"the pipeline has two {kind.__name__} pieces of one class, of which RLlib's checkpoint keeps only one"
            )
    return tuple(steps)


def read_action_steps(module_to_env: Any, action_space: Any) -> tuple[Transform, tuple[UserStep, ...]]:
    """Return what the module-to-env pipeline does to an action (`unsquash_action`, `clip_action` in ray 2.60)."""
    transform: Transform = "none"
    steps: list[UserStep] = []
    for piece in module_to_env.connectors:
        kind = type(piece)
        if kind.__name__ == "NormalizeAndClipActions" and _is_rllibs(kind):
            if piece.normalize_actions:
                transform = "unsquash"
            elif piece.clip_actions:
                transform = "clip"
        elif kind.__name__ not in PLUMBING or not _is_rllibs(kind):
            if transform != "none":
                raise UnsupportedError(
                    f"the module-to-env connector {kind.__name__} ({kind.__module__}) comes after the actions have "
                    "been scaled, which is not exported"
                )
            steps.append(_user_step(piece, "module-to-env", "the environment would get other actions"))
    leaves = space_leaves(action_space, "action").values()
    bounded = (bool((leaf.bounded_below & leaf.bounded_above).all()) for leaf in leaves if isinstance(leaf, Box))
    if transform == "unsquash" and not any(bounded):
        transform = "none"
    if not any(isinstance(leaf, Box) for leaf in leaves):
        transform = "none"
    return transform, tuple(steps)


def _observation_step(piece: Any, files: CheckpointFiles, seat: Seat) -> ObservationStep | None:
    """Return what an env-to-module piece does to an observation (None: nothing); freeze it while at it."""
    kind = type(piece)
    if not _is_rllibs(kind):
        return _user_step(piece, "env-to-module", "the network would see other numbers")
    space = seat.part(piece.input_observation_space)
    if kind.__name__ == "MeanStdFilter":
        if not (files.env_to_module / kind.__name__).is_dir():
            raise CheckpointError(
                f"{files.env_to_module / kind.__name__} is missing: the observation filter's statistics"
            )
        piece._update_stats = False  # a restored filter goes on learning from whatever it is shown
        return None if isinstance(space, Discrete | MultiDiscrete) else _filter(piece, space, seat)
    if kind.__name__ == "FlattenObservations":
        skipped = seat.agent is not None and piece._agent_ids and seat.agent not in piece._agent_ids
        return None if skipped else _flatten(piece, space)
    if kind.__name__ == "FrameStacking":
        return FrameStack(int(piece.num_frames), tuple(space.shape), str(space.dtype))
    if kind.__name__ == "PrevActionsPrevRewards":
        choices = seat.part(piece.input_action_space)
        if not isinstance(choices, Discrete):
            raise UnsupportedError(
                f"{kind.__name__} on the action space {choices} is not exported: RLlib's is Discrete"
            )
        keys = (piece.ORIG_OBS_KEY, piece.PREV_ACTIONS_KEY, piece.PREV_REWARDS_KEY)
        return Previous(int(piece.n_prev_actions), int(choices.n), int(piece.n_prev_rewards), keys)
    if kind.__name__ == "NumpyToTensor":
        piece._device = None  # a checkpoint from a GPU is read on a CPU
    if kind.__name__ in PLUMBING:
        return None
    raise UnsupportedError(
        f"the env-to-module connector {kind.__name__} ({kind.__module__}) is not exported yet: "
        "without it the network would see other numbers"
    )


def _flatten(piece: Any, space: Any) -> Flatten:
    for name, leaf in space_leaves(space, "obs").items():
        starts = np.asarray(leaf.start) if isinstance(leaf, Discrete | MultiDiscrete) else np.zeros(1)
        if (starts > 0).any():
            raise UnsupportedError(
                f"{name}: RLlib's own FlattenObservations cannot one-hot {leaf}, whose values do not start at 0"
            )
        if isinstance(leaf, MultiDiscrete) and leaf.nvec.ndim != 1:
            raise UnsupportedError(f"{name}: RLlib's own FlattenObservations cannot one-hot {leaf}, which is a grid")
    without = tuple(key for key in (piece._keys_to_remove or []) if isinstance(space, Dict))
    # A Box needs no more said, and the contract is shorter for it.
    return Flatten() if isinstance(space, Box) else Flatten(space, without)


def _user_step(piece: Any, pipeline: str, consequence: str) -> UserStep:
    kind = type(piece)
    function = getattr(piece, HOOK, None)
    if callable(function):
        return UserStep(f"{kind.__module__}.{kind.__name__}", function)
    raise UnsupportedError(
        f"the {pipeline} connector {kind.__name__} ({kind.__module__}) is not exported: it is code of your own, and "
        f"without it {consequence}. If it keeps no state, give it a method '{HOOK}(self, data)' that does the same to "
        "torch tensors with a leading batch axis"
    )


def _filter(piece: Any, space: Any, seat: Seat) -> ObservationFilter:
    if isinstance(space, Box) and np.dtype(space.dtype).kind == "u":
        raise UnsupportedError(f"MeanStdFilter on {space} is not exported: RLlib's result has no sign there and wraps")
    if not isinstance(space, Box | MultiBinary):
        raise UnsupportedError(f"MeanStdFilter on {space} is not exported: RLlib filters single arrays")
    if seat.agent not in piece.get_state():
        raise UnsupportedError(
            "MeanStdFilter keeps no statistics for this agent: with several agents RLlib's own pipeline needs "
            "MeanStdFilter(multi_agent=True), and with one it needs it without"
        )
    restored = piece._filters[seat.agent]
    stats = restored.running_stats
    mean, std = np.asarray(stats.mean, np.float64), np.asarray(stats.std, np.float32)
    if not (np.isfinite(mean).all() and np.isfinite(std).all()):
        raise CheckpointError("the observation filter's mean or standard deviation is not finite: training diverged")
    clip = float(restored.clip) if restored.clip else None  # RLlib tests for truth: 0 means no clipping, too
    return ObservationFilter(int(stats.n), mean, std, clip, bool(restored.demean), bool(restored.destd))


def _is_rllibs(kind: type) -> bool:
    """Return whether a piece is RLlib's own, not the user's of the same name."""
    return kind.__module__.startswith("ray.rllib.connectors.")
