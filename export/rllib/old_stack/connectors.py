"""Steps of the old API stack's agent and action connectors for an observation and an action.

They live in the policy's state. A piece that is not known is refused by its name, because leaving it out would change
the policy. As in `new_stack/connectors.py` the pieces are known by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium.spaces import Box, Dict

from rlservo.errors import UnsupportedError
from rlservo.export.recipe.recipe import ObservationStep, Preprocess, Transform, leaf_transform
from rlservo.export.recipe.trees import space_leaves
from rlservo.export.rllib import private_names
from rlservo.export.rllib.filter_statistics import frozen_filter

# Agent connectors that change no number of a stateless policy's observation, and action connectors likewise.
AGENT_PLUMBING = frozenset({"ClipRewardAgentConnector", "StateBufferConnector", "ViewRequirementAgentConnector"})
ACTION_PLUMBING = frozenset({"ConvertToNumpyConnector", "ImmutableActionsConnector"})
PREPROCESSOR = "ObsPreprocessorConnector"
FILTERS = frozenset({"MeanStdObservationFilterAgentConnector", "ConcurrentMeanStdObservationFilterAgentConnector"})
UNSQUASH, CLIP = "NormalizeActionsConnector", "ClipActionsConnector"
KNOWN = {
    "agent": AGENT_PLUMBING | FILTERS | {PREPROCESSOR},
    "action": ACTION_PLUMBING | {UNSQUASH, CLIP},
}
PREPROCESSORS = frozenset({
    "OneHotPreprocessor", "DictFlatteningPreprocessor", "TupleFlatteningPreprocessor", "AtariRamPreprocessor",
})  # fmt: skip


def check_connectors(state: Mapping[str, Any]) -> None:
    """Raise UnsupportedError unless the policy's state names connectors, and only ones that are known."""
    configs = state.get("connector_configs") or {}
    for side, known in KNOWN.items():
        if side not in configs:
            raise UnsupportedError(
                f"the checkpoint holds no {side} connectors, so it does not show what RLlib does to "
                f"{'observations' if side == 'agent' else 'actions'}: it was written by an early Ray or with "
                "connectors switched off; restore it in Ray 2.7 or later and save it again"
            )
        for name, _ in configs[side][1]:
            if name not in known:
                where = "before the network" if side == "agent" else "after the network"
                raise UnsupportedError(
                    f"the {side} connector {name} ({where}) is not exported: only RLlib's own are "
                    f"({', '.join(sorted(known))}), and without it the policy would act differently"
                )


def read_old_steps(agent_connectors: Any) -> tuple[ObservationStep, ...]:
    """Return the agent connectors' steps for an observation, and freeze them.

    Raises UnsupportedError for a preprocessor that is not exported, CheckpointError for a filter that diverged.
    """
    agent_connectors.in_eval()  # a restored filter continues learning from whatever it is shown
    steps: list[ObservationStep] = []
    for piece in agent_connectors.connectors:
        name = type(piece).__name__
        if name == PREPROCESSOR:
            steps += _preprocessing(private_names.get(piece, "_preprocessor"))
        elif name in FILTERS:
            if piece.filter.no_preprocessor:
                raise UnsupportedError(
                    "the observation filter keeps one statistic per part of a nested space: not exported"
                )
            steps.append(frozen_filter(piece.filter))
    return tuple(steps)


def read_old_transform(action_connectors: Any, action_space: Any) -> Transform:
    """Return the action connectors' transform of a Box action (others are left unchanged).

    Unlike the new stack's one connector, here `clip_actions` also clips where `normalize_actions` finds a bound
    missing and leaves the action as it is (ray/rllib/connectors/action/, ray 2.60).
    """
    names = [type(piece).__name__ for piece in action_connectors.connectors]
    if UNSQUASH in names and CLIP in names[: names.index(UNSQUASH)]:
        raise UnsupportedError(f"{CLIP} comes before {UNSQUASH}: only RLlib's own order, the other one, is exported")
    boxes = [leaf for leaf in space_leaves(action_space, "action").values() if isinstance(leaf, Box)]
    unsquashed = [leaf_transform(leaf, "unsquash") == "unsquash" for leaf in boxes] if UNSQUASH in names else []
    if CLIP in names and any(unsquashed) and not all(unsquashed):
        raise UnsupportedError(
            f"with clip_actions, {action_space} has parts that are unsquashed and parts that are only clipped: not "
            "exported; switch clip_actions off, or bound every part"
        )
    if any(unsquashed):
        return "unsquash"
    return "clip" if CLIP in names and boxes else "none"


def _preprocessing(preprocessor: Any) -> list[ObservationStep]:
    name, space = type(preprocessor).__name__, private_names.get(preprocessor, "_obs_space")
    # Every hundredth observation is checked against the space: it changes no number, but the gate's samples also lie
    # outside.
    preprocessor.check_shape = _accept
    if name == "NoPreprocessor":
        return []
    if name not in PREPROCESSORS:
        raise UnsupportedError(
            f"the preprocessor {name} for observations {space} is not exported: it resizes images or "
            "pads lists, outside torch"
        )
    if isinstance(space, Dict) and list(space.spaces) != sorted(space.spaces):
        raise UnsupportedError(
            f"the parts of {space} are not in sorted order: RLlib's preprocessor sorts a dict and takes an OrderedDict "
            "as it comes, and the checkpoint does not hold which of them the environment gives"
        )
    for inner in getattr(preprocessor, "preprocessors", ()):
        _preprocessing(inner)  # refuses unsupported ones, and switches off the checks
    return [Preprocess(space)]


def _accept(_observation: Any) -> None:
    """Stand in for a preprocessor's check."""
