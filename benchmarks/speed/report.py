"""Summaries of the samples: medians, ratios within rounds, targets, as tables, JSON and a chart."""

from __future__ import annotations

import statistics
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from speed.catalogue import (
    BARE,
    BARE_ASGI,
    BATCH,
    BENTOML,
    DEFAULTS,
    DIRECT,
    DIRECTLY,
    FASTIFY,
    GRANIAN,
    LITSERVE,
    MLSERVER,
    MOSEC,
    RLLIB,
    RLSERVO,
    TWO,
)
from speed.machine import OTHER, PROXY, REPLICA
from speed.rounds import (
    FLEETS,
    GRPC,
    HEAVY,
    IN_PROCESS,
    JSON1,
    JSON16,
    JSON64,
    LARGE,
    LINE,
    ONE,
    ONES,
    PACED_TURNS,
    PLANNED_HZ,
    STREAM,
    Sample,
    Samples,
    is_paced,
    paced_measure,
)

PEERS = (MLSERVER, LITSERVE, BENTOML, DEFAULTS, RLLIB)
LEAST = (FASTIFY, MOSEC, GRANIAN)
"""What a performance engineer would pick, which checks nothing; bare ASGI on uvicorn has targets of its own."""
Value = Callable[[Sample], float]


def p50(sample: Sample) -> float:
    return sample.load.p50_ms


def p99(sample: Sample) -> float:
    return sample.load.p99_ms


def p999(sample: Sample) -> float:
    return sample.load.p999_ms or 0.0


def late(sample: Sample) -> float:
    return 100 * (sample.load.late or 0.0)


def rate(sample: Sample) -> float:
    return sample.load.per_s


def cpu(sample: Sample) -> float:
    return sample.cpu_us


@dataclass(frozen=True)
class Verdict:
    """A target of the project's, and what was measured."""

    what: str
    measured: float | None
    at_most: float | None = None
    at_least: float | None = None
    note: str = ""

    @property
    def holds(self) -> bool | None:
        """None where it was not measured."""
        if self.measured is None:
            return None
        return (self.at_most is None or self.measured <= self.at_most) and (
            self.at_least is None or self.measured >= self.at_least
        )

    def __str__(self) -> str:
        bound = f"at most {self.at_most:g}" if self.at_most is not None else f"at least {self.at_least:g}"
        state = {True: "holds", False: "MISSED", None: "not measured"}[self.holds]
        shown = "" if self.measured is None else f": {self.measured:.2f}"
        return f"{state}: {self.what}{shown} (wanted: {bound}){'; ' + self.note if self.note else ''}"


@dataclass
class Result:
    """Everything that was measured."""

    samples: Samples
    cold_start_s: dict[str, float]
    replica_mb: dict[str, float]
    server_mb: dict[str, float]
    missing: dict[str, str]
    robots: dict[tuple[str, float], tuple[int, float]] = field(default_factory=dict)
    """By (server, times a second that each asks): robots that are served in time, and the cores it takes."""

    def median(self, measure: str, name: str, value: Value) -> float | None:
        """Return the median over the rounds, or None where it was not measured."""
        taken = self.samples.get((measure, name))
        return statistics.median(map(value, taken)) if taken else None

    def ratio(self, over: tuple[str, str], under: tuple[str, str], value: Value) -> float | None:
        """Return the median of the rounds' own ratios, so that a slow round does not count."""
        pairs = zip(self.samples.get(over, []), self.samples.get(under, []), strict=False)
        ratios = [value(a) / value(b) for a, b in pairs]
        return statistics.median(ratios) if ratios else None


