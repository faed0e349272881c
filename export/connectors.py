"""Read off RLlib's connector pipelines what they do to an observation and to an action.

A piece that is not known is refused by its class name, because leaving it out would change the policy. The pieces are
known by name and by coming from RLlib itself; this file imports nothing of RLlib.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from rlservo.export.errors import CheckpointError, UnsupportedError
from rlservo.export.location import CheckpointFiles
from rlservo.export.recipe import AnyDiscrete, Flatten, ObservationFilter, ObservationStep, Transform

# Pieces that move data about without changing a number of a stateless single-agent policy.
PLUMBING = frozenset({
    "AddObservationsFromEpisodesToBatch",
    "AddTimeDimToBatchAndZeroPad",
    "AddStatesFromEpisodesToBatch",
    "BatchIndividualItems",
    "NumpyToTensor",
    "GetActions",
    "TensorToNumpy",
    "UnBatchToIndividualItems",
    "RemoveSingleTsTimeRankFromBatch",
    "ListifyDataForVectorEnv",
})  # fmt: skip


def check_spaces(observation_space: Any, action_space: Any) -> None:
    """Raise UnsupportedError unless both spaces are of a kind that is exported."""
    if not isinstance(observation_space, Box):
        raise UnsupportedError(
            f"observation space {observation_space} is not exported yet: only Box is (others need one-hot or "
            "flattening in the graph)"
        )
    if not isinstance(action_space, Box | Discrete):
        raise UnsupportedError(f"action space {action_space} is not exported yet: only Box and Discrete are")
    for space in (observation_space, action_space):
        if isinstance(space, Box) and space.dtype not in (np.float32, np.float64):
            raise UnsupportedError(f"{space} is not exported yet: only float32 and float64 Boxes are")


def read_observation_steps(env_to_module: Any, files: CheckpointFiles) -> tuple[ObservationStep, ...]:
    """Return what the env-to-module pipeline does to an observation, and freeze the pipeline.

    Raises UnsupportedError for a piece that is not known, CheckpointError when a filter's statistics are missing.
    """
    found = [_observation_step(piece, files) for piece in env_to_module.connectors]
    steps = tuple(step for step in found if step is not None)
    if sum(isinstance(step, ObservationFilter) for step in steps) > 1:
        raise UnsupportedError("the pipeline has two MeanStdFilter pieces, of which RLlib's checkpoint keeps only one")
    return steps


def read_transform(module_to_env: Any, action_space: Box | AnyDiscrete) -> Transform:
    """Return what the module-to-env pipeline does to an action (`unsquash_action`, `clip_action` in ray 2.60)."""
    transform: Transform = "none"
    for piece in module_to_env.connectors:
        kind = type(piece)
        if kind.__name__ == "NormalizeAndClipActions" and _is_rllibs(kind):
            if isinstance(action_space, Box):
                bounded = bool(action_space.bounded_below.all() and action_space.bounded_above.all())
                if piece.normalize_actions:
                    transform = "unsquash" if bounded else "none"
                elif piece.clip_actions:
                    transform = "clip"
        elif kind.__name__ not in PLUMBING or not _is_rllibs(kind):
            raise UnsupportedError(
                f"the module-to-env connector {kind.__name__} ({kind.__module__}) is not exported yet: "
                "without it the environment would get other actions"
            )
    return transform


def _observation_step(piece: Any, files: CheckpointFiles) -> ObservationStep | None:
    """Return what an env-to-module piece does to an observation (None: nothing); freeze it while at it."""
    kind = type(piece)
    if kind.__name__ == "MeanStdFilter" and _is_rllibs(kind):
        if not (files.env_to_module / kind.__name__).is_dir():
            raise CheckpointError(
                f"{files.env_to_module / kind.__name__} is missing: the observation filter's statistics"
            )
        piece._update_stats = False  # a restored filter goes on learning from whatever it is shown
        return _filter(piece)
    if kind.__name__ == "FlattenObservations" and _is_rllibs(kind):
        return Flatten()
    if kind.__name__ == "NumpyToTensor" and _is_rllibs(kind):
        piece._device = None  # a checkpoint from a GPU is read on a CPU
    if kind.__name__ in PLUMBING and _is_rllibs(kind):
        return None
    raise UnsupportedError(
        f"the env-to-module connector {kind.__name__} ({kind.__module__}) is not exported yet: "
        "without it the network would see other numbers"
    )


def _filter(piece: Any) -> ObservationFilter:
    if set(piece.get_state()) != {None}:
        raise UnsupportedError("MeanStdFilter is set up for several agents, which is not exported yet")
    restored = piece._filters[None]
    stats = restored.running_stats
    mean, std = np.asarray(stats.mean, np.float64), np.asarray(stats.std, np.float32)
    if not (np.isfinite(mean).all() and np.isfinite(std).all()):
        raise CheckpointError("the observation filter's mean or standard deviation is not finite: training diverged")
    clip = float(restored.clip) if restored.clip else None  # RLlib tests for truth: 0 means no clipping, too
    return ObservationFilter(int(stats.n), mean, std, clip, bool(restored.demean), bool(restored.destd))


def _is_rllibs(kind: type) -> bool:
    """Return whether a piece is RLlib's own, not the user's of the same name."""
    return kind.__module__.startswith("ray.rllib.connectors.")
