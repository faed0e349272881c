"""Promotion of a version: a canary that is watched, and then put into production or ended.

It uses the commands that operators use and the metrics that Prometheus reads, and keeps nothing on the server. Its
state is its log, written before each step, so that the same command continues after a kill. If another operator
changes the policy meanwhile, it stops and undoes only its own changes.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any, NamedTuple, TypeVar

from pydantic import TypeAdapter

from rlservo.export.contract.errors import ConflictError, RlservoError, UnavailableError, UsageError
from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.client.promotion_evidence import Counts, Limits, Process, UntrustedError, figures, read_metrics
from rlservo.serve_app.client.promotion_log import PromotionLog
from rlservo.serve_app.interface import PRODUCTION

PATIENCE_S = 60.0  # with a server that is unreachable, or a process that does not follow
MOST_CHECKS = 1000  # in a log, of one promotion
IN_USE, CANARY, SHADOW = "production", "the canary", "the shadow"  # uses of versions

PROMOTED, ROLLED_BACK, STOPPED, INTERRUPTED = "promoted", "rolled back", "stopped", "interrupted"
EXIT_CODES = {PROMOTED: 0, ROLLED_BACK: 1, STOPPED: 4, INTERRUPTED: 130}  # 2 is for bad input

Result = TypeVar("Result")


@dataclass(frozen=True)
class Terms:
    """Terms of a promotion; the same terms are the same promotion."""

    urls: tuple[str, ...]  # commands go to the first, metrics are read from all
    policy: str
    version: str
    share: float  # of the sessions
    seconds: float
    limits: Limits


class Outcome(NamedTuple):
    """Result of a promotion, and its reason in a sentence."""

    outcome: str
    why: str
    is_finished: bool = True
    """Whether the server's plan matches the outcome; if not, the same promotion started again continues."""


@dataclass
class State:
    """What a promotion continues from, in each line of its log."""

    terms: Terms
    production: str = ""  # version at the start
    generation: int = 0  # of the newest plan that was seen
    remaining_s: float = 0.0
    decided: Outcome | None = None
    counts: Counts = field(default_factory=Counts)


