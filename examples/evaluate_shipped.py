"""Measure the policies in examples/checkpoints as their cards state: exported, deterministic, on fresh seeds.

    python examples/evaluate_shipped.py                          # all of them, 500 episodes each
    python examples/evaluate_shipped.py cartpole_dqn --write     # and put the figures into its card
    python examples/evaluate_shipped.py mir100_sparse_fixes --checkpoint runs/mir100_sparse_fixes/checkpoint

Each checkpoint is exported (which writes nothing unless the file acts as RLlib does) and acts through `Policy`, as on a
robot. It runs the list `evaluation` in the policy's training.yaml.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from shared.help_text import DefaultsFormatter

import rlservo
from rlservo.drive.report import EpisodeRow
from rlservo.drive.success import SuccessRate, success_rates

SHIPPED = Path(__file__).resolve().parent / "checkpoints"
EPISODES, SEED = 500, 20_000
BEGIN, END = "<!-- evaluate_shipped.py begins -->", "<!-- evaluate_shipped.py ends -->"


@dataclass(frozen=True)
class Evaluation:
    """Result of one evaluation. Success is None if neither environment nor training.yaml defines it."""

    start: str
    env_config: dict[str, Any]
    episodes: int
    seed: int  # of the first episode; the others follow
    successes: int | None
    success_interval: tuple[float, float] | None  # 95%, Wilson
    mean_return: float
    return_interval: tuple[float, float]  # 95%, of the mean, normal
    worst_return: float
    mean_steps: float
    endings: dict[str, int]  # number of episodes by ending


def shipped_names() -> list[str]:
    return sorted(path.parent.name for path in SHIPPED.glob("*/training.yaml"))


def load_settings(name: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.safe_load((SHIPPED / name / "training.yaml").read_text(encoding="utf-8"))
    return settings


def evaluate(
    policy: rlservo.Policy,
    settings: Mapping[str, Any],
    episodes: int,
    seed: int,
    notify: Callable[[str], None] = lambda line: None,
) -> list[Evaluation]:
    """Run every evaluation of the settings with a loaded policy."""
    reports, outcomes = [], []
    for setting in settings["evaluation"]:
        notify(f"{episodes} episodes: {setting['start']}")
        arguments, threshold = setting.get("env_config", {}), setting.get("success_return")
        report = rlservo.rollout(policy, settings["env"], episodes=episodes, seed=seed, env_kwargs=arguments)
        if report.interrupted:
            raise KeyboardInterrupt
        reports.append(report.episodes)
        outcomes.append(
            [row.success if threshold is None else row.episode_return >= threshold for row in report.episodes]
        )
    figures = zip(settings["evaluation"], reports, success_rates(*outcomes), strict=True)
    return [_summarise(setting, rows, success, seed) for setting, rows, success in figures]


def _summarise(
    setting: Mapping[str, Any], rows: tuple[EpisodeRow, ...], success: SuccessRate | None, seed: int
) -> Evaluation:
    returns = np.array([row.episode_return for row in rows])
    margin = 1.96 * returns.std(ddof=1) / len(rows) ** 0.5 if len(rows) > 1 else float("nan")
    return Evaluation(
        start=setting["start"],
        env_config=setting.get("env_config", {}),
        episodes=len(rows),
        seed=seed,
        successes=success and success.successes,
        success_interval=success and success.interval,
        mean_return=float(returns.mean()),
        return_interval=(float(returns.mean() - margin), float(returns.mean() + margin)),
        worst_return=float(returns.min()),
        mean_steps=float(np.mean([row.steps for row in rows])),
        endings=dict(Counter(row.final_status for row in rows if row.final_status is not None)),
    )


def render(evaluations: list[Evaluation]) -> str:
    """Return the Markdown table of a card."""
    lines = [
        "| start | episodes | success | 95% interval | mean return (95% interval) | worst | mean steps | endings |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in evaluations:
        success, interval = "-", "-"
        if one.successes is not None and one.success_interval is not None:
            success = f"{one.successes / one.episodes:.1%}"
            interval = f"{one.success_interval[0]:.1%} to {one.success_interval[1]:.1%}"
        low, high = one.return_interval
        endings = ", ".join(f"{count} {status}" for status, count in sorted(one.endings.items())) or "-"
        lines.append(
            f"| {one.start} | {one.episodes} | {success} | {interval} "
            f"| {one.mean_return:.4g} ({low:.4g} to {high:.4g}) | {one.worst_return:.4g} "
            f"| {one.mean_steps:.1f} | {endings} |"
        )
    return "\n".join(lines)


def write_card(name: str, evaluations: list[Evaluation]) -> None:
    """Put the figures into evaluation.json and, between the two marks, into the card."""
    folder = SHIPPED / name
    document = json.dumps([asdict(one) for one in evaluations], indent=2)
    (folder / "evaluation.json").write_text(document + "\n", encoding="utf-8")
    card = folder / "README.md"
    before, begin, rest = card.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise SystemExit(f"{card} has no place for the table: expected the lines {BEGIN} and {END}")
    card.write_text(f"{before}{BEGIN}\n{render(evaluations)}\n{END}{after}", encoding="utf-8")


def note(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Evaluate the policies that ship, from bundles exported now.",
        formatter_class=DefaultsFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all by default: {', '.join(shipped_names())}")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes of each evaluation")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first episode")
    parser.add_argument("--checkpoint", type=Path, help="evaluate this one in place of the one that ships (one NAME)")
    parser.add_argument("--write", action="store_true", help="put the figures into the cards")
    args = parser.parse_args()
    names = args.names or shipped_names()
    for name in names:
        if name not in shipped_names():
            parser.error(f"no policy {name!r} ships: expected some of {', '.join(shipped_names())}")
    if args.episodes < 2 or args.seed < 0:
        parser.error(f"--episodes is {args.episodes} and --seed {args.seed}: expected at least 2 and 0")
    if args.checkpoint is not None and (len(names) != 1 or args.write):
        parser.error("--checkpoint needs one NAME and no --write: cards describe what ships")
    with tempfile.TemporaryDirectory() as bundles:
        for name in names:
            try:
                bundle = rlservo.export_checkpoint(
                    args.checkpoint or SHIPPED / name, bundles, name=name, notify=lambda line: None
                )
                with rlservo.Policy.load(bundle.path) as policy:
                    evaluations = evaluate(policy, load_settings(name), args.episodes, args.seed, note)
            except rlservo.errors.RlservoError as error:
                sys.exit(f"error: {name}: {error.message}")
            print(f"{name}\n{render(evaluations)}\n", flush=True)
            if args.write:
                write_card(name, evaluations)


if __name__ == "__main__":
    main()
