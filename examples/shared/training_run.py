"""Run RLlib under Tune from a script: a private Ray, a progress table, Ctrl-C, resuming, the best checkpoint, a bundle.

Shared by `simple_trainer.py`, `training_inference_ur.py`, `training_inference_mir.py`, `tour.py` and
`policy_from_cp_*.py`.

A run is a Tune experiment folder `<storage>/<algorithm>-<environment>-<time>`: one folder per trial with its
checkpoints, `result.json`, `progress.csv` and TensorBoard's event file, and `run.json`, the part of the command line
that resuming needs.
"""

from __future__ import annotations

import contextlib
import csv
import json
import logging
import math
import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn, cast

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import ray
from ray import cloudpickle, tune
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.tune.registry import get_trainable_cls
from rich.console import Console
from rich.table import Table

import shared.failures as failures
import shared.resources as resources
from rlservo import errors
from rlservo.deploy.terminal import SAID_AFTER_S, status
from rlservo.drive.success import success_of
from shared.failures import metric

assert ray_settings
RETURN = "env_runners/episode_return_mean"
STEPS = failures.SAMPLED
RUN_FILE = "run.json"
INTERRUPTED = 130  # the shell's exit code for Ctrl-C

_out = Console(soft_wrap=True, highlight=False)


MILESTONE, MILESTONE_EPISODES = 0.95, 20  # the success rate whose time is printed, in an iteration with enough episodes
SUCCESS_WINDOW = 100  # episodes of the success rate


class InterruptError(Exception):
    """The user stopped the training; `folder` can be resumed."""

    def __init__(self, folder: Path) -> None:
        super().__init__(str(folder))
        self.folder = folder


@dataclass(frozen=True)
class Run:
    """A training run: how to resume it, and the metric of its best checkpoint."""

    algorithm: str
    env_id: str
    env_config: dict[str, Any]
    num_cpus: int  # cores Ray is started with; 0 is all of the machine's
    num_gpus: float = 0.0
    metric: str = RETURN
    mode: str = "max"
    rest: dict[str, Any] = field(default_factory=dict)  # the script's own settings for after the training
    request: list[dict[str, float]] = field(default_factory=list)  # the largest trial's bundles; empty: the config's


@dataclass(frozen=True)
class Trial:
    name: str
    settings: dict[str, Any]  # the swept ones
    iterations: int
    env_steps: int
    trained_steps: float  # steps that the learner has seen, repetitions counted
    score: float  # the last one reported
    best_score: float
    best_checkpoint: Path | None
    seconds: float
    folder: Path


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run: its trials, the best one first."""

    folder: Path
    trials: tuple[Trial, ...]

    @property
    def best(self) -> Trial:
        return self.trials[0]


def main_with_sentences(main: Callable[[], None], script: str) -> NoReturn:
    """Run a script's `main`: one sentence and no traceback on an error, 130 on Ctrl-C, 2 for a wrong argument."""
    try:
        main()
    except InterruptError as stopped:
        print(f"stopped; continue with: python {script} --resume {stopped.folder}", flush=True)
        sys.exit(INTERRUPTED)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except errors.RlservoError as error:
        print(f"error: {error.message}", file=sys.stderr)
        sys.exit(2 if isinstance(error, errors.UsageError) else 1)
    sys.exit(0)


def default_config(algorithm: str, log_level: str = "ERROR") -> AlgorithmConfig:
    """Return RLlib's default configuration of an algorithm, without RLlib's own messages.

    Registering the algorithms makes an environment that breaks its own space (DreamerV3's, ray 2.60), and each
    configuration announces that the default API stack is the default.
    """
    logging.getLogger("ray.rllib").setLevel("WARNING" if log_level == "WARN" else log_level)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        config: AlgorithmConfig = get_trainable_cls(algorithm).get_default_config()
    # RLlib's own 60 s before a failed env runner is restarted are as long as its wait for a sample.
    return config.fault_tolerance(delay_between_env_runner_restarts_s=1.0)


