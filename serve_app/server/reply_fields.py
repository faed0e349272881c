"""Fields of a reply, the same in every protocol, which only renames and encodes them."""

from __future__ import annotations

import time
from typing import Any

from rlservo.serve_app.episodes.request import Request
from rlservo.serve_app.versions.policy_store import Decision


def reply_fields(request: Request, decision: Decision) -> dict[str, Any]:
    """Return a reply's fields besides the action; empty ones are left out.

    `policy`, `version`, `infer_ms`, `seq`, `warnings` (a tuple of sentences), `session_id`, `session_step`, `state`
    (a dict of arrays, with what `carried_state.py` adds), `timestamp`, `received_at`, `sent_at`.
    """
    fields: dict[str, Any] = {
        "policy": decision.name,
        "version": decision.version,
        "infer_ms": round(decision.infer_ms, 4),
    }
    if request.seq is not None:
        fields["seq"] = request.seq
    if decision.notices:
        fields["warnings"] = decision.notices
    episode = decision.episode
    if episode is not None:
        if episode.session_id is not None:
            fields["session_id"] = episode.session_id
        if episode.step is not None:
            fields["session_step"] = episode.step
        if episode.state is not None:
            fields["state"] = episode.state
    if request.timestamp is not None:
        now = time.time()
        fields["timestamp"] = request.timestamp
        fields["received_at"] = now - (time.perf_counter() - request.received)
        fields["sent_at"] = now
    return fields
