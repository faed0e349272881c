"""The view of a drive: one moment, and the control cycles before it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.deploy.cockpit.stage import Scene, Stage

Phase = Literal["driving", "paused", "arrived"]


@dataclass(frozen=True)
class Cycle:
    """One control cycle: observation, action and their readings."""

    number: int  # since the drive began
    obs: NDArray[Any]
    action: NDArray[Any]
    latency_ms: float
    is_late: bool  # beyond the deadline or a control cycle, whichever is shorter
    fallback: str  # why the action is not the policy's, or nothing
    warnings: tuple[str, ...]
    value: float | None
    distance: float | None  # [m], of the robot from the target
    difference: NDArray[Any] | None  # of the ghost's policy's action for the same observation


@dataclass(frozen=True)
class View:
    """The drawn state of one moment."""

    stage: Stage
    contract: Contract
    before: Scene
    after: Scene
    since: float  # time.perf_counter() when `after` was reached
    period_s: float  # on the wall, until the next cycle
    ghost: tuple[Scene, Scene] | None
    ghost_contract: Contract | None
    phase: Phase
    sentence: str  # current activity
    trouble: str  # current fault, or empty
    refusal: str  # why the last command was not followed, or nothing
    episodes: int
    successes: int
    late: int
    late_beyond_ms: float
    fallbacks: int
