"""Checkpoints behind URIs: fetched by the file systems that Ray itself uses, and removed afterwards."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from rlservo.errors import CheckpointError, UnsupportedError, UsageError
from rlservo.export.checkpoints.remote import fetch
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.verify_bundle import verify_bundle


@pytest.fixture(autouse=True)
def nothing_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Fetch into a folder of the test's own, and look afterwards whether it is empty again."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture
def bucket() -> Iterator[str]:
    """A folder of fsspec's own file system in memory."""
    memory = fsspec.filesystem("memory")
    yield "memory://bucket"
    memory.rm("/bucket", recursive=True)


def test_a_checkpoint_is_fetched_by_pyarrow_or_fsspec_and_removed(
    zoo: Path, tmp_path: Path, bucket: str, notices: list[str]
) -> None:
    fsspec.filesystem("memory").put(str(zoo / "pendulum"), "/bucket/pendulum", recursive=True)
    local = export_checkpoint(zoo / "pendulum", tmp_path / "local", notify=notices.append).contract
    for index, uri in enumerate(((zoo / "pendulum").as_uri(), f"{bucket}/pendulum")):
        stages: list[str] = []
        result = export_checkpoint(uri, tmp_path / str(index), notify=notices.append, progress=stages.append)
        assert result.contract.provenance.checkpoint_sha256 == local.provenance.checkpoint_sha256
        assert stages[0] == f"fetching {uri}" and len(stages) > 3
        assert any(f"loading {uri}: checkpoints are pickles" in notice for notice in notices)
        verified = verify_bundle(result.path, uri, notify=notices.append)
        assert verified.same_checkpoint


def test_errors_name_the_uri_and_leave_nothing(tmp_path: Path, bucket: str, notices: list[str]) -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe("/bucket/old/checkpoint-12", b"x")
    memory.pipe("/bucket/file", b"x")
    for uri, words in (
        (f"{bucket}/none", "memory://bucket/none does not exist"),
        (f"{bucket}/file", "memory://bucket/file is a file"),
        ((tmp_path / "none").as_uri(), "none does not exist"),
    ):
        with pytest.raises(CheckpointError, match=words):
            export_checkpoint(uri, tmp_path / "out", notify=notices.append)
    with pytest.raises(UnsupportedError, match=r"^memory://bucket/old was written by a Ray before 2\.1"):
        export_checkpoint(f"{bucket}/old", tmp_path / "out", notify=notices.append)
    with pytest.raises(UsageError, match="nowhere://x cannot be read here: neither pyarrow nor fsspec opens 'nowhere'"):
        export_checkpoint("nowhere://x", tmp_path / "out", notify=notices.append)
    assert not (tmp_path / "out").exists() and notices == []


def test_a_local_path_is_used_where_it_is(zoo: Path) -> None:
    with fetch(str(zoo / "pendulum"), lambda _: None) as folder:
        assert folder == zoo / "pendulum"
