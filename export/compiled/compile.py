"""Bundle as one C file with header and self-test, proven if there is a compiler: `rlservo compile`."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.bundle.bundle import CONTRACT_FILE, ONNX_FILE, load_bundle
from rlservo.errors import UsageError
from rlservo.export.compiled.c_source import write_source
from rlservo.export.compiled.interface import header_text, interface_of
from rlservo.export.compiled.moved_weights import MovedGraph
from rlservo.export.compiled.proof import Proof, find_compiler, moved_inputs, must_not_leave, prove
from rlservo.export.compiled.self_test import self_test_text
from rlservo.export.compiled.static_graph import read_static_graph
from rlservo.export.compiled.tolerance import allowed_differences
from rlservo.policy.compiled_policy import COMPILE_FILE, acting_contract
from rlservo.policy.loading import open_graph
from rlservo.policy.policy import Policy

MOVED = 4  # draws of the last bits, of which the largest movement counts: in one draw movements may cancel out
NO_COMPILER = "no C compiler was found; run the self-test on a machine that has one"


@dataclass(frozen=True)
class Compiled:
    """Files that were written, and their proof."""

    folder: Path
    about: Mapping[str, Any]
    """As `compile.json` has it."""
    proof: Proof | None
    """None without a compiler."""


def compile_bundle(
    path: str | Path,
    out: str | Path,
    *,
    compiler: str | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> Compiled:
    """Write the bundle at `path` as C into the folder `out`, all of it or nothing.

    `compiler` is the one to prove it with ($CC or the machine's own by default). Raises what `Policy.load` does for a
    bundle, UnsupportedError for an operator without C code, ParityError if the compiled policy differs from
    onnxruntime, and UsageError.
    """
    folder, chosen = Path(out), find_compiler(compiler)
    progress("reading the bundle")
    bundle = load_bundle(path)
    Policy.load(bundle.path).close()  # every check that serving makes
    contract, (golden, recorded) = bundle.contract, bundle.golden()
    earlier = _earlier(folder, contract.name)
    ort_run: Callable[..., Sequence[Any]] = open_graph(bundle, 1).run
    progress("writing C")
    face = interface_of(contract)
    with bundle.verified_copy(ONNX_FILE) as file:
        model = file.read_bytes()
    wanted = [tensor.name for tensor in acting_contract(contract).outputs]
    graph = read_static_graph(model, wanted, {tensor.name: golden[tensor.name][:1] for tensor in contract.inputs})
    source = write_source(face, contract, graph)
    rng = np.random.default_rng(2)
    moved_graphs = [MovedGraph(model, rng) for _ in range(MOVED)]
    moved = [graph(moved_inputs(golden, rng)) for graph in moved_graphs]
    allowed, refused = allowed_differences(contract, recorded, moved), must_not_leave(contract, recorded)
    texts = {
        f"{face.prefix}.c": source.text,
        f"{face.prefix}.h": header_text(face, contract, bundle.digest, source.scratch),
        f"{face.prefix}_test.c": self_test_text(face, golden, recorded, allowed, refused),
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".rlservo-compile-", dir=folder.parent) as name:
        beside = Path(name)
        for file_name, text in texts.items():
            (beside / file_name).write_text(text, encoding="utf-8")
        shutil.copyfile(bundle.path / CONTRACT_FILE, beside / CONTRACT_FILE)
        proof, library = None, None
        if chosen is not None:
            library, names = f"lib{face.prefix}.so", [tensor.name for tensor in contract.outputs]
            progress(f"proving it with {Path(chosen).name} and 10,000 observations")
            with np.errstate(over="ignore"):
                proof = prove(
                    contract, chosen, beside, face.prefix, library,
                    lambda feed: dict(zip(names, ort_run(names, dict(feed)), strict=True)), moved_graphs, golden,
                )  # fmt: skip
            (beside / f"{face.prefix}_test").unlink()
        about = {
            "policy": contract.name,
            "version": contract.version,
            "bundle": bundle.digest,
            "prefix": face.prefix,
            "rlservo": installed_version("rlservo"),
            "library": library,
            "unproven": None if proof is not None else NO_COMPILER,
            "proof": None if proof is None else asdict(proof),
            "files": {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in sorted(beside.iterdir())},
        }
        (beside / COMPILE_FILE).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        _take_places(beside, folder, earlier)
    return Compiled(folder, about, proof)


def _earlier(folder: Path, name: str) -> dict[str, str]:
    """Return the hashes of what an earlier compilation of this policy left in the folder.

    Raises UsageError if something else in the folder has its name.
    """
    file = folder / COMPILE_FILE
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file: expected a folder to write the C into")
    if not file.exists():
        return {}
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
        policy, hashes = str(about["policy"]), dict(about["files"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} is not what `rlservo compile` wrote: choose another folder") from error
    if policy != name:
        raise UsageError(f"{folder} holds the compiled policy '{policy}': give '{name}' a folder of its own")
    return {**hashes, COMPILE_FILE: hashlib.sha256(file.read_bytes()).hexdigest()}


def _take_places(beside: Path, folder: Path, earlier: Mapping[str, str]) -> None:
    """Move the files into the folder; only an earlier compilation's files are replaced."""
    folder.mkdir(exist_ok=True)
    for name in {*earlier, *(file.name for file in beside.iterdir())}:
        there = folder / name
        if there.exists() and hashlib.sha256(there.read_bytes()).hexdigest() != earlier.get(name):
            raise UsageError(f"{there} is not what `rlservo compile` wrote: nothing was overwritten")
    for name in earlier:  # such as a library that was proven
        (folder / name).unlink(missing_ok=True)
    for file in sorted(beside.iterdir()):
        file.replace(folder / file.name)
