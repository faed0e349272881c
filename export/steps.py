"""Describe for people and programs what a graph has baked in, in the order it is applied."""

from __future__ import annotations

from typing import Any

from gymnasium.spaces import Box

from rlservo.export.bundle import BakedStep
from rlservo.export.recipe import ObservationFilter, ObservationStep, Recipe, Rescale


def baked_steps(recipe: Recipe, module_class: str, module: Any) -> tuple[BakedStep, ...]:
    """Return the contract's `baked_in` for a recipe and the torch module it surrounds."""
    steps = [_observation_step(step) for step in recipe.steps]
    parameters = sum(weights.numel() for weights in module.parameters())
    steps.append(
        BakedStep(
            step="network",
            detail=f"{module_class.rpartition('.')[2]}, {parameters:,} parameters in the checkpoint",
            values={"module_class": module_class, "parameters": parameters},
        )
    )
    steps.append(BakedStep(step="mode", detail=_mode_detail(recipe), values={"mode": recipe.mode}))
    if recipe.transform != "none":
        steps.append(_transform_step(recipe))
    return tuple(steps)


def _observation_step(step: ObservationStep) -> BakedStep:
    if isinstance(step, ObservationFilter):
        return _filter_step(step)
    if isinstance(step, Rescale):
        values = {"offset": step.offset, "divisor": step.divisor}
        return BakedStep(step="rescale", detail=f"(obs - {step.offset:g}) / {step.divisor:g}", values=values)
    return BakedStep(step="flatten", detail="to one row")


def _filter_step(frozen: ObservationFilter) -> BakedStep:
    clipped = f", clipped to ±{frozen.clip:g}" if frozen.clip is not None else ""
    return BakedStep(
        step="mean_std_filter",
        detail=f"(obs - mean) / (std + 1e-6){clipped}; frozen after {frozen.count:,} observations",
        values={
            "count": frozen.count,
            "mean": frozen.mean.ravel().tolist(),
            "std": frozen.std.astype(float).ravel().tolist(),
            "clip": frozen.clip,
            "demean": frozen.demean,
            "destd": frozen.destd,
        },
    )


def _mode_detail(recipe: Recipe) -> str:
    if recipe.mode == "argmax":
        what = "Q-value" if recipe.distribution is None else "logit"
        return f"the choice with the largest {what}"
    if recipe.mode == "tanh_mean":
        return "tanh of the Gaussian's mean"
    if recipe.distribution == "squashed_gaussian":
        return "the Gaussian's mean, not squashed: RLlib's own deterministic action"
    return "the Gaussian's mean"


def _transform_step(recipe: Recipe) -> BakedStep:
    assert isinstance(recipe.action_space, Box)
    if recipe.transform == "clip":
        return BakedStep(step="clip", detail="to the action space's bounds")
    return BakedStep(step="unsquash", detail="[-1, 1] to the action space's bounds, then clipped to them")
