"""Tensors of the Open Inference Protocol: JSON numbers, or raw little-endian bytes after the JSON.

The binary form is the protocol's "binary tensor data" extension. Specification:
github.com/kserve/open-inference-protocol, and Triton's extension_binary_data.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import ObservationError, RequestError
from rlservo.policy.input_numbers import parse_array
from rlservo.serve_app.protocols.request_fields import json_type

DATATYPES = "BOOL UINT8 UINT16 UINT32 UINT64 INT8 INT16 INT32 INT64 FP16 FP32 FP64"  # in the order of Triton's DataType
DTYPES: dict[str, np.dtype[Any]] = {
    name: np.dtype(name.lower().replace("fp", "float")).newbyteorder("<") for name in DATATYPES.split()
}
NAMES = {dtype.newbyteorder("="): name for name, dtype in DTYPES.items()}
MOST_NUMBERS = 2**59  # numpy counts an array's bytes in 63 bits


def datatype_of(dtype: str | np.dtype[Any]) -> str:
    """Return the protocol's name for a contract's or an array's dtype ('float32' is 'FP32')."""
    return NAMES[np.dtype(dtype).newbyteorder("=")]


def read_inputs(tensors: Sequence[Mapping[str, Any]], raw: memoryview) -> dict[str, NDArray[Any]]:
    """Return a request's inputs by name; those that give a `binary_data_size` are in `raw`, one after the other.

    Raises RequestError if the form is wrong, ObservationError if a number does not fit its datatype.
    """
    inputs: dict[str, NDArray[Any]] = {}
    offset = 0
    names = [tensor["name"] for tensor in tensors]
    if len(set(names)) < len(names):
        raise RequestError(f"input '{Counter(names).most_common(1)[0][0][:64]}' is given twice")
    for tensor in tensors:
        name, shape, parameters = tensor["name"], tuple(tensor["shape"]), tensor.get("parameters") or {}
        label = name[:64]
        dtype = _check_form(label, shape, tensor["datatype"], parameters)
        size = parameters.get("binary_data_size")
        if size is None:
            inputs[name] = _from_json(label, tensor.get("data"), shape, dtype)
            continue
        if "data" in tensor:
            raise RequestError(f"input '{label}' has both 'data' and 'binary_data_size': send one of them")
        expected = math.prod(shape) * dtype.itemsize
        if type(size) is not int or size != expected:
            raise RequestError(
                f"input '{label}' of shape {list(shape)} and datatype {tensor['datatype']} is {expected} bytes, but "
                f"its size is {json_type(size)}"
            )
        if offset + size > len(raw):
            raise RequestError(
                f"input '{label}' needs {size} bytes after the JSON, but the body has {len(raw) - offset} left"
            )
        inputs[name] = _from_bytes(label, raw[offset : offset + size], shape, dtype)
        offset += size
    if offset != len(raw):
        raise RequestError(f"the body has {len(raw) - offset} bytes after the last tensor's data")
    return inputs


def _check_form(label: str, shape: Sequence[int], datatype: str, parameters: Mapping[str, Any]) -> np.dtype[Any]:
    """Return the dtype of an input, whose bytes or numbers come next. Raises RequestError."""
    # Numpy can make no larger array; even an empty one is bounded in its other axes.
    if not all(0 <= n < 2**31 for n in shape) or math.prod(n for n in shape if n) >= MOST_NUMBERS:
        raise RequestError(f"input '{label}': 'shape' must be a list of sizes such as [1, 27]")
    if datatype == "BYTES":
        raise RequestError(f"input '{label}' has datatype BYTES, which holds strings: send numbers")
    if datatype not in DTYPES:
        raise RequestError(f"input '{label}': datatype must be one of {', '.join(DTYPES)}, got '{datatype[:64]}'")
    if "shared_memory_region" in parameters:
        raise RequestError(f"input '{label}' is in shared memory, which this server does not read: send the data")
    return DTYPES[datatype]


def _from_bytes(label: str, raw: memoryview, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
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


def write_tensor(name: str, array: NDArray[Any], *, binary: bool) -> tuple[dict[str, Any], bytes | None]:
    """Return the tensor's JSON and, in binary form, its bytes; `data` is the flat array, which orjson writes."""
    document: dict[str, Any] = {
        "name": name,
        "datatype": datatype_of(array.dtype),
        "shape": array.shape,
    }
    if not binary:
        document["data"] = np.ascontiguousarray(array).ravel()
        return document, None
    raw = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    document["parameters"] = {"binary_data_size": len(raw)}
    return document, raw
