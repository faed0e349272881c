"""`rlservo demo`: the whole path on the shipped checkpoints, twice in a row, and nothing left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from servers import free_ports, running

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
def test_demo_serves_a_page_until_ctrl_c_then_reaches_the_targets_and_leaves_nothing(tmp_path: Path) -> None:
    """Twice right after each other in the same folder: with the cockpit, and with the episodes and a picture."""
    pytest.importorskip("viser", reason="the cockpit draws with viser")
    out = tmp_path / "demo"
    (port,) = free_ports(1)
    command = [sys.executable, "-X", "faulthandler", "-m", "rlservo.deploy.cli", "demo", "--out", str(out)]
    with running([*command, "--cockpit", "--port", str(port)], port) as run:
        assert run.process.stdout is not None
        said = [next((line for line in run.process.stdout if line.startswith("cockpit at ")), "nothing")]
        assert said == [f"cockpit at http://127.0.0.1:{port}; Ctrl-C stops\n"]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as reply:
            assert reply.status == 200
        run.process.send_signal(signal.SIGINT)
        try:
            assert run.process.wait(120) == 0
        except subprocess.TimeoutExpired:
            run.process.send_signal(signal.SIGABRT)  # faulthandler writes where its threads are
            pytest.fail(f"still there after two minutes: {run.process.stdout.read()}")
    assert processes_naming(str(out)) == []
    (out / "demo.png").write_bytes(b"of an earlier demo")
    done = subprocess.run([*command, "--episodes", "4"], capture_output=True, text=True, timeout=900, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("4 of 4 ") == 4  # two robots on each engine
    assert done.stdout.rstrip().endswith(f"rlservo cockpit --bundle {out / 'policies'}")
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
