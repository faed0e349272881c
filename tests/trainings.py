"""Trainings, by the scripts that users run: one after the other in one process and one Ray.

Starting a Ray and importing RLlib take longer than most of what is trained here, so only a test of the start itself
starts its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from cache import cached, versions

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent / "examples"
TINY = ("--set", "train_batch_size_per_learner=400", "--hidden", "16")
# An env runner beside the driver, which waits while it samples.
HALVES = ("num_cpus_per_env_runner", "num_cpus_for_main_process", "num_cpus_per_learner")
ON_ONE_CORE = tuple(word for name in HALVES for word in ("--set", f"{name}=0.5"))


@dataclass(frozen=True)
class Ended:
    """Outcome of a script."""

    code: int
    out: str
    err: str


def command(script: str, *arguments: str) -> list[str]:
    return [sys.executable, str(EXAMPLES / script), *arguments]


def environment(home: Path) -> dict[str, str]:
    """A home of its own shows what a script leaves there. Ray's workers would step back behind all else: nice 15.

    Most of a worker's time is its imports: `quick_rllib.py`.
    """
    path = os.pathsep.join(part for part in (str(HERE), os.environ.get("PYTHONPATH", "")) if part)
    return {
        **os.environ, "HOME": str(home), "PYTHONPATH": path, "RAY_worker_niceness": "0",
        "RAY_preload_python_modules": "quick_rllib",
    }  # fmt: skip


def _inference(script: str, *more: str) -> tuple[str, ...]:
    return (script, *more, "--stop-iters", "1", "--num-episodes-during-inference", "2", "--storage", "runs")


def _again(name: str, *changes: str) -> tuple[str, ...]:
    return ("train_shipped.py", name, *(word for change in changes for word in ("--set", change)))


OFFSCREEN = bool(os.environ.get("DISPLAY") or find_library("EGL") or find_library("OSMesa"))
IN_ONE_RAY = {
    "mir": _inference("training_inference_mir.py", "--num-cpus", "1"),
    "tour": ("tour.py", "--quick", *(() if OFFSCREEN else ("--no-video",))),
    "again": _again(
        "cartpole_dqn",
        "stop.env_steps=400", "steps_per_iteration=300", "training.num_steps_sampled_before_learning_starts=200",
    ),
    "judged": _again(
        "mir100_obstacle_avoidance",
        "stop.env_steps=2500", "stop.episodes=3", "validation.above=0", "validation.episodes=2", "envs=8",
        "training.train_batch_size_per_learner=1024", "training.num_epochs=1",
    ),
    "begun": _again(
        "ur5_positioning_disturbed",
        "stop.env_steps=500", "envs=4", "training.train_batch_size_per_learner=512", "training.minibatch_size=128",
        "training.num_epochs=1",
    ),
    "edges": (str(HERE / "examples" / "train_edges.py"),),
    "benchmark": (str(HERE / "benchmarks" / "measure_training.py"),),
}  # fmt: skip
"""Scripts of `examples/`, or of the tests' own, by name."""

PRODUCT = ("rlservo", "export", "envs")
TESTS_OWN = (
    "trainings.py",
    "train_in_one_ray.py",
    "quick_rllib.py",
    "examples/app",
    "examples/train_edges.py",
    "benchmarks",
)
TRAINED_WITH = [
    *(HERE.parent / name for name in ("benchmarks/training.py", "benchmarks/measuring.py", "examples", *PRODUCT)),
    *(HERE / name for name in TESTS_OWN),
    versions("ray", "torch", "gymnasium", "numpy", "mujoco", "onnx", "onnxruntime"),
    str(EXAMPLES), str(OFFSCREEN),
]  # fmt: skip
"""Commands and folder of those scripts; their output and files name files."""


@dataclass(frozen=True)
class Trained:
    """Outcome of a script, its folder, and the files it left in the home folder."""

    ended: Ended
    folder: Path
    home: frozenset[str]
    videos: bool = OFFSCREEN  # whether there is an OpenGL library to make them with


class OneRay:
    """A process with a Ray of one core that runs scripts."""

    def __init__(self, process: subprocess.Popen[str], errors: Path) -> None:
        self._process = process
        self._errors = errors

    def run(self, folder: Path, *words: str) -> Trained:
        """Run a script with these arguments in a folder."""
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps([str(folder), *words]) + "\n")
        process.stdin.flush()
        for reply in process.stdout:
            one = json.loads(reply)
            if one["folder"] == str(folder):  # the others came when their test had given up
                return Trained(Ended(one["code"], one["out"], one["err"]), folder, frozenset(one["home"]))
        raise AssertionError(self._errors.read_text()[-5000:])


@pytest.fixture(scope="session")
def one_ray(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OneRay]:
    errors_file, home = tmp_path_factory.mktemp("one_ray") / "errors.txt", tmp_path_factory.mktemp("home")
    command = [sys.executable, "-W", "ignore", str(HERE / "train_in_one_ray.py")]
    with (
        errors_file.open("w") as errors,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment(home),
            cwd=home,
        ) as process,
    ):  # fmt: skip
        try:
            yield OneRay(process, errors_file)
        finally:
            assert process.stdin is not None
            process.stdin.close()  # the last request: it ends, and its Ray with it
            try:
                process.wait(200)
            except subprocess.TimeoutExpired:
                process.kill()


@pytest.fixture(scope="session")
def trained(request: pytest.FixtureRequest) -> Callable[[str], Trained]:
    """Return a function that runs a script of IN_ONE_RAY, unless the same code has run it before."""

    def run(name: str) -> Trained:
        words = IN_ONE_RAY[name]

        def train(folder: Path) -> None:
            done = request.getfixturevalue("one_ray").run(folder / "run", *words)
            assert done.ended.code == 0, done.ended.out + done.ended.err
            (folder / "ended.json").write_text(json.dumps([done.ended.out, done.ended.err, sorted(done.home)]))

        folder = cached(f"training-{name}", [*TRAINED_WITH, *words], train)
        out, err, home = json.loads((folder / "ended.json").read_text())
        return Trained(Ended(0, out, err), folder / "run", frozenset(home))

    return cache(run)
