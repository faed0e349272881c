"""A static folder with a page of one or more bundles."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.bundle import ONNX_FILE, Bundle, load_bundle
from rlservo.bundle.spaces import leaf_specs
from rlservo.deploy.page.npm_packages import libraries
from rlservo.deploy.page.robot_facts import robot_facts
from rlservo.errors import UsageError
from rlservo.export.card import card
from rlservo.policy.loading import GOLDEN_ATOL, GOLDEN_RTOL
from rlservo.policy.policy import Policy

MAX_BYTES = 25_000_000  # of the whole page: a phone loads it
LIST = "policies.json"  # the page's policies, and every file of it: how a page that may be replaced is known
DTYPES = {"float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "bool"}
STATIC = Path(__file__).with_name("static")


def write_site(bundles: Sequence[Path], out: Path, say: Callable[[str], None]) -> dict[str, int]:
    """Write the page of these bundle folders and return the size of its files by name.

    An earlier page in `out` is replaced. Raises UsageError if `out` holds anything else, the page would be larger than
    25 MB or a browser cannot compute the policy, and what `load_bundle` and `Policy.load` raise.
    """
    _check_out(out)
    loaded = [load_bundle(folder) for folder in bundles]
    size = sum(bundle.onnx.stat().st_size for bundle in loaded)
    if size > MAX_BYTES:
        raise _too_large(size)
    files = {f"lib/{name}": content for name, content in libraries(say).items()}
    files |= {file.name: file.read_bytes() for file in STATIC.iterdir()}
    policies = []
    for bundle in loaded:
        say(f"recording {bundle.contract.name}")
        folder = f"policies/{bundle.contract.name}"
        if f"{folder}/facts.json" in files:
            raise UsageError(f"two of the bundles are called {bundle.contract.name!r}: give one of them")
        files |= {f"{folder}/{name}": content for name, content in _policy_files(bundle).items()}
        policies.append({"name": bundle.contract.name, "version": bundle.contract.version})
    files[LIST] = json.dumps({"policies": policies, "files": sorted([*files, LIST])}).encode()
    if (size := sum(map(len, files.values()))) > MAX_BYTES:
        raise _too_large(size)
    _write(files, out)
    return {name: len(content) for name, content in files.items()}


def _too_large(size: int) -> UsageError:
    return UsageError(f"the page would have {size / 1e6:.1f} MB: at most {MAX_BYTES / 1e6:.0f} MB; give fewer bundles")


def _policy_files(bundle: Bundle) -> dict[str, bytes]:
    contract, data = bundle.contract, bytearray()
    strange = {tensor.dtype for tensor in (*contract.inputs, *contract.outputs)} - DTYPES
    if strange:
        raise UsageError(f"policy {contract.name!r} has {', '.join(sorted(strange))}, which browsers lack")

    def keep(array: NDArray[Any]) -> dict[str, Any]:
        data.extend(bytes(-len(data) % 8))
        place = {"dtype": str(array.dtype), "shape": array.shape, "offset": len(data)}
        data.extend(np.ascontiguousarray(array).tobytes())
        return place

    with Policy.load(bundle.path) as policy:  # replays the golden values
        robot = robot_facts(contract, policy, keep)
    inputs, outputs = bundle.golden()
    facts = {
        "name": contract.name,
        "version": contract.version,
        "rate": contract.control_rate_hz,
        "inputs": [tensor.model_dump() for tensor in contract.inputs],
        "outputs": [tensor.model_dump() for tensor in contract.outputs],
        "state": [state.model_dump() for state in contract.state],
        "observation": _leaves(contract.observation_space, "obs"),
        "action": _leaves(contract.action_space, "action"),
        "golden": {
            "inputs": {name: keep(array) for name, array in inputs.items()},
            "outputs": {name: keep(array) for name, array in outputs.items()},
            "rtol": max(contract.parity.rtol, GOLDEN_RTOL),
            "atol": max(contract.parity.atol, GOLDEN_ATOL),
        },
        "robot": robot,
        "card": card(contract),
    }
    with bundle.verified_copy(ONNX_FILE) as graph:
        return {
            "policy.onnx": graph.read_bytes(),
            "facts.json": json.dumps(facts).encode(),
            "data.bin": bytes(data),
        }


def _leaves(space: Any, root: str) -> dict[str, Any]:
    """Return a space's leaves, with a bound for each element; null is unbounded."""
    leaves: dict[str, Any] = {}
    for name, leaf in leaf_specs(space, root).items():
        leaves[name] = {
            "bounds": [
                [value if np.isfinite(value) else None for value in side.ravel().tolist()] for side in leaf.bounds()
            ],
            "elements": [element.model_dump() for element in leaf.elements],
        }
    return leaves


def _check_out(out: Path) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    try:
        known = {*json.loads((out / LIST).read_text(encoding="utf-8"))["files"]}
    except (OSError, ValueError, KeyError, TypeError):
        known = set()
    found = {str(path.relative_to(out)) for path in out.rglob("*") if not path.is_dir()} if out.is_dir() else {out.name}
    if strange := sorted(found - known):
        raise UsageError(
            f"{out} holds {strange[0]}, which is not part of a page that rlservo wrote: name another folder"
        )


def _write(files: dict[str, bytes], out: Path) -> None:
    """Write a complete new folder, then put it in the place of the old one."""
    out.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        for name, content in files.items():
            file = made / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        made.chmod(0o755)  # a web server may be another user
        if out.exists():
            shutil.rmtree(out)
        made.rename(out)
    finally:
        shutil.rmtree(made, ignore_errors=True)
