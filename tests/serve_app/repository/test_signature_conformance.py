"""Cases of OpenSSF Model Signing's conformance suite, in a checkout of it that RLSERVO_SIGNING_CASES names.

    git clone https://github.com/sampras343/model-signing-conformance
    RLSERVO_SIGNING_CASES=model-signing-conformance pytest tests/serve_app/repository/test_signature_conformance.py

The suite has no licence, so it is not part of this repository. Left out: Sigstore's identities, which rlservo does not
offer; files named with `ignore_unsigned_files`, since a bundle has no others; single files; and an expired certificate,
which test_signature.py has with bundles.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from rlservo.serve_app.repository.signature import SIGNATURE_FILE, read_signature, trusted

pytest.importorskip("model_signing")
SUITE = Path(os.environ.get("RLSERVO_SIGNING_CASES", "/nonexistent")) / "test"
BEFORE_THE_SPECIFICATION = "historical-v0.2.0-certificate"  # a format that rlservo refuses
CASES = sorted((SUITE / "test-cases" / "verify").glob("*/*/config.json"))


def is_ours(case: dict[str, Any]) -> bool:
    return case["method"] != "sigstore" and "." not in case.get("expected_signed_files", ())


def model_of(case: dict[str, Any], folder: Path, made: Path) -> None:
    """Copy a case's model, with its changes and without what it ignores, as a bundle's copy has only its own files."""
    root = folder if case.get("model_relative_to") == "test_dir" else SUITE / "assets"
    shutil.copytree(root / case["model"], made)
    changes = case.get("model_modifications", {})
    for name, text in {**changes.get("inject", {}), **changes.get("tamper", {})}.items():
        (made / name).write_text(text)
    for name in [*changes.get("delete", ()), *case["verify"].get("ignore_paths", ())]:
        (made / name).unlink(missing_ok=True)


@pytest.mark.skipif(not CASES, reason="RLSERVO_SIGNING_CASES names no checkout of the conformance suite")
def test_signatures_of_the_conformance_suite_are_judged_as_it_says(tmp_path: Path) -> None:
    judged, wrong = 0, []
    for number, file in enumerate(CASES):
        case, folder = json.loads(file.read_text()), file.parent
        options = case["verify"]
        if not is_ours(case) or "ignore_unsigned_files" in options or "expired" in folder.name:
            continue
        model_of(case, folder, model := tmp_path / str(number) / "model")
        if (signature := folder / "bundle.sig").exists():
            shutil.copyfile(signature, model.parent / SIGNATURE_FILE)
        key = SUITE / "assets" / (options.get("public_key") or options["cert_chain"][0])
        try:
            read_signature(model.parent)
            (verify,) = trusted(key).values()
            verify(model, model.parent / SIGNATURE_FILE)
        except Exception:
            accepted = False
        else:
            accepted = True
        judged += 1
        if accepted != (case.get("expect", "pass") == "pass" and folder.name != BEFORE_THE_SPECIFICATION):
            wrong.append(folder.name)
    assert judged >= 20
    assert not wrong
