"""Operator at the terminal of a real robot, who confirms motions and restarts and can take an arm over with `h`."""

from __future__ import annotations

import atexit
import select
import sys
import threading

from rlservo.robots.arm_interface import RobotError, RobotStoppedError

KEY = "h"
LOOK_S = 0.2


class Operator:
    """An operator who confirms motions and takes the arm over. `toggle` may be called from any thread."""

    def __init__(self, *, is_asked: bool) -> None:
        """Take `is_asked`: whether a motion needs the operator's confirmation."""
        self._is_asked = is_asked
        self._may_restart = threading.Event()
        self._has_taken_over = threading.Event()
        self._is_closed = threading.Event()
        self._terminal: list[object] | None = None
        self._keys: threading.Thread | None = None

    @property
    def has_taken_over(self) -> bool:
        """Whether the operator leads the arm now."""
        return self._has_taken_over.is_set()

    def toggle(self) -> None:
        """Take the arm over, or return it to the policy."""
        if self._has_taken_over.is_set():
            self._has_taken_over.clear()
        else:
            self._has_taken_over.set()

    def confirm(self, question: str) -> None:
        """Wait for a yes. Raises RobotError without one, or without a terminal."""
        if not self._is_asked:
            return
        if not _has_terminal():
            raise RobotError(f"{question}: there is no terminal to confirm at; use --yes (confirm=False)")
        self._ask(question)

    def allow_restart(self) -> None:
        """Let a robot that has stopped start again once: a person has said so elsewhere, at a service, say."""
        self._may_restart.set()

    def confirm_restart(self, why: str) -> None:
        """Wait for a yes after a stop, which is a person's until shown otherwise. No option gives it in advance.

        Raises RobotStoppedError without one, or without a terminal.
        """
        if self._may_restart.is_set():
            self._may_restart.clear()
        elif not _has_terminal():
            raise RobotStoppedError(f"the robot stopped ({why}), and a person must look at it: start the run again")
        else:
            try:
                self._ask(f"the robot stopped ({why}) and will connect again")
            except RobotError as error:
                raise RobotStoppedError(str(error)) from error

    def _ask(self, question: str) -> None:
        self._stop_keys()
        sys.stderr.write(f"\n{question}. Is everyone clear of the robot, and a hand on the emergency stop? [y/N] ")
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise RobotError(f"{question}: not confirmed")

    def watch_keys(self) -> None:
        """Let the key `h` take the arm over from now on, if there is a terminal."""
        if self._keys is not None or not _has_terminal():
            return
        import termios
        import tty

        self._terminal = termios.tcgetattr(sys.stdin)
        atexit.register(self.close)
        tty.setcbreak(sys.stdin)
        self._is_closed.clear()
        self._keys = threading.Thread(target=self._read_keys, name="operator-keys", daemon=True)
        self._keys.start()

    def close(self) -> None:
        """Restore the terminal."""
        self._stop_keys()
        atexit.unregister(self.close)

    def _stop_keys(self) -> None:
        if self._keys is None or self._terminal is None:
            return
        import termios

        self._is_closed.set()
        self._keys.join()
        self._keys = None
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)  # type: ignore[arg-type]  # as it was read

    def _read_keys(self) -> None:
        while not self._is_closed.is_set():
            ready, _, _ = select.select([sys.stdin], [], [], LOOK_S)
            if ready and sys.stdin.read(1).lower() == KEY:
                self.toggle()


def _has_terminal() -> bool:
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()
