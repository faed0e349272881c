"""Recording of what the server decides: each answer, what clients say came of it, and requests that got no action.

A record is a few references into what the request path has anyway; `recording/recorder.py` writes it in a thread.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import ObservationError, RequestError, RlservoError, UnknownPolicyError, UsageError
from rlservo.serve_app.episodes.request import Episode, Request
from rlservo.serve_app.recording.policy_format import LeafArrays, PolicyFormat
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore

try:
    from rlservo.serve_app.recording.recorder import Recorder
    from rlservo.serve_app.recording.records import DecisionRecord, OutcomeRecord
except ModuleNotFoundError as error:
    if (error.name or "").startswith("rlservo"):
        raise
    raise UsageError(f"recording needs the Python package {error.name!r}: pip install 'rlservo[record]'") from error

MOST_EPISODES = 65_536  # whose steps are counted; of more, the one that was silent longest begins anew
NO_EPISODE = Episode()


class _Place(NamedTuple):
    """Where an episode is: its last recorded step, and its last step by the session's own count."""

    step: int
    session_step: int | None


class RequestRecorder:
    """Records the requests of one replica."""

    def __init__(self, settings: ServerSettings) -> None:
        """Record into the folder that `settings` name. Raises UsageError where nothing can be written there."""
        assert settings.record is not None
        self.recorder = Recorder(
            Path(settings.record), max_file_bytes=settings.record_file_bytes, max_folder_bytes=settings.record_bytes
        )
        self._formats: WeakKeyDictionary[Policy, PolicyFormat] = WeakKeyDictionary()
        self._steps: OrderedDict[tuple[str, str], _Place] = OrderedDict()

    def record_answer(self, request: Request, decision: Decision, taken_s: float) -> None:
        """Record a decision, and what its request says of the one before."""
        policy = decision.policy
        if not policy.options.record:
            return
        said = request.episode or NO_EPISODE
        place = self._place(request, decision, said)
        if place is None:
            return
        episode, step = place
        known, rows, obs = self._format(policy), decision.batch or 1, LeafArrays(decision.inputs)
        ends = said.final_status is not None
        reward = None if said.reward is None else _numbers(said.reward, rows)
        if episode and step and (ends or reward is not None or said.last_action is not None):
            outcome = OutcomeRecord(
                known, episode, step - 1, reward, ends and not said.truncated, ends and said.truncated,
                said.final_status, obs if ends else None, said.last_action, rows,
            )  # fmt: skip
            self.recorder.record(outcome)
        if ends:
            return  # its action is for nobody
        record = DecisionRecord(
            known, obs, decision.action, episode, step, taken_s * 1e3, request.explore, seq=request.seq,
            request_id=request.request_id, warnings=decision.notices, rows=rows,
        )  # fmt: skip
        if policy.sees_reward:
            record.reward_input = reward
        if request.explore and policy.draw is not None:
            record.own_action, record.dist_inputs = policy.draw.own, policy.draw.inputs
        self.recorder.record(record)

    def record_failure(self, request: Request, store: PolicyStore | None, error: RlservoError) -> None:
        """Record a single observation that got no action, where it is one of the policy's at all."""
        if store is None or request.obs is None or isinstance(error, ObservationError | RequestError):
            return
        try:
            policy = store.get(request.policy, request.version) if request.stream is None else request.stream.policy
        except UnknownPolicyError:
            return
        if not policy.options.record:
            return
        known = self._format(policy)
        try:
            parts = known.observations.rows(request.obs)  # nothing has looked at it yet
        except (RequestError, ValueError, TypeError, KeyError):
            return
        if len(parts) > 1:
            return
        taken_ms = (time.perf_counter() - request.received) * 1e3
        episode = "" if _carries_state(request) else _episode_of(request)
        step = self._count(policy.contract.name, episode, request.episode or NO_EPISODE) if episode else 0
        record = DecisionRecord(
            known, LeafArrays(parts[0]), None, episode, step, taken_ms, request.explore, seq=request.seq,
            request_id=request.request_id, error=error.code,
        )  # fmt: skip
        self.recorder.record(record)

    def close(self) -> None:
        """Write what there is and end the file."""
        self.recorder.close()

    def _place(self, request: Request, decision: Decision, said: Episode) -> tuple[str, int] | None:
        """Return (episode, step); None for the last decision once more, whose request came again."""
        note = decision.episode
        if note is not None and note.recorded is not None:
            return note.recorded
        episode = _episode_of(request)
        if not episode:
            return "", 0
        session_step = None if note is None else note.step
        last = self._steps.get((decision.name, episode))
        if last is not None and not said.reset and session_step is not None and session_step == last.session_step:
            return None
        step = self._count(decision.name, episode, said, session_step)
        return episode, step

    def _count(self, name: str, episode: str, said: Episode, session_step: int | None = None) -> int:
        """Return the number of an episode's next step, from 0."""
        last = None if said.reset else self._steps.get((name, episode))
        step = 0 if last is None else last.step + 1
        if session_step is None and last is not None:
            session_step = last.session_step
        self._steps[name, episode] = _Place(step, session_step)
        self._steps.move_to_end((name, episode))
        if said.end or said.final_status is not None:
            del self._steps[name, episode]
        elif len(self._steps) > MOST_EPISODES:
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
    """Return the episode that a request is of: its session, its stream, or all that comes under its label."""
    in_session = request.episode is not None and request.episode.session_id is not None
    return (request.label if request.stream_id is None or in_session else request.stream_id) or ""


def _numbers(reward: Any, rows: int) -> NDArray[np.float64] | None:
    """Return a request's reward, or one a row; None for what is none."""
    try:
        numbers = np.ravel(np.asarray(reward, np.float64))
    except (ValueError, TypeError):
        return None
    return numbers if len(numbers) in (1, rows) else None


def _carries_state(request: Request) -> bool:
    return request.episode is not None and request.episode.state is not None
