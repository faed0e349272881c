"""Numpy arrays in msgpack, in the format of openpi's clients and servers. Decoding never runs code.

An array is `{b"__ndarray__": True, b"data": bytes, b"dtype": dtype.str, b"shape": shape}`, a numpy scalar
`{b"__npgeneric__": True, b"data": item, b"dtype": dtype.str}`; the marker keys are bytes, so that they never collide
with an observation's name. Source: github.com/Physical-Intelligence/openpi, packages/openpi-client. Arrays in the
format of PyPI's msgpack-numpy are also read, not written (github.com/lebedov/msgpack-numpy).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from rlservo.errors import ObservationError, RequestError, TooLargeError

KINDS = ("b1", "u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8")  # numbers; no objects, no records
DTYPES = {order + kind: np.dtype(order + kind) for kind in KINDS for order in ("<", ">", "|", "=", "")}
MAX_AXES = 32  # numpy itself stops at 64


def pack(document: Mapping[str, Any]) -> bytes:
    """Return the document as msgpack; arrays and numpy scalars of number types may be anywhere in it."""
    packed: Any = msgpack.packb(document, default=_pack_array)
    return bytes(packed)


def unpack(content: bytes, *, most: int | None = None) -> Any:
    """Return the document in `content` with numpy arrays (not writable: they share the message's memory).

    Raises RequestError when it is not msgpack, ObservationError when an array in it is inconsistent, TooLargeError for
    more than `most` lists, maps and entries.
    """
    hooks = {"object_hook": _unpack_array} if most is None else _counting_hooks(most)
    try:
        return msgpack.unpackb(content, strict_map_key=True, **hooks)
    except (ValueError, TypeError, msgpack.exceptions.UnpackException, RecursionError) as error:
        raise RequestError(f"the message is not msgpack: {str(error)[:200] or type(error).__name__}") from None


def _pack_array(value: Any) -> dict[bytes, Any]:
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic) and value.dtype.kind in "fiub":
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"cannot send a {type(value).__name__}")


def _unpack_array(document: dict[Any, Any]) -> Any:
    if b"__ndarray__" in document:
        return _array(document.get(b"data"), document.get(b"dtype"), document.get(b"shape"))
    if b"nd" in document and b"type" in document:  # msgpack-numpy's, whose scalars have no shape
        kind = document.get(b"kind", b"")
        if kind not in (b"", ""):  # records, and pickled objects
            raise ObservationError(f"a msgpack-numpy array in the message has kind {kind!r:.16}: send numbers")
        shape = document.get(b"shape") if document[b"nd"] is True else []
        return _array(document.get(b"data"), document[b"type"], shape)
    if b"__npgeneric__" in document:
        value = document.get(b"data")
        if not isinstance(value, bool | int | float):
            raise ObservationError(f"a numpy scalar in the message holds a {type(value).__name__}, not a number")
        return value
    return document


def _counting_hooks(most: int) -> dict[str, Callable[[Any], Any]]:
    """Return hooks for every map and list, which raise TooLargeError after `most` entries."""
    left = most

    def count(value: Any) -> Any:
        nonlocal left
        left -= 1 + len(value)
        if left < 0:
            raise TooLargeError(f"the message holds more than {most} values, the most that its policy needs")
        return value

    return {"list_hook": count, "object_hook": lambda document: _unpack_array(count(document))}


def _array(data: Any, name: Any, shape: Any) -> NDArray[Any]:
    text = name.decode("latin-1") if isinstance(name, bytes) else name
    dtype = DTYPES.get(text) if type(text) is str else None
    if dtype is None:
        raise ObservationError(f"an array in the message has dtype {name!r:.32}: send numbers, such as '<f4'")
    if (
        type(shape) is not list
        or len(shape) > MAX_AXES
        or not all(type(size) is int and 0 <= size < 2**31 for size in shape)
    ):
        raise ObservationError(f"an array in the message has the shape {shape!r:.64}: expected a list of sizes")
    needed = math.prod(shape) * dtype.itemsize
    if type(data) is not bytes or len(data) != needed:
        got = f"{len(data)} bytes" if type(data) is bytes else f"a {type(data).__name__}"
        raise ObservationError(
            f"an array in the message of shape {shape} and dtype {name} needs {needed} bytes, got {got}"
        )
    if dtype.kind == "b" and data.translate(None, b"\0\1"):  # in numpy any other byte is undefined
        raise ObservationError(f"an array in the message of dtype {name} holds a byte that is neither 0 nor 1")
    array: NDArray[Any] = np.frombuffer(data, dtype).reshape(shape)
    return array
