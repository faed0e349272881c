"""Checkpoints that RLlib trains for the tests: kept in the user's cache folder until what makes them changes.

`tests/zoo` has the training scripts. A checkout has its own checkpoints, for pickles name the folder of the code that
made them.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import secrets
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ZOO = Path(__file__).resolve().with_name("zoo")
APP = ZOO / "app"  # the user's own code that some of the checkpoints need
DECIDING = ("ray", "torch", "gymnasium", "numpy")  # a checkpoint is of these versions


def trained(script: str) -> Path:
    """Return the folder of a training script's checkpoints; run it where there are none of today's yet."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rlservo-tests"
    checkout = hashlib.sha256(str(ZOO).encode()).hexdigest()[:12]
    folder = cache / f"{script.removesuffix('.py')}-{checkout}"
    complete, wanted = folder / "complete", makes_them()
    cache.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another test run, or another worker of this one, may be training them
        if not (complete.exists() and complete.read_text() == wanted):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            # With the token in its environment Ray writes none to the user's home.
            environment = {
                **os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(16),
            }  # fmt: skip
            command = [sys.executable, "-W", "ignore", str(ZOO / script), str(folder)]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=580)
            assert done.returncode == 0, done.stderr[-3000:]
            complete.write_text(wanted)
    return folder


def makes_them() -> str:
    """Return a hash of the training scripts, the code they train with, and the versions of what trains."""
    digest = hashlib.sha256(sys.version.encode())
    for name in DECIDING:
        digest.update(f"{name} {version(name)}\n".encode())
    for file in sorted(ZOO.rglob("*.py")):
        digest.update(str(file.relative_to(ZOO)).encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


@pytest.fixture(scope="session")
def zoo() -> Path:
    """A folder of checkpoints `<name>/` and what the environment saw, `<name>.npz`."""
    return trained("train_zoo.py")


@pytest.fixture(scope="session")
def wide_zoo() -> Path:
    """The same for spaces, recurrent policies, connectors and algorithms of every kind."""
    return trained("train_wide_zoo.py")


@pytest.fixture(scope="session")
def old_zoo() -> Path:
    """The same for RLlib's old API stack."""
    return trained("train_old_zoo.py")
