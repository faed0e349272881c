"""Fixtures of the export tests beside the trained checkpoints of `tests/checkpoints.py`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from checkpoints import APP

if TYPE_CHECKING:
    from rlservo.export.export_checkpoint import ExportResult


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Tests call parts of an export by themselves; see `one_thread` for why."""
    pytest.importorskip("torch")
    from rlservo.export.graph.one_thread import one_thread

    with one_thread():
        yield


@pytest.fixture
def notices() -> list[str]:
    """The notices of an export: give it as `notify=notices.append`."""
    return []


@pytest.fixture(scope="session")
def app() -> Path:
    """The folder with the user's own code that some of the checkpoints need."""
    return APP


@pytest.fixture
def exported_copy(exported: Callable[..., ExportResult], tmp_path: Path) -> Callable[[Path], ExportResult]:
    """Return a function that gives a checkpoint's export, as `exported`, for a test that writes to its files."""

    def copy(checkpoint: Path) -> ExportResult:
        from rlservo.export.export_checkpoint import ExportResult

        kept = exported(checkpoint)
        path = shutil.copytree(kept.path, tmp_path / "exported" / checkpoint.name / "1")
        return ExportResult(path, kept.contract)

    return copy


@pytest.fixture
def copy_of(zoo: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies a checkpoint to where a test may damage it."""

    def copy(name: str) -> Path:
        return Path(shutil.copytree(zoo / name, tmp_path / "damaged" / name))

    return copy
