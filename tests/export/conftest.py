"""Real checkpoints for the export tests, trained by RLlib in a process and a Ray cluster of their own, and kept."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cache import cached, versions
from rlservo.export.graph.one_thread import one_thread

ZOO = Path(__file__).resolve().parents[1] / "zoo"
APP = ZOO / "app"


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Tests call parts of an export by themselves; see `one_thread` for why."""
    with one_thread():
        yield


@pytest.fixture
def notices() -> list[str]:
    """What an export told its user: give it as `notify=notices.append`."""
    return []


@pytest.fixture(scope="session")
def app() -> Path:
    """The folder with the user's own code that some of the checkpoints need."""
    return APP


def trained(script: str) -> Path:
    """Return the folder that a training script fills."""

    def train(folder: Path) -> None:
        # With the token in its environment Ray writes none to the user's home.
        environment = {**os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(16)}
        command = [sys.executable, "-W", "ignore", str(ZOO / script), str(folder)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=580)
        assert done.returncode == 0, done.stderr[-3000:]

    made_of = [ZOO, str(ZOO), versions("ray", "torch", "gymnasium", "numpy")]  # pickles name the code's own folder
    return cached(script.removesuffix(".py"), made_of, train)


@pytest.fixture(scope="session")
def zoo() -> Path:
    """A folder of checkpoints `<name>/` and what the environment saw, `<name>.npz`. Not to be written to."""
    return trained("train_zoo.py")


@pytest.fixture(scope="session")
def wide_zoo() -> Path:
    """The same for spaces, recurrent policies, connectors and algorithms of every kind."""
    return trained("train_wide_zoo.py")


@pytest.fixture(scope="session")
def old_zoo() -> Path:
    """The same for RLlib's old API stack."""
    return trained("train_old_zoo.py")


@pytest.fixture
def copy_of(zoo: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies a checkpoint to where a test may damage it."""

    def copy(name: str) -> Path:
        return Path(shutil.copytree(zoo / name, tmp_path / "damaged" / name))

    return copy
