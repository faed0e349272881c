"""Steps of RLlib's new-stack connector pipelines for an observation and an action, read from their pieces.

A piece that is not known is refused by its class name, because leaving it out would change the policy. The pieces are
known by name and by coming from RLlib itself. A piece of the user's own is used if it offers `torch_forward`, a
function of torch tensors `[batch, ...]` that does the same as the piece.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.location import CheckpointFiles
from rlservo.export.recipe.recipe import (
    Flatten,
    FrameStack,
    Logarithm,
    ObservationFilter,
    ObservationStep,
    Previous,
    SineAndCosine,
    Transform,
    UserStep,
)
from rlservo.export.recipe.trees import space_leaves
from rlservo.export.rllib import private_names
from rlservo.export.rllib.filter_statistics import frozen_filter

# Pieces that move data about without changing a number.
PLUMBING = frozenset({
    "AddObservationsFromEpisodesToBatch",
    "BatchedObservations",
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
BATCHES_OBSERVATION = frozenset({"AddObservationsFromEpisodesToBatch", "FrameStacking"})
"""Pieces that put the observation into the batch: later changes to the episode come too late."""
BATCHED_CONNECTORS = "rlservo.export.rllib.batched_connectors"
"""Pieces that work like RLlib's of the same names; those for observations also batch them."""

HOOK = "torch_forward"


@dataclass(frozen=True)
class AgentSlot:
    """An agent's place in pipelines that serve several; `agent` None if there is only one."""

    agent: Any = None
    module: str = ""
    agents: tuple[str, ...] = ()
    """All agents that this one represents."""
    others: tuple[Any, ...] = ()
    """The same without this one, as the environment has them."""

    def part(self, space: Any) -> Any:
        """Return the agent's own part of a space, which behind the mapping is its module's.

        None behind the mapping for a module that was added in training: RLlib saves the mapping as it began.
        """
        if self.agent is None:
            return space
        return space[self.agent] if self.agent in space.spaces else space.spaces.get(self.module)


SINGLE_AGENT = AgentSlot()


def read_observation_steps(env_to_module: Any, files: CheckpointFiles, slot: AgentSlot) -> tuple[ObservationStep, ...]:
    """Return the env-to-module pipeline's steps for the slot's agent, and freeze the pipeline.

    Raises UnsupportedError for a piece that is not known, CheckpointError when a filter's statistics are missing.
    """
    steps: list[ObservationStep] = []
    batched_by = ""
    for piece in env_to_module.connectors:
        step = _observation_step(piece, files, slot)
        name = type(piece).__name__
        is_batched = type(piece).__module__ == BATCHED_CONNECTORS  # and batches the observation as changed before it
        if step is not None and batched_by and not is_batched:
            raise UnsupportedError(
                f"the env-to-module connector {name} comes after {batched_by}, which has already passed the "
                "observation on: what RLlib does then depends on the previous step, which is not exported"
            )
        if is_batched or (name in BATCHES_OBSERVATION and comes_from_rllib(type(piece))):
            batched_by = name
        if step is not None:
            steps.append(step)
    for kind in (ObservationFilter, FrameStack, Previous):
        if sum(isinstance(step, kind) for step in steps) > 1:
            raise UnsupportedError(
                f"the pipeline has two {kind.__name__} pieces of one class, of which RLlib's checkpoint keeps only one"
            )
    return tuple(steps)


def read_action_steps(module_to_env: Any, action_space: Any) -> tuple[Transform, tuple[UserStep, ...]]:
    """Return the module-to-env pipeline's transform of an action (`unsquash_action`, `clip_action` in ray 2.60)."""
    transform: Transform = "none"
    steps: list[UserStep] = []
    for piece in module_to_env.connectors:
        kind = type(piece)
        if kind.__name__ == "NormalizeAndClipActions" and comes_from_rllib(kind):
            if piece.normalize_actions:
                transform = "unsquash"
            elif piece.clip_actions:
                transform = "clip"
        elif kind.__name__ not in PLUMBING or not comes_from_rllib(kind):
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


