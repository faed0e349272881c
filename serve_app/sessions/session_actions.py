"""Actions that depend on earlier ones: find a request's recurrent state, decide, keep the next state.

The state travels with request and reply (`state`), or stays on the server under a session's id or with a stream. The
request must say which: a recurrent policy that silently began an episode with every request would act wrongly and look
right. A state only reaches the version that it belongs to. A refused request does not change it, unless a shared store
took the write and did not answer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rlservo.client.formats.request_names import BELONGS_TO
from rlservo.errors import RequestError, SessionError, SessionLostError, StateNeededError
from rlservo.policy.policy import Policy, Step
from rlservo.serve_app.sessions.carried_state import carry, parse_state, split_identity
from rlservo.serve_app.sessions.memory_sessions import MemorySessions
from rlservo.serve_app.sessions.request import Request, SessionId, new_episode_id
from rlservo.serve_app.sessions.session import Session
from rlservo.serve_app.versions.policy_store import Decision, EpisodeStep, PolicyStore, take_step

if TYPE_CHECKING:
    from rlservo.serve_app.sessions.redis_sessions import RedisSessions

NO_SHARED_SESSIONS = (
    "this server has several processes and no shared session store: carry the 'state' in each request "
    "({} begins an episode), use a WebSocket, or start the server with one worker or with --session-store redis://..."
)
CARRY = "send 'state' ({} begins an episode, then what the last reply gave)"
SESSION = (
    "begin a session ('session_id' with 'reset'; in the Open Inference Protocol 'sequence_id' with 'sequence_start')"
)
NEEDS_STATE = f"remembers its episode: {CARRY.replace('an episode', 'one')}, or the inputs 'state_in.*', or {SESSION}"
NEEDS_LAST = (
    f"has a limit on the step from one action to the next: {CARRY}, or 'last_action' (in the Open Inference Protocol "
    f"an input, or 'sequence_start' for the first), or {SESSION}"
)


class Episodes:
    """Acts for requests that belong to an episode."""

    def __init__(
        self, *, max_sessions: int, idle_s: float, store: RedisSessions | None = None, is_alone: bool = True
    ) -> None:
        """Take the bounds of `MemorySessions`: `max_sessions` and `idle_s`.

        A `store` keeps the sessions instead. `is_alone` says whether requests reach only this process.
        """
        self.sessions = MemorySessions(most=max_sessions, idle_s=idle_s)
        self._idle_s = idle_s
        self.store = store
        self._has_sessions = is_alone or store is not None
        self.marks_states = False
        """Whether the state in a reply names its episode, for a recording."""
        self.begun: Counter[str] = Counter()
        """Sessions begun here, by policy name."""
        self.lost: Counter[str] = Counter()
        """Requests for a session that does not exist or was lost, by policy name."""

    async def act(self, store: PolicyStore, request: Request) -> Decision:
        """Decide for a request: an action for one observation, a batch for a batch.

        It waits only for a session in a shared store. Raises UnknownPolicyError, UnknownVersionError, SessionError,
        SessionLostError, RequestError, UnavailableError if there is no room or the store cannot be reached, and what
        `Policy.step` raises; the recurrent state has then not changed.
        """
        if request.final_status is not None and request.begins:
            raise RequestError(
                "'final_status' ends an episode, and this request begins one ('reset', or an empty 'state'): "
                "report how the last one ended in a separate request before it"
            )
        if request.session_id is not None:
            request.label = str(request.session_id)
            if store.remembers(request.policy):
                return await self._act_in_session(store, request)
            # There is nothing to remember: the id only groups requests.
        elif request.end or (request.reset and request.stream_id is None):
            word = "end" if request.end else "reset"
            raise RequestError(f"'{word}' needs a session: also send its 'session_id'")
        if request.state is not None:
            return self._act_from_carried(store, request, request.state)
        if request.stream is not None:
            return self._act_on_stream(store, request, request.stream)
        return _act_alone(store, request)

    def policy_of(
        self, store: PolicyStore, name: str, version: str | None, session_id: SessionId | None, identity: Any
    ) -> Policy:
        """Return the policy that a request's tensors belong to: its session's, or that of the state it carries."""
        session = None if session_id is None else self.sessions.find(name, session_id)
        if session is not None:
            return session.policy
        own = store.find(name, split_identity(identity)[0]) if type(identity) is str and version is None else None
        return own or store.get(name, version)

    def _act_from_carried(self, store: PolicyStore, request: Request, state: Mapping[str, Any]) -> Decision:
        """Act from a state in the request, with the version that it belongs to."""
        name, version, stream = request.policy, request.version, request.stream
        carried = parse_state(state)
        if carried.policy_identity is not None:
            policy = _owner(store, request, carried.policy_identity)
        else:
            policy = _choose(store, request)
            if stream is not None and state and store.has(stream.policy) and version is None:
                policy = stream.policy
            if carried.arrays and policy.contract.state and not store.is_certain(name, version):
                raise RequestError(
                    f"the state does not name its version of policy '{name}', which may differ from "
                    f"{policy.contract.version} (loaded: {', '.join(store.versions(name))}): send back the last "
                    f"reply's whole state ('{BELONGS_TO}' in 'state', or the parameter 'state_policy'), or name the "
                    "version in the URL"
                )
        if state:
            _check_last_action(policy, request, carried.last_action)
        given = carried.arrays if carried.arrays or (policy.contract.state and state) else None
        decision, step = _take_step(policy, request, state=given, last_action=carried.last_action)
        if policy.is_stateful:
            mark = next_mark = None
            if self.marks_states:  # one without a mark is unknown, but not an episode's first
                mark = carried.mark or EpisodeStep(new_episode_id(request.label), 1 if state else 0)
                next_mark = EpisodeStep(mark.episode, mark.step + 1)
            decision.state, decision.recorded_step = carry(policy, step, next_mark), mark
        return decision

    def _act_on_stream(self, store: PolicyStore, request: Request, stream: Session) -> Decision:
        """Act from the state that the connection keeps."""
        before = stream
        if request.reset:
            before = Session(_choose(store, request))
        else:
            _check_version(store, request, stream.policy, "this stream's episode")
        decision, step = _take_step(before.policy, request, before=before.state, last=before.last)
        self.sessions.reserve(stream, step.rows if before.policy.is_stateful else 0)
        stream.policy, stream.state, stream.last = before.policy, step.state or None, step.leaves
        decision.session_step = stream.steps = before.steps + 1
        return decision

    async def _act_in_session(self, store: PolicyStore, request: Request) -> Decision:
        """Act from the state stored under the request's id."""
        if request.state is not None:
            raise RequestError("the request has both 'state' and 'session_id': send one of them")
        if not self._has_sessions:
            raise RequestError(NO_SHARED_SESSIONS)
        try:
            decision = await (self.store or self.sessions).act(store, request, self._step_session)
        except SessionLostError:
            self.lost[request.policy] += 1
            raise
        self.begun[request.policy] += request.reset
        return decision

    def _step_session(self, store: PolicyStore, request: Request, session: Session | None) -> tuple[Decision, Session]:
        """Return the decision and the session after it; the given session is not changed.

        If the last request is repeated, the session has already answered it, and is returned unchanged.
        """
        if request.reset:
            session = Session(_choose(store, request))
        else:
            if session is None:
                raise self._lost(request)
            policy = session.policy
            _check_version(store, request, policy, f"session '{request.session_id!s:.64}'")
            if session.has_answered(request.seq, request.obs):
                action = policy.build_action(session.last or {}, batch=session.batch is not None)
                contract, notices = policy.contract, tuple(session.notices)
                decision = Decision(
                    action, policy, {}, contract.name, contract.version, session.infer_ms, session.batch, notices,
                    session_id=request.session_id, session_step=session.steps, is_repeat=True,
                )  # fmt: skip
                return decision, session
            if session.is_ended:
                raise self._lost(request)
        decision, step = _take_step(session.policy, request, before=session.state, last=session.last)
        inputs_hash = b"" if request.seq is None else session.policy.fingerprint(step.inputs)
        after = replace(
            session, state=step.state or None, last=step.leaves, steps=session.steps + 1, rows=step.rows,
            is_ended=request.end, seq=request.seq, inputs_hash=inputs_hash, infer_ms=decision.infer_ms,
            batch=decision.batch, notices=decision.notices,
        )  # fmt: skip
        decision.session_id, decision.session_step = request.session_id, after.steps
        return decision, after

    def _lost(self, request: Request) -> SessionLostError:
        shown = f"{request.session_id!s:.64}"
        return SessionLostError(
            f"this server has no session '{shown}' of policy '{request.policy[:64]}': it was never begun, was ended, "
            f"was idle for {self._idle_s:g} s, or was lost with its process, store or version: begin an episode",
            {"session_id": shown, "policy": request.policy[:64]},
        )


