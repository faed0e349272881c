"""Handling of a request of any protocol: receive, admit, parse, decide, encode; count, log and time.

A protocol is a `Codec` and a transport. The transport (`http_endpoint.py`, `websocket_stream.py`, `grpc_service.py`)
makes a `Request` and calls `RequestHandler.answer`, which calls the codec; it encodes its exceptions as errors.

A decision runs in the event loop from its first line to its last. So requests do not wait in a queue of ours: they wait
as tasks that the loop has created and not yet run.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rlservo.errors import (
    ForbiddenError,
    InternalError,
    ObservationError,
    OverloadedError,
    RequestError,
    RlservoError,
    TooLargeError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.serve_app.server.access_checks import StreamKey
from rlservo.serve_app.server.api_keys import A_KEY
from rlservo.serve_app.server.content_bounds import count_rows
from rlservo.serve_app.server.current_keys import CurrentKeys
from rlservo.serve_app.server.load_shedding import LoadShedding
from rlservo.serve_app.server.logs import FIELDS, OK, write_answer, write_failure
from rlservo.serve_app.server.metrics import Metrics
from rlservo.serve_app.server.settings import MEMORY, ServerSettings
from rlservo.serve_app.server.tracing import Tracing
from rlservo.serve_app.sessions.request import ClientGoneError, Request, check_deadline
from rlservo.serve_app.sessions.session_actions import Episodes
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore, blamed_version
from rlservo.serve_app.versions.shadow import Shadows

if TYPE_CHECKING:
    from rlservo.serve_app.server.request_recorder import RequestRecorder

logger = logging.getLogger(__name__)

STRICTER = "stricter-than-production"
"""Counted instead of `bad-observation` if the version in production accepts the observation."""
NO_EXPLORING = "this API key may not request exploring actions: leave 'explore' out, or use a key of role 'explore'"
BUG = "the server failed on this request; its log has the cause"

Source = TypeVar("Source", contravariant=True)
Reply = TypeVar("Reply", covariant=True)


class Codec(Protocol[Source, Reply]):
    """Bytes of one protocol: decoded from a transport's source, and encoded for its reply."""

    async def receive(self, handler: RequestHandler, request: Request, source: Source) -> Any:
        """Return the content, read within its limits. Raises RlservoError, and ClientGoneError."""
        ...

    def parse(self, handler: RequestHandler, request: Request, content: Any) -> None:
        """Fill the request from its content. Raises RlservoError."""
        ...

    def encode(self, request: Request, decision: Decision) -> Reply:
        """Return the reply."""
        ...


