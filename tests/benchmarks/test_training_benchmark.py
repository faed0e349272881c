"""The training benchmark's parts for a moment: its clock, its limit, its files. The benchmark itself is no test."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import training
import vectorisation

BENCHMARKS = Path(training.__file__).parent


def test_time_limit_ends_a_block_and_nothing_afterwards() -> None:
    with pytest.raises(training.TimeUp), training.TimeLimit(0.1) as limit:
        time.sleep(5)
    assert limit.up
    with training.TimeLimit(0.1) as limit:
        pass
    time.sleep(0.2)
    assert not limit.up


MEASURE = """
import sys
from pathlib import Path
import training
with training.training_run.ray_session(num_cpus=2):
    training.warm_up()
    rows = [training.measure("CartPole-v1", 1, 4, 1, 512, limit) for limit in (0.5, 200.0)]
for row in rows:
    print(training.line(row))
training.write(rows, "CartPole-v1", 512, Path())
"""


@pytest.mark.slow
def test_a_configuration_without_time_is_written_down_and_another_measured(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(BENCHMARKS), "RAY_worker_niceness": "0"}
    done = subprocess.run(
        [sys.executable, "-c", MEASURE], capture_output=True, text=True, timeout=300, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 x 4 no iteration ended within 0.5 s" in done.stdout
    none, row = json.loads((tmp_path / "training.json").read_text())["rows"]
    assert none == {"runners": 1, "envs": 4, "reason": "no iteration ended within 0.5 s"}
    assert (row["runners"], row["envs"], row["iterations"]) == (1, 4, 1)
    assert 512 <= row["steps_per_s"] * row["iteration_s"] < 600
    assert row["sample_s"] > 0 and row["learn_s"] > 0
    assert row["sample_s"] + row["learn_s"] + row["rest_s"] == pytest.approx(row["iteration_s"])
    assert row["env_step_share"] + row["inference_share"] + row["connectors_share"] == pytest.approx(1.0)
    assert (tmp_path / "training.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork:DeprecationWarning")
def test_every_way_to_step_several_robots_is_measured_beside_syncvectorenv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rates = vectorisation.measure([2], 1, 0.01, out=tmp_path)
    assert set(rates) == set(vectorisation.ways_of(2))
    assert all(wall > 0 and cpu > 0 for own in rates.values() for wall, cpu in own[2])
    written = json.loads((tmp_path / "vectorisation.json").read_text())
    assert written[vectorisation.SYNC]["2"]["of_sync"] == 1.0
    assert capsys.readouterr().out.count("physics alone") == 5