def verdicts(result: Result) -> list[Verdict]:
    """Compare with the targets."""
    ratio, median = result.ratio, result.median
    ours1, ours16 = (JSON1, RLSERVO), (JSON16, RLSERVO)
    quickest = min(PEERS, key=lambda name: median(JSON1, name, p50) or float("inf"))
    best = max(PEERS, key=lambda name: median(JSON16, name, rate) or 0)
    in_process = (LARGE, IN_PROCESS)
    memory = _quotient(result.replica_mb, RLSERVO, RLLIB)
    start = _quotient(result.cold_start_s, RLSERVO, RLLIB)
    return [
        Verdict("sequential JSON p50, over the bare server's", ratio(ours1, (JSON1, BARE), p50), at_most=1.6),
        Verdict(
            f"sequential JSON p50, over the quickest peer's ({quickest})", ratio(ours1, (JSON1, quickest), p50), 1.0
        ),
        Verdict(
            "sequential JSON p50 of Ray Serve's defaults, over ours", ratio((JSON1, DEFAULTS), ours1, p50), None, 15
        ),
        Verdict("sequential JSON p50 of RLlib's example, over ours", ratio((JSON1, RLLIB), ours1, p50), None, 15),
        Verdict(
            f"requests/s over 16 connections, over the best peer's ({best})",
            ratio(ours16, (JSON16, best), rate),
            None,
            1.5,
        ),
        Verdict("WebSocket p50, over our JSON's", ratio((STREAM, RLSERVO), (LINE, RLSERVO), p50), 0.8),
        Verdict("WebSocket p50, over uvicorn + FastAPI's", ratio((STREAM, RLSERVO), (STREAM, BARE), p50), 2.0),
        Verdict(
            f"observations/s in batches of {BATCH} over the binary protocol, over onnxruntime in process",
            ratio((LARGE, RLSERVO), in_process, rate),
            None,
            0.7,
        ),
        Verdict("memory of a replica, over the RLlib example's", memory, 0.6),
        Verdict("cold start to the first answer, over the RLlib example's", start, 0.8),
        *[
            Verdict(
                f"requests/s of two replicas, over one's, {what}{way}",
                ratio((measure, TWO + way), (measure, RLSERVO + way), rate),
                None,
                least,
                limits(result, measure, way),
            )
            for measure, what, least in ((ONES, "single observations", 1.5), (HEAVY, "batches of 64", 1.6))
            for way in ("", DIRECTLY)
        ],
        *_beside_the_least(result),
    ]


def _beside_the_least(result: Result) -> list[Verdict]:
    """Compare with servers that do no more than answer."""
    ratio = result.ratio
    quickest = min(LEAST, key=lambda name: result.median(JSON1, name, p50) or float("inf"))
    best = max(LEAST, key=lambda name: result.median(JSON16, name, rate) or 0)
    found = [
        Verdict("direct port: JSON p50, over bare ASGI's", ratio((JSON1, DIRECT), (JSON1, BARE_ASGI), p50), 1.15),
        Verdict(
            f"direct port: JSON p50, over the quickest other's ({quickest})",
            ratio((JSON1, DIRECT), (JSON1, quickest), p50),
            1.0,
        ),
        Verdict(
            "direct port: requests/s over 16 connections, over bare ASGI's",
            ratio((JSON16, DIRECT), (JSON16, BARE_ASGI), rate),
            None,
            0.9,
        ),
        Verdict(
            f"direct port: requests/s over 16 connections, over the best other's ({best})",
            ratio((JSON16, DIRECT), (JSON16, best), rate),
            None,
            1.0,
        ),
        Verdict(
            "direct port: WebSocket p50, over a bare uvicorn WebSocket's",
            ratio((STREAM, DIRECT), (STREAM, BARE_ASGI), p50),
            1.2,
        ),
        Verdict("JSON p50, over bare ASGI's", ratio((JSON1, RLSERVO), (JSON1, BARE_ASGI), p50), 1.5),
        Verdict(
            f"requests/s over 16 connections, over the best other's ({best})",
            ratio((JSON16, RLSERVO), (JSON16, best), rate),
            None,
            1.0,
        ),
        Verdict("p99 over 64 connections [ms]", result.median(JSON64, RLSERVO, p99), 50.0),
    ]
    for robots, rate_hz in FLEETS:
        measure = paced_measure("json", robots, rate_hz)
        found.append(
            Verdict(
                f"direct port: p99.9 of {robots} robots at {rate_hz:g} Hz, over bare ASGI's",
                ratio((measure, DIRECT), (measure, BARE_ASGI), p999),
                1.3,
            )
        )
    return found


