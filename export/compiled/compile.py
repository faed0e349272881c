"""Bundle as one C file with header, self-test and build files, proven where there is a compiler: `rlservo compile`."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.build_files import build_files
from rlservo.export.compiled.interface import header_text, interface_of
from rlservo.export.compiled.proof import Proof, find_compiler, must_not_leave, prove
from rlservo.export.compiled.self_test import self_test_text
from rlservo.export.compiled.source import write_source
from rlservo.export.compiled.static_graph import read_static_graph
from rlservo.export.compiled.tolerance import allowed_differences
from rlservo.export.contract.bundle import CONTRACT_FILE, ONNX_FILE, load_bundle
from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.runtime.compiled_policy import COMPILE_FILE, acting_contract
from rlservo.serve_app.runtime.loading import check_contract, check_copy, check_golden_vectors, check_graph, open_graph

NO_COMPILER = "no C compiler was found; the self-test proves it where there is one"


@dataclass(frozen=True)
class Compiled:
    """What was written."""

    folder: Path
    about: Mapping[str, Any]
    """As `compile.json` has it."""
    proof: Proof | None
    """None where there was no compiler."""


def compile_bundle(
    path: str | Path,
    out: str | Path,
    *,
    compiler: str | None = None,
    weights_in_file: bool = False,
    progress: Callable[[str], object] = lambda _: None,
) -> Compiled:
    """Write the bundle at `path` as C into the folder `out`, all of it or nothing.

    `compiler` is the one to prove it with ($CC or the machine's own by default); `weights_in_file` puts the weights
    into a binary file beside the C. Raises what `Policy.load` does for a bundle, UnsupportedError, naming an operator
    that has no C, ParityError where the compiled policy differs from onnxruntime, and UsageError.
    """
    folder = Path(out)
    chosen = find_compiler(compiler)
    progress("reading the bundle")
    bundle = load_bundle(path)
    contract = bundle.contract
    check_contract(bundle)
    face = interface_of(contract)
    earlier = _check_free(folder, contract.name)
    ort_session = open_graph(bundle, 1)
    check_graph(bundle, ort_session)
    check_copy(bundle, ort_session)
    names = [tensor.name for tensor in contract.outputs]
    check_golden_vectors(bundle, ort_session.run, names)
    golden, recorded = bundle.golden()
    with bundle.verified_copy(ONNX_FILE) as file:
        model = file.read_bytes()
    progress("writing C")
    wanted = [tensor.name for tensor in acting_contract(contract).outputs]
    example = {tensor.name: golden[tensor.name][:1] for tensor in contract.inputs}
    graph = read_static_graph(model, wanted, example)
    source = write_source(face, contract, graph, weights_in_file=weights_in_file)
    refused = must_not_leave(contract, recorded)
    texts = {
        f"{face.prefix}.c": source.text,
        f"{face.prefix}.h": header_text(face, contract, bundle.digest, source.scratch),
        f"{face.prefix}_test.c": self_test_text(
            face, golden, recorded, allowed_differences(contract, recorded), refused
        ),
        **build_files(face.prefix, contract.version, None if source.weights is None else source.weights.nbytes),
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".rlservo-compile-", dir=folder.parent) as name:
        beside = Path(name)
        for file_name, text in texts.items():
            (beside / file_name).write_text(text, encoding="utf-8")
        if source.weights is not None:
            (beside / f"{face.prefix}_weights.bin").write_bytes(source.weights.astype("<f4").tobytes())
        shutil.copyfile(bundle.path / CONTRACT_FILE, beside / CONTRACT_FILE)
        proof, library = None, None
        if chosen is not None:
            library = f"lib{face.prefix}.so"
            progress(f"proving it with {Path(chosen).name} and 10,000 observations")

            def compute(feed: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
                computed: Sequence[Any] = ort_session.run(names, dict(feed))
                return dict(zip(names, computed, strict=True))

            with np.errstate(over="ignore"):
                proof = prove(contract, chosen, beside, face.prefix, library, compute, golden)
            (beside / f"{face.prefix}_test").unlink()
        about = {
            "policy": contract.name,
            "version": contract.version,
            "bundle": bundle.digest,
            "prefix": face.prefix,
            "rlservo": installed_version("rlservo"),
            "library": library,
            "unproven": None if proof is not None else NO_COMPILER,
            "proof": None if proof is None else proof.as_dict(),
            "files": {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in sorted(beside.iterdir())},
        }
        (beside / COMPILE_FILE).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        _take_places(beside, folder, earlier)
    return Compiled(folder, about, proof)


def _check_free(folder: Path, name: str) -> dict[str, str]:
    """Return the hashes of what an earlier compilation of this policy left in the folder.

    Raises UsageError where the folder has something that this would overwrite: what a user changed or put there.
    """
    if not folder.exists():
        return {}
    if not folder.is_dir():
        raise UsageError(f"{folder} is a file: expected a folder to write the C into")
    file = folder / COMPILE_FILE
    if not file.exists():
        return {}
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
        policy, hashes = str(about["policy"]), dict(about["files"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} is not what `rlservo compile` wrote: choose another folder") from error
    if policy != name:
        raise UsageError(f"{folder} holds the compiled policy '{policy}': give '{name}' a folder of its own")
    return hashes


def _take_places(beside: Path, folder: Path, earlier: Mapping[str, str]) -> None:
    """Move the files into the folder, whose own files of these names have to be an earlier compilation's."""
    folder.mkdir(exist_ok=True)
    for file in beside.iterdir():
        there = folder / file.name
        known = file.name == COMPILE_FILE and earlier
        if there.exists() and not known and hashlib.sha256(there.read_bytes()).hexdigest() != earlier.get(file.name):
            raise UsageError(f"{there} is not what `rlservo compile` wrote: nothing was overwritten")
    for name in set(earlier) - {file.name for file in beside.iterdir()}:  # such as a library that was proven
        (folder / name).unlink(missing_ok=True)
    for file in sorted(beside.iterdir()):
        file.replace(folder / file.name)
