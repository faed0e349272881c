"""Per-policy runtime options: out-of-bounds observations, action step limit, exploring, recording.

A small model that the server's settings and a deployment's file hold by policy name.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Step = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PolicyOptions(BaseModel):
    """Runtime options of one policy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    out_of_bounds: Literal["accept", "warn", "clip", "refuse"] = "warn"
    """Treatment of an observation outside the space's bounds: use it as it is, use it and warn, clip it and warn, or
    refuse it. RLlib itself accepts it, but few policies were trained on such observations."""

    max_action_step: Step | tuple[Step | None, ...] | dict[str, Step | tuple[Step | None, ...]] | None = None
    """Largest change of each action element from the last action, in the action's unit: one number, one per element in
    row-major order (null: any), or for a nested action a map from `action.<path>` to these."""

    beyond_action_step: Literal["limit", "refuse"] = "limit"
    """Treatment of a larger step: limit it with a warning, or refuse it."""

    explore: bool = True
    """Whether clients may ask for exploratory actions, if their key allows it. A robot that must not explore does not
    request any; `false` refuses them to all clients."""

    record: bool = True
    """Whether a server that records (`--record`) also records this policy."""


DEFAULT_OPTIONS = PolicyOptions()
