"""Callers' observations as the graph's input tensors, for any space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.spaces import DictSpec, SpaceSpec, TupleSpec, leaf_specs
from rlservo.errors import ObservationError
from rlservo.policy.drift import Drift
from rlservo.policy.input_numbers import describe
from rlservo.policy.observation_leaf_check import LeafParser
from rlservo.policy.options import DEFAULT_OPTIONS, PolicyOptions

MOST_NOTICES = 16  # for a list of observations: the reply carries them


class Observed(NamedTuple):
    """A checked observation."""

    arrays: dict[str, NDArray[Any]]  # `[batch, ...]` by the graph's input names
    batch: bool  # whether it was given as a batch
    notices: tuple[str, ...]  # sentences about values that are out of bounds and used anyway


class ObservationParser:
    """Parses observations of any space for one policy."""

    def __init__(
        self,
        policy: str,
        space: SpaceSpec,
        *,
        options: PolicyOptions = DEFAULT_OPTIONS,
        drift: Drift | None = None,
    ) -> None:
        """`drift` is for a space that is a single array."""
        self._policy = policy
        self._space = space
        self.leaves = {
            name: LeafParser(policy, leaf, name, options=options, drift=drift)
            for name, leaf in leaf_specs(space, "obs").items()
        }

    def parse(self, obs: Any) -> Observed:
        """Raise ObservationError, which names the path of the unfit part."""
        if isinstance(self._space, DictSpec) and isinstance(obs, list | tuple) and obs and isinstance(obs[0], Mapping):
            return self._parse_list(obs)
        leaves: dict[str, Any] = {}
        self._collect(self._space, obs, "obs", leaves)
        arrays: dict[str, NDArray[Any]] = {}
        sizes: dict[str, int | None] = {}
        notices: tuple[str, ...] = ()
        for name, parser in self.leaves.items():
            arrays[name], batch, notice = parser.parse(leaves[name])
            sizes[name] = len(arrays[name]) if batch else None
            if notice:
                notices += (notice,)
        if len(set(sizes.values())) > 1:
            parts = ", ".join(
                f"{name} {'one' if size is None else f'a batch of {size}'}" for name, size in sizes.items()
            )
            self._refuse("obs", f"its parts have different batch sizes ({parts})")
        return Observed(arrays, next(iter(sizes.values())) is not None, notices)

    def _parse_list(self, observations: Sequence[Any]) -> Observed:
        rows: list[Observed] = []
        for index, one in enumerate(observations):
            try:
                row = self.parse(one)
            except ObservationError as error:
                raise ObservationError(f"observation {index}: {error.message}", error.details) from error
            if row.batch:
                self._refuse("obs", f"observation {index} of the list is itself a batch")
            rows.append(row)
        arrays = {name: np.concatenate([row.arrays[name] for row in rows]) for name in self.leaves}
        return Observed(arrays, True, tuple(notice for row in rows for notice in row.notices)[:MOST_NOTICES])

    def _collect(self, space: SpaceSpec, value: Any, path: str, leaves: dict[str, Any]) -> None:
        if isinstance(space, DictSpec):
            if not isinstance(value, Mapping):
                self._refuse(
                    path, f"expected a map with the keys {', '.join(sorted(space.spaces))}, got {describe(value)}"
                )
            missing = sorted(set(space.spaces) - set(value))
            unknown = sorted(str(key) for key in value if key not in space.spaces and key not in space.ignored)
            if missing or unknown:
                parts = [f"missing {', '.join(missing)}"] if missing else []
                parts += [f"unknown {', '.join(name[:64] for name in unknown[:8])}"] if unknown else []
                self._refuse(path, "; ".join(parts))
            for key, child in space.spaces.items():
                self._collect(child, value[key], f"{path}.{key}", leaves)
        elif isinstance(space, TupleSpec):
            if not isinstance(value, list | tuple) or len(value) != len(space.spaces):
                got = f"{len(value)} of them" if isinstance(value, list | tuple) else describe(value)
                self._refuse(path, f"expected a list of {len(space.spaces)} parts, got {got}")
            for index, child in enumerate(space.spaces):
                self._collect(child, value[index], f"{path}.{index}", leaves)
        else:
            leaves[path] = value

    def _refuse(self, path: str, why: str) -> NoReturn:
        raise ObservationError(f"policy '{self._policy}' cannot read {path}: {why}", {"policy": self._policy})