@contextlib.contextmanager
def ray_session(
    *,
    num_cpus: int = 0,
    num_gpus: float = 0.0,
    address: str | None = None,
    log_level: str = "ERROR",
    app_dir: Path | None = None,
) -> Iterator[None]:
    """Start a Ray of our own, or join the one at `address`; whatever is started here is gone afterwards.

    A private one has its own token and folder, so that neither RAY_ADDRESS nor another cluster on the machine is
    reached, and nothing is left in the home folder. SIGTERM, which Slurm sends, does what Ctrl-C does. `app_dir` is
    where every process finds the user's own modules.

    Raises UsageError when the cluster cannot be reached.
    """
    is_verbose = log_level in ("DEBUG", "INFO")
    level = logging.INFO if is_verbose else logging.ERROR
    quiet: dict[str, Any] = {"log_to_driver": is_verbose, "logging_level": level}
    # The cause of a failed trial is reported at the end.
    logging.getLogger("ray.tune").setLevel(logging.INFO if is_verbose else logging.CRITICAL)
    logging.getLogger("tensorboardX").setLevel(logging.ERROR)  # it warns of a return that is -inf (`fill_return`)
    folder: str | None = None
    own = str((app_dir or Path()).resolve())
    if app_dir is not None and own not in sys.path:
        sys.path.insert(0, own)
    path = os.pathsep.join(part for part in (own, os.environ.get("PYTHONPATH", "")) if part)
    quiet["runtime_env"] = {"env_vars": {"PYTHONPATH": path}}
    with sigterm_as_ctrl_c() as take_sigterm:
        try:
            if address is None:
                # A short path: Ray's sockets live below it, and a socket's path may have 107 characters.
                folder = tempfile.mkdtemp(prefix="train-", dir="/tmp" if Path("/tmp").is_dir() else None)
                os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(16))
                with status("starting Ray"):
                    _start(folder, num_cpus, num_gpus, quiet)
            else:
                with status(f"joining the cluster at {address}"):
                    _join(address, quiet)
            take_sigterm()  # Ray has set a handler of its own
            with resources.waiting_is_said():
                yield
        finally:
            with _ignore_signals(), status("stopping Ray"):
                ray.shutdown()
                if folder is not None:
                    shutil.rmtree(folder, ignore_errors=True)


def _start(folder: str, num_cpus: int, num_gpus: float, quiet: Mapping[str, Any], attempts: int = 3) -> None:
    """Start a private Ray; on a busy machine it may miss Ray's own 30 s (ray 2.60), so it is tried again."""
    for attempt in range(attempts):
        try:
            ray.init(
                "local",
                num_cpus=num_cpus or None,
                num_gpus=math.ceil(num_gpus) or None,
                include_dashboard=False,
                _temp_dir=folder,
                **quiet,
            )
            return
        except Exception as error:  # Ray raises plain Exception, RuntimeError, and its own
            ray.shutdown()
            if attempt == attempts - 1:
                raise errors.RlservoError(f"Ray did not start: {_first_line(error)}") from error
            print(f"Ray did not start ({_first_line(error)}); trying again", file=sys.stderr, flush=True)


def _join(address: str, quiet: Mapping[str, Any]) -> None:
    host, colon, port = address.rpartition(":")
    try:
        if colon and "/" not in address:  # Ray itself tries for minutes
            socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
        ray.init(address, **quiet)
    except Exception as error:  # Ray's own tree, RuntimeError, ConnectionError, ValueError: all mean the same
        raise errors.UsageError(
            f"--address {address}: no Ray cluster answers there ({_first_line(error)}); start one with "
            "'ray start --head', with the same RAY_AUTH_MODE and token as here"
        ) from error


def cores() -> int:
    return int(ray.cluster_resources().get("CPU", 0))


def local_gpus() -> float:
    import torch

    return float(torch.cuda.device_count()) if torch.cuda.is_available() else 0.0


