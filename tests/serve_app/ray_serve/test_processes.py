"""Marked processes of a launch, with real processes."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
import time

from rlservo.serve_app.ray_serve.processes import MARK, end_marked, find_marked


def test_marked_processes_are_ended_with_their_children_and_others_are_left() -> None:
    mark, other = secrets.token_hex(8), secrets.token_hex(8)
    nap = "import time; time.sleep(60)"
    code = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', '{nap}']); {nap}"
    parent = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, MARK: mark})
    bystander = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], env={**os.environ, MARK: other})
    try:
        deadline = time.monotonic() + 20
        while len(find_marked(mark)) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(find_marked(mark)) == 2
        assert end_marked(mark) == []
        assert find_marked(mark) == []
        assert bystander.poll() is None
    finally:
        parent.kill()
        bystander.kill()
        parent.wait()
        bystander.wait()


def test_a_process_that_lost_its_mark_is_found_by_its_session() -> None:
    """Ray's workers overwrite the memory of their environment with their title."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], env={}, start_new_session=True)
    try:
        assert process.pid in find_marked("no such mark", process.pid)
        assert find_marked("no such mark") == []
        assert end_marked("no such mark", process.pid) == []
        assert process.wait(5) == -9
    finally:
        process.kill()
        process.wait()
