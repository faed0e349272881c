"""`rlservo inspect --bom`: checked with CycloneDX's own schema, and against the files and the training script."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from bundles import rewrite_contract
from command_line import rlservo_here
from rlservo.bundle.contract import Evaluation

pytest.importorskip("cyclonedx")
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator


def made(bundle: Path, file: Path) -> dict[str, Any]:
    said = rlservo_here("inspect", bundle, "--bom", file)
    assert said.returncode == 0, said.stderr
    text = file.read_text()
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(text) is None
    parsed: dict[str, Any] = json.loads(text)
    references = [part["bom-ref"] for part in (*parsed["components"], parsed["metadata"]["component"])]
    assert len(set(references)) == len(references)
    return parsed


def test_it_lists_what_a_policy_was_made_of(all_shipped: Path, tmp_path: Path) -> None:
    for policy in sorted(all_shipped.iterdir()):
        if not policy.is_dir() or policy.name.startswith("."):
            continue
        parsed = made(policy, tmp_path / "bom.json")
        (bundle,) = (folder for folder in policy.iterdir() if folder.is_dir() and not folder.name.startswith("."))
        hashes = {part["name"]: part["hashes"][0]["content"] for part in parsed["components"] if "hashes" in part}
        for file in ("policy.onnx", "policy.ts", "contract.json", "golden.npz"):
            assert hashes[file] == hashlib.sha256((bundle / file).read_bytes()).hexdigest()
        whole = hashlib.sha256((bundle / "SHA256SUMS").read_bytes()).hexdigest()
        assert parsed["metadata"]["component"]["hashes"][0]["content"] == whole
        versions = {part["name"]: part["version"] for part in parsed["components"] if part["type"] == "library"}
        assert versions["torch"] and len(versions) >= 2
        assert set(parsed["dependencies"][0]["dependsOn"]) == {part["bom-ref"] for part in parsed["components"]}


def test_evaluations_are_its_metrics(ur5: Path, tmp_path: Path) -> None:
    bundle = shutil.copytree(ur5, tmp_path / "ur5" / "1")
    evaluation = Evaluation(
        env_id="rlservo/EndEffectorPositioningURSim-v0", episodes=200, first_seed=0, return_bundle=1.83,
        success_rate_bundle=0.985, success_interval=(0.957, 0.995), evaluated_at="2026-11-29T00:00:00+00:00",
    )  # fmt: skip
    rewrite_contract(bundle, evaluations=(evaluation,))
    parsed = made(bundle, tmp_path / "bom.json")
    first, second = parsed["metadata"]["component"]["modelCard"]["quantitativeAnalysis"]["performanceMetrics"]
    assert (first["value"], first["confidenceInterval"]) == ("0.985", {"lowerBound": "0.957", "upperBound": "0.995"})
    assert (second["type"], second["value"]) == ("mean return", "1.83") and "200 episodes" in second["slice"]
    both = rlservo_here("inspect", bundle, "--bom", tmp_path / "b", "--card", tmp_path / "c")
    assert both.returncode == 2 and "give one of them" in both.stderr
