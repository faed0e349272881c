"""Summaries of the samples: medians, ratios within rounds, targets, as tables, JSON and a chart."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from speed.catalogue import BARE, BATCH, BENTOML, DEFAULTS, LITSERVE, MLSERVER, RLLIB, RLSERVO, TWO
from speed.machine import OTHER, PROXY, REPLICA
from speed.rounds import GRPC, HEAVY, IN_PROCESS, JSON1, JSON16, LARGE, LINE, ONE, STREAM, Sample, Samples

PEERS = (MLSERVER, LITSERVE, BENTOML, DEFAULTS, RLLIB)
Value = Callable[[Sample], float]


def p50(sample: Sample) -> float:
    return sample.load.p50_ms


def p99(sample: Sample) -> float:
    return sample.load.p99_ms


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
        Verdict("WebSocket p50, over a bare uvicorn WebSocket's", ratio((STREAM, RLSERVO), (STREAM, BARE), p50), 2.0),
        Verdict(
            f"observations/s in batches of {BATCH} over the binary protocol, over onnxruntime in process",
            ratio((LARGE, RLSERVO), in_process, rate),
            None,
            0.7,
        ),
        Verdict("memory of a replica, over the RLlib example's", memory, 0.6),
        Verdict("cold start to the first answer, over the RLlib example's", start, 0.8),
        Verdict(
            "requests/s of two replicas, over one's, single observations",
            ratio((JSON16, TWO), ours16, rate),
            None,
            1.5,
            limits(result, JSON16),
        ),
        Verdict(
            "requests/s of two replicas, over one's, batches of 64",
            ratio((HEAVY, TWO), (HEAVY, RLSERVO), rate),
            None,
            1.5,
            limits(result, HEAVY),
        ),
    ]


def limits(result: Result, measure: str) -> str:
    """Say what each part used while one and two replicas were loaded [cores]."""
    parts = []
    for name, said in ((RLSERVO, "one"), (TWO, "two")):
        shares = {role: result.median(measure, name, _cores_of(role)) for role in ("generator", PROXY, REPLICA, OTHER)}
        parts.append(f"{said}: " + ", ".join(f"{role} {used or 0:.2f}" for role, used in shares.items()))
    return f"cores busy with {'; with '.join(parts)}"


def _cores_of(role: str) -> Value:
    return lambda sample: sample.cores[role]


def _quotient(values: dict[str, float], over: str, under: str) -> float | None:
    return values[over] / values[under] if values.get(over) and values.get(under) else None


# Tables


HEADINGS = ["server", "p50 ms", "p99 ms", "x bare", "req/s c=1", "CPU us", "req/s c=16", "CPU us", "MB"]


def table(result: Result) -> list[list[str]]:
    """One row per server: sequential JSON, then 16 connections; CPU is the whole server's per request."""
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
            result.server_mb.get(name),
        ]
        formats = ("{:.3f}", "{:.2f}", "{:.2f}", "{:,.0f}", "{:,.0f}", "{:,.0f}", "{:,.0f}", "{:,.0f}")
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


def markdown(result: Result, facts: dict[str, Any]) -> str:
    """Return the tables and the verdicts."""
    lines = [
        f"{facts['cores']} cores, {facts['rounds']} rounds of {facts['seconds']} s, taking turns; "
        f"load average {facts['load_average'][0]:.1f} before. Compare ratios, not times.",
        "",
        *_markdown(HEADINGS, table(result)),
        "",
        *_markdown(PROTOCOL_HEADINGS, protocols(result)),
        "",
        *(f"- {verdict}" for verdict in verdicts(result)),
        *(f"- not measured: {name}: {why}" for name, why in result.missing.items()),
    ]
    return "\n".join(lines) + "\n"


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
        "cold_start_s": result.cold_start_s,
        "replica_mb": result.replica_mb,
        "server_mb": result.server_mb,
        "missing": result.missing,
        "verdicts": [{**asdict(verdict), "holds": verdict.holds} for verdict in verdicts(result)],
    }


def chart(result: Result, file: Path) -> None:
    """Draw sequential latency and throughput over 16 connections, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = [row[0] for row in table(result) if result.median(JSON1, row[0], p50) is not None][::-1]
    colours = ["#1f6feb" if name == RLSERVO else "#9aa4b2" for name in names]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 0.42 * len(names) + 1.1), sharey=True)
    latency = [result.median(JSON1, name, p50) or 0.0 for name in names]
    throughput = [result.median(JSON16, name, rate) or 0.0 for name in names]
    for axes, values, title, label in (
        (left, latency, "one connection: p50 [ms], log scale (less is better)", "{:.2f}"),
        (right, throughput, "16 connections: requests/s (more is better)", "{:,.0f}"),
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
