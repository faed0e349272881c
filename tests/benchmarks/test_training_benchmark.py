"""The training benchmark's parts: its clock, its limit, its files. The benchmark itself is not a test."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
import training
import vectorisation


def test_time_limit_ends_a_block_and_nothing_afterwards() -> None:
    with pytest.raises(training.TimeUp), training.TimeLimit(0.1) as limit:
        time.sleep(5)
    assert limit.up
    with training.TimeLimit(0.1) as limit:
        pass
    time.sleep(0.2)
    assert not limit.up


@pytest.mark.slow
def test_a_configuration_without_time_is_written_down_and_another_measured(trained: Any) -> None:
    run = trained("benchmark")
    done, folder = run.ended, run.folder
    assert done.code == 0, done.out + done.err
    assert "1 x 4 no iteration ended within 0.05 s" in done.out
    none, row = json.loads((folder / "training.json").read_text())["rows"]
    assert none == {"runners": 1, "envs": 4, "reason": "no iteration ended within 0.05 s"}
    assert (row["runners"], row["envs"], row["iterations"]) == (1, 4, 1)
    assert 512 <= row["steps_per_s"] * row["iteration_s"] < 600
    assert row["sample_s"] > 0 and row["learn_s"] > 0
    assert row["sample_s"] + row["learn_s"] + row["rest_s"] == pytest.approx(row["iteration_s"])
    assert row["env_step_share"] + row["inference_share"] + row["connectors_share"] == pytest.approx(1.0)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork:DeprecationWarning")
def test_every_way_to_step_several_robots_is_measured_beside_syncvectorenv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = vectorisation.measure([2], 1, 0.01, out=tmp_path)
    assert set(results) == set(vectorisation.ways_of(2))
    assert all(wall > 0 and cpu > 0 for own in results.values() for wall, cpu in own["2"]["rounds"])
    written = json.loads((tmp_path / "vectorisation.json").read_text())
    assert written[vectorisation.SYNC]["2"]["of_sync"] == 1.0
    assert capsys.readouterr().out.count("bare loop") == 2
