"""Sources are found by path, by name, and in other packages."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rlservo.errors import CheckpointError, UsageError
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.sources.registry import find_source, sources
from rlservo.policy.policy import Policy

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "linear_source.py"


@pytest.fixture
def other_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package beside ours, as pip installs it, with the source of examples/linear_source.py."""
    (tmp_path / "site").mkdir()
    shutil.copy(EXAMPLE, tmp_path / "site")
    info = tmp_path / "site" / "linear_source-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: linear-source\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rlservo.sources]\nlinear = linear_source:Linear\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    yield tmp_path / "site"
    sys.modules.pop("linear_source", None)


def test_the_documented_source_of_another_package_is_found_and_proven(
    other_package: Path, tmp_path: Path, notices: list[str]
) -> None:
    assert "linear" in [source.name for source in sources()]
    weights = np.array([[1.0, -2.0, 0.5], [0.0, 1.0, 1.0]], np.float32)
    np.save(tmp_path / "arm.linear.npy", weights)
    result = export_checkpoint(tmp_path / "arm.linear.npy", tmp_path / "out", notify=notices.append)
    assert result.contract.provenance.source == "linear"
    assert not any("loading" in notice for notice in notices)  # it runs no code
    obs = np.array([0.1, 0.2, -0.3], np.float32)
    with Policy.load(result.path) as policy:
        np.testing.assert_allclose(policy.act(obs), np.clip(weights @ obs, -1, 1), rtol=1e-6)


def test_a_package_that_cannot_be_imported_stops_no_other_source(
    other_package: Path, tmp_path: Path, notices: list[str]
) -> None:
    (other_package / "linear_source.py").write_text("import nothing_of_that_name\n")
    assert "rllib" in [source.name for source in sources(notices.append)]
    assert "the source 'linear' of linear_source:Linear cannot be imported: No module named" in notices[0]


def test_a_path_that_no_source_knows_lists_what_each_expects(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(CheckpointError, match=r"is not a checkpoint of any known source: rllib: .*; sb3: the zip"):
        find_source(tmp_path / "notes.txt")
    with pytest.raises(CheckpointError, match="nothing does not exist: expected a checkpoint"):
        find_source(tmp_path / "nothing")
    with pytest.raises(UsageError, match="there is no source 'sb4': expected one of rllib, rllib-old, sb3"):
        find_source(tmp_path, "sb4")


def test_a_source_that_is_named_says_what_it_wants(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(CheckpointError, match="is not a model of Stable-Baselines3: expected the zip"):
        export_checkpoint(tmp_path / "notes.txt", tmp_path / "out", source="sb3")
    with pytest.raises(CheckpointError, match="is a file: expected the folder of an RLlib checkpoint"):
        export_checkpoint(tmp_path / "notes.txt", tmp_path / "out", source="rllib")
