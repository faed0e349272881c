"""Promotion of a version: a canary that is watched, and then put into production or ended.

It uses the commands that operators use and the metrics that Prometheus reads, and keeps nothing on the server. Its
state is its log: each step is written there before it is made, so that the same promotion started again continues.
Changes that others make to the policy meanwhile stay: then it stops, and undoes no more than its own changes.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

from rlservo.export.contract.errors import ConflictError, RlservoError, UnavailableError, UsageError
from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.client.promotion_evidence import Counts, Limits, Process, UntrustedError, figures, read_metrics
from rlservo.serve_app.client.promotion_log import CHECK, DECISION, END, START, PromotionLog

PRODUCTION = "production"
PATIENCE_S = 60.0  # with a server that is unreachable, or a process that does not follow
MOST_CHECKS = 1000  # in a log, of one promotion

PROMOTED, ROLLED_BACK, STOPPED, INTERRUPTED = "promoted", "rolled back", "stopped", "interrupted"
EXIT_CODES = {PROMOTED: 0, ROLLED_BACK: 1, STOPPED: 4, INTERRUPTED: 130}  # 2 is for bad input


@dataclass(frozen=True)
class Terms:
    """Terms of a promotion; the same terms are the same promotion."""

    urls: tuple[str, ...]  # commands go to the first, metrics are read from all
    policy: str
    version: str
    share: float  # of the sessions
    seconds: float
    limits: Limits


@dataclass(frozen=True)
class Outcome:
    """Result of a promotion, and its reason in a sentence."""

    outcome: str
    why: str
    is_finished: bool = True
    """Whether the server's plan matches the outcome; if not, the same promotion started again continues."""


