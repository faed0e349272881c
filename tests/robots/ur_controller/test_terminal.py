"""The controller's command without its terminal."""

from __future__ import annotations

import os
import pty
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from arms import PATIENCE_S


def test_controller_goes_on_when_its_terminal_is_gone(tmp_path: Path) -> None:
    keyboard, terminal = pty.openpty()
    host, log = f"127.77.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}", tmp_path / "log"
    with log.open("wb") as file:
        started = subprocess.Popen(
            [sys.executable, "-m", "rlservo.deploy.cli", "ur-controller", "--host", host],
            stdin=terminal, stdout=file, stderr=file, start_new_session=True,
        )  # fmt: skip
    os.close(terminal)
    limit = time.monotonic() + PATIENCE_S

    def answers() -> bool:
        with socket.socket() as client:
            return client.connect_ex((host, 29999)) == 0

    try:
        while "Ctrl-C" not in log.read_text():
            assert time.monotonic() < limit and started.poll() is None, log.read_text()
            time.sleep(0.1)
        os.write(keyboard, b"help\n")
        while "protective stop" not in log.read_text():
            assert time.monotonic() < limit, log.read_text()
            time.sleep(0.1)
        os.close(keyboard)
        time.sleep(0.5)
        assert answers()
    finally:
        started.send_signal(signal.SIGINT)
        started.wait(PATIENCE_S)
    assert "Traceback" not in log.read_text()
