"""The person at the terminal beside a real arm: asked before it moves to a start, and free to take it over with `h`."""

from __future__ import annotations

import atexit
import select
import sys
import threading

from rlservo.envs.robots.arm import RobotError

KEY = "h"
LOOK_S = 0.2


class Operator:
    """A person who confirms motions and takes the arm over. `toggle` may be called from any thread."""

    def __init__(self, *, is_asked: bool) -> None:
        """`is_asked`: whether a motion to a start waits for the person's yes."""
        self._is_asked = is_asked
        self._has_taken_over = threading.Event()
        self._is_closed = threading.Event()
        self._terminal: list[object] | None = None
        self._keys: threading.Thread | None = None

    @property
    def has_taken_over(self) -> bool:
        """Whether the person leads the arm now."""
        return self._has_taken_over.is_set()

    def toggle(self) -> None:
        """Take the arm over, or give it back."""
        if self._has_taken_over.is_set():
            self._has_taken_over.clear()
        else:
            self._has_taken_over.set()

    def confirm(self, question: str) -> None:
        """Wait for a yes. Raises RobotError without one, and where there is no terminal to ask at."""
        if not self._is_asked:
            return
        if not sys.stdin.isatty():
            raise RobotError(f"{question}: nobody can be asked without a terminal; --yes (confirm=False) says yes")
        self._stop_keys()
        sys.stderr.write(f"\n{question}. Is everybody out of its way, and a hand at the emergency stop? [y/N] ")
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise RobotError(f"{question}: not confirmed")

    def watch_keys(self) -> None:
        """Let the key `h` take the arm over from now on, where there is a terminal."""
        if self._keys is not None or not sys.stdin.isatty():
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
        """Give the terminal back."""
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
