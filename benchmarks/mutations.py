"""Count the mutants of exports that the parity gate refuses.

    python benchmarks/mutations.py [NAME ...] [--numbers 40] [--out bench/mutations]
    python benchmarks/mutations.py --table > tables.md

For a policy of each source every number of its ONNX graph, every attribute and step, every recorded statistic, bound,
flag and line of its recipe, and the order of its elements is changed in turn, and the real export decides. An accepted
mutant is judged on observations of our own drawing: a miss changes an action by more than 1% of its range. Written to
OUT/NAME.json; `--table` prints the tables of all files there, which benchmarks/results/mutations.md has.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from measuring import parser, write
from mutating.campaign import mutate
from mutating.policies import policies

OUTCOMES = ("caught", "stopped", "equivalent", "missed")


def main() -> None:
    options = parser(__doc__)
    options.set_defaults(out=Path("bench") / "mutations")
    options.add_argument("names", nargs="*", help="policies; all by default")
    options.add_argument("--numbers", type=int, default=40, help="numbers of a tensor, evenly spread, that are changed")
    options.add_argument("--table", action="store_true", help="print the tables of OUT's files, and mutate nothing")
    options.add_argument("--list", action="store_true", help="list the policies")
    args = options.parse_args()
    torch.set_num_threads(1)
    if args.table:
        documents = [json.loads(file.read_text()) for file in sorted(args.out.glob("*.json"))]
        print(_tables(documents))
        return
    with tempfile.TemporaryDirectory() as folder:
        every = policies(Path(folder))
        if args.list:
            print("\n".join(every))
            return
        for name in args.names or every:
            outcomes, figures = mutate(every[name](), args.numbers, partial(print, flush=True))
            document = {
                "name": name,
                "numbers": args.numbers,
                **figures,
                "outcomes": [asdict(each) for each in outcomes],
            }
            write(args.out, name.replace(" ", "_"), document)
            counts = Counter(each.outcome for each in outcomes)
            print(f"{name}: {len(outcomes)} mutants, {dict(counts)}, {figures['seconds']:.0f} s", flush=True)


def _tables(documents: list[dict[str, Any]]) -> str:
    """Return the counts by policy and by kind of mutation, and every miss, as Markdown."""
    by_policy = [(each["name"], each["outcomes"]) for each in documents]
    every = [outcome for _, outcomes in by_policy for outcome in outcomes]
    kinds = sorted({each["kind"] for each in every})
    by_kind = [(kind, [each for each in every if each["kind"] == kind]) for kind in kinds]
    missed = [
        f"- {name}: {each['kind']}, {each['what']}: changes an action by {100 * each['change']:.3g}% of its range"
        for name, outcomes in by_policy
        for each in outcomes
        if each["outcome"] == "missed"
    ]
    parts = [_table("policy", [*by_policy, ("all", every)]), _table("kind of mutation", by_kind)]
    return "\n\n".join([*parts, "\n".join(missed) or "None was missed."])


def _table(what: str, rows: list[tuple[str, list[dict[str, Any]]]]) -> str:
    lines = [f"| {what} | mutants | {' | '.join(OUTCOMES)} | share caught |", f"|---|{'---|' * (len(OUTCOMES) + 2)}"]
    for name, outcomes in rows:
        counts = Counter(each["outcome"] for each in outcomes)
        found = counts["caught"] + counts["stopped"]
        share = f"{100 * found / (found + counts['missed']):.2f}%" if found + counts["missed"] else ""
        numbers = " | ".join(f"{counts[outcome]:,}" for outcome in OUTCOMES)
        lines.append(f"| {name} | {len(outcomes):,} | {numbers} | {share} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
