"""Records: one decision of a policy, and what came of it.

A record is made on the hot path, so it holds what is there anyway; everything else is the writer thread's work. The
arrays in it must not change any more: a caller that may overwrite them later passes copies.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from rlservo.serve_app.interface import Observation
from rlservo.serve_app.recording.policy_format import LeafArrays, PolicyFormat


@dataclass(slots=True, eq=False)  # not frozen: that triples the time of making one
class DecisionRecord:
    """An observation and the action that was sent for it, or why there was none."""

    policy: PolicyFormat
    obs: Observation | LeafArrays
    """As the policy was given it; a batch is recorded as so many decisions."""
    action: Any
    """As it was sent, in the action space's own form; None if there was none."""
    episode: str = ""
    """Session, stream or loop; empty if unknown. Row i of a batch is episode `<episode>.<i>`."""
    step: int = 0
    """Which decision of the episode, from 0."""
    latency_ms: float | None = None
    explore: bool = False
    own_action: Mapping[str, NDArray[Any]] | None = None
    """If it explored, the module's own action by tensor name `[batch, *shape]` (`Draw.own`)."""
    dist_inputs: NDArray[Any] | None = None
    """If it explored, `action_dist_inputs`, `[batch, n]`."""
    reward_input: Any = None
    """The reward that the policy was given to see."""
    last_action_input: Any = None
    """The action that a limit on the step counted from, if the client gave it."""
    seq: int | None = None
    request_id: str | None = None
    warnings: Sequence[str] = ()
    error: str | None = None
    """The code of what came instead of an action: deadline-passed, unavailable, bad-observation ..."""
    commanded: Any = None
    """Command to the robot instead, in the action space's own form."""
    rows: int = 1
    """Number of decisions it is."""
    wall_ns: int = field(default_factory=time.time_ns)
    monotonic_ns: int = field(default_factory=time.monotonic_ns)


@dataclass(slots=True, eq=False)
class OutcomeRecord:
    """Outcome of a decision, which the control loop knows later than the action."""

    policy: PolicyFormat
    episode: str
    step: int
    reward: Any = None
    """A number; of a batch one for each row, or one for all."""
    terminated: bool = False
    truncated: bool = False
    final_status: str | None = None
    final_obs: Observation | LeafArrays | None = None
    """The observation after an episode's last action, which no decision holds."""
    commanded: Any = None
    """Command to the robot instead of the action."""
    robot: Mapping[str, Any] | None = None
    """State of a real robot, its changes, and the limits that were kept."""
    rows: int = 1
    """Of the decision."""
    wall_ns: int = field(default_factory=time.time_ns)
    monotonic_ns: int = field(default_factory=time.monotonic_ns)
