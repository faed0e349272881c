"""Messages of one policy: its contract's spaces as JSON with named elements, and back bit for bit.

A float32 is written with the fewest digits that give the same float32 again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract, contract_json
from rlservo.bundle.log_probability import log_probability
from rlservo.bundle.nested import action_leaves
from rlservo.bundle.spaces import DictSpec, DiscreteSpec, LeafSpec, SpaceSpec, TupleSpec, leaf_specs
from rlservo.errors import RequestError

Leaves = Mapping[str, NDArray[Any]]


class LeafArrays(dict[str, NDArray[Any]]):
    """A value, or a batch of them, as arrays by tensor name, `[batch, *shape]`."""


class PolicyFormat:
    """Format of one policy's decisions; one object per policy, version and graph."""

    def __init__(self, contract: Contract, *, graph_hash: str = "", options: Mapping[str, Any] | None = None) -> None:
        """`graph_hash` is empty if only a server knows it; `options` are those of `PolicyOptions` that were set."""
        self.contract = contract
        self.graph_hash = graph_hash
        self.options = dict(options or {})
        self.contract_document = contract_json(contract).encode()
        self.contract_hash = hashlib.sha256(self.contract_document).hexdigest()
        self.observations = SpaceFormat(contract.observation_space, "obs")
        self.actions = SpaceFormat(contract.action_space, "action")

    @property
    def title(self) -> str:
        return f"{self.contract.name}/{self.contract.version}"

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """Identity of a recorded policy."""
        options = json.dumps(self.options, sort_keys=True)
        return self.contract.name, self.contract.version, self.graph_hash, self.contract_hash, options

    @property
    def record_bytes(self) -> int:
        """Approximate memory [bytes] of one decision that waits for the writer."""
        spaces = (self.contract.observation_space, self.contract.action_space)
        return 1000 + sum(
            leaf.size * np.dtype(leaf.dtype).itemsize for space in spaces for leaf in leaf_specs(space, "").values()
        )

    def log_probability(self, inputs: NDArray[Any], own: Leaves) -> NDArray[np.float64] | None:
        """Return the log-probability of each row's own action; None if the policy has no distribution."""
        if self.contract.distribution is None:
            return None
        return log_probability(inputs, own, self.contract.distribution, self.contract.action_space)