def limits(result: Result, measure: str, way: str) -> str:
    """Say what each part used while one and two replicas were loaded [cores]."""
    parts = []
    for name, said in ((RLSERVO + way, "one"), (TWO + way, "two")):
        shares = {role: result.median(measure, name, _cores_of(role)) for role in ("generator", PROXY, REPLICA, OTHER)}
        parts.append(f"{said}: " + ", ".join(f"{role} {used or 0:.2f}" for role, used in shares.items()))
    return f"cores busy with {'; with '.join(parts)}"


def _cores_of(role: str) -> Value:
    return lambda sample: sample.cores[role]


def _quotient(values: dict[str, float], over: str, under: str) -> float | None:
    return values[over] / values[under] if values.get(over) and values.get(under) else None


# Tables


HEADINGS = ["server", "p50 ms", "p99 ms", "x bare", "req/s c=1", "CPU us", "req/s c=16", "CPU us"]
HEADINGS += ["req/s c=64", "p99 ms", "MB"]


def table(result: Result) -> list[list[str]]:
    """One row per server: sequential JSON, then 16 and 64 connections; CPU is the whole server's per request."""
    rows = []
    names = dict.fromkeys(name for measure, name in result.samples if measure == JSON16)
    for name in sorted(names, key=lambda one: result.median(JSON1, one, p50) or float("inf")):
        columns = [
            result.median(JSON1, name, p50),
            result.median(JSON1, name, p99),
            result.ratio((JSON1, name), (JSON1, BARE), p50),
            result.median(JSON1, name, rate),
            result.median(JSON1, name, cpu),
            result.median(JSON16, name, rate),
            result.median(JSON16, name, cpu),
            result.median(JSON64, name, rate),
            result.median(JSON64, name, p99),
            result.server_mb.get(name),
        ]
        formats: tuple[str, ...] = ("{:.3f}", "{:.2f}", "{:.2f}", "{:,.0f}", "{:,.0f}", "{:,.0f}", "{:,.0f}")
        formats += ("{:,.0f}", "{:.1f}", "{:,.0f}")
        rows.append([name, *("" if c is None else f.format(c) for f, c in zip(formats, columns, strict=True))])
    return rows


PROTOCOL_HEADINGS = ["protocol (Python line client)", "server", "p50 ms", "p99 ms", "per s", "CPU us"]


def protocols(result: Result) -> list[list[str]]:
    """One row per protocol and server, measured through the same kind of client."""
    rows = []
    for measure, name in result.samples:
        if measure in (ONE, LINE, STREAM, GRPC, LARGE):
            values = [result.median(measure, name, value) for value in (p50, p99, rate, cpu)]
            formats = ("{:.4f}", "{:.3f}", "{:,.0f}", "{:,.0f}")
            shown = ["" if v is None else f.format(v) for f, v in zip(formats, values, strict=True)]
            rows.append([measure, name, *shown[:3], "" if name == IN_PROCESS else shown[3]])
    return rows


PACED_HEADINGS = ["load", "server", "p50 ms", "p99 ms", "p99.9 ms", "late %", "p99.9 x bare"]


def paced_loads(result: Result) -> list[list[str]]:
    """One row per paced load and server, from when each robot should have asked: late is half a period."""
    rows = []
    for measure, name in result.samples:
        if is_paced(measure):
            values = [result.median(measure, name, value) for value in (p50, p99, p999, late)]
            values.append(result.ratio((measure, name), (measure, BARE_ASGI), p999))
            shown = ["" if value is None else f"{value:.2f}" for value in values]
            rows.append([measure.removeprefix("paced "), name, *shown])
    return rows


ROBOTS_HEADINGS = ["robots (cores)", *(f"{rate_hz:g} Hz" for rate_hz in PLANNED_HZ)]


