"""`rlservo demo`: the whole path on the shipped checkpoints, twice in a row, and nothing left."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def processes_naming(text: str) -> list[str]:
    """The command lines of this machine's processes that contain `text`."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            try:
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if text in command:
                found.append(command)
    return found


@pytest.mark.serve
@pytest.mark.slow
def test_demo_reaches_the_targets_draws_a_picture_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    for episodes in (4, 1):  # a second one right after works too
        done = subprocess.run(
            [sys.executable, "-m", "rlservo.deploy.cli", "demo", "--out", str(out), "--episodes", str(episodes)],
            capture_output=True, text=True, timeout=900, cwd=ROOT,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stdout.count(f"{episodes} of {episodes} ") == 2
        assert (out / "demo.png").read_bytes().startswith(b"\x89PNG")
        assert (out / "policies" / "ur5" / "1" / "contract.json").is_file()
        assert (out / "policies" / "mir100" / "1" / "contract.json").is_file()
        assert processes_naming(str(out)) == []


def test_demo_outside_a_checkout_says_what_is_missing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rlservo.deploy.cli", "demo"], capture_output=True, text=True, timeout=120, cwd=tmp_path
    )
    assert done.returncode == 2
    assert "run this in a checkout of rlservo" in done.stderr
    assert not (tmp_path / "demo").exists()
