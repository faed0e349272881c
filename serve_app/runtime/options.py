"""Per-policy runtime options: out-of-bounds observations, action step limit, exploring, recording.

One small model, so that the server's settings and a deployment's file can hold it by name.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Step = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PolicyOptions(BaseModel):
    """Options of one policy at its limits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    out_of_bounds: Literal["accept", "warn", "clip", "refuse"] = "warn"
    """An observation outside the space's bounds: use it as it is, use it and warn, clip it and warn, or
    refuse it. RLlib itself accepts; a policy has seldom been trained there."""

    max_action_step: Step | tuple[Step | None, ...] | dict[str, Step | tuple[Step | None, ...]] | None = None
    """The most by which an action's element may differ from the last action's, in the action's own unit: one number,
    one per element in row-major order (null: any), or for a nested action a map from `action.<path>` to such."""

    beyond_action_step: Literal["limit", "refuse"] = "limit"
    """Treatment of a larger step: limited with a warning, or refused."""

    explore: bool = True
    """Whether clients may ask for exploring actions, if their key allows it. A robot that must not explore asks for
    none; `false` refuses them to all."""

    record: bool = True
    """Whether a server that records (`--record`) also records this policy."""


DEFAULT_OPTIONS = PolicyOptions()
