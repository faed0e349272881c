"""Commands that write more than the disk holds: here more than the kernel lets a process write into a file."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rlservo

LIMIT = 2_000  # [bytes]


def on_a_full_disk(cache: Path, *words: object, limit: int = LIMIT) -> subprocess.CompletedProcess[str]:
    """Run a command; what it caches is cut off too, so that must be its own."""

    def shrink() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-m", "rlservo.deploy.cli", *map(str, words)]
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "XDG_CACHE_HOME": str(cache), "MPLCONFIGDIR": str(cache)}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=200, env=env, preexec_fn=shrink
    )  # fmt: skip


@pytest.mark.parametrize("limit", [1_000, 9_000])
def test_an_export_says_that_its_folder_is_full_and_leaves_nothing(limit: int, zoo: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = on_a_full_disk(tmp_path / "cache", "export", zoo / "pendulum", "--out", out, limit=limit)
    assert done.returncode == 1, done.stderr[-300:]
    assert done.stderr.splitlines()[-1] == f"rlservo: {out}: File too large"
    assert not out.exists()


def test_conversions_name_the_file_that_does_not_fit(ur5: Path, tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    with rlservo.WithRecording(rlservo.Policy.load(ur5), run) as policy:
        policy.reset()
        for number in range(50):
            policy.act(np.full(27, number / 50, np.float32))
            policy.outcome(0.0, terminated=number == 49)
    for number, words in enumerate((
        ("log", "export", run, "--to", "parquet", "--out"),
        ("log", "export", run, "--to", "lerobot", "--out"),
        ("log", "plot", run, "--out"),
        ("log", "repair", run, "--out"),
    )):  # fmt: skip
        out = tmp_path / f"out{number}{'.png' if 'plot' in words else ''}"
        done = on_a_full_disk(tmp_path / "cache", *words, out)
        said = f"rlservo: {out}: File too large"
        assert (done.returncode, done.stderr.splitlines()[-1:]) == (1, [said]), (words, done.stderr)
