"""Scripts run as a user runs them, and results that several tests share: made once per session."""

from __future__ import annotations

import contextlib
import io
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from cache import cached
from trainings import EXAMPLES, ON_ONE_CORE, TINY, TRAINED_WITH, Ended, OneRay, command, environment


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
        [sys.executable, "-W", "ignore", str(Path(__file__).with_name(script)), *arguments],
        capture_output=True,
        text=True,
        timeout=550,
        env=environment(folder),
        cwd=folder,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-5000:]
    return done.stdout


@pytest.fixture(scope="session", name="run_helper")
def run_helper_fixture() -> Callable[..., str]:
    """The function above, for test files: they cannot import this one."""
    return run_helper


@pytest.fixture(scope="session", name="run_here")
def run_here_fixture() -> Callable[..., Ended]:
    return run_here


# Slurm's srun takes options, then a command. It writes down on which node it was asked to run what.
SRUN = r"""#!/usr/bin/env bash
node=-
while [ "${1#--}" != "$1" ]; do
  case "$1" in --nodelist=*) node="${1#*=}" ;; esac
  shift
done
echo "$node $*" >> "$STUB_LOG"
exec "$@"
"""
SCONTROL = """#!/usr/bin/env bash
[ "$1 $2 $3" = "show hostnames node[1-2]" ] && printf 'node1\nnode2\n'
"""


@dataclass(frozen=True)
class Job:
    """A job that ran: its script's end, and the folders that it had."""

    ended: Ended
    home: Path
    checkout: Path
    stubs: Path

    @property
    def called(self) -> list[str]:
        """Return what `srun` was asked to run: the node, then the command."""
        return (self.stubs / "srun.log").read_text().splitlines()


def job_folders(folder: Path) -> tuple[Path, Path, Path]:
    return folder / "home", folder / "checkout", folder / "stubs"


def submit(script: str, *arguments: str, folder: Path, **more: str) -> Job:
    """Run a job script as Slurm would: from a spool, in an environment of its own."""
    job = Job(Ended(-1, "", ""), *job_folders(folder))
    for each in (job.home, job.checkout, job.stubs):
        each.mkdir()
    for name in ("examples", "deploy"):
        (job.checkout / name).symlink_to(EXAMPLES.parent / name)
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL)):
        (job.stubs / name).write_text(text)
        (job.stubs / name).chmod(0o755)
    spool = job.stubs / "slurm_script"
    shutil.copy(EXAMPLES.parent / "deploy" / "slurm" / script, spool)
    variables = {
        **environment(job.home),
        "PATH": f"{job.stubs}:{os.environ['PATH']}",
        "STUB_LOG": str(job.stubs / "srun.log"),
        "SLURM_SUBMIT_DIR": str(job.checkout),
        "SLURM_JOB_ID": str(os.getpid()),
        "SLURM_CPUS_PER_TASK": "1",
        "RLSERVO_PYTHON": sys.executable,
        "RLSERVO_STORAGE": str(job.home / "runs"),
        "RLSERVO_RAY_FOLDER": f"/tmp/slurm-{os.getpid()}",
        **more,
    }
    done = subprocess.run(
        ["bash", str(spool), *arguments], env=variables, capture_output=True, text=True, timeout=500, cwd=job.home
    )
    return replace(job, ended=Ended(done.returncode, done.stdout, done.stderr))


@pytest.fixture(scope="session", name="submit")
def submit_fixture() -> Callable[..., Job]:
    return submit


@pytest.fixture(scope="session")
def sweep() -> Job:
    """A sweep of `simple_trainer.py` as a job of one node: two learning rates, evaluation, traces, a bundle."""

    def run(folder: Path) -> None:
        space = folder / "space.yaml"
        space.write_text("gamma: {choice: [0.9]}\n")
        ended = submit(
            "one_node.sh", "--run", "PPO", "--name-env", "CartPole-v1", *TINY,
            "--stop-iters", "2", "--sweep", "lr=1e-4,1e-3", "--search-space", str(space), "--scheduler", "asha",
            "--evaluation-interval", "1", "--evaluation-duration", "2", "--output", "traces", "--episodes", "2",
            folder=folder,
        ).ended  # fmt: skip
        assert ended.code == 0, ended.out + ended.err
        (folder / "ended.json").write_text(json.dumps([ended.out, ended.err]))

    folder = cached("sweep", [*TRAINED_WITH, Path(__file__), EXAMPLES.parent / "deploy" / "slurm"], run)
    return Job(Ended(0, *json.loads((folder / "ended.json").read_text())), *job_folders(folder))


@dataclass(frozen=True)
class Interrupted:
    """A run that got Ctrl-C after its second checkpoint, and was resumed."""

    home: Path
    stopped: Ended
    resumed: Ended
    left: list[str]


@pytest.fixture(scope="session")
def interrupted(tmp_path_factory: pytest.TempPathFactory, one_ray: OneRay) -> Iterator[Interrupted]:
    home = tmp_path_factory.mktemp("interrupted")
    started = subprocess.Popen(
        command(
            "simple_trainer.py", "--num-cpus", "1", *ON_ONE_CORE, *TINY, "--stop-iters", "6",
            "--checkpoint-frequency", "1", "--episodes", "1",
        ),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(home), cwd=home,
        start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 300
        checkpoints: list[Path] = []
        while len(checkpoints) < 2:
            assert started.poll() is None, started.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.1)
            with contextlib.suppress(FileNotFoundError):  # Ray's temporary folders come and go meanwhile
                checkpoints = list(home.glob("runs/*/trial_*/checkpoint_*"))
        os.killpg(started.pid, signal.SIGINT)  # as a terminal sends it: to the script and all it started
        out, err = started.communicate(timeout=100)
        stopped = Ended(started.returncode, out, err)
        left = in_session(started.pid)
        run = next(home.glob("runs/*"))
        resumed = one_ray.run(home / "resumed", "simple_trainer.py", "--resume", str(run)).ended
        yield Interrupted(home, stopped, resumed, left)
    finally:
        if started.poll() is None:
            os.killpg(started.pid, signal.SIGKILL)
            started.communicate()


def in_session(leader: int) -> list[str]:
    """Return what still runs of a session, given the time to end."""
    deadline = time.monotonic() + 20
    while True:
        listed = subprocess.run(["ps", "-s", str(leader), "-o", "stat=,args="], capture_output=True, text=True).stdout
        alive = [one for one in listed.splitlines() if one and not one.startswith("Z")]
        if not alive or time.monotonic() > deadline:
            return alive
        time.sleep(0.2)