@dataclass(frozen=True)
class _Served:
    """The server's plan of the policy."""

    generation: int
    last_change: str
    versions: list[str]
    production: str
    canary: str  # such as "2=0.1"; "none" without one
    shadow: str


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
        self._connect = connect
        self._terms = terms
        self._log = log
        self._every_s = every_s
        self._say = say
        self._sleep = sleep
        self._clock = clock
        self._canary = f"{terms.version}={terms.share:g}"
        self._shadow = "none" if terms.limits.action_difference is None else terms.version
        self._production = ""  # the version that is in production
        self._generation = 0  # of the newest plan that was seen
        self._counts = Counts()
        self._ends_at = math.inf  # by the clock
        self._logged_at = -math.inf

    def run(self) -> Outcome:
        """Watch and decide. Raises RlservoError if nothing has begun: bad input, or a server out of reach."""
        is_new, decided = not self._log.entries, None
        try:
            if is_new:
                self._begin()
            else:
                decided = self._resume()
        except UntrustedError as error:
            raise UsageError(str(error)) from None
        decided_at = None if decided is None else self._generation
        try:
            outcome = decided or (self._start() if is_new else None) or self._watch()
            if decided is None:
                self._log.write(DECISION, outcome=outcome.outcome, why=outcome.why, generation=self._generation)
        except KeyboardInterrupt:
            outcome = Outcome(INTERRUPTED, "interrupted by Ctrl-C")
        except UsageError as error:  # nothing is put into production that the log does not hold
            outcome = Outcome(STOPPED, error.message)
        try:
            outcome = self._carry_out(outcome, decided_at)
            if outcome.is_finished:
                self._log.write(END, outcome=outcome.outcome, why=outcome.why)
        except KeyboardInterrupt:
            outcome = self._unfinished(outcome, "interrupted meanwhile")
        except UsageError as error:
            self._say(error.message)  # started again it finds nothing left to do
        return outcome

    # Begin, or continue.

    def _begin(self) -> None:
        """Check the server's plan, and count from here on."""
        terms, served = self._terms, self._served()
        name, version = terms.policy, terms.version
        if served is None:
            raise UsageError(f"no policy '{name}' is served: see 'rlservo policy list'")
        if version not in served.versions:
            raise UsageError(
                f"policy '{name}' has no version {version}: expected one of {', '.join(served.versions)}; "
                f"'rlservo policy load {name} {version}' loads it"
            )
        if served.production == version:
            raise UsageError(f"version {version} of policy '{name}' is in production already")
        for kind, running, own in (("canary", served.canary, self._canary), ("shadow", served.shadow, self._shadow)):
            if running != "none" != own:
                raise UsageError(
                    f"policy '{name}' has a {kind} already, {running}: 'rlservo policy {kind} {name} off' ends it "
                    f"({served.last_change})"
                )
        self._production, self._generation = served.production, served.generation
        self._counts.add(self._processes())
        self._log.write(
            START,
            terms=asdict(terms),
            production=served.production,
            generation=served.generation,
            remaining_s=terms.seconds,
            **asdict(self._counts),
        )

    def _start(self) -> Outcome | None:
        """Start the shadow and the canary; return the outcome if that is impossible."""
        terms = self._terms
        name, version = terms.policy, terms.version
        try:
            if self._shadow != "none":
                self._change(lambda client: client.shadow(name, version))
            self._change(lambda client: client.canary(name, version, terms.share))
        except RlservoError as error:
            return Outcome(STOPPED, f"the canary could not be started: {error.message}")
        self._ends_at = self._clock() + terms.seconds
        self._say(
            f"watches version {version} of '{name}' against {self._production} for {_duration(terms.seconds)}, on "
            f"{', '.join(self._counts.seen)}; the log is {self._log.path}"
        )
        return None

    def _resume(self) -> Outcome | None:
        """Read the state of the log's promotion; return the outcome if it was decided."""
        start, decision = self._log.entries[START], self._log.entries.get(DECISION)
        if start.get("terms") != json.loads(json.dumps(asdict(self._terms))):
            raise UsageError(
                f"{self._log.path} has a promotion that is not finished, with other terms ({start.get('terms')}): "
                "start that one again, or name another --log"
            )
        try:
            known = self._log.entries.get(CHECK, start)
            self._production, self._generation = start["production"], int((decision or known)["generation"])
            self._counts = Counts(known["total"], known["seen"])
            # A clock that was set back adds nothing, and one that was set while it ran changes nothing.
            self._ends_at = self._clock() + float(known["remaining_s"]) - max(0.0, time.time() - known["seconds"])
            outcome = Outcome(decision["outcome"], decision["why"]) if decision else None
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(f"{self._log.path} cannot be read ({error!r}): name another --log") from None
        self._say(f"continues: {_duration(self._remaining)} are left")
        return outcome

    # Watch.

    def _watch(self) -> Outcome:
        """Return the outcome, when there is one. Temporary faults have a minute to pass."""
        fine_at = self._clock()
        while True:
            self._sleep(min(self._every_s, max(self._remaining, min(1.0, self._every_s))))
            try:
                served = self._served()
                if changed := self._changed(served):
                    return Outcome(STOPPED, changed)
                processes = self._processes()
                self._counts.add(processes)
                trouble = self._behind(processes)
            except UntrustedError as error:
                return Outcome(ROLLED_BACK, str(error))
            except RlservoError as error:
                trouble = error.message
            if not trouble:
                fine_at = self._clock()
                outcome = self._judge()
                if outcome is not None:
                    return outcome
            elif self._clock() - fine_at > PATIENCE_S:
                return Outcome(ROLLED_BACK, f"it could not be judged for {PATIENCE_S:g} s: {trouble}")
            else:
                self._say(f"cannot judge: {trouble}")

    def _behind(self, processes: dict[str, Process]) -> str:
        """Return a sentence on a process that does not serve the watched versions."""
        for name, process in processes.items():
            if process.plan < self._generation:
                return f"replica '{name}' follows plan {process.plan:g}, not yet {self._generation}"
            if self._terms.version not in process.versions:
                return f"replica '{name}' has not loaded version {self._terms.version}"
        return ""

    def _judge(self) -> Outcome | None:
        """Log the counts; return the outcome if there is one."""
        terms, remaining = self._terms, self._remaining
        found = list(figures(terms.limits, self._counts.total, self._production, terms.version))
        surely, all_of_it = [each for each in found if each.is_surely_beyond], "; ".join(map(str, found))
        if surely or remaining <= 0 or self._clock() - self._logged_at >= terms.seconds / MOST_CHECKS:
            self._logged_at = self._clock()
            known = {"generation": self._generation, "remaining_s": remaining, **asdict(self._counts)}
            self._log.write(CHECK, figures=list(map(str, found)), **known)
        self._say(f"{_duration(remaining)} left; {all_of_it}")
        if remaining > 0 and not surely:
            return None
        against = surely or [each for each in found if each.is_beyond or each.lacks]
        return Outcome(ROLLED_BACK, "; ".join(map(str, against))) if against else Outcome(PROMOTED, all_of_it)

    def _changed(self, served: _Served | None) -> str:
        """Return a sentence on what another command has changed."""
        terms, what = self._terms, ""
        if served is None:
            return f"policy '{terms.policy}' is no longer served"
        if served.production != self._production:
            what = f"'{PRODUCTION}' leads to {served.production} and no longer to {self._production}"
        elif terms.version not in served.versions:
            what = f"version {terms.version} is no longer loaded"
        elif served.canary != self._canary:
            what = f"the canary is {served.canary} and no longer {self._canary}"
        elif self._shadow not in ("none", served.shadow):
            what = f"the shadow is {served.shadow} and no longer {self._shadow}"
        return f"another command has changed what is served: {what} ({served.last_change})" if what else ""

    # Carry out what was decided.

    def _carry_out(self, outcome: Outcome, decided_at: int | None) -> Outcome:
        """Move the alias or not, and end the canary; return the outcome with the new listing."""
        deadline = self._clock() + PATIENCE_S
        while True:
            try:
                return self._attempt(outcome, decided_at)
            except RlservoError as error:
                if self._clock() > deadline:
                    return self._unfinished(outcome, error.message)
                self._say(f"cannot be carried out yet: {error.message}")
            self._sleep(min(1.0, self._every_s))

    def _attempt(self, outcome: Outcome, decided_at: int | None) -> Outcome:
        """Carry out once; finished steps are not repeated."""
        name, version, served = self._terms.policy, self._terms.version, self._served()
        if outcome.outcome == PROMOTED and served is not None and served.production != version:
            changed = self._changed(served)
            if not changed and decided_at not in (None, served.generation):
                changed = f"this promotion may have been undone ({served.last_change}): start it again"
            try:
                if not changed:
                    self._change(lambda client: client.alias(name, PRODUCTION, version, expected=self._production))
            except ConflictError as error:
                changed = error.message
            outcome = Outcome(STOPPED, changed) if changed else outcome
        if served is not None and served.canary == self._canary:
            self._change(lambda client: client.canary(name, None))
        # The listing has no shadow that is in production itself.
        if served is not None and self._shadow != "none" and version in (served.shadow, served.production):
            self._change(lambda client: client.shadow(name, None))
        served = self._served()
        if served is None:
            return outcome
        return replace(
            outcome, why=f"{outcome.why}; {served.production} is in production, the canary is {served.canary}"
        )

    def _unfinished(self, outcome: Outcome, why: str) -> Outcome:
        return Outcome(
            STOPPED,
            f"{outcome.why}; but this could not be carried out ({why}): the same promotion, started again, continues; "
            f"'rlservo policy canary {self._terms.policy} off' ends a canary that still runs",
            is_finished=False,
        )

    # Ask the servers.

    def _served(self) -> _Served | None:
        """Return the plan of the policy; None if it is not served. Raises RlservoError, also for an older plan."""
        with self._connect(self._terms.urls[0]) as client:
            listing = client.listing()
        try:
            generation = int(listing["generation"])
            if generation < self._generation:  # of a worker or replica that has not followed yet
                raise UnavailableError(f"the server follows plan {generation}, not yet {self._generation}")
            self._generation = generation
            policy = next((policy for policy in listing["policies"] if policy["name"] == self._terms.policy), None)
            return policy and _Served(
                generation,
                f"the last change was '{listing['changed_by'].strip()}', at {listing['changed_at'][:19]} UTC",
                policy["versions"],
                policy["version"],
                _canary(policy["canary"], policy["aliases"]),
                (policy["shadow"] or {"version": "none"})["version"],
            )
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
            self._generation = int(change(client)["generation"])

    @property
    def _remaining(self) -> float:
        return self._ends_at - self._clock()


def _canary(canary: dict[str, Any] | None, aliases: dict[str, str]) -> str:
    return f"{aliases.get(canary['version'], canary['version'])}={canary['share']:g}" if canary else "none"


def _duration(seconds: float) -> str:
    whole = max(0, round(seconds))
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"
