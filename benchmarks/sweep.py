"""Train a shipped policy with other settings, and compare the results.

    python benchmarks/sweep.py mir100_obstacle_avoidance               # all its variants, hours on two cores
    python benchmarks/sweep.py ur5_positioning --set stop.env_steps=310000 --seeds 2
    python benchmarks/sweep.py mir100_obstacle_avoidance --variants "as it ships" "three frames"

`benchmarks/variants/NAME.yaml` has the variants: what each changes of `examples/checkpoints/NAME/training.yaml`. Each
is trained by `train_shipped.py`, one process per core, and the result is exported and judged as in the cards, without
exploration, on its own seeds (`--first-seed`). The table goes to `bench/sweep-NAME.md`, a line per training as soon as
it has ended; checkpoints, curves and logs to `bench/sweep-NAME/`.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import shared.training_run as training_run  # before Ray  # isort: skip
import evaluate_shipped
import train_shipped
import yaml
from measuring import parser

import rlservo
from rlservo.drive.success import wilson_interval

VARIANTS = Path(__file__).resolve().parent / "variants"
FIRST_SEED = 60_000
TOLD_EVERY_S = 10.0
HEAD = "| variant | seed | steps | CPU s | {starts} | over all | 95% interval |"


@dataclass(frozen=True)
class Trial:
    variant: str
    seed: int
    settings: dict[str, Any]
    folder: Path

    def train(self, name: str) -> str:
        """Train; return the last line of the curve. Raises CalledProcessError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / "settings.yaml"
        path.write_text(yaml.safe_dump(self.settings, sort_keys=False), encoding="utf-8")
        words = (name, "--settings", str(path), "--seed", str(self.seed), "--storage", str(self.folder))
        with (self.folder / "log").open("w", encoding="utf-8") as log:
            subprocess.run(
                [sys.executable, train_shipped.__file__, *words],
                stdout=log, stderr=subprocess.STDOUT, check=True,
            )  # fmt: skip
        return (self.folder / name / "curve.csv").read_text(encoding="utf-8").splitlines()[-1]

    def how_far(self) -> str:
        """Return the last line of its training's output."""
        log = self.folder / "log"
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []
        last = next((line.partition("  return")[0] for line in reversed(lines) if line.startswith("steps ")), "begins")
        return f"{self.variant}, seed {self.seed}: {' '.join(last.split())}"

    def judge(self, name: str, episodes: int, first_seed: int) -> list[evaluate_shipped.Evaluation]:
        """Export the result of a training, and let it act."""
        with tempfile.TemporaryDirectory() as folder:
            checkpoint = self.folder / name / "checkpoint"
            bundle = rlservo.export_checkpoint(checkpoint, folder, name="trial", notify=lambda _: None)
            with rlservo.Policy.load(bundle.path) as policy:
                return evaluate_shipped.evaluate(policy, self.settings, episodes, first_seed)


def variants_of(name: str, wanted: list[str]) -> dict[str, dict[str, Any]]:
    """Return a policy's settings by the variants' names, changed as their file says; "" unchanged for none.

    Raises ValueError for a name that does not exist.
    """
    path = VARIANTS / f"{name}.yaml"
    every: dict[str, dict[str, Any]] = yaml.safe_load(path.read_text(encoding="utf-8")) if path.exists() else {}
    unknown = [variant for variant in wanted if variant not in (*every, "all")]
    if unknown:
        raise ValueError(f"--variants {unknown[0]}: expected all, or some of {', '.join(map(repr, every))}")
    chosen = {variant: changes for variant, changes in every.items() if variant in wanted or "all" in wanted}
    found = {}
    for variant, changes in (chosen or {"": {}}).items():
        settings = found[variant] = evaluate_shipped.load_settings(name)
        for part, new in changes.items():
            is_merged = isinstance(new, dict) and isinstance(settings.get(part), dict)
            settings[part] = settings[part] | new if is_merged else new
    return found


def line_of(trial: Trial, curve: str, evaluations: list[evaluate_shipped.Evaluation]) -> str:
    steps, *_, cpu_s = curve.split(",")
    successes, episodes = (sum(getattr(one, what) or 0 for one in evaluations) for what in ("successes", "episodes"))
    low, high = wilson_interval(successes, episodes)
    each = " | ".join(f"{(one.successes or 0) / one.episodes:.1%}" for one in evaluations)
    return (
        f"| {trial.variant} | {trial.seed} | {int(steps):,} | {cpu_s} | {each} | {successes / episodes:.1%} "
        f"| {low:.1%} to {high:.1%} |"
    )


def main() -> None:
    options = parser(__doc__)
    names = sorted(path.stem for path in VARIANTS.glob("*.yaml"))
    options.add_argument("name", choices=names)
    options.add_argument("--variants", nargs="+", default=["all"], metavar="NAME", help="of its file; all by default")
    options.add_argument("--seeds", type=int, nargs="+", default=[0])
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as train_shipped.py's")
    options.add_argument("--episodes", type=int, default=400, help="of each evaluation")
    options.add_argument("--first-seed", type=int, default=FIRST_SEED, help="of the episodes that are judged")
    options.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="trainings at a time")
    args = options.parse_args()
    if min(args.episodes - 1, args.jobs) < 1 or args.first_seed < 0:
        options.error("expected at least 2 --episodes, 1 --jobs and a --first-seed of 0 or more")
    try:
        variants = variants_of(args.name, args.variants)
        for settings in variants.values():
            train_shipped.change_settings(settings, args.set)
    except ValueError as error:
        options.error(str(error))
    folder = args.out / f"sweep-{args.name}"
    trials = [
        Trial(variant, seed, settings, folder / f"{variant.replace(' ', '-').replace('/', '-')}-{seed}")
        for seed, (variant, settings) in itertools.product(args.seeds, variants.items())
    ]
    starts = " | ".join(one["start"] for one in trials[0].settings["evaluation"])
    head = HEAD.format(starts=starts)
    lines = [head, "|---" * (head.count("|") - 1) + "|"]
    print(f"{len(trials)} trainings, {args.jobs} at a time; logs in {folder}", flush=True)
    failed = []
    with ThreadPoolExecutor(args.jobs) as pool:
        waiting: dict[Future[str], Trial] = {pool.submit(trial.train, args.name): trial for trial in trials}
        while waiting:
            ended = next(iter(wait(waiting, timeout=TOLD_EVERY_S, return_when=FIRST_COMPLETED).done), None)
            if ended is None:
                print("; ".join(trial.how_far() for future, trial in waiting.items() if future.running()), flush=True)
                continue
            trial = waiting.pop(ended)
            try:
                curve = ended.result()
            except subprocess.CalledProcessError:
                failed.append(f"{trial.variant}, seed {trial.seed}")
                print(f"{failed[-1]}: failed, see {trial.folder / 'log'}", flush=True)
                continue
            lines.append(line_of(trial, curve, trial.judge(args.name, args.episodes, args.first_seed)))
            print(lines[-1], flush=True)
            (args.out / f"sweep-{args.name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if failed:
        sys.exit(f"error: {len(failed)} of {len(trials)} trainings failed: {'; '.join(failed)}")


if __name__ == "__main__":
    training_run.main_with_sentences(main, __file__)
