"""Policy compiled to C by `rlservo compile`, in this process: the same `act`, without onnxruntime.

Its folder has the shared library that was proven on this machine. A library is executable code: load only your own.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.bundle import CONTRACT_FILE, Bundle, read_contract
from rlservo.bundle.contract import REWARD, Contract
from rlservo.bundle.spaces import leaf_specs
from rlservo.errors import ActionError, BundleError, BundleTamperedError, ObservationError
from rlservo.policy.options import DEFAULT_OPTIONS, PolicyOptions
from rlservo.policy.policy import Policy

COMPILE_FILE = "compile.json"
REFUSED = {
    2: "an observation is not a finite number", 3: "an observation is not one of its choices",
    4: "the network computed an action that is not a finite number",
    5: "the network computed an action outside the action space",
}  # fmt: skip
"""Kinds of result codes without an action (written by `export/compiled/interface.py`)."""


class CompiledPolicy(Policy):
    """A compiled policy.

    ```python
    policy = CompiledPolicy("build")  # the folder that `rlservo compile policies/ur5 --out build` wrote
    action = policy.act(obs)
    ```

    It acts, remembers and checks as `Policy` does, one observation at a time; it cannot explore and has no value.
    """

    def __init__(self, path: str | Path, *, options: PolicyOptions = DEFAULT_OPTIONS) -> None:
        """Load the folder's library. Raises BundleError if it has none, BundleTamperedError if it is not proven."""
        folder = Path(path)
        about = _read_about(folder)
        contract = acting_contract(read_contract(folder))
        if about.get("library") is None:
            raise BundleError(f"{folder} has no library: it was written without a C compiler ({about.get('unproven')})")
        file = folder / str(about["library"])
        recorded = about["files"]
        for each in (file, folder / CONTRACT_FILE):
            try:
                actual = hashlib.sha256(each.read_bytes()).hexdigest()
            except OSError as error:
                raise BundleError(f"{each} cannot be read: {error.strerror}") from error
            if actual != recorded.get(each.name):
                raise BundleTamperedError(f"{each} is not the proven file: {COMPILE_FILE} has another hash")
        library = CompiledLibrary(file, about["prefix"], contract)
        if library.bundle != about["bundle"]:
            raise BundleTamperedError(f"{file} was compiled from a different bundle than {COMPILE_FILE} names")
        bundle = Bundle(folder, contract, recorded, about["bundle"])
        super().__init__(bundle, cast(Any, library), options, graph_hash=recorded[file.name])


def open_policy(path: str | Path, *, options: PolicyOptions = DEFAULT_OPTIONS, check_golden: bool = True) -> Policy:
    """Return the policy of a bundle, or of a folder written by `rlservo compile`. Raises the errors of both."""
    if (Path(path) / COMPILE_FILE).is_file():
        return CompiledPolicy(path, options=options)
    return Policy.load(path, options=options, check_golden=check_golden)


def acting_contract(contract: Contract) -> Contract:
    """Return the contract of the acting part: no distribution, no value."""
    wanted = {*leaf_specs(contract.action_space, "action"), *(f"state_out.{state.name}" for state in contract.state)}
    outputs = tuple(tensor for tensor in contract.outputs if tensor.name in wanted)
    return contract.model_copy(update={"distribution": None, "outputs": outputs})


def _read_about(folder: Path) -> dict[str, Any]:
    file = folder / COMPILE_FILE
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(about["files"], dict) or not isinstance(about["prefix"], str) or not about["bundle"]:
            raise ValueError("it lacks fields that `rlservo compile` writes")
    except FileNotFoundError as error:
        raise BundleError(f"{folder} holds no compiled policy: expected {COMPILE_FILE} (`rlservo compile`)") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BundleError(f"{file} cannot be read: {error}") from error
    return dict(about)