class SpaceFormat:
    """Values of one space as JSON text, and in columns."""

    def __init__(self, space: SpaceSpec, path: str) -> None:
        self._space = space
        self._path = path
        self.leaves = leaf_specs(space, path)
        self._formats = {name: _LeafFormat(name, leaf) for name, leaf in self.leaves.items()}
        self._is_leaf = path in self.leaves
        self._template = self._nest(space, path)

    def arrays(self, value: Any) -> LeafArrays:
        """Return one value, or a batch, as `[rows, *shape]` in the space's own types.

        Raises ValueError or RequestError if the value is not of the space.
        """
        parts = value if isinstance(value, LeafArrays) else self._parts(value)
        return LeafArrays({name: self._formats[name].array(parts[name]) for name in self.leaves})

    def encode_rows(self, value: Any) -> list[bytes]:
        """Return the JSON of each row of `arrays`' input."""
        parts = value if isinstance(value, LeafArrays) else self._parts(value)
        columns = [self._formats[name].encode_rows(parts[name]) for name in self.leaves]
        return columns[0] if self._is_leaf else [self._template % row for row in zip(*columns, strict=True)]

    def count_rows(self, value: Any) -> int:
        """Return the number of values in an array, or in nested arrays."""
        return max(1, _total_size(value) // sum(leaf.size for leaf in self.leaves.values()))

    def columns(self, documents: Sequence[Any]) -> dict[str, NDArray[Any]]:
        """Return the leaves `[len(documents), *shape]` of parsed values; a value of None becomes zeros."""
        found: dict[str, NDArray[Any]] = {}
        self._columns(self._space, self._path, documents, found)
        return found

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema of one value, its numbers with their units."""
        return self._schema(self._space, self._path)

    def labels(self, name: str) -> list[str]:
        """Return the names of a leaf's elements."""
        return self._formats[name].labels(name)

    def _parts(self, value: Any) -> Mapping[str, Any]:
        if isinstance(self._space, DictSpec | TupleSpec):
            return action_leaves(self._space, value, self._path)
        if isinstance(value, Mapping):  # a flat observation by element names
            names = [element.name for element in self._space.elements]
            if set(names) != set(value):
                raise RequestError(f"{self._path} does not have the elements {', '.join(names)}")
            array = np.stack([np.asarray(value[name]) for name in names], axis=-1)
            return {self._path: array.reshape((*array.shape[:-1], *self._space.shape))}
        return {self._path: value}

    def _nest(self, space: SpaceSpec, path: str) -> bytes:
        """Return the JSON of a value with `%b` for each leaf, in the order of `leaves`."""
        if path in self._formats:
            return b"%b"
        return _object_template((key, self._nest(child, f"{path}.{key}")) for key, child in _children(space))

    def _columns(self, space: SpaceSpec, path: str, documents: Sequence[Any], found: dict[str, NDArray[Any]]) -> None:
        if path in self._formats:
            found[path] = self._formats[path].column(documents)
            return
        for key, child in _children(space):
            self._columns(child, f"{path}.{key}", [one if one is None else one[key] for one in documents], found)

    def _schema(self, space: SpaceSpec, path: str) -> dict[str, Any]:
        if path in self._formats:
            return self._formats[path].schema()
        inside = {key: self._schema(child, f"{path}.{key}") for key, child in _children(space)}
        return {"type": "object", "properties": inside}


def json_rows(array: NDArray[Any]) -> list[bytes]:
    """Return the numbers of each row of `[rows, n]` as JSON, without brackets."""
    return orjson.dumps(array, option=orjson.OPT_SERIALIZE_NUMPY)[2:-2].split(b"],[")


def _object_template(members: Iterable[tuple[str, bytes]]) -> bytes:
    """Return the JSON of an object with `%` placeholders for its values."""
    inside = (json.dumps(key).encode().replace(b"%", b"%%") + b":" + value for key, value in members)
    return b"{" + b",".join(inside) + b"}"


def _total_size(value: Any) -> int:
    if isinstance(value, Mapping):
        value = tuple(value.values())
    return sum(map(_total_size, value)) if isinstance(value, tuple) else int(np.size(value))


def _children(space: SpaceSpec) -> list[tuple[str, SpaceSpec]]:
    """Return a nested space's parts by key. A Tuple is also an object: viewers need array items of one kind."""
    if isinstance(space, DictSpec):
        return list(space.spaces.items())
    assert isinstance(space, TupleSpec), "a leaf has no parts"
    return [(str(index), child) for index, child in enumerate(space.spaces)]


class _LeafFormat:
    """One array: an object by element name if all elements are named, else a flat array; a choice is a number."""

    def __init__(self, path: str, leaf: LeafSpec) -> None:
        self._path, self._leaf = path, leaf
        self._shape, self._dtype, self._size = leaf.shape, np.dtype(leaf.dtype), leaf.size
        names = [element.name for element in leaf.elements]
        self._names = names if leaf.shape and len(set(names)) == leaf.size else None
        self._template = b""
        if self._names is not None:
            self._template = _object_template((name, b"%b") for name in self._names)
            getter = itemgetter(*self._names)
            self._values = getter if len(names) > 1 else lambda document: (getter(document),)

    def array(self, value: Any) -> NDArray[Any]:
        """Return `[rows, *shape]`."""
        array, shape = np.asarray(value), self._shape
        if not shape and array.shape[1:] == (1,):  # a batch of choices with their own axis
            array = array[:, 0]
        if array.shape != shape and array.shape[1:] != shape:
            raise ValueError(f"{self._path} has shape {array.shape}, expected {shape}")
        return np.ascontiguousarray(array, self._dtype).reshape(-1, *shape)

    def encode_rows(self, value: Any) -> list[bytes]:
        rows = json_rows(self.array(value).reshape(-1, self._size))
        if not self._shape:
            return rows
        if self._names is None:
            return [b"[%b]" % row for row in rows]
        return [self._template % tuple(row.split(b",")) for row in rows]

    def column(self, documents: Sequence[Any]) -> NDArray[Any]:
        size = self._leaf.size
        absent = [0] * size if self._leaf.shape else 0
        rows = (
            [absent if one is None else one for one in documents]
            if self._names is None
            else [absent if one is None else self._values(one) for one in documents]
        )
        kind = np.dtype(self._leaf.dtype)
        wide = np.array(rows, np.float64 if kind.kind == "f" else kind)  # a null is not a number
        return wide.astype(kind, copy=False).reshape(len(rows), *self._leaf.shape)

    def labels(self, name: str) -> list[str]:
        if self._names is not None:
            return list(self._names)
        return [f"{name}[{i}]" for i in range(self._leaf.size)] if self._leaf.shape else [name]

    def schema(self) -> dict[str, Any]:
        if self._names is None:
            number = self._number(self._leaf.elements[0].unit if self._leaf.elements else "")
            return {"type": "array", "items": number} if self._leaf.shape else number
        inside = {element.name: self._number(element.unit) for element in self._leaf.elements}
        return {"type": "object", "properties": inside}

    def _number(self, unit: str) -> dict[str, Any]:
        number: dict[str, Any] = {"type": "number" if np.dtype(self._leaf.dtype).kind == "f" else "integer"}
        if isinstance(self._leaf, DiscreteSpec):
            number["description"] = f"one of {self._leaf.n}, counted from {self._leaf.start}"
        if unit:
            number |= {"description": f"[{unit}]", "unit": unit}
        return number


def decision_schema(policy: PolicyFormat) -> dict[str, Any]:
    """Return the JSON schema of a policy's decisions."""
    action = policy.actions.schema()
    return _object(
        f"Decision of {policy.title}",
        {
            "episode": _text("Session, stream or loop; absent if unknown"),
            "step": _integer("Number of the decision in the episode, from 0"),
            "obs": policy.observations.schema(),
            "action": {**action, "description": "The action as sent; absent if there was none"},
            "commanded": {**action, "description": "The robot's command instead of an action"},
            "own_action": {**action, "description": "The module's own action, before unsquash, clip and start"},
            "dist_inputs": {"type": "array", "items": {"type": "number"}, "description": "null: minus infinity"},
            "logp": {"type": "number", "description": "Log-probability of own_action"},
            "explore": {"type": "boolean"},
            "reward_input": {"type": "number", "description": "The policy's reward input"},
            "last_action_input": {
                **action,
                "description": "The action from which a step limit counted, if the client sent it",
            },
            "latency_ms": {"type": "number", "description": "[ms]", "unit": "ms"},
            "seq": _integer("The request's number"),
            "request_id": _text("The request's id in the server's log"),
            "trace_id": _text("The trace of the client's that it belongs to (W3C trace context)"),
            "warnings": {"type": "array", "items": {"type": "string"}},
            "error": _text("The error code instead of an action"),
        },
    )


def outcome_schema(policy: PolicyFormat) -> dict[str, Any]:
    """Return the JSON schema of the outcomes of a policy's decisions."""
    return _object(
        f"Outcome of a decision of {policy.title}",
        {
            "episode": _text("As in the decision"),
            "step": _integer("As in the decision"),
            "reward": {"type": "number"},
            "terminated": {"type": "boolean"},
            "truncated": {"type": "boolean"},
            "final_status": _text("How the episode ended, in the environment's words"),
            "final_obs": {**policy.observations.schema(), "description": "The observation after the last action"},
            "commanded": {**policy.actions.schema(), "description": "The robot's command instead of the action"},
            "robot": _object("Facts about a real robot", _ROBOT),
            "may_teach": {"type": "boolean", "description": "false: reported with a key that may not explore"},
        },
    )


_ROBOT: dict[str, Any] = {
    "state": {"type": "string", "description": "State of the machine around the policy; 'human': led by a person"},
    "changes": {
        "type": "array",
        "description": "Changes of the state since the last decision",
        "items": {
            "type": "object",
            "properties": {
                "wall_s": {"type": "number", "description": "[s] since 1970"},
                "state": {"type": "string"},
                "why": {"type": "string"},
            },
        },
    },
    "limited": {"type": "object", "description": "Cycles in which a limit applied, by element", "properties": {}},
}


DROPPED_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "Number of records that are missing before this place because the buffer was full",
    "type": "object",
    "properties": {"count": {"type": "integer"}},
}


