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
from dataclasses import KW_ONLY, asdict, dataclass, field
from datetime import datetime
from typing import Any, NamedTuple, TypeVar

from pydantic import TypeAdapter

from rlservo.client.admin_client import AdminClient
from rlservo.client.promotion_evidence import (
    START,
    Counts,
    PromotionLimits,
    UntrustedError,
    check_lag,
    figures,
    has_ended,
    late_requests,
    lost_workers,
    read_metrics,
)
from rlservo.client.promotion_log import PromotionLog
from rlservo.errors import ConflictError, RlservoError, UnavailableError, UsageError
from rlservo.policy.acting_policy import PRODUCTION

PATIENCE_S = 60.0  # with a server that is unreachable, or a process that does not follow
ANSWERS_EACH = 10  # of a load balancer, by each process known behind it: one is missed by chance in 20,000 looks
MOST_CHECKS = 1000  # in a log, of one promotion

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
    limits: PromotionLimits


class Outcome(NamedTuple):
    """Result of a promotion, and its reason in a sentence."""

    outcome: str
    why: str
    is_finished: bool = True
    """Whether the server's plan matches the outcome; if not, the same promotion started again continues."""


@dataclass
class PromotionState:
    """What a promotion continues from, in each line of its log."""

    terms: Terms
    remaining_s: float
    production: str = ""  # version at the start
    generation: int = 0  # of the newest plan that was seen
    decided: Outcome | None = None
    counts: Counts = field(default_factory=lambda: Counts({}, {}))
    late_before: tuple[float, float] = (0.0, 0.0)  # `late_requests` of the time before
    lost: dict[str, float] = field(default_factory=dict)  # workers that had died at the start, by address