def _act_alone(store: PolicyStore, request: Request) -> Decision:
    """Act for a request that needs nothing from earlier ones."""
    policy = _choose(store, request)
    if policy.contract.state:
        raise StateNeededError(f"policy '{request.policy}' {NEEDS_STATE}")
    _check_last_action(policy, request, None)
    return _take_step(policy, request)[0]


def _choose(store: PolicyStore, request: Request) -> Policy:
    """Return the policy for a request without one."""
    return store.choose(request.policy, request.version, request.label)


def _check_last_action(policy: Policy, request: Request, last_action: Any) -> None:
    """Raise StateNeededError if a limited step has no last action to count from."""
    if policy.has_step_limit and last_action is None and request.last_action is None:
        raise StateNeededError(f"policy '{request.policy}' {NEEDS_LAST}")


def _owner(store: PolicyStore, request: Request, identity: str) -> Policy:
    """Return the policy of a carried state. Raises SessionError, or SessionLostError if it is gone."""
    own = store.find(request.policy, identity)
    if own is None:
        store.get(request.policy, request.version)  # an unknown policy or version is reported first
        raise SessionLostError(
            f"the state belongs to '{identity[:128]}', which is not or no longer loaded as policy '{request.policy}': "
            "begin an episode (state {})",
            {"state": identity[:128]},
        )
    _check_version(store, request, own, "the state")
    return own


def _check_version(store: PolicyStore, request: Request, policy: Policy, memory: str) -> None:
    """Raise SessionLostError if the policy of a memory is gone, SessionError if the request names another."""
    own = f"version {policy.contract.version} of policy '{request.policy}'"
    if not store.has(policy):
        raise SessionLostError(f"{memory} belongs to {own}, which is no longer loaded: begin an episode")
    if request.version is not None and store.get(request.policy, request.version) is not policy:
        raise SessionError(
            f"{memory} belongs to {own}, but the request names version {request.version[:32]}: begin an episode with "
            "it, or name the version of the state"
        )


def _take_step(policy: Policy, request: Request, *, last_action: Any = None, **memory: Any) -> tuple[Decision, Step]:
    """Take a step from `memory`, as `Policy.step` takes it; a last action in the request precedes `last_action`."""
    return take_step(
        policy,
        request.obs,
        last_action=last_action if request.last_action is None else request.last_action,
        reward=request.reward,
        explore=request.explore,
        seed=request.seed,
        **memory,
    )
