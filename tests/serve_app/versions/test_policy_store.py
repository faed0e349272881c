"""Names, versions and defaults over real bundles."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from bundles import write_box_policy
from rlservo.errors import (
    BundleError,
    ConflictError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.versions.policy_store import take_step
from stores import load_store

OBS = np.zeros(27, np.float32) + 0.1


def test_the_newest_version_by_number_is_the_default(policies: Path) -> None:
    store = load_store(policies)
    assert store.names == ("gridworld", "ur5")
    assert store.versions("ur5") == ("1", "2", "10")
    newest, _ = take_step(store.get("ur5"), OBS)
    assert (newest.name, newest.version) == ("ur5", "10")
    np.testing.assert_array_equal(newest.action, Policy.load(policies / "ur5" / "10").act(OBS))
    np.testing.assert_array_equal(store.get("ur5", "2").act(OBS), Policy.load(policies / "ur5" / "2").act(OBS))
    assert 0 < newest.infer_ms < 1000


def test_a_bundle_a_policy_folder_and_a_repository_load_and_repeats_count_once(policies: Path) -> None:
    store = load_store(policies / "ur5" / "1", policies / "ur5", policies / "gridworld", policies)
    assert store.versions("ur5") == ("1", "2", "10")


def test_unknown_names_and_versions_say_what_there_is(policies: Path) -> None:
    store = load_store(policies)
    with pytest.raises(UnknownPolicyError, match="no policy 'ur6' is loaded: this server has gridworld, ur5"):
        store.get("ur6")
    with pytest.raises(UnknownVersionError, match="no version '3': expected one of 1, 2, 10"):
        store.get("ur5", "3")
    with pytest.raises(UnknownVersionError):
        store.get("ur5", "../../etc")


def test_two_bundles_of_the_same_name_and_version_are_refused_and_a_copy_counts_once(
    policies: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(policies / "ur5" / "1", tmp_path / "elsewhere"))
    assert load_store(policies / "ur5" / "1", copy).versions("ur5") == ("1",)
    other = write_box_policy(tmp_path / "other", version="1", seed=7)
    with pytest.raises(UsageError, match="policy 'ur5' version 1 is in both"):
        load_store(policies / "ur5" / "1", other)


def test_versions_that_compare_equal_are_refused(tmp_path: Path) -> None:
    write_box_policy(tmp_path, version="1")
    write_box_policy(tmp_path, version="1.0.0")
    with pytest.raises(ConflictError, match="policy 'ur5': two versions compare equal"):
        load_store(tmp_path)


def test_every_broken_bundle_is_listed_and_nothing_is_served(policies: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(policies, tmp_path / "copy"))
    (root / "ur5" / "2" / "policy.onnx").write_bytes(b"")
    (root / "gridworld" / "1" / "golden.npz").unlink()
    with pytest.raises(BundleError) as caught:
        load_store(root)
    message = caught.value.message
    assert message.startswith("2 bundles cannot be served")
    assert "policy.onnx" in message and "golden.npz is missing" in message
    (root / "ur5" / "1" / "contract.json").unlink()
    with pytest.raises(BundleError) as caught:  # what the folders lack comes before any bundle is loaded
        load_store(root, tmp_path / "nowhere")
    message = caught.value.message
    assert message.startswith("2 bundles cannot be served")
    assert "contract.json" in message and "nowhere does not exist" in message


def test_no_folder_at_all_is_refused() -> None:
    with pytest.raises(UsageError, match="no policy to serve"):
        load_store()
