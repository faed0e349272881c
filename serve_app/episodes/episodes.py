"""Actions that depend on earlier ones: find a request's recurrent state, decide, keep the next state.

It comes with the request and returns with the reply (`state`), or stays here: under a session's id, or with a stream.
One of them must be said: a recurrent policy that silently began anew with every request would act wrongly and look
right. A state goes to the version that it is of, and to no other. Whatever is refused leaves it where it was.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rlservo.export.contract.errors import (
    RequestError,
    SessionError,
    SessionLostError,
    StateNeededError,
    UnavailableError,
)
from rlservo.serve_app.episodes.carried_state import NO_STATE, CarriedState, carry, split_identity
from rlservo.serve_app.episodes.request import Episode, Request, new_episode_id
from rlservo.serve_app.episodes.sessions import Session, SessionId, Sessions, shorten
from rlservo.serve_app.runtime.policy import Policy, Step
from rlservo.serve_app.versions.policy_store import (
    NEEDS_LAST,
    NEEDS_STATE,
    Decision,
    EpisodeNote,
    EpisodeStep,
    PolicyStore,
    take_step,
)
from rlservo.serve_app.wire.state_names import BELONGS_TO


class Episodes:
    """Acts for requests that belong to an episode."""

    def __init__(self, *, max_sessions: int, idle_s: float) -> None:
        """`max_sessions` and `idle_s` bound what `Sessions` remembers."""
        self.sessions = Sessions(most=max_sessions, idle_s=idle_s)
        self.is_shared = False
        """Whether sessions are found by `shared_sessions.py`: ids of policies that remember nothing are labels then."""
        self.marks_states = False
        """Whether a state that goes to the client names its episode, for a recording."""

    def act(self, store: PolicyStore, request: Request) -> Decision:
        """Decide for a request that says something of its episode, or came on a stream that keeps one.

        Raises SessionError, SessionLostError, RequestError, UnavailableError where nothing more can be remembered, and
        what `Policy.step` raises; the recurrent state has then not moved on.
        """
        episode, stream = request.episode or NO_EPISODE, request.stream
        if episode.final_status is not None and (episode.reset or (episode.state is not None and not episode.state)):
            raise RequestError(
                "'final_status' ends an episode, and this request begins one ('reset', or an empty 'state'): tell how "
                "the last one ended in a request of its own, before"
            )
        if episode.session_id is not None:
            request.label = str(episode.session_id)
            name = request.policy
            has_session = self.sessions.peek(name, episode.session_id) is not None
            begins = episode.reset and not self.is_shared
            if has_session or begins or _choose(store, request).is_stateful:
                return self._act_in_session(store, request, episode, episode.session_id)
            # There is nothing to remember: the id says only which requests belong together.
            episode = replace(episode, session_id=None, reset=False, end=False)
        if episode.end or (episode.reset and request.stream_id is None):
            word = "end" if episode.end else "reset"
            raise RequestError(f"'{word}' is for a session: send its 'session_id', too")
        if episode.state is not None:
            return self._act_from_carried(store, request, episode)
        if stream is not None:
            return self._act_on_stream(store, request, episode, stream)
        policy = _choose(store, request)
        if policy.contract.state:
            raise StateNeededError(f"policy '{request.policy}' {NEEDS_STATE}")
        if policy.has_step_limit and episode.last_action is None:
            raise StateNeededError(f"policy '{request.policy}' {NEEDS_LAST}")
        return _take_step(policy, request, episode)[0]

    def policy_of(
        self, store: PolicyStore, name: str, version: str | None, session_id: SessionId | None, identity: Any
    ) -> Policy:
        """Return the policy whose tensors a request's are: its session's, or that of the state it carries."""
        session = None if session_id is None else self.sessions.peek(name, session_id)
        if session is not None:
            return session.policy
        own = store.find(name, split_identity(identity)[0]) if type(identity) is str and version is None else None
        return own or store.get(name, version)

    def _act_from_carried(self, store: PolicyStore, request: Request, episode: Episode) -> Decision:
        """Act from a state that came with the request, for the version that it is of."""
        name, version, stream = request.policy, request.version, request.stream
        assert episode.state is not None
        carried = CarriedState.parse(episode.state)
        if carried.policy_identity is not None:
            policy = _owner(store, name, version, carried.policy_identity)
        else:
            policy = _choose(store, request)
            if stream is not None and not carried.is_empty and store.has(stream.policy) and version is None:
                policy = stream.policy
            if carried.arrays and policy.contract.state and not store.is_certain(name, version):
                raise RequestError(
                    f"the state does not say of which version of policy '{name}' it is, and that can be another than "
                    f"{policy.contract.version} (loaded are {', '.join(store.versions(name))}): send back all that the "
                    f"last reply gave ('{BELONGS_TO}' in 'state', or the parameter 'state_policy'), or name the "
                    "version in the address"
                )
        needs_last = policy.has_step_limit and not carried.is_empty
        if needs_last and carried.last_action is None and episode.last_action is None:
            raise StateNeededError(f"policy '{name}' {NEEDS_LAST}")
        decision, step = _take_step(policy, request, episode, carried)
        if policy.is_stateful:
            mark = self._mark(carried, request) if self.marks_states else None
            next_mark = None if mark is None else EpisodeStep(mark.episode, mark.step + 1)
            decision.episode = EpisodeNote(state=carry(policy, step, next_mark), recorded_step=mark)
        return decision

    def _mark(self, carried: CarriedState, request: Request) -> EpisodeStep:
        """Return which step of which episode of the recording this is."""
        if carried.is_empty:
            return EpisodeStep(new_episode_id(request.label), 0)
        return carried.mark or EpisodeStep(new_episode_id(request.label), 1)  # nobody knows which, but not the first

    def _act_on_stream(self, store: PolicyStore, request: Request, episode: Episode, stream: Session) -> Decision:
        """Act from the state that the connection keeps."""
        policy, begins = stream.policy, episode.reset
        if begins:
            policy = _choose(store, request)
        else:
            self._check_version(store, request, stream)
        decision, step = _take_step(policy, request, episode, session=Session(policy) if begins else stream)
        rows = step.rows if policy.is_stateful else 0
        if rows != stream.rows:
            self.sessions.reserve(stream, rows)
        if begins:
            stream.begin(policy)
        stream.keep(step)
        decision.episode = EpisodeNote(step=stream.steps)
        return decision

    def _act_in_session(
        self, store: PolicyStore, request: Request, episode: Episode, session_id: SessionId
    ) -> Decision:
        """Act from the state that stands under the request's id; its `seq` tells a request sent again."""
        name, seq = request.policy, request.seq
        if episode.state is not None:
            raise RequestError("the request has a 'state' and a 'session_id': either you carry the state, or we do")
        if episode.reset:
            policy = _choose(store, request)
            before = self.sessions.peek(name, session_id)
            if before is not None and _is_late(request, before):
                raise UnavailableError(
                    f"another request began session '{shorten(session_id)}' of policy '{name[:64]}' at the same time: "
                    "try again"
                )
            if policy.is_stateful and not episode.end:
                self.sessions.check_room(name, session_id)
            session = Session(policy)
        else:
            session = self.sessions.use(name, session_id)
            self._check_version(store, request, session, session_id)
            repeated = session.answer_again(seq, request.obs)
            if repeated is not None:
                return repeated
            if _is_late(request, session):
                raise SessionError(
                    f"the request was under way when another one began session '{shorten(session_id)}' again: it is of "
                    "the episode before"
                )
        decision, step = _take_step(session.policy, request, episode, session=session)
        if episode.end:
            self.sessions.end(name, session_id)
        elif episode.reset:
            self.sessions.put(name, session_id, session, step.rows if session.policy.is_stateful else 0)
        session.keep(step)
        decision.episode = EpisodeNote(session_id=session_id, step=session.steps)
        session.connection = request.connection
        session.seq, session.answer, session.inputs_hash = seq, None, b""
        if seq is not None:  # without the inputs: they may be views of a whole request's body
            session.answer = replace(decision, inputs={}, is_repeat=True)
            session.inputs_hash = session.policy.fingerprint(step.inputs)
        return decision

    def _check_version(
        self, store: PolicyStore, request: Request, session: Session, session_id: SessionId | None = None
    ) -> None:
        """A session stays with the version it began with, for as long as that is loaded."""
        name, version = request.policy, request.version
        own = session.policy.contract.version
        which = "this stream's episode" if session_id is None else f"session '{shorten(session_id)}'"
        if not store.has(session.policy):
            if session_id is not None:
                self.sessions.end(name, session_id, lost=True)
            raise SessionLostError(
                f"{which} was with version {own} of policy '{name}', which is no longer loaded: begin an episode"
            )
        if version is not None and store.get(name, version) is not session.policy:
            raise SessionError(
                f"{which} is with version {own} of policy '{name}', and the request names version {version[:32]}: "
                "begin an episode with that one"
            )


NO_EPISODE = Episode()


def _choose(store: PolicyStore, request: Request) -> Policy:
    """Return the policy for a request that is with none yet."""
    return store.choose(request.policy, request.version, request.label)


def _is_late(request: Request, session: Session) -> bool:
    """Whether a request was on its way when a session began: its client has given it up, or did not wait."""
    return session.policy.is_stateful and request.arrived < session.begun


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


def _take_step(
    policy: Policy,
    request: Request,
    episode: Episode,
    carried: CarriedState = NO_STATE,
    *,
    session: Session | None = None,
) -> tuple[Decision, Step]:
    """Take a step from what the client carries, or from a session's state."""
    return take_step(
        policy,
        request.obs,
        before=None if session is None else session.state,
        last=None if session is None else session.last,
        state=carried.arrays if carried.arrays or (policy.contract.state and not carried.is_empty) else None,
        last_action=carried.last_action if episode.last_action is None else episode.last_action,
        reward=episode.reward,
        explore=request.explore,
        seed=request.seed,
    )
