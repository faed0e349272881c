"""Start of a recording in code that otherwise does not need the recording packages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlservo.extras import needs_extra
from rlservo.policy.acting_policy import ActingPolicy

if TYPE_CHECKING:
    from rlservo.recording.recorded_policy import WithRecording
    from rlservo.recording.recorder import Recorder


def record_policy(
    policy: ActingPolicy,
    record: str | Path | Recorder,
    *,
    wait: bool = False,
    act: Callable[..., Any] | None = None,
) -> WithRecording:
    """Return `WithRecording(policy, record)`; raise UsageError if a package is missing."""
    with needs_extra("record", what="recording"):
        from rlservo.recording.recorded_policy import WithRecording

    return WithRecording(policy, record, wait=wait, act=act)
