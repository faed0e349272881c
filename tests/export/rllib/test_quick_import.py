"""Imports of a process that only restores a checkpoint: deferred packages run later, and nothing is missing."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rlservo.export.rllib import quick_import

ROOT = Path(__file__).parents[3]
EXPORT = """
import sys

from rlservo.export.rllib import quick_import

quick_import.prepare()
from rlservo.export.export_checkpoint import export_checkpoint

export_checkpoint("examples/checkpoints/ur5_positioning", sys.argv[1], notify=lambda _: None)
unused = {"pandas", "ray.data", "ray.tune.tuner", "ray.rllib.algorithms.ppo.ppo"} & set(sys.modules)
assert not unused, unused

import ray.data
from ray import train, tune
from ray.rllib.algorithms import PPOConfig
from ray.rllib.utils import checkpoints

assert tune.Tuner and ray.data.Dataset and "pandas" in sys.modules
assert checkpoints.Checkpoint_tune is tune.Checkpoint and checkpoints.Checkpoint_train is train.Checkpoint
assert PPOConfig().environment("CartPole-v1").observation_filter == "NoFilter"
"""


def test_an_export_imports_nothing_that_it_does_not_use_and_it_is_there_later(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", EXPORT, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture
def finder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[quick_import.Finder]:
    """Give the finder for a package `outer`, whose `__init__`s write down that they ran."""
    (tmp_path / "outer" / "inner").mkdir(parents=True)
    (tmp_path / "journal.py").write_text("ran = []\n")
    (tmp_path / "outer" / "__init__.py").write_text(
        "import journal\njournal.ran.append('outer')\nfrom outer.inner.leaf import VALUE\n"
    )
    (tmp_path / "outer" / "inner" / "__init__.py").write_text("import journal\njournal.ran.append('inner')\nNAME = 1\n")
    (tmp_path / "outer" / "inner" / "leaf.py").write_text("VALUE = 2\n")
    (tmp_path / "outer" / "inner" / "other.py").write_text("import journal\njournal.ran.append('other')\n")
    (tmp_path / "outer" / "broken").mkdir()
    (tmp_path / "outer" / "broken" / "__init__.py").write_text("import no_such_module\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(quick_import, "DEFERRED", ("outer",))
    finder = quick_import.Finder()
    sys.meta_path.insert(0, finder)
    yield finder
    sys.meta_path.remove(finder)
    for name in [name for name in sys.modules if name.partition(".")[0] in {"outer", "journal"}]:
        del sys.modules[name]


def test_a_deferred_package_runs_when_one_of_its_names_is_used(finder: quick_import.Finder) -> None:
    with finder.deferring():
        leaf = importlib.import_module("outer.inner.leaf")
    journal = importlib.import_module("journal")
    assert (leaf.VALUE, journal.ran) == (2, [])
    assert sys.modules["outer"].inner.leaf is leaf  # an import sets it: no reason to run
    assert journal.ran == []
    assert sys.modules["outer.inner"].NAME == 1
    assert journal.ran == ["outer", "inner"]  # outermost first, as importing it does
    assert sys.modules["outer"].VALUE == 2
    assert journal.ran == ["outer", "inner"]
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = sys.modules["outer"].no_such_name


def test_what_is_above_another_module_runs_before_it(finder: quick_import.Finder) -> None:
    with finder.deferring():
        importlib.import_module("outer.inner.leaf")
    importlib.import_module("outer.inner.other")
    assert importlib.import_module("journal").ran == ["outer", "inner", "other"]


def test_a_package_that_cannot_be_imported_says_so_whoever_asks(finder: quick_import.Finder) -> None:
    with finder.deferring():
        broken = importlib.import_module("outer.broken")
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="no_such_module"):
            _ = broken.NAME
