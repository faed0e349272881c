"""Counts of a promotion: what all replicas have counted since it began, and what they serve.

A replica counts from its own start. What is summed are its increments from one look to the next: one that is gone keeps
what it had, one that came counts whole, and one whose numbers fell has begun anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rlservo.export.contract.errors import UnavailableError
from rlservo.serve_app.client.promotion_conditions import Comparison, Evidence, Tally

Numbers = dict[str, float]  # by a path such as "2/latency/3"


@dataclass(frozen=True)
class Served:
    """What the replica with the newest plan serves of the policy."""

    generation: int
    changed_by: str
    changed_at: str
    versions: tuple[str, ...]
    production: str | None
    canary: tuple[str, float] | None
    shadow: str | None
    behind: tuple[str, ...]  # of every replica, what it cannot serve

    @property
    def last_change(self) -> str:
        return f"the last change was '{self.changed_by.strip()}', at {self.changed_at[:19]} UTC"


@dataclass
class Counts:
    """Sums over all replicas since a promotion began."""

    total: Numbers = field(default_factory=dict)
    seen: dict[str, Numbers] = field(default_factory=dict)
    """Each replica's own numbers when it was last seen."""

    def begin(self, replies: Sequence[Mapping[str, Any]], versions: Sequence[str]) -> None:
        """Count from here on."""
        self.total, self.seen = {}, {reply["replica"]: _numbers(reply, versions) for reply in replies}

    def add(self, replies: Sequence[Mapping[str, Any]], versions: Sequence[str]) -> list[str]:
        """Add what was counted since the last look; return which replicas have begun anew."""
        restarted = []
        for reply in replies:
            name, numbers = reply["replica"], _numbers(reply, versions)
            before = self.seen.get(name, {})
            if any(numbers.get(key, 0.0) < value for key, value in before.items()):
                restarted.append(name)
                before = {}
            for key, value in numbers.items():
                self.total[key] = self.total.get(key, 0.0) + value - before.get(key, 0.0)
            self.seen[name] = numbers
        return restarted

    def evidence(self, reply: Mapping[str, Any], candidate: str, production: str) -> Evidence:
        """Return the sums as what a version is judged by; the histograms' bounds are a reply's."""
        latency, differences = reply["latency_bounds"], reply["difference_bounds"]
        get = self.total.get
        return Evidence(
            self._tally(candidate, len(latency) + 1),
            self._tally(production, len(latency) + 1),
            Comparison(
                [get(f"shadow/differences/{index}", 0.0) for index in range(len(differences) + 1)],
                *(get(f"shadow/{name}", 0.0) for name in ("total", "squares", "failed", "left_out")),
            ),
            latency,
            differences,
        )

    def _tally(self, version: str, buckets: int) -> Tally:
        get, failed = self.total.get, f"{version}/failed/"
        return Tally(
            [get(f"{version}/latency/{index}", 0.0) for index in range(buckets)],
            {key[len(failed) :]: value for key, value in self.total.items() if key.startswith(failed)},
            (get(f"{version}/ends/0", 0.0), get(f"{version}/ends/1", 0.0)),
        )


def served_by(replies: Sequence[Mapping[str, Any]]) -> Served | None:
    """Return what is served; None where the policy is not. Raises UnavailableError for what is no answer of ours."""
    try:
        newest = max(replies, key=lambda reply: int(reply["generation"]))
        canary = newest["canary"]
        for reply in replies:
            _numbers(reply, ("", ""))
        return None if not newest["is_served"] else Served(
            generation=newest["generation"],
            changed_by=str(newest["changed_by"]),
            changed_at=str(newest["changed_at"]),
            versions=tuple(newest["versions"]),
            production=newest["aliases"].get("production"),
            canary=canary and (newest["aliases"].get(canary["version"], canary["version"]), canary["share"]),
            shadow=newest["aliases"].get(newest["shadow"], newest["shadow"]),
            behind=tuple(f"replica {reply['replica']}: {why}" for reply in replies for why in reply["behind"]),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UnavailableError(f"the server's counts cannot be read ({type(error).__name__}: {error})") from None


def _numbers(reply: Mapping[str, Any], versions: Sequence[str]) -> Numbers:
    """Return a replica's numbers of these versions, (production, candidate), flat; what is 0 is left out."""
    production, candidate = versions
    found: dict[str, Any] = {version: reply["counts"].get(version, {}) for version in versions}
    for pair in reply["comparisons"]:
        if (pair["version"], pair["shadow"]) == (production, candidate):
            found["shadow"] = pair
    return {path: value for path, value in _flat(found) if value}


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping | list):
        pairs = value.items() if isinstance(value, Mapping) else enumerate(value)
        for key, part in pairs:
            yield from _flat(part, f"{path}/{key}" if path else str(key))
    elif isinstance(value, int | float):
        yield path, float(value)
