"""Scripts run as a user runs them, and what several tests look at: made once a session."""

from __future__ import annotations

import contextlib
import io
import json
import os
import runpy
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parents[1] / "examples"
TINY = ("--set", "train_batch_size_per_learner=400", "--hidden", "16")


@dataclass(frozen=True)
class Ended:
    """How a script ended."""

    code: int
    out: str
    err: str


def command(script: str, *arguments: str) -> list[str]:
    return [sys.executable, str(EXAMPLES / script), *arguments]


def environment(home: Path) -> dict[str, str]:
    """A home of its own shows what a script leaves there. Ray's workers would step back behind all else: nice 15."""
    return {**os.environ, "HOME": str(home), "RAY_worker_niceness": "0"}


def run_script(script: str, *arguments: str, home: Path) -> Ended:
    done = subprocess.run(
        command(script, *arguments), capture_output=True, text=True, timeout=500, env=environment(home), cwd=home
    )
    return Ended(done.returncode, done.stdout, done.stderr)


def run_here(script: str, *arguments: str, home: Path) -> Ended:
    """Run a script in this process, for what starts no Ray: to import RLlib takes longer than that."""
    out, err, code, before = io.StringIO(), io.StringIO(), 0, dict(os.environ)
    try:
        with contextlib.ExitStack() as stack:
            patch = stack.enter_context(pytest.MonkeyPatch.context())
            patch.setattr(sys, "argv", command(script, *arguments)[1:])
            patch.chdir(home)
            stack.enter_context(contextlib.redirect_stdout(out))
            stack.enter_context(contextlib.redirect_stderr(err))
            stack.enter_context(warnings.catch_warnings(action="ignore"))
            os.environ.update(environment(home))
            runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    except SystemExit as end:
        assert end.code is None or isinstance(end.code, int), end.code
        code = end.code or 0
    finally:  # a script sets what Ray is to see
        os.environ.clear()
        os.environ.update(before)
    return Ended(code, out.getvalue(), err.getvalue())


