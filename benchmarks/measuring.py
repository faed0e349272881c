"""Timing, tables and files of the benchmarks."""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.table import Table

T = TypeVar("T")
WALL, CPU = 0, 1  # of a rate


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with a module's docstring, and `--out`."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, default=Path("bench"), help="folder of the results")
    return made


def rate(
    step: Callable[[], object], seconds: float, *, each: int = 1, cpu_s: Callable[[], float] = time.process_time
) -> tuple[float, float]:
    """Call `step`, which counts as `each`, for about `seconds`; return counts per second of wall clock and of CPU time.

    CPU time stays comparable on a busy machine. The first call warms up.
    """
    step()
    count, began, cpu_began = 0, time.perf_counter(), cpu_s()
    while (elapsed := time.perf_counter() - began) < seconds:
        step()
        count += each
    return count / elapsed, count / max(cpu_s() - cpu_began, 1e-6)


def alternate(ways: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Measure all ways once a round, because a machine's speed drifts; return each one's figures."""
    found: dict[str, list[T]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, measure in ways.items():
            found[name].append(measure())
    return found


def column(rounds: Iterable[Sequence[float]], which: int) -> list[float]:
    """Return one figure of each round."""
    return [figures[which] for figures in rounds]


def median_ratio(own: Iterable[float], other: Iterable[float]) -> float:
    """Return the median over the rounds of the ratio within a round."""
    return statistics.median(one / two for one, two in zip(own, other, strict=True))


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table, the first column to the left."""
    table = Table(title=title)
    for index, name in enumerate(columns):
        table.add_column(name, justify="right" if index else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(markup=False).print(table)


def write(out: Path, name: str, document: Any) -> None:
    """Write `NAME.json` into the folder of the results."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
