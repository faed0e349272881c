"""Tensors of the Open Inference Protocol: JSON numbers, or raw little-endian bytes after the JSON.

The binary form is the protocol's "binary tensor data" extension. Specification:
github.com/kserve/open-inference-protocol, and Triton's extension_binary_data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import ObservationError, RequestError
from rlservo.serve_app.protocols.json_text import json_type
from rlservo.serve_app.runtime.input_numbers import parse_array

DTYPES: dict[str, np.dtype[Any]] = {
    "BOOL": np.dtype("?"),
    "UINT8": np.dtype("u1"),
    "UINT16": np.dtype("<u2"),
    "UINT32": np.dtype("<u4"),
    "UINT64": np.dtype("<u8"),
    "INT8": np.dtype("i1"),
    "INT16": np.dtype("<i2"),
    "INT32": np.dtype("<i4"),
    "INT64": np.dtype("<i8"),
    "FP16": np.dtype("<f2"),
    "FP32": np.dtype("<f4"),
    "FP64": np.dtype("<f8"),
}
NAMES = {dtype.newbyteorder("="): name for name, dtype in DTYPES.items()}
MAX_AXES = 32  # numpy itself stops at 64
MOST_NUMBERS = 2**59  # numpy counts an array's bytes in 63 bits
TENSOR_FIELDS = frozenset({"name", "shape", "datatype", "parameters", "data"})


def is_shape(shape: Sequence[Any]) -> bool:
    """Return whether numpy can make an array of this shape: even an empty one is bounded in its other axes."""
    if len(shape) > MAX_AXES or not all(type(n) is int and 0 <= n < 2**31 for n in shape):
        return False
    return bool(math.prod(n for n in shape if n) < MOST_NUMBERS)


def datatype_of(dtype: str | np.dtype[Any]) -> str:
    """Return the protocol's name for a contract's or an array's dtype ('float32' is 'FP32')."""
    return NAMES[np.dtype(dtype).newbyteorder("=")]


def parse_tensor(document: Any, raw: memoryview, offset: int) -> tuple[str, NDArray[Any], int]:
    """Return (name, array, offset after it); `offset` is where the tensor would begin in `raw`, were it binary.

    Raises RequestError if the form is wrong, ObservationError if a number does not fit its datatype.
    """
    if type(document) is not dict:
        raise RequestError(f"every entry of 'inputs' must be an object, got {json_type(document)}")
    name, datatype = document.get("name"), document.get("datatype")
    shape: Any = document.get("shape")
    if type(name) is not str:
        raise RequestError(f"an input's 'name' must be a string, got {json_type(name)}")
    label = name[:64]
    unknown = next((field for field in document if field not in TENSOR_FIELDS), None)
    if unknown is not None:
        raise RequestError(f"input '{label}' has the unknown field '{unknown[:64]}': expected name, shape, ...")
    parameters = document.get("parameters") or {}
    if type(parameters) is not dict:
        raise RequestError(f"input '{label}': 'parameters' must be an object, got {json_type(parameters)}")
    dtype = check_form(label, shape if type(shape) is list else None, datatype, parameters)
    size = parameters.get("binary_data_size")
    if size is None:
        return name, _from_json(label, document.get("data"), tuple(shape), dtype), offset
    if "data" in document:
        raise RequestError(f"input '{label}' has both 'data' and 'binary_data_size': send one of them")
    if type(size) is not int or size < 0:
        raise RequestError(f"input '{label}': 'binary_data_size' must be a number of bytes, got {json_type(size)}")
    check_size(label, shape, dtype, size, "'binary_data_size' is")
    if offset + size > len(raw):
        raise RequestError(
            f"input '{label}' needs {size} bytes after the JSON, but the body has {max(0, len(raw) - offset)} left"
        )
    return name, from_bytes(label, raw[offset : offset + size], tuple(shape), dtype), offset + size


def check_form(label: str, shape: Sequence[Any] | None, datatype: Any, parameters: Mapping[str, Any]) -> np.dtype[Any]:
    """Return the dtype of an input of either transport, whose bytes or numbers come next. Raises RequestError."""
    if shape is None or not is_shape(shape):
        raise RequestError(f"input '{label}': 'shape' must be a list of sizes such as [1, 27]")
    if datatype == "BYTES":
        raise RequestError(f"input '{label}' has datatype BYTES, which holds strings: send numbers")
    dtype = DTYPES.get(datatype) if type(datatype) is str else None
    if dtype is None:
        given = f"'{datatype[:64]}'" if type(datatype) is str else json_type(datatype)
        raise RequestError(f"input '{label}': datatype must be one of {', '.join(DTYPES)}, got {given}")
    if "shared_memory_region" in parameters:
        raise RequestError(f"input '{label}' is in shared memory, which this server does not read: send the data")
    return dtype


def check_size(label: str, shape: Sequence[int], dtype: np.dtype[Any], size: int, given: str) -> None:
    """Raise RequestError unless a tensor's bytes match its shape; `given` names the source of `size`."""
    expected = math.prod(shape) * dtype.itemsize
    if size != expected:
        raise RequestError(
            f"input '{label}' of shape {list(shape)} and datatype {datatype_of(dtype)} is {expected} bytes, "
            f"but its {given} {size}"
        )


def from_bytes(label: str, raw: memoryview, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the array in `raw`, whose length has been checked. Not writable: it shares the request's memory.

    Raises ObservationError for a BOOL that is neither 0 nor 1.
    """
    if dtype.kind == "b":  # in numpy any other byte is undefined
        return parse_array(np.frombuffer(raw, np.uint8), dtype, f"input '{label}'", ObservationError).reshape(shape)
    array: NDArray[Any] = np.frombuffer(raw, dtype)
    if not array.flags.aligned:  # it may start at any offset, after the JSON
        array = array.copy()
    return array.reshape(shape)


def _from_json(label: str, data: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Read `data`, nested or flat in row-major order."""
    if type(data) is not list:
        raise RequestError(f"input '{label}': 'data' must be a list of numbers, got {json_type(data)}")
    array = parse_array(data, dtype, f"input '{label}': 'data'", ObservationError)
    if array.shape != shape and not (array.ndim == 1 and array.size == math.prod(shape)):
        raise ObservationError(
            f"input '{label}': 'data' has the shape {list(array.shape)}, but 'shape' says {list(shape)}",
            {"expected_shape": list(shape), "shape": list(array.shape)},
        )
    if dtype.kind in "iu" and bool in _leaf_types(data):
        raise ObservationError(f"input '{label}': 'data' holds true or false, which is not an integer")
    return array.reshape(shape)


def _leaf_types(data: list[Any]) -> set[type]:
    types = set(map(type, data))
    return types if list not in types else set().union(*map(_leaf_types, data))


def write_tensor(name: str, array: NDArray[Any], *, binary: bool) -> tuple[dict[str, Any], bytes]:
    """Return the tensor's JSON and, in binary form, its bytes; `data` is the flat array, which orjson writes."""
    document: dict[str, Any] = {
        "name": name,
        "datatype": datatype_of(array.dtype),
        "shape": array.shape,
    }
    if not binary:
        document["data"] = np.ascontiguousarray(array).ravel()
        return document, b""
    raw = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    document["parameters"] = {"binary_data_size": len(raw)}
    return document, raw


def parse_flag(parameters: Mapping[str, Any], name: str) -> bool | None:
    """Return an optional boolean parameter. Raises RequestError when it is something else."""
    value = parameters.get(name)
    if value is None or type(value) is bool:
        return value
    raise RequestError(f"the parameter '{name}' must be true or false, got {json_type(value)}")
