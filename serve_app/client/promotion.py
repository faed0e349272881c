"""Promotion of a version: a canary that is watched, and then is in production, or is not.

It uses the commands that people use, and keeps nothing on the server. Its state is its log: what is to be done is
written there before it is done, so that whoever starts it again goes on. Whatever of the server's state is neither as
it was nor as the promotion made it is somebody else's doing: then it stops, and undoes no more than its own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from rlservo.export.contract.errors import (
    ConflictError,
    DeadlineError,
    ForbiddenError,
    PartlyAppliedError,
    RlservoError,
    UnauthenticatedError,
    UnavailableError,
    UsageError,
)
from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.client.promotion_conditions import Condition, Figure, check_limits, document, judge
from rlservo.serve_app.client.promotion_counts import Counts, Served, served_by
from rlservo.serve_app.client.promotion_log import (
    CHECK,
    DECISION,
    END,
    START,
    STARTED,
    Entry,
    PromotionLog,
    newest,
    seconds_of,
)

PRODUCTION = "production"
PATIENCE_S = 60.0  # without an answer, or with a replica that cannot follow
SETTLE_S = 10.0  # in which replicas follow a plan that nobody told them of
QUIET_S = 10.0  # between lines for whoever watches

MOST_CHECKS = 1000  # in a log, of one promotion

PROMOTED, ROLLED_BACK, UNDECIDED, STOPPED, INTERRUPTED = (
    "promoted",
    "rolled back",
    "undecided",
    "stopped",
    "interrupted",
)
EXIT_CODES = {PROMOTED: 0, ROLLED_BACK: 1, UNDECIDED: 3, STOPPED: 4, INTERRUPTED: 130}  # 2 is for bad input
AWAY = (UnavailableError, DeadlineError)
NO_KEY = (UnauthenticatedError, ForbiddenError)

Replies = list[dict[str, Any]]


@dataclass(frozen=True)
class Terms:
    """What a promotion was asked to do; the same terms are the same promotion."""

    url: str
    policy: str
    version: str
    share: float  # of the sessions
    seconds: float
    unless: str
    min_requests: int
    min_episodes: int
    dry_run: bool = False


@dataclass(frozen=True)
class Outcome:
    """How a promotion ended, and why, in a sentence."""

    outcome: str
    why: str
    is_finished: bool = True
    """Whether the server is as it says; if not, the same promotion started again goes on."""


@dataclass
class _State:
    """What a promotion has to know to go on."""

    production: str  # the version that is in production
    own_shadow: bool  # whether the shadow is the promotion's
    canary: tuple[str, float] | None  # what it expects to run
    shadow: str | None = None
    began: float = 0.0  # [s] since 1970; 0 before the canary runs
    generation: int = 0
    decided_at: int | None = None  # the generation of a decision that an earlier run wrote down


class Promotion:
    """One promotion, from its beginning or from where its log ends."""

    def __init__(
        self,
        connect: Callable[[], AdminClient],
        terms: Terms,
        conditions: Sequence[Condition],
        log: PromotionLog,
        *,
        every_s: float,
        say: Callable[[str], None],
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """`connect` makes a client with the admin key as it is now; `say` is for whoever watches."""
        self._connect = connect
        self._client = connect()
        self._terms = terms
        self._conditions = conditions
        self._log = log
        self._every_s = every_s
        self._say = say
        self._sleep = sleep
        self._clock = clock
        self._patience_s = patience_s
        self._counts = Counts()
        self._said_at = self._logged_at = -math.inf
        self._ends_at = math.inf  # by the clock

    def run(self) -> Outcome:
        """Watch and decide. Raises RlservoError where nothing has begun: bad input, or a server out of reach."""
        entries = self._log.unfinished()
        state, decided = self._resume(entries) if entries else (self._begin(), None)
        try:
            outcome = decided or (None if state.began else self._start(state)) or self._watch(state)
        except KeyboardInterrupt:
            outcome = Outcome(INTERRUPTED, "interrupted by Ctrl-C")
        except UsageError as error:  # of the log
            outcome = Outcome(STOPPED, error.message)
        if decided is None:
            try:
                self._log.write(DECISION, outcome=outcome.outcome, why=outcome.why, generation=state.generation)
            except UsageError as error:  # nothing is put into production that is not written down
                outcome = Outcome(STOPPED, error.message)
        try:
            outcome = self._carry_out(state, outcome)
        except KeyboardInterrupt:
            outcome = self._unsure(outcome, "interrupted meanwhile")
        if outcome.is_finished:
            try:
                self._log.write(END, outcome=outcome.outcome, why=outcome.why)
            except UsageError as error:
                self._tell(error.message, at_once=True)  # started again it finds nothing left to do
        return outcome

    def close(self) -> None:
        """Close the connection; what runs on the server stays."""
        self._client.close()

    # Begin, or go on.

    def _begin(self) -> _State:
        terms = self._terms
        replies, served = self._look()
        if served is None or served.production is None:
            raise UsageError(f"no policy '{terms.policy}' is served: see 'rlservo policy list'")
        if terms.version not in served.versions:
            raise UsageError(
                f"policy '{terms.policy}' has no version {terms.version}: loaded are {', '.join(served.versions)}; "
                f"'rlservo policy load {terms.policy} {terms.version}' loads it"
            )
        if served.production == terms.version:
            raise UsageError(f"version {terms.version} of policy '{terms.policy}' is in production already")
        compares = any(condition.name == "action_difference" for condition in self._conditions)
        wants_shadow = compares and served.shadow != terms.version and not terms.dry_run
        if served.canary is not None and not terms.dry_run:
            raise UsageError(
                f"policy '{terms.policy}' has a canary already, {served.canary[0]}={served.canary[1]:g}: "
                f"'rlservo policy canary {terms.policy} off' ends it ({served.last_change})"
            )
        if wants_shadow and served.shadow is not None:
            raise UsageError(
                f"policy '{terms.policy}' has a shadow already, {served.shadow}, and action_difference needs it: "
                f"'rlservo policy shadow {terms.policy} off' ends it"
            )
        canary = served.canary if terms.dry_run else (terms.version, terms.share)
        state = _State(served.production, wants_shadow, canary)
        check_limits(self._conditions, self._counts.evidence(replies[0], terms.version, state.production))
        self._log.write(
            START, terms=asdict(terms), production=state.production, own_shadow=wants_shadow, canary=state.canary
        )
        return state

    def _resume(self, entries: list[Entry]) -> tuple[_State, Outcome | None]:
        terms, start = self._terms, entries[0]
        if start.get("terms") != asdict(terms):
            raise UsageError(
                f"{self._log.file} has a promotion that is not finished, with other terms ({start.get('terms')}): "
                "start that one again, or name another --log"
            )
        try:
            return self._read(entries)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise UsageError(
                f"{self._log.file} has a promotion that is not finished and cannot be read "
                f"({type(error).__name__}: {error}): name another --log"
            ) from None

    def _read(self, entries: list[Entry]) -> tuple[_State, Outcome | None]:
        """Return what a log's promotion has come to, and the outcome if that was decided."""
        terms, start = self._terms, entries[0]
        canary = start["canary"]
        state = _State(
            start["production"], bool(start["own_shadow"]), None if canary is None else (canary[0], canary[1])
        )
        started, decision = newest(entries, STARTED), newest(entries, DECISION)
        known = newest(entries, CHECK) or started
        if started is not None and known is not None:
            state.shadow, state.began = started["shadow"], seconds_of(started)
            self._counts = Counts(known["total"], known["seen"])
            state.generation = known["generation"]
        if decision is not None:
            if decision["outcome"] not in EXIT_CODES:
                raise ValueError(f"no outcome is called {decision['outcome']!r:.40}")
            state.decided_at = decision["generation"]
            self._say(f"goes on: it was decided ({decision['outcome']}) and not yet carried out")
            return state, Outcome(decision["outcome"], decision["why"])
        if known is None:
            self._say("goes on: it had ended before its canary was known to run")
        else:
            # A clock that was set back adds nothing, and one that was set while the promotion ran changes nothing.
            away_s = max(0.0, time.time() - seconds_of(known))
            self._ends_at = self._clock() + float(known.get("remaining_s", terms.seconds)) - away_s
            self._say(f"goes on: {_duration(self._remaining)} are left")
        return state, None

    def _start(self, state: _State) -> Outcome | None:
        """Start what is to be watched, and count from before it; return the outcome where that is impossible."""
        terms = self._terms
        try:
            replies, served = self._look()
            if served is None:
                return self._gone()
            foreign = state.own_shadow and served.shadow not in (None, terms.version)
            if foreign or served.canary not in (None, state.canary) or served.production != state.production:
                return Outcome(STOPPED, f"somebody else has changed what is served ({served.last_change})")
            self._counts.begin(replies, self._versions(state))
            state.shadow, state.generation = served.shadow, served.generation
            if not terms.dry_run:
                if state.own_shadow:
                    self._change(state, lambda client: client.shadow(terms.policy, terms.version))
                    state.shadow = terms.version
                self._change(state, lambda client: client.canary(terms.policy, terms.version, terms.share))
        except RlservoError as error:
            return Outcome(STOPPED, f"the canary could not be started: {error.message}")
        entry = self._log.write(
            STARTED,
            shadow=state.shadow,
            generation=state.generation,
            total=self._counts.total,
            seen=self._counts.seen,
        )
        state.began, self._ends_at = seconds_of(entry), self._clock() + terms.seconds
        self._say(
            f"watches version {terms.version} of '{terms.policy}' beside {state.production} for "
            f"{_duration(terms.seconds)}, on {_plural(len(replies), 'replica')}; the log is {self._log.file}"
        )
        return None

    # Watch.

    def _watch(self, state: _State) -> Outcome:
        answered_at = followed_at = settled_at = self._clock()
        while True:
            try:
                replies, served = self._look()
            except AWAY as error:
                self._log.write("unreachable", error=error.message)
                self._tell(f"no counts: {error.message}", at_once=True)
                if self._clock() - answered_at > self._patience_s:
                    return Outcome(
                        STOPPED, f"the server told no counts for {self._patience_s:g} s, so nobody can judge: {error}"
                    )
            except NO_KEY as error:
                return Outcome(STOPPED, f"the server takes the admin key no longer: {error.message}")
            except RlservoError as error:
                return Outcome(STOPPED, f"the server's counts cannot be had any more: {error.message}")
            else:
                answered_at = self._clock()
                if served is None:
                    return self._gone()
                is_older = served.generation < state.generation
                if not is_older:
                    settled_at = answered_at
                # Who had followed may have been killed, and the others look at the ledger every two seconds.
                if not is_older or answered_at - settled_at > SETTLE_S:
                    changed = self._changed(state, served)
                    if changed is not None:
                        return Outcome(STOPPED, changed)
                    if not served.behind:
                        followed_at = answered_at
                    elif answered_at - followed_at > self._patience_s:
                        return Outcome(ROLLED_BACK, f"not every replica can serve it: {'; '.join(served.behind)}")
                    state.generation = served.generation
                    outcome = self._check(state, replies, served)
                    if outcome is not None:
                        return outcome
            self._sleep(min(self._every_s, max(self._remaining, min(1.0, self._every_s))))

    def _check(self, state: _State, replies: Replies, served: Served) -> Outcome | None:
        """Count, judge, and write both down; return the outcome where there is one."""
        terms = self._terms
        restarted = self._counts.add(replies, self._versions(state))
        evidence = self._counts.evidence(replies[0], terms.version, state.production)
        least = {"min_requests": terms.min_requests, "min_episodes": terms.min_episodes}
        figures = [judge(condition, evidence, **least) for condition in self._conditions]
        remaining = self._remaining
        certain = [figure.sentence() for figure in figures if figure.is_certain]
        if certain or restarted or remaining <= 0 or self._clock() - self._logged_at >= terms.seconds / MOST_CHECKS:
            self._logged_at = self._clock()
            self._log.write(
                CHECK,
                remaining_s=round(remaining, 3),
                replicas=[reply["replica"] for reply in replies],
                began_anew=restarted,
                behind=served.behind,
                generation=served.generation,
                requests=evidence.candidate.answered,
                requests_in_production=evidence.production.answered,
                figures=[document(figure) for figure in figures],
                total=self._counts.total,
                seen=self._counts.seen,
            )
        answered = f"{evidence.candidate.answered:,} requests"
        self._tell(f"{_duration(remaining)} left, {answered}; " + "; ".join(figure.sentence() for figure in figures))
        if certain:
            return Outcome(ROLLED_BACK, "; ".join(certain))
        if remaining > 0 or served.behind:  # what a replica refuses is not promoted: `_watch` has the patience
            return None
        return self._decide(figures, evidence.candidate.asked)

    def _decide(self, figures: Sequence[Figure], asked: int) -> Outcome:
        """Decide when the time is over."""
        least = self._terms.min_requests
        if asked < least:
            return Outcome(
                UNDECIDED,
                f"too little traffic to judge: version {self._terms.version} was asked {asked:,} times, not {least:,} "
                "(a canary gets requests that name no version)",
            )
        few = [
            f"{figure.sentence()}, counted of {figure.count:,} and not {figure.needed:,}"
            for figure in figures
            if not figure.is_enough
        ]
        if few:
            return Outcome(UNDECIDED, f"too little to judge: {'; '.join(few)}")
        beyond = [figure.sentence() for figure in figures if figure.is_beyond]
        if beyond:
            return Outcome(ROLLED_BACK, "; ".join(beyond))
        return Outcome(PROMOTED, "; ".join(figure.sentence() for figure in figures))

    def _changed(self, state: _State, served: Served) -> str | None:
        """Return what somebody else has changed of what is watched, in a sentence."""
        terms = self._terms
        what = None
        if served.production != state.production:
            what = f"'{PRODUCTION}' leads to {served.production} and no longer to {state.production}"
        elif terms.version not in served.versions:
            what = f"version {terms.version} is no longer loaded"
        elif served.canary != state.canary:
            what = f"the canary is {_canary(served.canary)} and no longer {_canary(state.canary)}"
        elif state.own_shadow and served.shadow != state.shadow:
            what = f"the shadow is {served.shadow or 'none'} and no longer {state.shadow}"
        if what is None:
            return None
        whose = "a new start of the server" if served.generation < state.generation else "somebody else"
        return f"{whose} has changed what is served: {what} ({served.last_change})"

    def _gone(self) -> Outcome:
        return Outcome(STOPPED, f"policy '{self._terms.policy}' is no longer served")

    # Carry out what was decided.

    def _carry_out(self, state: _State, outcome: Outcome) -> Outcome:
        """Move the alias or not, and end the canary; return the outcome with what is served then."""
        terms = self._terms
        if terms.dry_run:
            return replace(outcome, why=f"{outcome.why} (dry run: nothing was changed)")
        deadline = self._clock() + self._patience_s
        while True:
            try:
                return self._attempt(state, outcome)
            except AWAY as error:
                if self._clock() > deadline:
                    return self._unsure(outcome, error.message)
                self._tell(f"cannot be carried out yet: {error.message}", at_once=True)
            except RlservoError as error:
                return self._unsure(outcome, error.message)
            self._sleep(min(1.0, self._every_s))

    def _attempt(self, state: _State, outcome: Outcome) -> Outcome:
        """Carry out once; what is done already is not done again."""
        terms = self._terms
        _, served = self._look()
        if served is None:
            return outcome
        if outcome.outcome == PROMOTED and served.production != terms.version:
            changed = self._changed(state, served)
            if changed is None and state.decided_at is not None and served.generation != state.decided_at:
                changed = (
                    "what is served was changed after the decision, and this promotion may have been undone "
                    f"({served.last_change}): decide anew"
                )
            if changed is not None:
                outcome = Outcome(STOPPED, changed)
            else:
                try:
                    self._change(
                        state,
                        lambda client: client.alias(terms.policy, PRODUCTION, terms.version, expected=state.production),
                    )
                except ConflictError as error:
                    outcome = Outcome(STOPPED, f"somebody else has changed what is served: {error.message}")
        if served.canary == (terms.version, terms.share) == state.canary:
            self._change(state, lambda client: client.canary(terms.policy, None))
        if state.own_shadow and served.shadow == terms.version:
            self._change(state, lambda client: client.shadow(terms.policy, None))
        _, served = self._look()
        if served is None:
            return outcome
        canary = f"the canary is {_canary(served.canary)}" if served.canary else "no canary runs"
        return replace(outcome, why=f"{outcome.why}; {served.production} is in production, {canary}")

    def _unsure(self, outcome: Outcome, why: str) -> Outcome:
        """Return an outcome that could not be carried out."""
        terms = self._terms
        how = "started again, the same promotion goes on"
        if outcome.outcome != PROMOTED:
            how = f"'rlservo policy canary {terms.policy} off' ends the canary, which may still run; or {how}"
        sentence = f"{outcome.why}; but this could not be carried out ({why}): {how}"
        return Outcome(STOPPED, sentence, is_finished=False)

    # Ask the server.

    def _look(self) -> tuple[Replies, Served | None]:
        """Return what every replica counted, and what is served. Raises RlservoError."""
        try:
            replies = self._client.counts(self._terms.policy)
        except UnauthenticatedError:  # `rlservo serve` makes a new key when it starts
            self._client.close()
            self._client = self._connect()
            replies = self._client.counts(self._terms.policy)
        if not replies:
            raise UnavailableError("no replica told its counts")
        return replies, served_by(replies)

    def _change(self, state: _State, change: Callable[[AdminClient], dict[str, Any]]) -> None:
        """Make a change. Raises RlservoError."""
        try:
            state.generation = int(change(self._client)["generation"])
        except PartlyAppliedError as error:  # it stands, and who could not follow is seen at the next look
            self._tell(f"not every replica has followed yet: {error.message}", at_once=True)

    def _versions(self, state: _State) -> tuple[str, str]:
        return state.production, self._terms.version

    @property
    def _remaining(self) -> float:
        return self._ends_at - self._clock()

    def _tell(self, line: str, *, at_once: bool = False) -> None:
        if at_once or self._clock() - self._said_at >= QUIET_S:
            self._said_at = self._clock()
            self._say(line)


def _canary(canary: tuple[str, float] | None) -> str:
    return "none" if canary is None else f"{canary[0]}={canary[1]:g}"


def _plural(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _duration(seconds: float) -> str:
    whole = max(0, round(seconds))
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"
