"""A policy's checkpoint in, episodes out, with a count of the actions that needed clipping."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

CHECKPOINTS = Path(__file__).resolve().parents[2] / "examples" / "checkpoints"
ROBOTS = [("policy_from_cp_ur.py", "ur_positioning"), ("policy_from_cp_mir.py", "mir100_navigation")]


def returns(ended: Any) -> list[str]:
    assert ended.code == 0, ended.err
    return re.findall(r"^episode \d+: (.*)$", ended.out, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "name"), ROBOTS)
def test_checkpoint_and_bundle_run_the_same_episodes_and_the_bundle_needs_no_clipping(
    script: str, name: str, tmp_path: Path, run_here: Any, all_shipped: Path
) -> None:
    bundle = all_shipped / name / "1"
    raw = run_here(script, str(CHECKPOINTS / name), "--num-episodes", "2", home=tmp_path)
    exported = run_here(script, "--bundle", str(bundle), "--num-episodes", "2", home=tmp_path)
    assert returns(raw) == returns(exported)
    clipped, actions = map(int, re.search(r"clipped (\d+) of (\d+) actions", raw.out).groups())  # type: ignore[union-attr]
    assert 0 < clipped <= actions
    assert f"clipped 0 of {actions} actions" in exported.out


@pytest.mark.slow
def test_wrong_paths_are_refused_in_a_sentence(tmp_path: Path, run_here: Any) -> None:
    for script, arguments, code, sentence in (
        ("policy_from_cp_ur.py", [], 2, "give either a checkpoint's path or --bundle"),
        ("policy_from_cp_ur.py", [str(tmp_path)], 1, "is not an RLlib checkpoint"),
        ("policy_from_cp_ur.py", [str(CHECKPOINTS / "mir100_navigation")], 2, "trained for another environment"),
    ):
        ended = run_here(script, *arguments, home=tmp_path)
        assert ended.code == code, ended
        assert re.search(sentence, ended.err.strip().splitlines()[-1])
        assert "Traceback" not in ended.err
