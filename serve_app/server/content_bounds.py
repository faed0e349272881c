"""Bounds on a request's content, checked before anything is parsed or computed: bytes, values and observations.

A few megabytes of `[]` or of unknown fields take a parser seconds in which nothing else is answered. Counting JSON's
separators takes a millisecond, and `max_batch` observations need a known number of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import orjson

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import DictSpec, SpaceSpec, TupleSpec, leaf_specs
from rlservo.errors import TooLargeError
from rlservo.policy.policy import Policy
from rlservo.serve_app.versions.policy_store import PolicyStore

SMALL = 1 << 14  # [bytes] content up to which no parser takes long
SPARE = 1000  # values besides observations and states: options, tensors, names
SPARE_BYTES = 1 << 16
NUMBER_BYTES = 64  # of a number's text, with separator and indentation
LENGTH, ARRAYS = b"length", b"arrays"
ARRAY_VALUES = 12  # of a map that is an array
MARKS = {b",": "values", b"[": "lists", b"{": "maps", b":": "fields"}  # before each one, but for a list's first value


@dataclass(frozen=True, slots=True)
class ContentBounds:
    """Upper bounds for the content of a request to one policy."""

    content_bytes: int
    values: int
    """Entries of lists and maps, plus the lists and maps themselves, in msgpack, where arrays are maps."""
    named: bytes
    """JSON of every element's name: a batch may be a map from each to a list."""
    parts: Sequence[Counter[bytes]]
    """What a value of each kind in a request needs: observation, action, reward, recurrent states."""
    max_batch: int

    @classmethod
    def of(cls, contract: Contract, max_batch: int) -> ContentBounds:
        """Return the bounds for `max_batch` observations with everything that can accompany each."""
        parts = [_need_of(contract.observation_space), _need_of(contract.action_space), _need_of_array(())]
        parts += [_need_of_array(state.shape) for state in contract.state]
        row = sum(parts, Counter[bytes]())
        names = [
            element.name for leaf in leaf_specs(contract.observation_space, "").values() for element in leaf.elements
        ]
        named = orjson.dumps(dict.fromkeys(names, 0))
        return cls(
            SPARE_BYTES + len(named) + max_batch * (row[LENGTH] + NUMBER_BYTES * row[b","]),
            SPARE
            + len(names)
            + max_batch * (row[b","] + row[b":"] + 2 * row[b"["] + 2 * row[b"{"] + ARRAY_VALUES * row[ARRAYS]),
            named,
            parts,
            max_batch,
        )

    def exceeded_by(self, content: bytes) -> str:
        """Return the bound that the JSON exceeds, such as '900 lists', or ''."""
        # Small bodies of large observations have few lists: no more of each kind than the body has room for.
        rows = [min(self.max_batch, len(content) // part[LENGTH] + 1) for part in self.parts]
        for mark, what in MARKS.items():
            most = SPARE + self.named.count(mark)
            most += sum(each * part[mark] for each, part in zip(rows, self.parts, strict=True))
            if content.count(mark) > most:
                return f"{most} {what}"
        return ""


_bounds: WeakKeyDictionary[Policy, ContentBounds] = WeakKeyDictionary()


def check_length(store: PolicyStore, name: str, content: Any, max_batch: int) -> list[ContentBounds]:
    """Return the bounds over a policy's versions: a session or a state may belong to any of them.

    Raises TooLargeError if the content is longer than `max_batch` observations need, and UnknownPolicyError.
    """
    policies = [store.get(name, version) for version in store.versions(name)]
    for policy in policies:
        if policy not in _bounds:
            _bounds[policy] = ContentBounds.of(policy.contract, max_batch)
    bounds = [_bounds[policy] for policy in policies]
    most = max(each.content_bytes for each in bounds)
    if len(content) > most:
        raise _too_large(name, f"{most} bytes", max_batch)
    return bounds


def check_json(store: PolicyStore, name: str, content: Any, max_batch: int) -> None:
    """Raise TooLargeError if the JSON holds more than `max_batch` observations of any version need."""
    text = bytes(content)
    exceeded = [each.exceeded_by(text) for each in check_length(store, name, text, max_batch)]
    if all(exceeded):
        raise _too_large(name, exceeded[-1], max_batch)


def _too_large(name: str, what: str, max_batch: int) -> TooLargeError:
    return TooLargeError(
        f"the request holds more than {what}: {max_batch} observations of policy '{name}' need no more",
        {"policy": name, "max_batch": max_batch},
    )


def _need_of(space: SpaceSpec) -> Counter[bytes]:
    """Count each of MARKS in a value's shortest JSON with the comma that follows, and its LENGTH."""
    if isinstance(space, DictSpec):
        text = sum(len(key) + len('"":') for key in space.spaces)
        own = Counter({b"{": 1, b":": len(space.spaces), b",": 1, LENGTH: text + len("{},")})
        return sum(map(_need_of, space.spaces.values()), own)
    if isinstance(space, TupleSpec):
        return sum(map(_need_of, space.spaces), Counter({b"[": 1, b",": 1, LENGTH: len("[],")}))
    return _need_of_array(space.shape)


def _need_of_array(shape: Sequence[int]) -> Counter[bytes]:
    numbers, lists = math.prod(shape), sum(math.prod(shape[:axis]) for axis in range(len(shape)))
    return Counter({b",": numbers, b"[": lists, LENGTH: 2 * numbers + 2 * lists, ARRAYS: 1 + len(shape)})


def count_rows(space: SpaceSpec, obs: Any) -> int:
    """Return the number of observations in `obs`, which may be anything; an array as long as the space's is one."""
    if isinstance(space, DictSpec | TupleSpec):
        if isinstance(space, DictSpec) and type(obs) is list:
            return len(obs)  # of single observations
        inside = space.spaces.items() if isinstance(space, DictSpec) else enumerate(space.spaces)
        parts = obs if type(obs) in (dict, list, tuple) else {}
        found: dict[Any, Any] = dict(parts) if type(parts) is dict else dict(enumerate(parts))
        return max((count_rows(child, found[key]) for key, child in inside if key in found), default=0)
    if type(obs) is dict:  # element names and values
        return max((_length(value) for value in obs.values()), default=0)
    rows = _length(obs)
    return rows if rows != (space.shape or (0,))[0] else 1


def _length(value: Any) -> int:
    if type(value) is np.ndarray:
        return len(value) if value.ndim else 0
    return len(value) if type(value) in (list, tuple) else 0