@dataclass
class Promotion:
    """One promotion, from its beginning or from where its log ends."""

    connect: Callable[[str], AdminClient]  # to an address, with the key as it is then
    terms: Terms
    log: PromotionLog
    _: KW_ONLY
    every_s: float
    say: Callable[[str], object]  # takes lines for the operator
    sleep: Callable[[float], None] = time.sleep
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._state = PromotionState(self.terms, self.terms.seconds)
        # The version's uses while it is watched: by command, the command's document, which a listing has as it is.
        self._uses: dict[str, dict[str, Any]] = {"canary": {"version": self.terms.version, "share": self.terms.share}}
        if self.terms.limits.action_difference is not None:
            self._uses["shadow"] = {"version": self.terms.version}
        self._last_change = ""  # of the server's plan, in words
        self._decided_at: int | None = None  # the plan at an earlier run's decision

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
                f"'rlservo policy canary {self.terms.policy} off' ends a canary that is still running",
                is_finished=False,
            )
        try:
            self._write("end", outcome)
        except UsageError as error:
            self.say(error.message)  # the same command, repeated, finds nothing left to do
        return outcome

    def _patiently(self, step: Callable[[], Result]) -> Result:
        """Return what a step returns, trying for a minute."""
        deadline = self.clock() + PATIENCE_S
        while True:
            try:
                return step()
            except RlservoError as error:
                if isinstance(error, UntrustedError | ConflictError) or self.clock() > deadline:
                    raise
                self.say(f"trying again: {error.message}")
            self.sleep(self.every_s)

    # Begin, or continue.

    def _begin(self) -> None:
        """Check the server's plan, and count from here on. Raises RlservoError."""
        name, version, policy = self.terms.policy, self.terms.version, self._served()
        if version not in (versions := policy.get("versions", ())):
            wrong = f"has no version {version}: expected one of {', '.join(versions)}" if versions else "is not served"
            raise UsageError(
                f"policy '{name}' {wrong}; 'rlservo policy load {name} {version}' loads it from the server's repository"
            )
        if policy["version"] == version:
            raise UsageError(f"version {version} of policy '{name}' is already in production")
        for use in self._uses:
            if policy.get(use) is not None:
                raise UsageError(
                    f"policy '{name}' already has a {use}, {_shown(policy[use])}: 'rlservo policy {use} {name} off' "
                    f"ends it ({self._last_change})"
                )
        self._state.production = policy["version"]
        late = [late_requests(numbers) for numbers in self._count().values()]
        self._state.late_before = (sum(count for count, _ in late), sum(of for _, of in late))
        self._write("start")

    def _start(self) -> None:
        """Start the shadow and the canary. Raises RlservoError."""
        for use, document in reversed(self._uses.items()):
            self._change(use, document)
        living = [name for name, numbers in self._state.counts.seen.items() if not has_ended(numbers)]
        self.say(
            f"watching version {self.terms.version} of '{self.terms.policy}' against {self._state.production} for "
            f"{self.terms.seconds:.0f} s on {', '.join(living)}; the log is {self.log.path}"
        )

    def _resume(self) -> bool:
        """Restore the state from the log; return False if it has no promotion that has not ended. Raises UsageError."""
        if not self.log.last:
            return False
        try:
            line = json.loads(self.log.last)
            gone_s = time.time() - datetime.fromisoformat(line.pop("time")).timestamp()
            if line.pop("event") == "end":
                return False
            state = TypeAdapter(PromotionState).validate_python(line)
        except (ValueError, KeyError) as error:  # ValidationError is one
            raise UsageError(f"{self.log.path} cannot be read ({error}): name another --log") from None
        if state.terms != self.terms:
            raise UsageError(
                f"{self.log.path} has an unfinished promotion with other terms ({state.terms}): give that command "
                "again, or name another --log"
            )
        self._state, self._decided_at = state, state.generation if state.decided else None
        state.remaining_s = max(0.0, state.remaining_s - max(0.0, gone_s))  # a clock that was set back adds no time
        self.say(f"continuing: {state.remaining_s:.0f} s are left")
        return True

    def _write(self, event: str, decided: Outcome | None = None, **fields: Any) -> None:
        """Log everything that a promotion continues from. Raises UsageError."""
        self._state.decided = decided
        self.log.write(event, fields | asdict(self._state))

    # Watch.

    def _watch(self) -> Outcome:
        """Return the outcome. Raises UsageError if the log cannot be written, ConflictError as `_check` does."""
        terms, state, now, logged_s = self.terms, self._state, self.clock(), math.inf
        while True:
            self.sleep(min(self.every_s, max(state.remaining_s, min(1.0, self.every_s))))
            try:
                self._patiently(self._look)
            except ConflictError:
                raise
            except UntrustedError as error:
                return Outcome(ROLLED_BACK, error.message)
            except RlservoError as error:
                return Outcome(ROLLED_BACK, f"it could not be judged for {PATIENCE_S:g} s: {error.message}")
            before, now = now, self.clock()
            state.remaining_s = max(0.0, state.remaining_s - (now - before))
            found = list(figures(terms.limits, state.counts.total, state.production, terms.version, state.late_before))
            surely, shown = [each for each in found if each.is_surely_beyond], "; ".join(map(str, found))
            is_last = bool(surely) or state.remaining_s == 0
            if is_last or logged_s - state.remaining_s >= terms.seconds / MOST_CHECKS:
                logged_s = state.remaining_s
                self._write("check", figures=[str(each) for each in found])
            self.say(f"{state.remaining_s:.0f} s left; {shown}")
            if is_last:
                against = surely or [each for each in found if each.is_beyond or each.lacks]
                return Outcome(ROLLED_BACK, "; ".join(map(str, against))) if against else Outcome(PROMOTED, shown)

    def _look(self) -> None:
        """Update the counts. Raises ConflictError if another command has changed what is served, UntrustedError."""
        self._check(self._served())
        check_lag(self._count(), self._state.generation, self.terms.version)

    def _check(self, policy: dict[str, Any]) -> None:
        """Raise ConflictError if another command has changed what is served."""
        if not policy:
            raise ConflictError(f"policy '{self.terms.policy}' is no longer served")
        for use, ours in {"version": self._state.production, **self._uses}.items():
            if policy.get(use) != ours:  # a version that is unloaded has no use
                what = "production" if use == "version" else f"the {use}"
                raise ConflictError(
                    f"another command has changed what is served: {what} is {_shown(policy.get(use))} and no longer "
                    f"{_shown(ours)} ({self._last_change})"
                )

    # Carry out what was decided.

    def _carry_out(self, decided: Outcome) -> Outcome:
        """Move the alias or not, and end the canary; return the outcome with the new listing.

        Steps that are finished are not repeated. Raises RlservoError.
        """
        version, policy = self.terms.version, self._served()
        outcome, why, _ = decided
        if outcome == PROMOTED and policy.get("version") != version:
            try:
                self._check(policy)
                if self._decided_at not in (None, self._state.generation):
                    raise ConflictError(f"someone may have undone this promotion ({self._last_change}): start it again")
                alias = {"alias": PRODUCTION, "version": version, "expected": self._state.production}
                self._change("alias", alias)
            except ConflictError as error:
                outcome, why = STOPPED, error.message
        for use, ours in self._uses.items():
            # The listing has no shadow that is in production itself.
            if policy.get(use) == ours or (use == "shadow" and policy.get("version") == version):
                self._change(use, {"version": None})
        policy = self._served()
        canary = f"canary {_shown(policy['canary'])}" if policy.get("canary") else "no canary"
        return Outcome(outcome, f"{why}; {_shown(policy.get('version'))} is in production, with {canary}")

    # Ask the servers.

    def _served(self) -> dict[str, Any]:
        """Return the policy as listed, empty if it is not served. Raises RlservoError, also for an older plan."""
        with self.connect(self.terms.urls[0]) as client:
            listing = client.listing()
        try:
            generation = int(listing["generation"])
            changed = f"the last change was '{listing['changed_by']}', at {listing['changed_at'][:19]} UTC"
            read = ("versions", "version", "canary", "shadow")
            policies: dict[str, dict[str, Any]] = {
                each["name"]: {field: each[field] for field in read} for each in listing["policies"]
            }
        except (KeyError, TypeError, ValueError) as error:
            raise UnavailableError(f"the server's listing cannot be read ({error!r})") from None
        if generation < self._state.generation:  # of a worker or replica that has not followed yet
            raise UnavailableError(f"the server follows plan {generation}, not yet {self._state.generation}")
        self._state.generation, self._last_change = generation, changed
        return policies.get(self.terms.policy, {})

    def _count(self) -> dict[str, dict[str, float]]:
        """Update the counts, and return each process's numbers. Raises RlservoError and UntrustedError."""
        processes: dict[str, dict[str, float]] = {}
        for url in self.terms.urls:
            named = self._ask_all(url)
            self._check_deaths(url, named)
            processes |= named
        self._state.counts.add(processes)
        return processes

    def _ask_all(self, url: str) -> dict[str, dict[str, float]]:
        """Return the numbers of each process behind an address, which is asked until all known ones have answered.

        Behind a load balancer any of them answers. Raises RlservoError, and UntrustedError if one has vanished.
        """
        known = {name for name, numbers in self._state.counts.seen.items() if not has_ended(numbers)}
        known = {name for name in known if name.split(" ")[0] == url}
        found: dict[str, dict[str, float]] = {}
        for _ in range(max(1, len(known)) * ANSWERS_EACH):
            with self.connect(url) as client:
                read = read_metrics(client.metrics(), self.terms.policy)
            found |= {f"{url} {replica}".strip(): numbers for replica, numbers in read.items()}
            if known <= found.keys() and (known or lost_workers(found) is not None or url in found):
                break
        if missing := sorted(known - found.keys()):
            raise UntrustedError(
                f"'{missing[0]}' has vanished while version {self.terms.version} was on trial, so it may have died: "
                "promote while no process is removed or replaced"
            )
        return found

    def _check_deaths(self, url: str, processes: dict[str, dict[str, float]]) -> None:
        """Raise UntrustedError if a process has died since the promotion began."""
        state, tried = self._state, f"while version {self.terms.version} was on trial"
        lost = lost_workers(processes)
        if lost is not None:
            died = lost - state.lost.setdefault(url, lost)
            if died:
                raise UntrustedError(f"{died:g} of {url}'s workers died {tried}: the server's log has the reason")
        for name, numbers in processes.items():
            before = state.counts.seen.get(name, {}).get(START)
            if before is not None and numbers.get(START, before) > before:
                raise UntrustedError(f"'{name}' has started again {tried}, so it died or was restarted")

    def _change(self, command: str, document: dict[str, Any]) -> None:
        """Make a change. Raises RlservoError."""
        with self.connect(self.terms.urls[0]) as client:
            self._state.generation = int(client.command(self.terms.policy, command, document)["generation"])


def _shown(use: Any) -> str:
    """Return what a listing has for a use, for a sentence: `none`, `2`, or `2=0.1`."""
    parts = use.values() if isinstance(use, dict) else ["none" if use is None else use]
    return "=".join(f"{part:g}" if isinstance(part, float) else str(part) for part in parts)