@contextlib.contextmanager
def sigterm_as_ctrl_c() -> Iterator[Callable[[], None]]:
    """Let SIGTERM do what Ctrl-C does; returns the function that installs it again."""

    def forward(number: int, frame: FrameType | None) -> None:
        handler = signal.getsignal(signal.SIGINT)  # Tune's while it runs, Python's otherwise
        if not callable(handler):  # a shell starts its background jobs with SIGINT ignored
            handler = signal.default_int_handler
        handler(signal.SIGINT, frame)

    def take() -> None:
        signal.signal(signal.SIGTERM, forward)

    before = signal.getsignal(signal.SIGTERM)
    take()
    try:
        yield take
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _ignore_signals() -> Iterator[None]:
    """Let no second Ctrl-C leave Ray's processes and folder behind."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def build(config: AlgorithmConfig) -> Any:
    """Build an algorithm without Tune, in the Ray that runs. Raises UsageError if the resources do not suffice."""
    resources.check_room(resources.request_of(config), resources.ray_room("this machine"), config=config)
    with status("building the algorithm"):
        return config.build_algo()


def iterate(algorithm: Any) -> dict[str, Any]:
    """Train an algorithm that was built without Tune for an iteration. Raises RlservoError with the cause."""
    try:
        with status(f"iteration {algorithm.iteration + 1}"):
            result: dict[str, Any] = algorithm.train()
    except Exception as error:  # an environment is anyone's code
        raise errors.RlservoError(f"training failed: {failures.in_a_line(error)}") from error
    return result


@contextlib.contextmanager
def stopping(algorithm: Any) -> Iterator[Any]:
    """Stop an algorithm that was built without Tune, and remove the folder it makes in ~/ray_results (ray 2.60)."""
    try:
        yield algorithm
    finally:
        algorithm.stop()
        folder = Path(algorithm.logdir)
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # others' results are in it
            folder.parent.rmdir()


def pickle_by_value(*modules: ModuleType) -> None:
    """Let checkpoints load, and other nodes run, without the scripts' own files."""
    for module in (sys.modules[__name__], failures, *modules):
        cloudpickle.register_pickle_by_value(module)


@dataclass
class SuccessLog:
    """RLlib's callback at an episode's end: the share of successes, if the environment ever reports one in `info`."""

    reports: bool = False
    silent: int = 0  # episodes before the first report: failures as soon as there is one

    def __call__(self, *, episode: Any, metrics_logger: Any, **_: Any) -> None:
        outcome = success_of(episode.get_infos(-1) or {})
        self.reports |= outcome is not None
        if not self.reports:
            self.silent = min(self.silent + 1, SUCCESS_WINDOW)
            return
        for succeeded in (*[False] * self.silent, bool(outcome)):
            metrics_logger.log_value("success_rate", float(succeeded), reduce="mean", window=SUCCESS_WINDOW)
        self.silent = 0


def fill_return(metric: str, mode: str) -> Callable[..., None]:
    """Return RLlib's callback for a result: before the first episode has ended, the metric gets the worst value.

    RLlib leaves it out or reports NaN, which Tune's stop criteria, its schedulers and its choice of checkpoints cannot
    handle (ray 2.60).
    """
    *path, last = metric.split("/")
    worst = -math.inf if mode == "max" else math.inf

    def on_train_result(*, result: dict[str, Any], **_: Any) -> None:
        part = result
        for key in path:
            part = part.setdefault(key, {})
        if not isinstance(part.get(last), int | float) or math.isnan(part[last]):
            part[last] = worst

    return on_train_result