def run_helper(script: str, *arguments: str, folder: Path) -> str:
    """Run a script of the tests' own and return its output; the last line is a JSON document."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(HERE / script), *arguments],
        capture_output=True,
        text=True,
        timeout=550,
        env=environment(folder),
        cwd=folder,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-5000:]
    return done.stdout


@pytest.fixture(scope="session", name="run_script")
def run_script_fixture() -> Callable[..., Ended]:
    """The function above, for test files: they cannot import this one."""
    return run_script


@pytest.fixture(scope="session", name="run_helper")
def run_helper_fixture() -> Callable[..., str]:
    return run_helper


@pytest.fixture(scope="session", name="run_here")
def run_here_fixture() -> Callable[..., Ended]:
    return run_here


def _inference(script: str, *more: str) -> tuple[str, ...]:
    return (script, *more, "--stop-iters", "1", "--num-episodes-during-inference", "2", "--storage", "runs")


def _again(name: str, *changes: str) -> tuple[str, ...]:
    return ("train_shipped.py", name, *(word for change in changes for word in ("--set", change)))


OFFSCREEN = bool(os.environ.get("DISPLAY") or find_library("EGL") or find_library("OSMesa"))
IN_ONE_RAY = {
    "ur": _inference("training_inference_ur.py"),
    "mir": _inference("training_inference_mir.py", "--num-cpus", "1"),
    "tour": ("tour.py", "--quick", *(() if OFFSCREEN else ("--no-video",))),
    "again": _again(
        "cartpole_dqn",
        "stop.env_steps=400", "steps_per_iteration=300", "training.num_steps_sampled_before_learning_starts=200",
    ),
    "judged": _again(
        "mir100_obstacle_avoidance",
        "stop.env_steps=5000", "stop.episodes=3", "validation.above=0", "validation.episodes=2",
        "training.train_batch_size_per_learner=2048", "training.num_epochs=1",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Trained:
    """How a script ended, in which folder, and what it left in the home folder."""

    ended: Ended
    folder: Path
    home: frozenset[str]
    videos: bool = OFFSCREEN  # whether there is an OpenGL library to make them with


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Trained]]:
    """Return a function that runs a script once, by its name in IN_ONE_RAY or by a new name and its words.

    All of them share a process and a Ray.
    """
    folder, home = tmp_path_factory.mktemp("one_ray"), tmp_path_factory.mktemp("home")
    command = [sys.executable, "-W", "ignore", str(HERE / "train_in_one_ray.py")]
    with (
        (folder / "errors.txt").open("w") as errors,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment(home),
            cwd=home,
        ) as process,
    ):  # fmt: skip

        @cache
        def train(name: str, *words: str) -> Trained:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(json.dumps([str(folder / name), *(words or IN_ONE_RAY[name])]) + "\n")
            process.stdin.flush()
            reply = process.stdout.readline()
            assert reply, (folder / "errors.txt").read_text()[-5000:]
            one = json.loads(reply)
            return Trained(Ended(one["code"], one["out"], one["err"]), folder / name, frozenset(one["home"]))

        try:
            yield train
        finally:
            assert process.stdin is not None
            process.stdin.close()  # the last request: it ends, and its Ray with it
            try:
                process.wait(200)
            except subprocess.TimeoutExpired:
                process.kill()


@dataclass(frozen=True)
class Sweep:
    """A finished run of `simple_trainer.py`: two learning rates, evaluation, traces, a bundle."""

    home: Path
    ended: Ended

    @property
    def run(self) -> Path:
        return next(path.parent for path in (self.home / "runs").glob("*/run.json"))


@pytest.fixture(scope="session")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    home = tmp_path_factory.mktemp("sweep")
    (home / "space.yaml").write_text("gamma: {choice: [0.9]}\n")
    ended = run_script(
        "simple_trainer.py", "--run", "PPO", "--name-env", "CartPole-v1", "--num-cpus", "0", *TINY,
        "--stop-iters", "2", "--sweep", "lr=1e-4,1e-3", "--search-space", "space.yaml", "--scheduler", "asha",
        "--evaluation-interval", "1", "--evaluation-duration", "2", "--output", "traces", "--episodes", "2",
        home=home,
    )  # fmt: skip
    return Sweep(home, ended)


@dataclass(frozen=True)
class Interrupted:
    """A run that got Ctrl-C after its second checkpoint, and was resumed."""

    home: Path
    stopped: Ended
    resumed: Ended
    left: list[str]


@pytest.fixture(scope="session")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Interrupted]:
    home = tmp_path_factory.mktemp("interrupted")
    started = subprocess.Popen(
        command(
            "simple_trainer.py", "--num-cpus", "1", *TINY, "--stop-iters", "6", "--checkpoint-frequency", "1",
            "--episodes", "1",
        ),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(home), cwd=home,
        start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 300
        while len(list(home.glob("runs/*/trial_*/checkpoint_*"))) < 2:
            assert started.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        os.killpg(started.pid, signal.SIGINT)  # as a terminal sends it: to the script and all it started
        out, err = started.communicate(timeout=100)
        stopped = Ended(started.returncode, out, err)
        left = in_session(started.pid)
        run = next(home.glob("runs/*"))
        resumed = run_script("simple_trainer.py", "--resume", str(run), home=home)
        yield Interrupted(home, stopped, resumed, left)
    finally:
        if started.poll() is None:
            os.killpg(started.pid, signal.SIGKILL)


def in_session(leader: int) -> list[str]:
    """Return what still runs of a session, given the time to end."""
    deadline = time.monotonic() + 20
    while True:
        listed = subprocess.run(["ps", "-s", str(leader), "-o", "stat=,args="], capture_output=True, text=True).stdout
        alive = [one for one in listed.splitlines() if one and not one.startswith("Z")]
        if not alive or time.monotonic() > deadline:
            return alive
        time.sleep(0.2)