def _observation_step(piece: Any, files: CheckpointFiles, slot: AgentSlot) -> ObservationStep | None:
    """Return an env-to-module piece's step (None: no effect), and freeze the piece."""
    kind = type(piece)
    if not comes_from_rllib(kind):
        return _user_step(piece, "env-to-module", "the network would see other numbers")
    space = slot.part(piece.input_observation_space)
    if kind.__name__ == "MeanStdFilter":
        if files.has_pipelines and not (files.env_to_module / kind.__name__).is_dir():
            raise CheckpointError(
                f"{files.env_to_module / kind.__name__} is missing: it holds the observation filter's statistics"
            )
        private_names.replace(piece, "_update_stats", False)  # it would continue learning from whatever it is shown
        return None if isinstance(space, Discrete | MultiDiscrete) else _filter(piece, space, slot)
    if kind.__name__ == "FlattenObservations":
        flattened = private_names.get(piece, "_agent_ids")  # none: all agents'
        return _flatten(piece, space) if slot.agent is None or slot.agent in (flattened or [slot.agent]) else None
    if kind.__name__ == "FrameStacking":
        # The batched connectors' has `every`; RLlib's own takes neighbouring frames.
        return FrameStack(int(piece.num_frames), tuple(space.shape), str(space.dtype), int(getattr(piece, "every", 1)))
    if kind.__name__ == "Logarithm":
        return Logarithm(tuple(piece.elements), piece.LOWEST)
    if kind.__name__ == "SineAndCosine":
        return SineAndCosine(tuple(piece.elements))
    if kind.__name__ == "PrevActionsPrevRewards":
        choices = slot.part(piece.input_action_space)
        if not isinstance(choices, Discrete):
            raise UnsupportedError(
                f"{kind.__name__} on the action space {choices} is not exported: expected a Discrete one"
            )
        keys = (piece.ORIG_OBS_KEY, piece.PREV_ACTIONS_KEY, piece.PREV_REWARDS_KEY)
        return Previous(int(piece.n_prev_actions), int(choices.n), int(piece.n_prev_rewards), keys)
    if kind.__name__ == "NumpyToTensor":
        private_names.replace(piece, "_device", None)  # a checkpoint from a GPU is read on a CPU
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
                f"{name}: RLlib's own FlattenObservations cannot encode {leaf}, whose values do not start at 0"
            )
        if isinstance(leaf, MultiDiscrete) and leaf.nvec.ndim != 1:
            raise UnsupportedError(
                f"{name}: RLlib's own FlattenObservations cannot encode {leaf}, which is not one-dimensional"
            )
    removed = private_names.get(piece, "_keys_to_remove") if isinstance(space, Dict) else None
    without = tuple(removed or ())
    # A Box needs no further detail, which keeps the contract short.
    return Flatten() if isinstance(space, Box) else Flatten(space, without)


def _user_step(piece: Any, pipeline: str, consequence: str) -> UserStep:
    kind = type(piece)
    function = getattr(piece, HOOK, None)
    if callable(function):
        return UserStep(f"{kind.__module__}.{kind.__name__}", function)
    saved_whole = kind.__module__ == "__main__"
    again = (
        "; the checkpoint holds the class as the script had it, so restore and save it with the new one"
        if saved_whole
        else ""
    )
    raise UnsupportedError(
        f"the {pipeline} connector {kind.__name__} ({kind.__module__}) is not exported: it is code of your own, and "
        f"without it {consequence}. If it keeps no state, give it a method '{HOOK}(self, data)' that does the same to "
        f"torch tensors with a leading batch axis{again}"
    )


def _filter(piece: Any, space: Any, slot: AgentSlot) -> ObservationFilter:
    if isinstance(space, Box) and np.dtype(space.dtype).kind == "u":
        raise UnsupportedError(f"MeanStdFilter on {space} is not exported: RLlib's result has no sign there and wraps")
    if not isinstance(space, Box | MultiBinary):
        raise UnsupportedError(f"MeanStdFilter on {space} is not exported: RLlib filters only single arrays")
    if slot.agent not in piece.get_state():
        raise UnsupportedError(
            "MeanStdFilter keeps no statistics for this agent: with several agents RLlib's own pipeline needs "
            "MeanStdFilter(multi_agent=True), and with one it needs it without"
        )
    return frozen_filter(private_names.get(piece, "_filters")[slot.agent])


def comes_from_rllib(kind: type) -> bool:
    """Return whether a piece is RLlib's own or does the same, and not the user's of the same name."""
    return kind.__module__ == BATCHED_CONNECTORS or kind.__module__.startswith("ray.rllib.connectors.")
