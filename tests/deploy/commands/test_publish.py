"""`rlservo publish`: under the bundle's own number, under the next free one, and never over another."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rlservo.deploy.cli import app
from rlservo.errors import BundleError, ConflictError
from rlservo.policy.policy import Policy


def test_a_bundle_is_published_under_its_own_and_the_next_free_number(ur5: Path, tmp_path: Path) -> None:
    place = str(tmp_path / "published")
    for options, version in (([], "10"), (["--version", "next"], "11"), (["--version", "3"], "3")):
        done = CliRunner().invoke(app, ["publish", str(ur5), place, "--json", *options], catch_exceptions=False)
        assert json.loads(done.stdout)["version"] == version
        policy = Policy.load(Path(place) / "ur5" / version)  # contract, the graph's copy of it, golden vectors
        assert policy.contract.version == version and policy.digest == json.loads(done.stdout)["sha256"]
        policy.close()
    refused = CliRunner().invoke(app, ["publish", str(ur5), place])
    assert isinstance(refused.exception, ConflictError)
    (Path(place) / "ur5" / "3" / "policy.onnx").write_bytes(b"broken")
    broken = CliRunner().invoke(app, ["publish", str(Path(place) / "ur5" / "3"), str(tmp_path / "elsewhere")])
    assert isinstance(broken.exception, BundleError) and not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("version", ["0", "../1", "latest"])
def test_what_is_no_version_is_refused(version: str, ur5: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["publish", str(ur5), str(tmp_path / "p"), "--version", version])
    assert "cannot be a version" in str(done.exception)


def test_a_signature_is_not_published_under_another_number_and_that_is_said(ur5: Path, tmp_path: Path) -> None:
    bundle = shutil.copytree(ur5, tmp_path / "ur5" / "10")
    (bundle / "model.sig").write_text("of version 10")
    done = CliRunner().invoke(app, ["publish", str(bundle), str(tmp_path / "p"), "--version", "11"])
    assert done.exit_code == 0 and "model.sig is of version 10: 11 has no signature" in " ".join(done.output.split())
    assert not (tmp_path / "p" / "ur5" / "11" / "model.sig").exists()
