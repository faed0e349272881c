"""The tour runs from end to end, and what it prints agrees with itself."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow


def test_every_stop_ends_in_a_bundle(trained: Any) -> None:
    run = trained("tour")
    ended, folder = run.ended, run.folder
    assert ended.code == 0, ended.out + ended.err
    assert ended.out.count("the environment check passed") == 3
    assert len(re.findall(r"random actions: mean return -?[\d.]+", ended.out)) == 3
    assert "the exported graph gives the same: largest difference" in ended.out
    assert len(re.findall(r"^[SFHG] [←↓→↑] +-?[\d.]+(   [SFHG] [←↓→↑] +-?[\d.]+){3}$", ended.out, re.MULTILINE)) == 4
    lake = ended.out.split("=== FrozenLake: DQN")[1].split("===")[0]
    assert float(re.findall(r"random actions had (-?[\d.]+)", lake)[0]) < 0.1
    crossing = ended.out.split("=== FrozenLake: export")[1].split("===")[0]
    assert "the exported policy: return 1.00 in 6 steps" in crossing  # the shortest way: it has learnt
    assert re.search(r"step +0: value +-?[\d.]+, action mean", ended.out)
    bundles = {path.parent.parent.name for path in (folder / "tour" / "bundles").glob("*/*/contract.json")}
    assert len(bundles) == 3
    if run.videos:
        films = list((folder / "tour" / "videos").glob("*/*.mp4"))
        assert len(films) == 3 and all(film.stat().st_size > 1000 for film in films)
    assert "ray_results" not in run.home


def test_unknown_stop_is_refused_in_a_sentence(tmp_path: Path, run_here: Any) -> None:
    ended = run_here("tour.py", "atari", home=tmp_path)
    assert ended.code == 2
    assert "atari is not a stop of the tour: expected cartpole, frozenlake, ur5" in ended.err
