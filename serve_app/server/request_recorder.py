"""Recording of the server's decisions: each answer, the outcome reported by clients, and requests without an action.

The request path leaves a note; the record is made from it after the reply was written, in the event loop's next turn,
and `recording/recorder.py` writes it in a thread. A fault here costs records, never a request.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import ObservationError, RequestError, RlservoError, UnknownPolicyError
from rlservo.extras import needs_extra
from rlservo.policy.exploration import Draw
from rlservo.policy.input_numbers import parse_array
from rlservo.policy.policy import Policy
from rlservo.recording.policy_format import LeafArrays, PolicyFormat
from rlservo.serve_app.server.api_keys import without_keys
from rlservo.serve_app.server.content_bounds import count_rows
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.sessions.request import Request, shorten_label, trace_id
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore

with needs_extra("record", what="recording"):
    from rlservo.recording.recorder import Recorder
    from rlservo.recording.records import DecisionRecord, OutcomeRecord

logger = logging.getLogger(__name__)

LARGEST_FILE = 256 << 20  # [bytes]
MOST_EPISODES = 65_536  # whose steps are counted; beyond it, the one that was silent longest starts over
LONGEST_REQUEST_ID = 128  # longer ones are cut: a header may have 16 KB


class RequestRecorder:
    """Records the requests of one replica."""

    def __init__(self, settings: ServerSettings) -> None:
        """Record into the folder that `settings` name. Raises UsageError if nothing can be written there."""
        assert settings.record is not None
        file_bytes = min(LARGEST_FILE, settings.record_bytes // 4)
        self.recorder = Recorder(
            Path(settings.record), max_file_bytes=file_bytes, max_folder_bytes=settings.record_bytes
        )
        self._formats: WeakKeyDictionary[Policy, PolicyFormat] = WeakKeyDictionary()
        self._steps: OrderedDict[tuple[str, str], int] = OrderedDict()
        """The last recorded step of each episode, by policy name and episode; those silent longest come first."""
        self._notes: deque[Callable[[], None]] = deque()
        """Requests whose records are still to be made."""
        self._lock = threading.Lock()
        self._has_failed = False

    def note_answer(self, request: Request, decision: Decision, taken_s: float) -> None:
        """Record a decision, and the outcome in its request of the one before, once the reply has been written."""
        policy = decision.policy
        if policy.options.record and not decision.is_repeat:
            draw = policy.draw if request.explore else None  # the next request's one replaces it
            self._note(partial(self._record_answer, request, decision, taken_s, draw))

    def note_failure(self, request: Request, store: PolicyStore | None, error: RlservoError) -> None:
        """Record a single observation that got no action, if it fits the policy."""
        if store is not None and request.obs is not None and not isinstance(error, ObservationError | RequestError):
            taken_ms = (time.perf_counter() - request.received) * 1e3
            self._note(partial(self._record_failure, request, store, error.code, taken_ms))

    def close(self) -> None:
        """Write the remaining records and end the file."""
        self._make_records()
        self.recorder.close()

    def _note(self, make_record: Callable[[], None]) -> None:
        if not self._notes:
            asyncio.get_running_loop().call_soon(self._make_records)
        self._notes.append(make_record)

    def _make_records(self) -> None:
        with self._lock:  # `close` may come from another thread
            while self._notes:
                make_record = self._notes.popleft()
                try:
                    make_record()
                except Exception:  # a bug of ours: everything in a request was checked before
                    self.recorder.dropped += 1
                    if not self._has_failed:
                        self._has_failed = True
                        logger.exception("a request was not recorded; further ones are only counted")

    def _record_answer(self, request: Request, decision: Decision, taken_s: float, draw: Draw | None) -> None:
        policy = decision.policy
        episode, step = self._place(request, decision)
        known, rows = self._format(policy), decision.batch or 1
        # Copies: binary input is a view of the whole request's body, which may be a thousand times as large.
        obs = LeafArrays({name: decision.inputs[name].copy() for name in known.observations.leaves})
        ends = request.final_status is not None
        reward = None if request.reward is None else _numbers(request.reward, rows)
        if episode and step and (ends or reward is not None or request.last_action is not None):
            outcome = OutcomeRecord(
                known, episode, step - 1, reward, ends and not request.truncated, ends and request.truncated,
                request.final_status, obs if ends else None, request.last_action, rows=rows,
                may_teach=request.may_explore,
            )  # fmt: skip
            self.recorder.record(outcome)
        if ends:
            return  # its action is not used
        record = DecisionRecord(
            known, obs, decision.action, episode, step, taken_s * 1e3, request.explore, seq=request.seq,
            request_id=_request_id(request), trace_id=trace_id(request.headers), warnings=decision.notices, rows=rows,
        )  # fmt: skip
        if policy.has_step_limit and decision.last_action is not None:
            record.last_action_input = LeafArrays(decision.last_action)
        if policy.sees_reward:
            record.reward_input = reward
        if draw is not None:
            record.own_action, record.dist_inputs = draw.own, draw.inputs
        self.recorder.record(record)

    def _record_failure(self, request: Request, store: PolicyStore, code: str, taken_ms: float) -> None:
        if request.final_status is not None:
            return  # no decision was requested; the episode continues until its end is reported
        session_id = request.session_id
        label = request.label if session_id is None else str(session_id)
        try:
            stream = request.stream
            policy = store.choose(request.policy, request.version, label) if stream is None else stream.policy
        except UnknownPolicyError:
            return
        if not policy.options.record:
            return
        known = self._format(policy)
        if count_rows(policy.contract.observation_space, request.obs) > 1:
            return
        try:
            arrays = known.observations.arrays(request.obs)
        except Exception:  # it may be anything: it has not been checked yet
            return
        carries_state = policy.is_stateful and request.state is not None
        episode = "" if carries_state else _episode_of(request)
        step = self._count(policy.contract.name, episode, request.begins) if episode else 0
        record = DecisionRecord(
            known, LeafArrays({name: array.copy() for name, array in arrays.items()}), None, episode, step, taken_ms,
            request.explore, seq=request.seq, request_id=_request_id(request), trace_id=trace_id(request.headers),
            error=code,
        )  # fmt: skip
        self.recorder.record(record)

    def _place(self, request: Request, decision: Decision) -> tuple[str, int]:
        """Return (episode, step)."""
        if decision.recorded_step is not None:
            return decision.recorded_step
        episode = _episode_of(request)
        if not episode:
            return "", 0
        # A memory that continues does not begin an episode, even if its end was reported or it was forgotten here.
        least = decision.session_step - 1 if decision.session_step is not None and decision.policy.is_stateful else 0
        step = self._count(decision.name, episode, request.begins, least)
        if request.end or request.final_status is not None:
            del self._steps[decision.name, episode]
        return episode, step

    def _count(self, name: str, episode: str, begins: bool, least: int = 0) -> int:
        """Return the number of an episode's next step, from 0."""
        step = max(least, 0 if begins else self._steps.get((name, episode), -1) + 1)
        self._steps[name, episode] = step
        self._steps.move_to_end((name, episode))
        if len(self._steps) > MOST_EPISODES:
            self._steps.popitem(last=False)
        return step

    def _format(self, policy: Policy) -> PolicyFormat:
        known = self._formats.get(policy)
        if known is None:
            options = policy.options.model_dump(mode="json", exclude_defaults=True)
            known = self.recorder.policy(policy.contract, graph_hash=policy.graph_hash, options=options)
            self._formats[policy] = known
        return known


def _episode_of(request: Request) -> str:
    """Return a request's episode: its session, its stream, or everything under its label."""
    session_id = request.session_id
    session = f"#{session_id}" if isinstance(session_id, int) else session_id  # 7 and "7" are different sessions
    return session or request.stream_id or shorten_label(request.label or "")


def _request_id(request: Request) -> str | None:
    return None if request.request_id is None else without_keys(request.request_id[:LONGEST_REQUEST_ID])


def _numbers(reward: Any, rows: int) -> NDArray[np.float64] | None:
    """Return a request's reward, or one per row; None if it is not a number."""
    try:
        numbers = parse_array(reward, "float64", "the reward").ravel()
    except RequestError:
        return None
    return numbers if len(numbers) in (1, rows) and np.isfinite(numbers).all() else None