class RequestHandler:
    """Answers requests of every protocol; the only place that admits, counts, logs and times them."""

    def __init__(
        self,
        control: PlanFollower,
        settings: ServerSettings,
        replica: str = "",
        *,
        is_alone: bool = True,
    ) -> None:
        """Take what is served, which may still be loading, and read the keys that `settings` name.

        `replica` names this process in the metrics; `is_alone` says whether every request reaches this process.
        Raises UsageError.
        """
        self.control = control
        self.replica = replica
        self.keys = CurrentKeys(settings)
        self.settings = settings
        self.admission = LoadShedding(settings)
        sessions = None
        if settings.session_store != MEMORY:
            from rlservo.serve_app.sessions.redis_sessions import RedisSessions  # only several workers need it

            patience_s = self.admission.max_wait_s
            sessions = RedisSessions(settings.session_store, idle_s=settings.session_idle_s, patience_s=patience_s)
        self.episodes = Episodes(
            max_sessions=settings.max_sessions, idle_s=settings.session_idle_s, store=sessions, is_alone=is_alone
        )
        self.metrics = Metrics(replica)
        self.shadows = Shadows(self.metrics.record_differences)
        self._tracing = Tracing() if settings.tracing else None
        self.recorder: RequestRecorder | None = None
        if settings.record is not None:
            from rlservo.serve_app.server.request_recorder import RequestRecorder  # which needs an extra

            self.recorder = RequestRecorder(settings)
            self.episodes.marks_states = True

    async def close(self) -> None:
        """Close the connections to other services, and complete the recording and the traces."""
        if self.episodes.store is not None:
            await self.episodes.store.close()
        for service in (self.recorder, self._tracing):
            if service is not None:
                await asyncio.to_thread(service.close)

    def store(self) -> PolicyStore:
        """Return the policies. Raises UnavailableError while they are being loaded."""
        store = self.control.store
        if store is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        return store

    async def answer(
        self, codec: Codec[Source, Reply], request: Request, source: Source, key: StreamKey | None = None
    ) -> Reply:
        """Return the reply; the codec reads from `source`. A stream's `key` is checked for each of its requests.

        Raises RlservoError, which has been counted and logged, and ClientGoneError.
        """
        try:
            if key is not None:
                request.may_explore = key.check()
            content = await codec.receive(self, request, source)
            self._admit(request)
            self.store()  # being not ready takes precedence over any fault of the request
            codec.parse(self, request, content)
            if request.explore and not request.may_explore:
                raise ForbiddenError(NO_EXPLORING)
            _check_names(request)
            if request.non_finite:
                decision = await self._decide_non_finite(request)
            else:
                decision = await self.decide(request)
            reply = codec.encode(request, decision)
        except ClientGoneError:
            raise
        except RlservoError as error:
            self.record_failure(request, error)
            if self.recorder is not None:
                self.recorder.note_failure(request, self.control.store, error)
            raise
        except Exception as error:
            self.record_bug(request, asked=blamed_version(error))
            raise InternalError(BUG) from error
        taken = time.perf_counter() - request.received
        self.metrics.record_answer(request.protocol, decision, taken)
        if request.final_status is not None:
            self._count_end(request, decision, request.final_status)
        if self.recorder is not None:
            self.recorder.note_answer(request, decision, taken)
        if self._tracing is not None:
            self._tracing.note(request, OK, decision.name, decision.version, taken, decision.infer_ms)
        if self.settings.log_requests:
            write_answer(request, decision, taken)
        return reply

    async def decide(self, request: Request) -> Decision:
        """Decide, unless its deadline has passed.

        Raises DeadlineError, TooLargeError and what `Episodes.act` raises.
        """
        store, name, obs = self.store(), request.policy, request.obs
        if request.deadline_ms is not None and (time.perf_counter() - request.received) * 1e3 >= request.deadline_ms:
            check_deadline(request)  # raises: time has passed since
        is_flat = type(obs) is list and obs and type(obs[0]) is float  # the usual observation
        if not is_flat or len(obs) > self.settings.max_batch:
            self._check_batch(store, request)
        decision = await self.episodes.act(store, request)
        shadow = store.shadow(name)
        if shadow is not None and decision.version == store.default(name) and not request.explore:
            self.shadows.offer(shadow, obs, decision)
        return decision

    def record_failure(self, request: Request, error: RlservoError, code: str = "") -> None:
        """Count and log a request that got no action, under the error's code or another one.

        Requests for unknown names share one count.
        """
        name, version, asked = request.policy, request.version, blamed_version(error)
        store, code = self.control.store, code or error.code
        counted_as = code
        if store is None or name not in store.names:
            name = version = ""
        elif asked is not None:
            version = asked
            if isinstance(error, ObservationError) and _is_stricter(store, request, asked):
                counted_as = STRICTER
        else:  # an alias counts as its version, no version as the default
            version = store.default(name) if version is None else store.plans[name].version_of(version) or ""
        self.metrics.count_failure(request.protocol, name, version, counted_as)
        if self._tracing is not None:
            taken = time.perf_counter() - request.received
            self._tracing.note(request, code, name or request.policy[:64], version or None, taken, None)
        write_failure(request, code, error.message if self.settings.log_values else None)

    def record_bug(self, request: Request, *, asked: str | None = None) -> None:
        """Count a request that failed with the current exception, and log its traceback."""
        logger.exception("a request failed", extra={FIELDS: {"request_id": request.request_id}})
        # Unless a version was asked: the policies themselves may have failed.
        name, version = ("", "") if asked is None else (request.policy, asked)
        self.metrics.count_failure(request.protocol, name, version, InternalError.code)
        if self._tracing is not None:
            taken = time.perf_counter() - request.received
            self._tracing.note(request, InternalError.code, name, version or None, taken, None)

    @contextlib.contextmanager
    def open_stream(self, request: Request) -> Iterator[None]:
        """Count a stream while it is open; `request` is its opening request. Raises OverloadedError."""
        try:
            self.admission.open_stream(request.policy)
        except OverloadedError as error:
            self.record_failure(request, error)
            raise
        try:
            yield
        finally:
            self.admission.streams[request.policy] -= 1

    def _count_end(self, request: Request, decision: Decision, status: str) -> None:
        """Count an episode that ended, unless its requests were divided between versions at random."""
        may_vary = request.version is None and decision.state is None
        if not (may_vary and self.store().is_drawn(decision.name, request.label)) and not decision.is_repeat:
            self.metrics.count_end(decision, status)

    def _admit(self, request: Request) -> None:
        """Raise OverloadedError or LateError; waiting before `received` counts as well."""
        if request.stream_id is not None:  # requests and replies alternate there, so the number of streams is the bound
            if not request.is_fresh:
                self.admission.check_age()
            return
        # Only now that the body is here: a client that sends slowly delays only itself.
        request.received = min(request.received, self.admission.enter())

    async def _decide_non_finite(self, request: Request) -> Decision:
        """Refuse numbers that JSON lacks, naming the element if it is one of the observation's."""
        if request.session_id is None:  # otherwise a session would advance
            try:
                await self.decide(request)
            except ObservationError as error:
                raise ObservationError(f"{error.message}; JSON has no NaN or Infinity", error.details) from error
        raise RequestError("the request body holds NaN or Infinity, which JSON does not have: send finite numbers")

    def _check_batch(self, store: PolicyStore, request: Request) -> None:
        most = self.settings.max_batch
        with contextlib.suppress(UnknownPolicyError):  # the decision raises it, or that the session has gone with it
            rows = count_rows(store.get(request.policy, request.version).contract.observation_space, request.obs)
            if rows > most:
                raise TooLargeError(f"a batch of {rows} observations is too large: at most {most}")


def _is_stricter(store: PolicyStore, request: Request, version: str) -> bool:
    """Return whether production accepts an observation that a version has refused.

    Most that a version refuses would be refused by every version, and say nothing about it. One that production accepts
    does, even if the version's contract demands the refusal.
    """
    try:
        production = store.get(request.policy)
        return production.contract.version != version and bool(production.parse(request.obs))
    except RlservoError:
        return False


def _check_names(request: Request) -> None:
    """Refuse an API key in an episode's name or end, which would reach recordings, metrics and logs."""
    said = {"x-session-id": request.label, "session_id": request.session_id, "final_status": request.final_status}
    for name, text in said.items():
        if type(text) is str and A_KEY.search(text):
            request.label = request.session_id = request.final_status = None
            raise RequestError(f"'{name}' holds an API key, which would be recorded: send another name")