class CompiledLibrary:
    """The functions of a shared library, with the interface of onnxruntime's session: `run`."""

    def __init__(self, file: Path, prefix: str, contract: Contract) -> None:
        """Load the library. Raises BundleError if it cannot be loaded, or is not of a compiled policy."""
        try:
            library = ctypes.CDLL(str(file.resolve()))
            self._act, self._reset, self._element = (
                library[f"{prefix}_{name}"] for name in ("act", "reset", "element")
            )
            self.state_size = ctypes.c_size_t.in_dll(library, f"{prefix}_state_size").value
            self.bundle = ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(library, f"{prefix}_bundle"))).decode()
        except (OSError, AttributeError, ValueError) as error:
            raise BundleError(f"{file} is not the library of a compiled policy: {error}") from error
        self._act.restype, self._act.argtypes = ctypes.c_int32, [ctypes.c_void_p] * 3
        self._element.restype, self._element.argtypes = ctypes.c_char_p, [ctypes.c_int32]
        self._policy = contract.name
        observed, acted = leaf_specs(contract.observation_space, "obs"), leaf_specs(contract.action_space, "action")
        obs = [(name, leaf.dtype, leaf.shape) for name, leaf in observed.items()]
        if contract.has_reward:
            obs.append((REWARD, "float32", ()))
        # numpy lays structs out as C does. The state begins with the remembered values; working memory follows.
        self._structs = (
            np.dtype(obs, align=True),
            np.dtype([(f"state_in.{state.name}", state.dtype, state.shape) for state in contract.state], align=True),
            np.dtype([(name, leaf.dtype, leaf.shape) for name, leaf in acted.items()], align=True),
        )
        self._outputs = {tensor.name: tensor for tensor in contract.outputs}
        self._own = threading.local()

    def run(self, names: Sequence[str], feed: Mapping[str, NDArray[Any]], _options: Any = None) -> list[NDArray[Any]]:
        """Return the named outputs `[batch, ...]`, computed row by row. Raises the error of a refused row."""
        codes, outputs = self.step(feed)
        for code in codes[is_refused(codes)][:1].tolist():
            kind, element = code >> 24, self._element(code).decode("utf-8", "replace")
            sentence = (
                f"policy '{self._policy}': {REFUSED.get(kind, f'result {kind}')}: element {code & 0xFFFFFF} ({element})"
            )
            raise (ObservationError if kind <= 3 else ActionError)(sentence, {"policy": self._policy, "code": code})
        return [outputs[name] for name in names]

    def step(self, feed: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.int32], dict[str, NDArray[Any]]]:
        """Return (each row's result code, every output `[batch, ...]`, with zeros for a refused row)."""
        places, pointers = self._memory()
        rows = len(next(iter(feed.values())))
        codes = np.zeros(rows, np.int32)
        outputs = {name: np.zeros((rows, *one.shape[1:]), one.dtype) for name, one in self._outputs.items()}
        written = [(out, places[name.replace("state_out.", "state_in.", 1)]) for name, out in outputs.items()]
        given = [(places[name], array) for name, array in feed.items()]
        for row in range(rows):
            for place, array in given:
                place[...] = array[row]
            codes[row] = code = self._act(*pointers)
            if not is_refused(code):
                for out, place in written:
                    out[row] = place.reshape(out.shape[1:])
        return codes, outputs

    def _memory(self) -> tuple[dict[str, NDArray[Any]], tuple[int, ...]]:
        """Return this thread's structs: the array of each tensor, and the structs' addresses."""
        if not hasattr(self._own, "structs"):
            places: dict[str, NDArray[Any]] = {}
            raws = []
            for struct, size in zip(self._structs, (0, self.state_size, 0), strict=True):
                raws.append(np.zeros(max(struct.itemsize, size, 1) // 8 + 1, np.int64))
                members = np.frombuffer(raws[-1], struct, 1) if struct.itemsize else None
                places |= {name: members[name][0, ...] for name in struct.names or ()} if members is not None else {}
            self._own.structs = places, tuple(raw.ctypes.data for raw in raws), raws
        return self._own.structs[:2]  # type: ignore[no-any-return]


def is_refused(code: Any) -> Any:
    """Return whether a result code (or each of an array) means that there is no action."""
    return code >> 24 >= min(REFUSED)
