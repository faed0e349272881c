"""Description of the steps baked into a graph, for people and programs, in the order they are applied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete

from rlservo.bundle.contract import BakedStep
from rlservo.export.recipe.recipe import (
    Flatten,
    FrameStack,
    Logarithm,
    ObservationFilter,
    ObservationStep,
    Preprocess,
    Previous,
    Recipe,
    SineAndCosine,
    Transpose,
    leaf_transform,
)
from rlservo.export.recipe.trees import space_leaves


def baked_steps(recipe: Recipe, module_class: str, module: Any, unread: Sequence[str] = ()) -> tuple[BakedStep, ...]:
    """Return the contract's `baked_in` for a recipe, the torch module it surrounds, and leaves that nothing reads."""
    steps = [observation_step(step) for step in recipe.steps]
    if unread:
        steps.append(
            BakedStep(
                step="ignored",
                detail=f"{', '.join(unread)}: nothing reads it; observations may omit it",
                values={"names": list(unread)},
            )
        )
    parameters = sum(weights.numel() for weights in module.parameters())
    recurrent = ", recurrent" if recipe.network_state else ""
    steps.append(
        BakedStep(
            step="network",
            detail=f"{module_class.rpartition('.')[2]}{recurrent}, {parameters:,} parameters in the checkpoint",
            values={"module_class": module_class, "parameters": parameters},
        )
    )
    steps.append(BakedStep(step="mode", detail=_mode_detail(recipe), values={"mode": recipe.mode}))
    steps += [BakedStep(step="user_connector", detail=f"{step.name}, your own") for step in recipe.action_steps]
    if (affine := recipe.affine) is not None:
        limited = f"clipped to ±{affine.limit:g}, then " if affine.limit is not None else ""
        values = {"scale": affine.scale.ravel().tolist(), "offset": affine.offset.ravel().tolist()}
        steps.append(BakedStep(step="scale", detail=f"{limited}action * scale + offset", values=values))
    if any(leaf_transform(leaf, recipe.transform) != "none" for leaf in recipe.action_leaves.values()):
        steps.append(_transform_step(recipe))
    if (present := recipe.present) is not None:
        clipped = "clipped, then " if present.clips else ""
        steps.append(
            BakedStep(
                step="present_position",
                detail=f"{clipped}added to the positions in the observation",
                values={
                    name: [None if np.isinf(one) else one for one in np.asarray(values, float).tolist()]
                    for name, values in vars(present).items()
                },
            )
        )
    return tuple(steps)


def unexpected_steps(recipe: Recipe) -> list[str]:
    """Return a sentence for each surprising behaviour of RLlib that the export reproduces."""
    sentences: list[str] = []
    for name, space in recipe.action_leaves.items():
        if isinstance(space, Discrete) and space.start != 0:
            which = "the action space" if name == "action" else name
            sentences.append(
                f"{which} starts at {space.start}, but RLlib sends 0..{space.n - 1} to env.step: the export does the "
                "same"
            )
    if recipe.needs_reward:
        sentences.append(
            "the policy was trained with previous rewards: the graph has an input 'reward', 0 at an episode's start"
        )
    return sentences


def observation_step(step: ObservationStep) -> BakedStep:
    """Return the contract's form of one step before the network."""
    if isinstance(step, ObservationFilter):
        return _filter_step(step)
    if isinstance(step, Flatten):
        return _flatten_step(step)
    if isinstance(step, Preprocess):
        return _preprocess_step(step)
    if isinstance(step, FrameStack):
        apart = f", {step.every} steps apart," if step.every > 1 else ""
        return BakedStep(
            step="frame_stack",
            detail=f"the last {step.frames} observations{apart} side by side, zeros before the episode's start"
            + _of_leaf(step.leaf),
            values={"frames": step.frames, **({"every": step.every} if step.every > 1 else {})},
        )
    if isinstance(step, Transpose):
        return BakedStep(step="transpose", detail=f"images from channels last to channels first{_of_leaf(step.leaf)}")
    if isinstance(step, Logarithm):
        return BakedStep(
            step="logarithm",
            detail=f"log(max(obs, {step.lowest:g})) of {len(step.elements)} elements",
            values={"elements": list(step.elements), "lowest": step.lowest},
        )
    if isinstance(step, SineAndCosine):
        return BakedStep(
            step="sine_and_cosine",
            detail=f"sines of {len(step.elements)} elements in their place, their cosines at the end",
            values={"elements": list(step.elements)},
        )
    if isinstance(step, Previous):
        parts = [f"the last {step.actions} actions, one-hot"] if step.actions else []
        parts += [f"the last {step.rewards} rewards"] if step.rewards else []
        return BakedStep(
            step="previous",
            detail=f"with the observation: {' and '.join(parts)}; zeros before the episode's start",
            values={"actions": step.actions, "rewards": step.rewards},
        )
    return BakedStep(step="user_connector", detail=f"{step.name}, your own")


