"""Copy of a bundle under another version number, with everything else as it was proven."""

from __future__ import annotations

import shutil
from pathlib import Path

from rlservo.bundle.bundle import CONTRACT_KEY, ONNX_FILE, Bundle, load_bundle, write_contract
from rlservo.bundle.contract import contract_json
from rlservo.export.bundle_names import check_names


def renumber(bundle: Bundle, version: str, out: Path) -> Bundle:
    """Copy a bundle to `out/<name>/<version>/`; the number also goes into its contract and the graph's copy of it.

    Needs onnx. Raises UsageError for an invalid version, and BundleError.
    """
    from rlservo.export.graph.onnx_file import add_metadata

    check_names(None, version)
    folder = out / bundle.contract.name / version
    folder.mkdir(parents=True)
    for file in bundle.sums:  # a signature would be of the other number
        shutil.copyfile(bundle.path / file, folder / file)
    contract = bundle.contract.model_copy(update={"version": version})
    add_metadata(folder / ONNX_FILE, {CONTRACT_KEY: contract_json(contract)})
    write_contract(folder, contract)
    return load_bundle(folder)
