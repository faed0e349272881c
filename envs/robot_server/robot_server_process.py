"""One robot server as a child process: started, watched, ended. It cannot outlive the process that started it."""

from __future__ import annotations

import contextlib
import os
import selectors
import subprocess
import sys
import time

from rlservo.envs.robot_server.robot_server import FAILED, READY
from rlservo.envs.robot_server.robot_server_settings import Settings, settings_to_json

START_TIMEOUT_S = 60.0
TERMINATE_TIMEOUT_S = 0.4


class StartFailedError(ValueError):
    """The robot server did not start."""


class ServerProcess:
    """A running robot server. Its standard input is its lifeline: it ends when our end of the pipe is closed."""

    def __init__(self, settings: Settings, *, orphan_s: float | None = None) -> None:
        self.settings = settings
        command = [sys.executable, "-m", "rlservo.envs.robot_server.robot_server", settings_to_json(settings)]
        if orphan_s is not None:
            command.append(str(orphan_s))
        environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **os.environ}
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C in our terminal is ours to handle
        )
        try:
            self.port = self._receive_port(time.monotonic() + START_TIMEOUT_S)
        except BaseException:
            self.kill()
            raise

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """None while it runs; negative is the signal that ended it."""
        return self._process.poll()

    def end(self) -> None:
        """Ask it to end, and kill it after 0.4 s."""
        self._process.terminate()
        try:
            self._process.wait(TERMINATE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self.kill()

    def kill(self) -> None:
        """Kill it, reap the process, and close the pipes."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _receive_port(self, deadline: float) -> int:
        """Wait for the line with the port, or the reason of a failure."""
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        output = b""
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while b"\n" not in output:
                if not selector.select(max(0.0, deadline - time.monotonic())):
                    raise StartFailedError(f"the robot server did not start within {START_TIMEOUT_S:g} s")
                part = os.read(pipe, 4096)
                if not part:
                    raise StartFailedError(f"the robot server exited while starting (exit code {self._process.wait()})")
                output += part
        line = output.decode(errors="replace").splitlines()[0]
        if line.startswith(FAILED):
            raise StartFailedError(line.removeprefix(FAILED))
        if not line.startswith(READY):
            raise StartFailedError(f"the robot server printed {line!r} instead of {READY!r}")
        return int(line.removeprefix(READY))
