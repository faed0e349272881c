"""Decisions that depend on what came before: where a request's memory comes from, and where it goes.

It comes with the request and returns with the reply (`state`), or stays here: under a session's id, or with a stream.
One of them must be said: a recurrent policy that silently began anew with every request would act wrongly and look
right. It knows nothing of protocols.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from rlservo.export.errors import RequestError, SessionError, SessionLostError
from rlservo.serve_app.policy import Policy, Step
from rlservo.serve_app.sessions import Session, Sessions
from rlservo.serve_app.store import NEEDS_LAST, NEEDS_STATE, Decision, EpisodeNote, PolicyStore, take_notices


@dataclass(frozen=True, slots=True)
class Episode:
    """What a request says of the episode it belongs to."""

    state: Mapping[str, Any] | None = None
    """The memory that the client carries; empty at an episode's start. None: it carries none."""

    session_id: str | None = None
    reset: bool = False  # begin the session, or the stream's episode
    end: bool = False  # forget the session after this request
    reward: Any = None
    last_action: Any = None  # what the robot was last commanded, where a limit is set on the step from it


class Episodes:
    """Acts for requests that belong to an episode."""

    def __init__(self, *, max_sessions: int, idle_s: float, alone: Callable[[], bool] = lambda: True) -> None:
        """`alone` says whether every request reaches this process; if not, no id finds its session reliably."""
        self.sessions = Sessions(most=max_sessions, idle_s=idle_s)
        self._alone = alone

    def act(
        self,
        store: PolicyStore,
        name: str,
        version: str | None,
        obs: Any,
        episode: Episode,
        *,
        stream: Session | None = None,
        explore: bool = False,
        seed: int | None = None,
        seq: int | None = None,
        session: str | None = None,
    ) -> Decision:
        """Decide. `stream` is the session of the stream that the request came on; `session` is whose request it is.

        Raises SessionError, SessionLostError, RequestError and what `Policy.step` raises; the memory has then not
        moved on.
        """
        if episode.session_id is not None:
            session = episode.session_id
            begun = self.sessions.peek(name, session) is not None or (episode.reset and self._alone())
            if begun or store.choose(name, version, session).episodic:
                return self._in_session(store, name, version, obs, episode, explore=explore, seed=seed, seq=seq)
            # There is nothing to remember: the id says only which requests belong together.
            episode = replace(episode, session_id=None, reset=False, end=False)
        if episode.end or (episode.reset and stream is None):
            word = "end" if episode.end else "reset"
            raise RequestError(f"'{word}' is for a session: send its 'session_id', too")
        if stream is not None:
            begins = episode.reset or (episode.state is not None and not episode.state)
            try:
                self._check_version(store, name, version, stream)
            except SessionError:
                if not begins:
                    raise
                stream.policy = store.choose(name, version, session)  # an episode begins: with what is there now
                stream.begin()
        if stream is not None and episode.state is None:
            if episode.reset:
                stream.begin()
            step, taken_ms, notices = _timed(
                stream.policy, obs, episode, before=stream.state, last=stream.last, explore=explore, seed=seed
            )
            _keep(stream, step)
            return _decision(stream.policy, step, taken_ms, notices, EpisodeNote(step=stream.steps))
        policy = store.choose(name, version, session) if stream is None else stream.policy
        _check_carried(policy, episode)
        step, taken_ms, notices = _timed(policy, obs, episode, explore=explore, seed=seed)
        state = step.state if step.batch is not None else {key: leaf[0, ...] for key, leaf in step.state.items()}
        note = EpisodeNote(state=state) if policy.contract.state else None
        return _decision(policy, step, taken_ms, notices, note)

    def _in_session(
        self,
        store: PolicyStore,
        name: str,
        version: str | None,
        obs: Any,
        episode: Episode,
        *,
        explore: bool,
        seed: int | None,
        seq: int | None,
    ) -> Decision:
        session_id = episode.session_id
        assert session_id is not None
        if episode.state is not None:
            raise RequestError("the request has a 'state' and a 'session_id': either you carry the state, or we do")
        if episode.reset:
            policy = store.choose(name, version, session_id)
            if not self._alone():
                raise SessionError(
                    "this server has several replicas, and requests of a session would reach any of them: send the "
                    "'state' along, use a WebSocket, or run one replica"
                )
            session = self.sessions.begin(name, session_id, policy)
        else:
            session = self.sessions.find(name, session_id)
            self._check_version(store, name, version, session, session_id)
            repeated = session.repeated(seq)
            if repeated is not None:
                return repeated
        step, taken_ms, notices = _timed(
            session.policy, obs, episode, before=session.state, last=session.last, explore=explore, seed=seed
        )
        _keep(session, step)
        note = EpisodeNote(session_id=session_id, step=session.steps)
        decision = _decision(session.policy, step, taken_ms, notices, note)
        session.seq, session.answer = seq, decision
        if episode.end:
            self.sessions.end(name, session_id)
        return decision

    def _check_version(
        self, store: PolicyStore, name: str, version: str | None, session: Session, session_id: str | None = None
    ) -> None:
        """A session stays with the version it began with, for as long as that is loaded."""
        own = session.policy.contract.version
        which = "this stream's episode" if session_id is None else f"session '{session_id[:64]}'"
        if name not in store.names or own not in store.versions(name) or store.get(name, own) is not session.policy:
            if session_id is not None:
                self.sessions.end(name, session_id)
            raise SessionLostError(
                f"{which} was with version {own} of policy '{name}', which is no longer loaded: begin an episode"
            )
        if version is not None and store.get(name, version) is not session.policy:
            raise SessionError(
                f"{which} is with version {own} of policy '{name}', and the request names version {version[:32]}: "
                "begin an episode with that one"
            )


def _check_carried(policy: Policy, episode: Episode) -> None:
    """Raise RequestError unless everything the policy remembers came with the request."""
    if policy.contract.state and episode.state is None:
        raise RequestError(f"policy '{policy.contract.name}' {NEEDS_STATE}")
    if policy.limited and episode.last_action is None:
        raise RequestError(f"policy '{policy.contract.name}' {NEEDS_LAST}")


def _timed(policy: Policy, obs: Any, episode: Episode, **more: Any) -> tuple[Step, float, tuple[str, ...]]:
    """Return (the step, milliseconds it took, what was out of bounds)."""
    policy.notices.clear()
    started = time.perf_counter()
    step = policy.step(obs, state=episode.state or None, last_action=episode.last_action, reward=episode.reward, **more)
    taken_ms = (time.perf_counter() - started) * 1e3
    return step, taken_ms, take_notices(policy)


def _keep(session: Session, step: Step) -> None:
    session.state = step.state or None
    session.last = step.leaves
    session.steps += 1


def _decision(
    policy: Policy, step: Step, taken_ms: float, notices: tuple[str, ...], note: EpisodeNote | None
) -> Decision:
    contract = policy.contract
    return Decision(step.action, contract.name, contract.version, taken_ms, step.batch, notices, note)