def robots(result: Result) -> list[list[str]]:
    """One row per server: robots with p99.9 under a quarter of the period, and the cores that its processes took."""
    rows = []
    for name in dict.fromkeys(name for name, _ in result.robots):
        found = [result.robots.get((name, rate_hz)) for rate_hz in PLANNED_HZ]
        rows.append([name, *("" if one is None else f"{one[0]:,} ({one[1]:.2f})" for one in found)])
    return rows


def markdown(result: Result, facts: dict[str, Any]) -> str:
    """Return the tables and the verdicts."""
    lines = [
        f"{facts['cores']} cores, {facts['rounds']} rounds of {facts['seconds']} s "
        f"(robots at their pace {PACED_TURNS * facts['seconds']} s), taking turns; "
        f"load average {facts['load_average'][0]:.1f} before. Compare ratios, not times.",
        "",
        *_markdown(HEADINGS, table(result)),
        "",
        *_markdown(PROTOCOL_HEADINGS, protocols(result)),
        "",
        *_markdown(PACED_HEADINGS, paced_loads(result)),
        "",
        *_markdown(ROBOTS_HEADINGS, robots(result)),
        "",
        *_bullets(verdicts(result)),
        *_bullets(f"not measured: {name}: {why}" for name, why in result.missing.items()),
    ]
    return "\n".join(lines) + "\n"


def _bullets(sentences: Iterable[object]) -> list[str]:
    return [textwrap.fill(str(each), 120, initial_indent="- ", subsequent_indent="  ") for each in sentences]


def _markdown(headings: list[str], rows: list[list[str]]) -> list[str]:
    rules = ["---", *(["---:"] * (len(headings) - 1))]
    return ["| " + " | ".join(line) + " |" for line in (headings, rules, *rows)]


def document(result: Result, facts: dict[str, Any]) -> dict[str, Any]:
    """Return everything for machines, each round's figures included."""
    return {
        **facts,
        "samples": {
            f"{measure} / {name}": [
                {**asdict(sample.load), "cpu_us": sample.cpu_us, "cores": sample.cores} for sample in taken
            ]
            for (measure, name), taken in result.samples.items()
        },
        "robots": [[name, rate_hz, *found] for (name, rate_hz), found in result.robots.items()],
        "cold_start_s": result.cold_start_s,
        "replica_mb": result.replica_mb,
        "server_mb": result.server_mb,
        "missing": result.missing,
        "verdicts": [{**asdict(verdict), "holds": verdict.holds} for verdict in verdicts(result)],
    }


def chart(result: Result, file: Path) -> None:
    """Draw sequential latency and throughput over 16 and 64 connections, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = [row[0] for row in table(result) if result.median(JSON1, row[0], p50) is not None][::-1]
    colours = ["#1f6feb" if name in (RLSERVO, DIRECT) else "#9aa4b2" for name in names]
    figure, (left, *others) = pyplot.subplots(1, 3, figsize=(11, 0.42 * len(names) + 1.1), sharey=True)
    latency = [result.median(JSON1, name, p50) or 0.0 for name in names]
    throughput = [[result.median(measure, name, rate) or 0.0 for name in names] for measure in (JSON16, JSON64)]
    for axes, values, title, label in (
        (left, latency, "one connection: p50 [ms], log scale", "{:.2f}"),
        (others[0], throughput[0], "16 connections: requests/s", "{:,.0f}"),
        (others[1], throughput[1], "64 connections: requests/s", "{:,.0f}"),
    ):
        bars = axes.barh(names, values, color=colours)
        axes.bar_label(bars, [label.format(value) for value in values], padding=3, fontsize=8)
        axes.set_title(title, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.margins(x=0.15)
    left.set_xscale("log")
    left.set_xlim(min(latency) / 2, max(latency) * 4)
    figure.tight_layout()
    figure.savefig(file, metadata={"Date": None} if file.suffix == ".svg" else None)
    pyplot.close(figure)
