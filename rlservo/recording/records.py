"""Records: one decision of a policy, and its outcome.

A record is made on the hot path, so it holds only existing objects; the writer thread does everything else. The arrays
in it must not change: a caller that may overwrite them later passes copies.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from rlservo.policy.acting_policy import Observation
from rlservo.recording.policy_format import LeafArrays, PolicyFormat


@dataclass(slots=True, eq=False)  # not frozen, which would triple the time to make one
class DecisionRecord:
    """An observation and the action sent for it, or the reason for a missing one."""

    policy: PolicyFormat
    obs: Observation | LeafArrays
    """The policy's input; a batch is recorded as one decision per row."""
    action: Any
    """The action as sent, in the action space's own form; None if there was none."""
    episode: str = ""
    """Session, stream or loop; empty if unknown. Row i of a batch belongs to episode `<episode>.<i>`."""
    step: int = 0
    """Number of the decision in the episode, from 0."""
    latency_ms: float | None = None
    explore: bool = False
    own_action: Mapping[str, NDArray[Any]] | None = None
    """If it explored, the module's own action by tensor name `[batch, *shape]` (`Draw.own`)."""
    dist_inputs: NDArray[Any] | None = None
    """If it explored, `action_dist_inputs`, `[batch, n]`."""
    reward_input: Any = None
    """The policy's reward input."""
    last_action_input: Any = None
    """The action from which a step limit counted, if the client sent it."""
    seq: int | None = None
    request_id: str | None = None
    trace_id: str | None = None
    warnings: Sequence[str] = ()
    error: str | None = None
    """The error code if there was no action: deadline-passed, unavailable, bad-observation ..."""
    commanded: Any = None
    """Command to the robot instead, in the action space's own form."""
    rows: int = 1
    """Number of decisions in the record."""
    wall_ns: int = field(default_factory=time.time_ns)
    monotonic_ns: int = field(default_factory=time.monotonic_ns)


@dataclass(slots=True, eq=False)
class OutcomeRecord:
    """Outcome of a decision, known after the action."""

    policy: PolicyFormat
    episode: str
    step: int
    reward: Any = None
    """A number; for a batch one per row, or one for all."""
    terminated: bool = False
    truncated: bool = False
    final_status: str | None = None
    final_obs: Observation | LeafArrays | None = None
    """The observation after an episode's last action, which belongs to no decision."""
    commanded: Any = None
    """Command to the robot instead of the action."""
    robot: Mapping[str, Any] | None = None
    """State of a real robot, its changes, and the limits that were applied."""
    may_teach: bool = True
    """Whether the key that reported it may explore: reports with other keys are never learned from."""
    rows: int = 1
    """Number of the decision's rows."""
    wall_ns: int = field(default_factory=time.time_ns)
    monotonic_ns: int = field(default_factory=time.monotonic_ns)