def element_differences(recorded: Contract, other: Contract) -> Iterator[str]:
    """Yield a sentence for each difference between two contracts that makes records unusable for the other."""
    for side, ours, theirs in (
        ("observation", recorded.observation_space, other.observation_space),
        ("action", recorded.action_space, other.action_space),
    ):
        mine, yours = leaf_specs(ours, side), leaf_specs(theirs, side)
        for name in sorted({*mine, *yours}):
            if name not in mine or name not in yours:
                yield f"{name} is only in the {'recording' if name in mine else 'bundle'}"
            else:
                yield from _leaf_differences(name, mine[name], yours[name], bounds=side == "action")


def _leaf_differences(name: str, ours: LeafSpec, theirs: LeafSpec, *, bounds: bool) -> Iterator[str]:
    for word in ("kind", "shape", "dtype"):
        mine, yours = getattr(ours, word), getattr(theirs, word)
        if mine != yours:
            yield f"{name} has {word} {mine} in the recording and {yours} in the bundle"
            return
    if ours.elements and theirs.elements:
        for index, (mine, yours) in enumerate(zip(ours.elements, theirs.elements, strict=True)):
            if mine.name != yours.name:
                yield f"element {index} of the {name} is {mine.name!r}, but {yours.name!r} in the bundle"
            elif mine.unit != yours.unit and mine.unit and yours.unit:
                yield f"element {index} of the {name} ({mine.name}) is in {mine.unit} there and {yours.unit} here"
    discrete = ours.kind in ("discrete", "multi_discrete")
    for word, mine, yours in zip(("low", "high"), ours.bounds(), theirs.bounds(), strict=True):
        if (bounds or discrete) and not np.array_equal(mine, yours):
            index = int(np.argmax(np.ravel(mine != yours)))
            yield (
                f"element {index} of the {name} has {word} {np.ravel(mine)[index]:g} in the recording and "
                f"{np.ravel(yours)[index]:g} in the bundle"
            )


def _object(title: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "type": "object",
        "properties": properties,
    }


def _text(description: str) -> dict[str, Any]:
    return {"type": "string", "description": description}


def _integer(description: str) -> dict[str, Any]:
    return {"type": "integer", "description": description}
