"""Actions that depend on earlier ones: find a request's recurrent state, decide, keep the next state.

It comes with the request and returns with the reply (`state`), or stays here: under a session's id, or with a stream.
One of them must be said: a recurrent policy that silently began anew with every request would act wrongly and look
right. A memory goes to the version that it is of, and to no other. Whatever is refused leaves it where it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from rlservo.export.contract.errors import RequestError, SessionError, SessionLostError
from rlservo.serve_app.episodes.carried_state import NOTHING, Carried, carry
from rlservo.serve_app.episodes.sessions import Session, SessionId, Sessions, shown
from rlservo.serve_app.runtime.policy import Policy, Step
from rlservo.serve_app.versions.policy_store import (
    NEEDS,
    NEEDS_LAST,
    NEEDS_STATE,
    Decision,
    EpisodeNote,
    PolicyStore,
    take_notices,
)
from rlservo.serve_app.wire.state_names import BELONGS_TO


@dataclass(frozen=True, slots=True)
class Episode:
    """What a request says of the episode it belongs to."""

    state: Mapping[str, Any] | None = None
    """The memory that the client carries (see `carried_state.py`); empty at an episode's start. None: it carries
    none."""

    session_id: SessionId | None = None
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

        Raises SessionError, SessionLostError, RequestError, UnavailableError where nothing more can be remembered, and
        what `Policy.step` raises; the memory has then not moved on.
        """
        if episode.session_id is not None:
            session = str(episode.session_id)
            begun = self.sessions.peek(name, episode.session_id) is not None or (episode.reset and self._alone())
            if begun or store.choose(name, version, session).episodic:
                return self._in_session(_Asked(store, name, version, obs, episode, explore, seed, session), seq)
            # There is nothing to remember: the id says only which requests belong together.
            episode = replace(episode, session_id=None, reset=False, end=False)
        if episode.end or (episode.reset and stream is None):
            word = "end" if episode.end else "reset"
            raise RequestError(f"'{word}' is for a session: send its 'session_id', too")
        asked = _Asked(store, name, version, obs, episode, explore, seed, session)
        if episode.state is not None:
            return self._carried(asked, stream)
        if stream is not None:
            return self._on_stream(asked, stream)
        policy = asked.choose()
        if policy.contract.state:
            raise RequestError(f"policy '{name}' {NEEDS_STATE}", NEEDS)
        if policy.limited and episode.last_action is None:
            raise RequestError(f"policy '{name}' {NEEDS_LAST}", NEEDS)
        return _timed(policy, asked).decision(policy, None)

    def policy_of(
        self, store: PolicyStore, name: str, version: str | None, session_id: SessionId | None, identity: Any
    ) -> Policy:
        """Return the policy whose tensors a request's are: its session's, or that of the state it carries."""
        session = None if session_id is None else self.sessions.peek(name, session_id)
        if session is not None:
            return session.policy
        own = store.find(name, identity) if type(identity) is str and version is None else None
        return own or store.get(name, version)

    def _carried(self, asked: _Asked, stream: Session | None) -> Decision:
        """Act from a memory that came with the request, for the version that it is of."""
        store, name, version, episode = asked.store, asked.name, asked.version, asked.episode
        assert episode.state is not None
        carried = Carried.read(episode.state)
        if carried.belongs_to is not None:
            policy = _owner(store, name, version, carried.belongs_to)
        else:
            policy = asked.choose()
            if stream is not None and _is_loaded(store, stream.policy) and version is None:
                policy = stream.policy
            if carried.arrays and policy.contract.state and not store.is_certain(name, version):
                raise RequestError(
                    f"the state does not say of which version of policy '{name}' it is, and that can be another than "
                    f"{policy.contract.version} (loaded are {', '.join(store.versions(name))}): send back all that the "
                    f"last reply gave ('{BELONGS_TO}' in 'state', or the parameter 'state_policy'), or name the "
                    "version in the address"
                )
        if policy.limited and not carried.begins and carried.last_action is None and episode.last_action is None:
            raise RequestError(f"policy '{name}' {NEEDS_LAST}", NEEDS)
        taken = _timed(policy, asked, carried)
        carries = bool(policy.contract.state) or policy.limited
        return taken.decision(policy, EpisodeNote(state=carry(policy, taken.step)) if carries else None)

    def _on_stream(self, asked: _Asked, stream: Session) -> Decision:
        """Act from the memory that the connection keeps."""
        policy, begins = stream.policy, asked.episode.reset
        try:
            self._check_version(asked, stream)
        except SessionError:
            if not begins:
                raise
            policy = asked.choose()  # an episode begins: with what is there now
        taken = _timed(policy, asked, session=Session(policy) if begins else stream)
        rows = taken.step.rows if policy.episodic else 0
        if rows != stream.rows:
            self.sessions.hold(stream, rows)
        if begins:
            stream.begin(policy)
        stream.keep(taken.step)
        return taken.decision(policy, EpisodeNote(step=stream.steps))

    def _in_session(self, asked: _Asked, seq: int | None) -> Decision:
        """Act from the memory that stands under the request's id; `seq` tells a request sent again."""
        name, episode = asked.name, asked.episode
        session_id = episode.session_id
        assert session_id is not None
        if episode.state is not None:
            raise RequestError("the request has a 'state' and a 'session_id': either you carry the state, or we do")
        if episode.reset:
            policy = asked.choose()
            if not self._alone():
                raise SessionError(
                    "this server has several replicas, and requests of a session would reach any of them: send the "
                    "'state' along, use a WebSocket, or run one replica"
                )
            if policy.episodic and not episode.end:
                self.sessions.check_room(name, session_id)
            session = Session(policy)
        else:
            session = self.sessions.find(name, session_id)
            self._check_version(asked, session, session_id)
            repeated = session.repeated(seq, asked.obs)
            if repeated is not None:
                return repeated
        taken = _timed(session.policy, asked, session=session)
        if episode.end:
            self.sessions.end(name, session_id)
        elif episode.reset:
            self.sessions.put(name, session_id, session, taken.step.rows if session.policy.episodic else 0)
        session.keep(taken.step)
        decision = taken.decision(session.policy, EpisodeNote(session_id=session_id, step=session.steps))
        session.seq, session.answer = seq, decision
        session.asked = b"" if seq is None else session.policy.fingerprint(taken.step.fed)
        return decision

    def _check_version(self, asked: _Asked, session: Session, session_id: SessionId | None = None) -> None:
        """A session stays with the version it began with, for as long as that is loaded."""
        name, version = asked.name, asked.version
        own = session.policy.contract.version
        which = "this stream's episode" if session_id is None else f"session '{shown(session_id)}'"
        if not _is_loaded(asked.store, session.policy):
            if session_id is not None:
                self.sessions.end(name, session_id, lost=True)
            raise SessionLostError(
                f"{which} was with version {own} of policy '{name}', which is no longer loaded: begin an episode"
            )
        if version is not None and asked.store.get(name, version) is not session.policy:
            raise SessionError(
                f"{which} is with version {own} of policy '{name}', and the request names version {version[:32]}: "
                "begin an episode with that one"
            )


