"""Checkpoints that RLlib trains for the tests, in a process and a Ray cluster of their own: made once and kept.

`tests/zoo` has the training scripts.
"""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cache import cached, versions

HERE = Path(__file__).resolve().parent
ZOO = HERE / "zoo"
APP = ZOO / "app"  # the user's own code that some of the checkpoints need
CONNECTORS = ZOO.parents[1] / "export/rllib/batched_connectors.py"  # our own, which one of them has
# A script as Python runs it, after the settings with which RLlib starts and makes connectors sooner.
QUICKLY = "import quick_rllib, runpy, sys; del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
TRAINED_WITH = [ZOO, CONNECTORS, HERE / "quick_rllib.py", versions("ray", "torch", "gymnasium", "numpy")]


def training_code() -> Path:
    """Return the folder where the training scripts run: a copy that lives as long as their checkpoints.

    So any checkout with the same code has the same checkpoints, and may go.
    """

    def copy(folder: Path) -> None:
        shutil.copytree(ZOO, folder / ZOO.name, ignore=shutil.ignore_patterns("__pycache__"))

    return cached("zoo-code", [ZOO], copy) / ZOO.name


def trained(script: str) -> Path:
    """Return the folder that a training script fills."""
    code = training_code()

    def train(folder: Path) -> None:
        # With the token in its environment Ray writes none to the user's home.
        token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(16)}
        path = os.pathsep.join(part for part in (str(HERE), os.environ.get("PYTHONPATH", "")) if part)
        environment = {**os.environ, **token, "PYTHONPATH": path}
        for prestart in ("enable_worker_prestart", "prestart_worker_first_driver"):
            environment[f"RAY_{prestart}"] = "0"  # everything here trains in one process
        command = [sys.executable, "-W", "ignore", "-c", QUICKLY, str(code / script), str(folder)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=580)
        assert done.returncode == 0, done.stderr[-3000:]

    return cached(script.removesuffix(".py"), TRAINED_WITH, train)


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need these checkpoints."""
    for item in items:
        if {"zoo", "wide_zoo", "old_zoo", "layout_zoo", "reported_zoo", "connector_zoo"} & set(
            getattr(item, "fixturenames", ())
        ):
            item.add_marker("trained")


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


@pytest.fixture(scope="session")
def layout_zoo() -> Path:
    """The same for every place where a checkpoint may hold a filter's statistics."""
    return trained("train_layout_zoo.py")


@pytest.fixture(scope="session")
def reported_zoo() -> Path:
    """The same for what people brought and an export had refused."""
    return trained("train_reported_zoo.py")


@pytest.fixture(scope="session")
def connector_zoo() -> Path:
    """The same for connectors of the user's own."""
    return trained("train_connector_zoo.py")