class ProgressTable(tune.Callback):
    """Prints a row per training iteration, under a header that is repeated now and then, and failures as they occur."""

    HEADER = "{:>8} {:>5} {:>12} {:>10} {:>8} {:>8} {:>10} {:>8} {:>8}".format(
        "trial", "iter", "steps", "return", "length", "success", "eval", "steps/s", "time"
    )

    def __init__(self, folder: Path) -> None:
        self._rows = 0
        self._reached: set[str] = set()  # trials
        self._failures = folder / failures.FILE
        self._failed, _ = failures.read(self._failures)
        self._told_at = time.monotonic()
        self._row_at, self._silence_s = time.monotonic(), SAID_AFTER_S

    def on_step_end(self, iteration: int, trials: Any, **info: Any) -> None:
        self._tell_failures(trials)
        if time.monotonic() - self._row_at >= self._silence_s:
            building = all(trial.status == "PENDING" for trial in trials)
            what = "the algorithm is built, in a process of its own" if building else "an iteration is trained"
            print(f"{what}, {time.monotonic() - self._row_at:.0f} s so far", file=sys.stderr, flush=True)
            self._silence_s *= 2

    def _tell_failures(self, trials: Any) -> None:
        if self._failed and time.monotonic() - self._told_at < failures.PRINT_EVERY_S:
            return
        count, last = failures.read(self._failures)
        if count > self._failed:
            self._failed, self._told_at = count, time.monotonic()
            print(f"failed while sampling, {count} so far: {last} (all of them: {self._failures})", flush=True)
        waited_s = time.monotonic() - self._told_at
        if count and waited_s > failures.BUILT_S and all(trial.status == "PENDING" for trial in trials):
            raise RuntimeError(f"{last}, after which the algorithm was not built")  # RLlib sometimes waits indefinitely

    def on_trial_result(self, iteration: int, trials: Any, trial: Any, result: dict[str, Any], **info: Any) -> None:
        self._row_at, self._silence_s = time.monotonic(), SAID_AFTER_S
        if self._rows % 25 == 0:
            print(self.HEADER)
        self._rows += 1
        runners: Mapping[str, Any] = result.get("env_runners", {})
        evaluated: Mapping[str, Any] = (result.get("evaluation") or {}).get("env_runners") or {}
        steps, seconds = result.get(STEPS, 0), result.get("time_total_s", 0.0)
        print(
            f"{trial.trial_id[-8:]:>8} {result['training_iteration']:>5} {steps:>12,.0f} "
            f"{_number(runners.get('episode_return_mean')):>10} {_number(runners.get('episode_len_mean'), 1):>8} "
            f"{_number(runners.get('success_rate'), 3):>8} {_number(evaluated.get('episode_return_mean')):>10} "
            f"{steps / max(seconds, 1e-9):>8,.0f} {int(seconds) // 60:>5}:{int(seconds) % 60:02d}",
            flush=True,
        )
        enough = runners.get("num_episodes", 0) >= MILESTONE_EPISODES
        if enough and runners.get("success_rate", 0.0) >= MILESTONE and trial.trial_id not in self._reached:
            self._reached.add(trial.trial_id)
            print(f"{MILESTONE:.0%} success first reached after {steps:,.0f} steps, {seconds:.0f} s", flush=True)

    def on_trial_error(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        print(f"{trial.trial_id[-8:]:>8} failed; its error.txt is in {trial.path}", flush=True)


def _number(value: Any, digits: int = 2) -> str:
    return f"{value:,.{digits}f}" if isinstance(value, int | float) and math.isfinite(value) else "-"


def train(
    config: AlgorithmConfig,
    run: Run,
    *,
    storage: Path,
    stop: Mapping[str, float],
    checkpoint_frequency: int,
    num_samples: int = 1,
    scheduler: Any = None,
    max_concurrent: int | None = None,
    max_failures: int = 0,
    swept: Sequence[str] = (),
    resumable: bool = True,
    where: str = "this machine",
) -> Outcome:
    """Train until one of the stop criteria holds (Ray must be running); see `resume` for what is raised.

    `resumable` is whether the script has a `--resume` to mention; `where` describes what Ray runs on.
    """
    run = replace(run, request=run.request or resources.request_of(config))
    resources.check_room(run.request, resources.ray_room(where), config=config, concurrent=max_concurrent)
    name = f"{run.algorithm}-{run.env_id.split('/')[-1].split(':')[-1]}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = _new_folder(storage, name)
    (folder / RUN_FILE).write_text(json.dumps(asdict(run) | {"swept": list(swept)}, indent=2) + "\n")
    failures.watch(config, folder)
    print(f"run: {folder}\ncurves: tensorboard --logdir {folder}", flush=True)
    print("Ctrl-C stops" + (f"; --resume {folder} continues" if resumable else ""), flush=True)
    tuner = tune.Tuner(
        run.algorithm,
        param_space=cast(Any, config),  # Tune takes an AlgorithmConfig, its annotation says dict
        tune_config=tune.TuneConfig(
            metric=run.metric,
            mode=run.mode,
            num_samples=num_samples,
            scheduler=scheduler,
            max_concurrent_trials=max_concurrent,
            trial_name_creator=_trial_name,
            trial_dirname_creator=_trial_name,
        ),
        run_config=tune.RunConfig(
            name=folder.name,
            storage_path=str(folder.parent),
            stop=dict(stop),
            failure_config=tune.FailureConfig(max_failures=max_failures),
            checkpoint_config=tune.CheckpointConfig(
                num_to_keep=3,
                checkpoint_score_attribute=run.metric,
                checkpoint_score_order=run.mode,
                checkpoint_frequency=checkpoint_frequency,
                checkpoint_at_end=True,
            ),
            callbacks=[ProgressTable(folder)],
            verbose=0,
        ),
    )
    return _fit(tuner, folder, run, swept)


def check_storage(storage: Path) -> None:
    """Raise UsageError when no folder can be made in `storage`: better now than when Ray has started."""
    try:
        with tempfile.TemporaryDirectory(dir=_make_folder(storage)):
            pass
    except OSError as error:
        raise errors.UsageError(f"--storage {storage}: cannot be written: {error.strerror}") from error


def _make_folder(storage: Path) -> Path:
    folder = storage.expanduser().resolve()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _new_folder(storage: Path, name: str) -> Path:
    """Make a folder of this name, or a longer one: jobs of an array may begin in the same second."""
    try:
        folder = _make_folder(storage) / name
        while True:
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder
            folder = folder.with_name(f"{name}-{secrets.token_hex(2)}")
    except OSError as error:
        raise errors.UsageError(f"--storage {storage}: cannot be written: {error.strerror}") from error


def _trial_name(trial: Any) -> str:
    return f"trial_{trial.trial_id}"


def load_run(folder: Path) -> tuple[Run, list[str]]:
    """Return the content of a run's `run.json`, and the names of the swept settings.

    Raises UsageError if the folder is not a run.
    """
    try:
        document = json.loads((folder / RUN_FILE).read_text())
        swept = document.pop("swept")
        return Run(**document), list(swept)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        near = sorted(path.parent for path in folder.parent.glob(f"*/{RUN_FILE}"))
        runs = f"; the newest there is {max(near, key=lambda path: path.stat().st_mtime)}" if near else ""
        raise errors.UsageError(
            f"--resume {folder}: not the folder of a run, which has a {RUN_FILE} and Tune's state in it{runs}"
        ) from error


def resume(folder: Path, *, where: str = "this machine") -> Outcome:
    """Resume a run that was interrupted or failed, each trial from its newest checkpoint (Ray must be running).

    Raises UsageError if the folder is not a run or the resources do not suffice, Interrupted on Ctrl-C and
    RlservoError when a trial fails.
    """
    folder = folder.expanduser().resolve()
    run, swept = load_run(folder)
    resources.check_room(run.request, resources.ray_room(where))
    default_config(run.algorithm)  # registers the algorithms, quietly
    if not tune.Tuner.can_restore(str(folder)):
        raise errors.UsageError(f"--resume {folder}: the run was stopped before Tune saved anything; start it again")
    try:
        tuner = tune.Tuner.restore(str(folder), run.algorithm, resume_unfinished=True, resume_errored=True)
    except Exception as error:  # a damaged or foreign pickle may raise anything
        raise errors.UsageError(f"--resume {folder}: Tune's state cannot be read: {_first_line(error)}") from error
    return _fit(tuner, folder, run, swept)


def _fit(tuner: tune.Tuner, folder: Path, run: Run, swept: Sequence[str]) -> Outcome:
    try:
        results = tuner.fit()
    except KeyboardInterrupt:
        raise InterruptError(folder) from None
    except Exception as error:  # before a trial has begun, or Tune's own; a trial's are in the results
        raise errors.RlservoError(f"training failed: {failures.in_a_line(error)}") from error
    trials, failed, unfinished = [], [], False
    for result in (results[index] for index in range(len(results))):
        if result.error is not None:
            failed.append(result)
        elif not (result.metrics or {}).get("done"):
            unfinished = True
        trials.append(_trial(result, run, swept))
    if unfinished or not trials:
        raise InterruptError(folder)
    if len(failed) == len(trials):
        cause = failures.in_a_line(str(failed[0].error))
        _, last = failures.read(folder / failures.FILE)
        if last and last not in cause:
            cause += f", after an env runner's {last}"
        raise errors.RlservoError(
            f"training failed: {cause}; all of it is in {failed[0].path}/error.txt, and "
            f"--resume {folder} continues from the last checkpoint"
        )
    if not any(trial.trained_steps for trial in trials):
        raise errors.RlservoError(f"nothing was learned: {failures.nothing_learned(trials[0].env_steps, folder)}")
    sign = -1.0 if run.mode == "max" else 1.0
    # A trial without a score comes last.
    trials.sort(key=lambda one: sign * one.best_score if math.isfinite(one.best_score) else math.inf)
    return Outcome(folder, tuple(trials))


def _trial(result: Any, run: Run, swept: Sequence[str]) -> Trial:
    metrics = result.metrics or {}
    scores = [
        (score, Path(checkpoint.path))
        for checkpoint, at in result.best_checkpoints
        if math.isfinite(score := metric(at, run.metric))
    ]
    trained_steps = metric(metrics, failures.TRAINED)
    is_judged = scores or not run.metric.startswith("evaluation/")
    newest = Path(result.checkpoint.path) if result.checkpoint and trained_steps > 0 and is_judged else None
    best = (max if run.mode == "max" else min)(scores, default=(math.nan, newest), key=lambda pair: pair[0])
    config = result.config or {}
    return Trial(
        name=Path(result.path).name,
        settings={name: config.get(name, config.get(f"_{name}")) for name in swept},  # RLlib keeps some as properties
        iterations=int(metrics.get("training_iteration", 0)),
        env_steps=int(metrics.get(STEPS, 0)),
        trained_steps=trained_steps if trained_steps > 0 else 0.0,
        score=metric(metrics, run.metric),
        best_score=best[0],
        best_checkpoint=best[1],
        seconds=float(metrics.get("time_total_s", 0.0)),
        folder=Path(result.path),
    )


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def best_checkpoint_of(outcome: Outcome) -> Path:
    """Return the best checkpoint of the best trial, or raise RlservoError when there is none."""
    for trial in outcome.trials:
        if trial.best_checkpoint is not None:
            return trial.best_checkpoint
    raise errors.RlservoError(f"{outcome.folder} holds no checkpoint that learned and has a score")


def report(outcome: Outcome, run: Run) -> None:
    """Print the trials as a table and write `results.csv` and the learning curves, `results.png`, beside them."""
    swept = list(outcome.best.settings)
    columns = ["trial", *swept, "iterations", "steps", "last", "best", "time [s]", "checkpoint"]
    rows = [
        [
            trial.name,
            *(_plain(value) for value in trial.settings.values()),
            f"{trial.iterations}",
            f"{trial.env_steps}",
            _number(trial.score, 3),
            _number(trial.best_score, 3),
            f"{trial.seconds:.1f}",
            trial.best_checkpoint.name if trial.best_checkpoint else "-",
        ]
        for trial in outcome.trials
    ]
    table = Table(title=f"{run.metric}, the best first", title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(width=max(100, _out.width) if _out.is_terminal else 200, highlight=False).print(table)
    with (outcome.folder / "results.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    picture = plot_curves(outcome, run)
    print(f"results: {outcome.folder / 'results.csv'}" + (f", {picture}" if picture else ""))


def _plain(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def plot_curves(outcome: Outcome, run: Run) -> Path | None:
    """Draw each trial's metric over environment steps into `results.png`; None when nothing was reported."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 4.5), layout="constrained")
    drawn = 0
    for trial in outcome.trials:
        points = []
        for line in (trial.folder / "result.json").read_text().splitlines():
            with contextlib.suppress(ValueError):  # a line cut off by a crash
                result = json.loads(line)
                points.append((result.get(STEPS, 0), metric(result, run.metric)))
        points = [(steps, score) for steps, score in points if math.isfinite(score)]
        if points:
            settings = ", ".join(f"{name}={_plain(value)}" for name, value in trial.settings.items())
            axes.plot(*zip(*points, strict=True), marker=".", label=settings or trial.name)
            drawn += 1
    path = outcome.folder / "results.png"
    if drawn:
        axes.set(xlabel="environment steps", ylabel=run.metric, title=f"{run.algorithm} on {run.env_id}")
        axes.grid(alpha=0.3)
        if drawn <= 12:
            axes.legend(fontsize="small")
        figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return path if drawn else None


def export_and_run(
    checkpoint: Path,
    out: Path,
    *,
    env_id: str,
    env_config: Mapping[str, Any],
    episodes: int,
    explore: bool = False,
    app_dir: Path = Path(),
    seed: int = 10_000,
) -> Path:
    """Export the checkpoint and run episodes with the bundle, which export has proven to act as RLlib does."""
    from rlservo import Policy, export_checkpoint, rollout
    from rlservo.drive.report import render_report

    with status("exporting") as show:
        bundle = export_checkpoint(checkpoint, out, app_dir=app_dir, notify=print, progress=show)
    print(f"bundle: {bundle.path}", flush=True)
    if episodes:
        with Policy.load(bundle.path) as policy, status(f"0 of {episodes} episodes") as show:
            result = rollout(
                policy,
                env_id,
                episodes=episodes,
                seed=seed,
                explore=explore,
                env_kwargs=env_config,
                on_episode=lambda row: show(f"{row.index + 1} of {episodes} episodes"),
            )
        _out.print(render_report(result))
        if result.interrupted:
            raise KeyboardInterrupt
    return bundle.path
