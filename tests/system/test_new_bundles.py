"""Bundles that are exported after a server's first start: named when it starts again, and loaded by that command."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bundles import write_box_policy, write_discrete_policy
from servers import ask, free_ports, running, wait_until_served
from waiting import wait_for

pytestmark = [pytest.mark.serve, pytest.mark.slow]
RLSERVO = [sys.executable, "-m", "rlservo.deploy.cli"]


@contextmanager
def serving(root: Path, runtime: Path, workers: int) -> Iterator[tuple[int, list[str]]]:
    """Run `rlservo serve` as a user does; gives the port and the lines that it prints until it is ready."""
    (port,) = free_ports(1)
    command = [*RLSERVO, "serve", str(root), "--port", str(port), "--workers", str(workers)]
    with running(command, port, XDG_RUNTIME_DIR=str(runtime), RLSERVO_PLAN=str(root)) as run:
        lines: list[str] = []
        drain = threading.Thread(target=lines.extend, args=(run.process.stdout,), daemon=True)
        drain.start()
        wait_until_served(run, lines)
        wait_for(lambda: any(line.startswith("ready") for line in lines), "the line that it is ready")
        ready = next(index for index, line in enumerate(lines) if line.startswith("ready"))
        yield port, lines[: ready + 1]
        assert run.end(signal.SIGTERM) == 0
        drain.join()


def rlservo(runtime: Path, *words: str) -> str:
    environment = {"PATH": "/usr/bin:/bin", "XDG_RUNTIME_DIR": str(runtime)}
    done = subprocess.run([*RLSERVO, *words], capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("workers", [1, 2])
def test_a_start_names_what_it_does_not_serve_and_the_command_that_loads_it(tmp_path: Path, workers: int) -> None:
    root, runtime = tmp_path / "policies", tmp_path / "runtime"
    runtime.mkdir()
    write_box_policy(root, version="1")
    with serving(root, runtime, workers) as (_, lines):
        assert "not served" not in "".join(lines)
    write_box_policy(root, version="2", seed=1)
    write_discrete_policy(root)
    with serving(root, runtime, workers) as (port, lines):
        said = "".join(lines)
        url = ("--url", f"http://127.0.0.1:{port}")
        for name, version in (("ur5", "2"), ("gridworld", "1")):
            assert f"{name} version {version} is not served" in said
            assert f"not loaded: {name} {version}" in rlservo(runtime, "policy", "list", *url)
        for command in re.findall(r"\(rlservo (policy load .*)\)", said):
            rlservo(runtime, *command.split(), *url)
        status, _ = ask(port, "POST", "/v1/policies/gridworld/act", {"obs": 0})
        assert status == 200
        assert ask(port, "POST", "/v1/policies/ur5/versions/2/act", {"obs": [0.0] * 27})[0] == 200
        assert "not loaded" not in rlservo(runtime, "policy", "list", *url)
        rlservo(runtime, "policy", "unload", "ur5", "2", *url)
    with serving(root, runtime, workers) as (_, lines):
        assert "not served" not in "".join(lines)  # an operator has left it out