@dataclass(frozen=True, slots=True)
class _Asked:
    """A request of an episode."""

    store: PolicyStore
    name: str
    version: str | None
    obs: Any
    episode: Episode
    explore: bool
    seed: int | None
    session: str | None  # whose it is, for the canary's share

    def choose(self) -> Policy:
        """Return the policy for whoever is with none yet."""
        return self.store.choose(self.name, self.version, self.session)


def _is_loaded(store: PolicyStore, policy: Policy) -> bool:
    name, version = policy.contract.name, policy.contract.version
    return name in store.names and version in store.versions(name) and store.get(name, version) is policy


def _owner(store: PolicyStore, name: str, version: str | None, identity: str) -> Policy:
    """Return the policy that a carried state is of. Raises SessionError, or SessionLostError where it is gone."""
    own = store.find(name, identity)
    if own is None:
        store.get(name, version)  # a policy or version that does not exist comes first
        raise SessionLostError(
            f"the state is of '{identity[:128]}', which is not loaded here (any more) as policy '{name}': begin an "
            "episode (state {})",
            {"state": identity[:128]},
        )
    if version is not None and store.get(name, version) is not own:
        raise SessionError(
            f"the state is of version {own.contract.version} of policy '{name}', and the request names version "
            f"{version[:32]}: begin an episode with that one (state {{}}), or name the state's"
        )
    return own


@dataclass(frozen=True, slots=True)
class _Taken:
    """A step, and what there is to say of it."""

    step: Step
    milliseconds: float
    notices: tuple[str, ...]

    def decision(self, policy: Policy, note: EpisodeNote | None) -> Decision:
        contract = policy.contract
        return Decision(
            self.step.action, contract.name, contract.version, self.milliseconds, self.step.batch, self.notices, note
        )


def _timed(policy: Policy, asked: _Asked, carried: Carried = NOTHING, *, session: Session | None = None) -> _Taken:
    """Take a step from what the client carries, or from a session's memory."""
    episode = asked.episode
    policy.notices.clear()
    started = time.perf_counter()
    step = policy.step(
        asked.obs,
        before=None if session is None else session.state,
        last=None if session is None else session.last,
        state=carried.arrays if carried.arrays or (policy.contract.state and not carried.begins) else None,
        last_action=carried.last_action if episode.last_action is None else episode.last_action,
        reward=episode.reward,
        explore=asked.explore,
        seed=asked.seed,
    )
    taken_ms = (time.perf_counter() - started) * 1e3
    return _Taken(step, taken_ms, take_notices(policy))