def _flatten_step(step: Flatten) -> BakedStep:
    leaves = {} if step.space is None else space_leaves(step.space, "obs")
    coded = [name for name, leaf in leaves.items() if isinstance(leaf, Discrete | MultiDiscrete)]
    left_out = f"; without {', '.join(step.without)}" if step.without else ""
    if coded:
        return BakedStep(
            step="one_hot" if len(leaves) == 1 else "flatten",
            detail=f"to one row, {', '.join(coded)} one-hot{left_out}",
            values={"order": list(leaves)},
        )
    return BakedStep(step="flatten", detail=f"to one row{left_out}", values={"order": list(leaves)} if leaves else {})


def _preprocess_step(step: Preprocess) -> BakedStep:
    leaves = space_leaves(step.space, "obs")
    rescaled = [name for name, leaf in leaves.items() if isinstance(leaf, Box) and leaf.shape == (128,)]
    flat = _flatten_step(Flatten(step.space))
    if not rescaled:
        return flat
    detail = f"{', '.join(rescaled)}: (obs - 128) / 128, as RLlib does with every Box of 128 numbers"
    if len(leaves) == 1:
        return BakedStep(step="rescale", detail=detail, values={"offset": 128.0, "divisor": 128.0})
    return flat.model_copy(update={"detail": f"{flat.detail}; {detail}"})


def _of_leaf(leaf: str) -> str:
    return "" if leaf == "obs" else f", of {leaf}"


def _filter_step(frozen: ObservationFilter) -> BakedStep:
    clipped = f", clipped to ±{frozen.clip:g}" if frozen.clip is not None else ""
    small = f" + {frozen.epsilon:g}".replace("e-0", "e-") if frozen.epsilon else ""
    return BakedStep(
        step="mean_std_filter",
        detail=f"(obs - mean) / (std{small}){clipped}{_of_leaf(frozen.leaf)}; frozen after {frozen.count:,} "
        "observations",
        values={
            "count": frozen.count,
            "mean": frozen.mean.ravel().tolist(),
            "std": frozen.std.astype(float).ravel().tolist(),
            "clip": frozen.clip,
            "demean": frozen.demean,
            "destd": frozen.destd,
            **({} if frozen.leaf == "obs" else {"leaf": frozen.leaf}),
        },
    )


def _mode_detail(recipe: Recipe) -> str:
    if recipe.mode == "given":
        return "the network's own action, or its own distribution's"
    leaves = recipe.action_leaves.values()
    boxes = [leaf for leaf in leaves if isinstance(leaf, Box)]
    choice = f"the choice with the largest {'Q-value' if recipe.distribution is None else 'logit'}"
    if not boxes:
        return choice if len(leaves) == 1 else f"{choice}, for each part"
    if recipe.mode == "tanh_mean":
        mean = "tanh of the Gaussian's mean"
    elif recipe.distribution == "squashed_gaussian":
        mean = "the Gaussian's mean, not squashed: RLlib's own deterministic action"
    else:
        mean = "the Gaussian's mean"
    return mean if len(boxes) == len(leaves) else f"{mean}; {choice}"


def _transform_step(recipe: Recipe) -> BakedStep:
    if recipe.transform == "clip":
        return BakedStep(step="clip", detail="to the action space's bounds")
    boxes = [leaf for leaf in recipe.action_leaves.values() if isinstance(leaf, Box)]
    if all(np.dtype(leaf.dtype).kind in "iu" for leaf in boxes):
        return BakedStep(step="unsquash", detail="the choice is counted from the action space's lower bound")
    return BakedStep(step="unsquash", detail="[-1, 1] to the action space's bounds, then clipped to them")