class Promotion:
    """One promotion, from its beginning or from where its log ends."""

    def __init__(
        self,
        connect: Callable[[str], AdminClient],
        terms: Terms,
        log: PromotionLog,
        *,
        every_s: float,
        say: Callable[[str], object],
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`connect` makes a client for an address, with the key as it is then; `say` takes lines for the operator."""
        self._connect, self._terms, self._log = connect, terms, log
        self._every_s, self._say, self._sleep, self._clock = every_s, say, sleep, clock
        self._state = State(terms)
        self._ours = {CANARY: f"{terms.version}={terms.share:g}"}  # uses of versions meanwhile
        if terms.limits.action_difference is not None:
            self._ours[SHADOW] = terms.version
        self._last_change = ""  # of the server's plan, in words
        self._decided_at: int | None = None  # the plan at an earlier run's decision
        self._ends_at = clock() + terms.seconds

    def run(self) -> Outcome:
        """Watch and decide. Raises RlservoError if it cannot begin: bad input, or an unreachable server."""
        is_new = not self._resume()
        if is_new:
            self._begin()
        decided = self._state.decided
        try:
            if decided is None:
                if is_new:
                    self._start()
                decided = self._watch()
                self._write("decision", decided)
        except KeyboardInterrupt:
            decided = Outcome(INTERRUPTED, "interrupted by Ctrl-C")
        except RlservoError as error:  # nothing is put into production that the log does not hold
            decided = Outcome(STOPPED, error.message)
        try:
            outcome = self._patiently(lambda: self._carry_out(decided))
        except (RlservoError, KeyboardInterrupt) as error:
            why = error.message if isinstance(error, RlservoError) else "interrupted meanwhile"
            return Outcome(
                STOPPED,
                f"{decided.why}; but this could not be carried out ({why}): the same command, given again, continues; "
                f"'rlservo policy canary {self._terms.policy} off' ends a canary that is still running",
                is_finished=False,
            )
        try:
            self._write("end", outcome)
        except UsageError as error:
            self._say(error.message)  # the same command, repeated, finds nothing left to do
        return outcome

    def _patiently(self, step: Callable[[], Result]) -> Result:
        """Return what a step returns, trying for a minute."""
        deadline = self._clock() + PATIENCE_S
        while True:
            try:
                return step()
            except RlservoError as error:
                if isinstance(error, UntrustedError | ConflictError) or self._clock() > deadline:
                    raise
                self._say(f"trying again: {error.message}")
            self._sleep(self._every_s)

    # Begin, or continue.

    def _begin(self) -> None:
        """Check the server's plan, and count from here on. Raises RlservoError."""
        name, version, (versions, uses) = self._terms.policy, self._terms.version, self._served()
        if version not in versions:
            raise UsageError(
                f"policy '{name}' has no version {version}: expected one of {', '.join(versions) or 'none'}; "
                f"'rlservo policy load {name} {version}' loads it"
            )
        if uses[IN_USE] == version:
            raise UsageError(f"version {version} of policy '{name}' is in production already")
        for use in self._ours:
            if uses[use] != "none":
                kind = use.removeprefix("the ")
                raise UsageError(
                    f"policy '{name}' has a {kind} already, {uses[use]}: 'rlservo policy {kind} {name} off' ends it "
                    f"({self._last_change})"
                )
        self._state.production = uses[IN_USE]
        self._state.counts.add(self._processes())
        self._write("start")

    def _start(self) -> None:
        """Start the shadow and the canary. Raises RlservoError."""
        terms = self._terms
        if SHADOW in self._ours:
            self._change(lambda client: client.shadow(terms.policy, terms.version))
        self._change(lambda client: client.canary(terms.policy, terms.version, terms.share))
        self._ends_at = self._clock() + terms.seconds
        self._say(
            f"watching version {terms.version} of '{terms.policy}' against {self._state.production} for "
            f"{terms.seconds:.0f} s on {', '.join(self._state.counts.seen)}; the log is {self._log.path}"
        )

    def _resume(self) -> bool:
        """Restore the state from the log; return False if it has no promotion that has not ended. Raises UsageError."""
        if not self._log.last:
            return False
        try:
            line = json.loads(self._log.last)
            gone_s = time.time() - datetime.fromisoformat(line.pop("time")).timestamp()
            if line.pop("event") == "end":
                return False
            state = TypeAdapter(State).validate_python(line)
        except (ValueError, KeyError) as error:  # ValidationError is one
            raise UsageError(f"{self._log.path} cannot be read ({error}): name another --log") from None
        if state.terms != self._terms:
            raise UsageError(
                f"{self._log.path} has an unfinished promotion with other terms ({state.terms}): give that command "
                "again, or name another --log"
            )
        # A clock that was set back adds no time.
        self._state, self._ends_at = state, self._clock() + state.remaining_s - max(0.0, gone_s)
        self._decided_at = state.generation if state.decided else None
        self._say(f"continuing: {max(0.0, self._remaining):.0f} s are left")
        return True

    def _write(self, event: str, decided: Outcome | None = None, **fields: Any) -> None:
        """Log everything that a promotion continues from. Raises UsageError."""
        self._state.decided, self._state.remaining_s = decided, self._remaining
        self._log.write(event, fields | asdict(self._state))

    # Watch.

    def _watch(self) -> Outcome:
        """Return the outcome. Raises UsageError if the log cannot be written, ConflictError as `_check` does."""
        terms, logged_at = self._terms, -math.inf
        while True:
            self._sleep(min(self._every_s, max(self._remaining, min(1.0, self._every_s))))
            try:
                self._patiently(self._look)
            except ConflictError:
                raise
            except UntrustedError as error:
                return Outcome(ROLLED_BACK, error.message)
            except RlservoError as error:
                return Outcome(ROLLED_BACK, f"it could not be judged for {PATIENCE_S:g} s: {error.message}")
            remaining, counted = self._remaining, self._state.counts.total
            found = list(figures(terms.limits, counted, self._state.production, terms.version))
            surely, shown = [each for each in found if each.is_surely_beyond], "; ".join(map(str, found))
            if surely or remaining <= 0 or self._clock() - logged_at >= terms.seconds / MOST_CHECKS:
                logged_at = self._clock()
                self._write("check", figures=[str(each) for each in found])
            self._say(f"{max(0.0, remaining):.0f} s left; {shown}")
            if surely or remaining <= 0:
                against = surely or [each for each in found if each.is_beyond or each.lacks]
                return Outcome(ROLLED_BACK, "; ".join(map(str, against))) if against else Outcome(PROMOTED, shown)

    def _look(self) -> None:
        """Update the counts. Raises ConflictError if another command has changed what is served, UntrustedError."""
        self._check(self._served()[1])
        processes = self._processes()
        self._state.counts.add(processes)
        for name, process in processes.items():
            if process.plan < self._state.generation:
                raise UnavailableError(
                    f"replica '{name}' follows plan {process.plan:g}, not yet {self._state.generation}"
                )
            if self._terms.version not in process.versions:
                raise UnavailableError(f"replica '{name}' has not loaded version {self._terms.version}")

    def _check(self, uses: dict[str, str]) -> None:
        """Raise ConflictError if another command has changed what is served."""
        if uses[IN_USE] == "none":
            raise ConflictError(f"policy '{self._terms.policy}' is no longer served")
        for use, ours in {IN_USE: self._state.production, **self._ours}.items():
            if uses[use] != ours:  # a version that is unloaded has none
                raise ConflictError(
                    f"another command has changed what is served: {use} is {uses[use]} and no longer {ours} "
                    f"({self._last_change})"
                )

    # Carry out what was decided.

    def _carry_out(self, decided: Outcome) -> Outcome:
        """Move the alias or not, and end the canary; return the outcome with the new listing.

        Steps that are finished are not repeated. Raises RlservoError.
        """
        name, version, (_, uses) = self._terms.policy, self._terms.version, self._served()
        outcome, why, _ = decided
        if outcome == PROMOTED and uses[IN_USE] != version:
            try:
                self._check(uses)
                if self._decided_at not in (None, self._state.generation):
                    raise ConflictError(f"someone may have undone this promotion ({self._last_change}): start it again")
                self._change(lambda client: client.alias(name, PRODUCTION, version, expected=self._state.production))
            except ConflictError as error:
                outcome, why = STOPPED, error.message
        if uses[CANARY] == self._ours[CANARY]:
            self._change(lambda client: client.canary(name, None))
        # The listing has no shadow that is in production itself.
        if SHADOW in self._ours and version in (uses[SHADOW], uses[IN_USE]):
            self._change(lambda client: client.shadow(name, None))
        uses = self._served()[1]
        return Outcome(outcome, f"{why}; {uses[IN_USE]} is in production, the canary is {uses[CANARY]}")

    # Ask the servers.

    def _served(self) -> tuple[list[str], dict[str, str]]:
        """Return the policy's versions, and what production, the canary (such as "2=0.1") and the shadow are.

        No versions and "none" if it is not served. Raises RlservoError, also for an older plan.
        """
        with self._connect(self._terms.urls[0]) as client:
            listing = client.listing()
        try:
            generation = int(listing["generation"])
            if generation < self._state.generation:  # of a worker or replica that has not followed yet
                raise UnavailableError(f"the server follows plan {generation}, not yet {self._state.generation}")
            self._state.generation = generation
            self._last_change = f"the last change was '{listing['changed_by']}', at {listing['changed_at'][:19]} UTC"
            named: dict[str, Any] = {each["name"]: each for each in listing["policies"]}
            policy = named.get(self._terms.policy, {})
            canary, shadow = policy.get("canary"), policy.get("shadow")
            return policy.get("versions", []), {
                IN_USE: policy.get("version", "none"),
                CANARY: f"{canary['version']}={canary['share']:g}" if canary else "none",
                SHADOW: shadow["version"] if shadow else "none",
            }
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UnavailableError(f"the server's listing cannot be read ({error!r})") from None

    def _processes(self) -> dict[str, Process]:
        """Return all processes. Raises RlservoError and UntrustedError."""
        processes: dict[str, Process] = {}
        for url in self._terms.urls:
            with self._connect(url) as client:
                found = read_metrics(client.metrics(), self._terms.policy)
            processes |= {f"{url} {replica}".strip(): process for replica, process in found.items()}
        return processes

    def _change(self, change: Callable[[AdminClient], dict[str, Any]]) -> None:
        """Make a change. Raises RlservoError."""
        with self._connect(self._terms.urls[0]) as client:
            self._state.generation = int(change(client)["generation"])

    @property
    def _remaining(self) -> float:
        return self._ends_at - self._clock()
