"""Nested observations and actions: between what a caller holds and the graph's tensors `obs.<path>`, `action.<path>`.

A Dict is a map with exactly its keys, a Tuple a list of exactly its length. A batch has a batch axis on every leaf, as
Gymnasium's vector environments give it; for a Dict, a list of single observations is a batch, too. It knows numpy and
the contract's spaces only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.bundle import DictSpec, SpaceSpec, TupleSpec, leaf_specs
from rlservo.export.contract.errors import ObservationError, RequestError
from rlservo.serve_app.runtime.observations import ObservationReader
from rlservo.serve_app.runtime.options import DEFAULT_OPTIONS, PolicyOptions


class StructureReader:
    """Reads observations of any space for one policy."""

    def __init__(
        self,
        policy: str,
        space: SpaceSpec,
        *,
        options: PolicyOptions = DEFAULT_OPTIONS,
        notice: Callable[[str], None] | None = None,
    ) -> None:
        self._policy = policy
        self._space = space
        self._readers = {
            name: ObservationReader(policy, leaf, name, options=options, notice=notice)
            for name, leaf in leaf_specs(space, "obs").items()
        }

    def watch(self, name: str, see: Callable[[NDArray[Any]], None]) -> None:
        """Show `see` the checked observations of the leaf `name`."""
        self._readers[name].watch = see

    def read(self, obs: Any) -> tuple[dict[str, NDArray[Any]], bool]:
        """Return (`[batch, ...]` by the graph's input names, whether `obs` was a batch).

        Raises ObservationError, which names the path of what does not fit.
        """
        if isinstance(self._space, DictSpec) and isinstance(obs, list | tuple) and obs and isinstance(obs[0], Mapping):
            return self._read_list(obs), True
        leaves: dict[str, Any] = {}
        self._collect(self._space, obs, "obs", leaves)
        arrays: dict[str, NDArray[Any]] = {}
        sizes: dict[str, int | None] = {}
        for name, reader in self._readers.items():
            arrays[name], batch = reader.read(leaves[name])
            sizes[name] = len(arrays[name]) if batch else None
        if len(set(sizes.values())) > 1:
            told = ", ".join(
                f"{name} {'one' if size is None else f'a batch of {size}'}" for name, size in sizes.items()
            )
            self._refuse("obs", f"its parts are not of one batch ({told})")
        return arrays, next(iter(sizes.values())) is not None

    def _read_list(self, observations: Sequence[Any]) -> dict[str, NDArray[Any]]:
        rows: list[dict[str, NDArray[Any]]] = []
        for index, one in enumerate(observations):
            try:
                arrays, batch = self.read(one)
            except ObservationError as error:
                raise ObservationError(f"observation {index}: {error.message}", error.details) from error
            if batch:
                self._refuse("obs", f"observation {index} of the list is a batch itself")
            rows.append(arrays)
        return {name: np.concatenate([row[name] for row in rows]) for name in self._readers}

    def _collect(self, space: SpaceSpec, value: Any, path: str, leaves: dict[str, Any]) -> None:
        if isinstance(space, DictSpec):
            if not isinstance(value, Mapping):
                self._refuse(
                    path, f"expected a map with the keys {', '.join(sorted(space.spaces))}, got {_kind(value)}"
                )
            missing = sorted(set(space.spaces) - set(value))
            unknown = sorted(str(key) for key in value if key not in space.spaces)
            if missing or unknown:
                parts = [f"missing {', '.join(missing)}"] if missing else []
                parts += [f"unknown {', '.join(name[:64] for name in unknown[:8])}"] if unknown else []
                self._refuse(path, "; ".join(parts))
            for key, child in space.spaces.items():
                self._collect(child, value[key], f"{path}.{key}", leaves)
        elif isinstance(space, TupleSpec):
            if not isinstance(value, list | tuple) or len(value) != len(space.spaces):
                got = f"{len(value)} of them" if isinstance(value, list | tuple) else _kind(value)
                self._refuse(path, f"expected a list of its {len(space.spaces)} parts, got {got}")
            for index, child in enumerate(space.spaces):
                self._collect(child, value[index], f"{path}.{index}", leaves)
        else:
            leaves[path] = value

    def _refuse(self, path: str, why: str) -> NoReturn:
        raise ObservationError(f"policy '{self._policy}' cannot read {path}: {why}", {"policy": self._policy})


def build_action(space: SpaceSpec, leaves: Mapping[str, Any], path: str = "action") -> Any:
    """Return the action in the space's own form: dicts and tuples of its leaves, which come by tensor name."""
    if isinstance(space, DictSpec):
        return {key: build_action(child, leaves, f"{path}.{key}") for key, child in space.spaces.items()}
    if isinstance(space, TupleSpec):
        return tuple(build_action(child, leaves, f"{path}.{index}") for index, child in enumerate(space.spaces))
    return leaves[path]


def action_leaves(space: SpaceSpec, action: Any, path: str = "action") -> dict[str, Any]:
    """Return a nested action's leaves by tensor name: `build_action`, undone.

    Raises RequestError where it is not of the space's form.
    """
    if isinstance(space, DictSpec):
        if not isinstance(action, Mapping) or set(action) != set(space.spaces):
            raise RequestError(f"{path} must be a map with the keys {', '.join(sorted(space.spaces))}")
        parts = [action_leaves(child, action[key], f"{path}.{key}") for key, child in space.spaces.items()]
    elif isinstance(space, TupleSpec):
        if not isinstance(action, list | tuple) or len(action) != len(space.spaces):
            raise RequestError(f"{path} must be a list of {len(space.spaces)} parts")
        parts = [action_leaves(child, action[i], f"{path}.{i}") for i, child in enumerate(space.spaces)]
    else:
        return {path: action}
    return {name: leaf for part in parts for name, leaf in part.items()}


def _kind(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return {"dict": "a map", "list": "a list", "str": "a string"}.get(type(value).__name__, f"a {type(value).__name__}")
