"""Folder of an online learning run: versions, used episodes and lock. A run can always be resumed.

`learn.json` is replaced atomically, and names the newest version that was made, proven and published. Later updates are
learned again from the same episodes, which count as used only once a version includes them.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rlservo.bundle.contract import first_fault
from rlservo.deploy.learning.episode_filter import KnownVersion
from rlservo.errors import UsageError
from rlservo.policy.acting_policy import Closeable

STATE_FILE, LOCK_FILE, REWARD_FILE = "learn.json", ".lock", "reward.py"
FOLDERS = ("bundles", "checkpoints", "followed", "promotions")


@dataclass
class RunState:
    """State of a run at its newest version."""

    terms: dict[str, Any]
    """Settings that must not change between starts of a run."""
    versions: list[KnownVersion] = field(default_factory=list)
    """The versions in order, the newest last."""
    updates: int = 0
    episodes: int = 0
    steps: int = 0
    used: dict[str, list[str]] = field(default_factory=dict)
    """The used and dropped episodes, by the file that has their end."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Number of dropped episodes, by reason."""
    refused: int = 0
    """Versions that the gate refused, or whose canary was rolled back."""
    unproven: list[str] = field(default_factory=list)
    """The used episodes of the refused versions."""


STATE = TypeAdapter(RunState)


class RunFolder(Closeable):
    """A run's folder, locked by one process."""

    def __init__(self, path: Path, terms: dict[str, Any], reward_source: str | None) -> None:
        """Make the folder, or resume its run. Raises UsageError if another process holds it or settings differ."""
        self.path = path.absolute()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._check_ours()
            self._lock = os.open(self.path / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise UsageError(f"--out {path} cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise UsageError(f"--out {path}: another process is learning in it") from None
        try:
            self.state = self._read(terms, reward_source)
        except BaseException:
            self.close()
            raise

    @property
    def is_new(self) -> bool:
        return not self.state.versions

    @property
    def bundles(self) -> Path:
        """The folder of the bundles, `<policy>/<version>`."""
        return self.path / "bundles"

    def checkpoint(self, version: str) -> Path:
        """Return the checkpoint from which a version was exported."""
        return self.path / "checkpoints" / version

    def begin(self, name: str, version: str) -> Path:
        """Return the folder for a new version's checkpoint, and remove a killed process's remains."""
        shutil.rmtree(self.checkpoint(version), ignore_errors=True)
        shutil.rmtree(self.bundles / name / version, ignore_errors=True)
        self.checkpoint(version).parent.mkdir(parents=True, exist_ok=True)
        return self.checkpoint(version)

    def commit(self, present: Collection[str]) -> None:
        """Write the state, leaving out files that are no longer `present`."""
        state = self.state
        state.used = {file: keys for file, keys in state.used.items() if file in present}
        part = self.path / f"{STATE_FILE}.part"
        with part.open("wb") as stream:
            stream.write(STATE.dump_json(state, indent=1))
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(self.path / STATE_FILE)

    def close(self) -> None:
        """Release the lock."""
        os.close(self._lock)

    def _check_ours(self) -> None:
        """Raise UsageError for a folder with content that is not a run's."""
        ours = {LOCK_FILE, REWARD_FILE, STATE_FILE, f"{STATE_FILE}.part", *FOLDERS}
        others = sorted({entry.name for entry in self.path.iterdir()} - ours)
        if others:
            raise UsageError(f"--out {self.path} holds {others[0]}: expected a new folder, or the folder of a run")

    def _read(self, terms: dict[str, Any], reward_source: str | None) -> RunState:
        file, shown = self.path / STATE_FILE, self.path / REWARD_FILE
        if not file.exists():
            if reward_source is not None:
                shown.write_text(reward_source)
            return RunState(terms)
        try:
            state = STATE.validate_json(file.read_bytes())
        except (OSError, ValidationError) as error:
            reason = first_fault(error) if isinstance(error, ValidationError) else str(error)
            raise UsageError(f"{file} cannot be read ({reason}): give a new --out") from None
        changed = next((name for name in terms if state.terms.get(name) != terms[name]), None)
        if changed is not None:
            raise UsageError(
                f"--out {self.path} is a run with {changed} {state.terms.get(changed)!r}, not {terms[changed]!r}: "
                "give the same value, or a new --out"
            )
        if (shown.read_text() if shown.exists() else None) != reward_source:
            raise UsageError(f"--reward differs from this run's first one ({shown}): give the same, or a new --out")
        return state
