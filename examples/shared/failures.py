"""Failures in RLlib's env runners: written next to the run and printed at once; a run that samples nothing ends.

If a sample fails, RLlib (2.60) logs the error in the env runner's process, ends that process and starts another. The
process that trains sees an iteration without a step; the user sees nothing and gets an untrained policy.
"""

from __future__ import annotations

import logging
import math
import re
import socket
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ray.exceptions import RayError
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.callbacks.callbacks import RLlibCallback

FILE = "failures.txt"
SAMPLED = "num_env_steps_sampled_lifetime"
EVALUATED = f"evaluation/env_runners/{SAMPLED}"
TRAINED = "learners/__all_modules__/num_env_steps_trained_lifetime"
PATIENCE_S, PATIENCE = 180.0, 3  # the training fails after so long and so many iterations without a step
MADE_AT_MOST = 100  # environments for one sample, where those that crash are made again
PRINT_EVERY_S = 10.0  # while more of them fail
BUILT_S = 60.0  # after an env runner failed to start
EXCEPTION = re.compile(r"[\w.]+(Error|Exception|Exit): \S")  # a traceback's last line
LOST = re.compile(r"\), taking actor \d+ out of service\.$")  # RLlib's suffix
HEAD = "--- "  # begins the line that names a failure; its traceback follows


def watch(config: AlgorithmConfig, folder: Path) -> None:
    """Let a training's processes write failures into `folder`; the training fails when it no longer samples."""
    file = folder / FILE

    class Watch(RLlibCallback):
        """Callback; each process makes its own, before its environment."""

        def __init__(self) -> None:
            super().__init__()
            _write_errors(file)
            self._sampling, self._evaluating = Drought("sampled", file), Drought("evaluated", file)
            self._made = 0

        def on_environment_created(self, **_: Any) -> None:
            self._made += 1
            if self._made > MADE_AT_MOST:
                raise RuntimeError(f"an environment crashed {MADE_AT_MOST} times without a sample{_last_words(file)}")

        def on_sample_end(self, **_: Any) -> None:
            self._made = 0

        def on_evaluate_end(self, **_: Any) -> None:
            self._evaluating.is_due = True

        def on_train_result(self, *, result: dict[str, Any], **_: Any) -> None:
            self._sampling.is_due = True
            self._sampling.check(metric(result, SAMPLED))
            self._evaluating.check(metric(result, EVALUATED))
            if self._evaluating.empty:  # RLlib repeats the previous evaluation's results
                result["evaluation"]["env_runners"] = {}

    config.callbacks(callbacks_class=Watch)


def metric(result: Mapping[str, Any], name: str) -> float:
    """Return a number of a result by its path (`env_runners/num_episodes`), nested or flat; NaN if there is none."""
    value: Any = result.get(name)
    if value is None:
        value = result
        for key in name.split("/"):
            value = value.get(key) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) else math.nan


@dataclass
class Drought:
    """Consecutive iterations without a step, in training or evaluation."""

    what: str
    file: Path
    is_due: bool = False
    steps: float = 0.0
    empty: int = 0
    since: float = field(default_factory=time.monotonic)

    def check(self, steps: float) -> None:
        """Raise RuntimeError when there was no step for too long, or never one and the environment failed."""
        if not self.is_due:
            return
        self.is_due = False
        now = time.monotonic()
        if steps > self.steps:
            self.steps, self.empty, self.since = steps, 0, now
            return
        self.empty += 1
        has_failed = self.steps == 0 and self.file.exists()
        if has_failed or (self.empty >= PATIENCE and now - self.since >= PATIENCE_S):
            iterations = f" in {self.empty} iterations" if self.empty > 1 else ""
            raise RuntimeError(f"no step was {self.what}{iterations}{_last_words(self.file)}")


def _last_words(file: Path) -> str:
    count, last = read(file)
    if count:
        return f": {last} (the traceback is in {file})"
    return (
        ", and no environment has failed: env runners were killed (is memory short?), or a sample takes longer than "
        "sample_timeout_s (60 s by default)"
    )


def nothing_learned(steps: float, folder: Path | None = None) -> str:
    """Return in words why a learner has seen none of the sampled steps."""
    if steps == 0:
        return "no step was sampled" + (_last_words(folder / FILE) if folder else "")
    return (
        f"{steps:,.0f} steps were sampled, and the training stopped before the learner took any (DQN and SAC begin "
        "after num_steps_sampled_before_learning_starts): train for longer"
    )


def read(file: Path) -> tuple[int, str]:
    """Return how many failures were written, and the last one's exception in a line."""
    try:
        heads = [line for line in file.read_text(encoding="utf-8").splitlines() if line.startswith(HEAD)]
    except FileNotFoundError:
        return 0, ""
    return len(heads), heads[-1].split(": ", 1)[1] if heads else ""


def in_a_line(error: object) -> str:
    """Return the exception at the root, an environment's own, of an exception or of a traceback's text."""
    if isinstance(error, BaseException) and not isinstance(error, RayError):  # whose text is a traceback
        while error.__cause__ is not None:  # RLlib raises a RuntimeError without words from it
            error = error.__cause__
        return " ".join(f"{type(error).__name__}: {error}".split())
    lines = [line for line in str(error).splitlines() if line and not line.startswith((" ", "\t", "Traceback"))]
    exceptions = [line for line in lines if EXCEPTION.match(line)]  # RLlib raises some without words
    return (exceptions or lines or [type(error).__name__])[-1]


def _write_errors(file: Path) -> None:
    loggers = [logging.getLogger(name) for name in ("ray.rllib", "rlservo")]  # ours: that of the batched env runner
    if not any(handler.get_name() == str(file) for handler in loggers[0].handlers):
        handler = _ErrorWriter(file)
        for logger in loggers:
            logger.addHandler(handler)


class _ErrorWriter(logging.Handler):
    """Appends each exception that RLlib logs in this process to the file."""

    def __init__(self, file: Path) -> None:
        super().__init__(logging.ERROR)
        self.set_name(str(file))
        self._file = file
        self._last = ""

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.exc_info[1]:
            words, text = in_a_line(record.exc_info[1]), "".join(traceback.format_exception(record.exc_info[1]))
        else:  # if an environment cannot be made in its process, RLlib logs that process's traceback, as a text
            text = LOST.sub("", record.getMessage())
            words = in_a_line(text)
            if not EXCEPTION.match(words):
                return
        if words == self._last:  # it is logged when it is caught and when the process ends
            return
        self._last = words
        place = f"{time.strftime('%Y-%m-%d %H.%M.%S')}, process {record.process} on {socket.gethostname()}"
        with self._file.open("a", encoding="utf-8") as out:
            out.write(f"{HEAD}{place}: {words}\n{text}\n\n")
