"""C of a network's layers: dense, convolution, pooling, recurrent cells, matrix products.

Convolutions come down to the kernel `windows`, all else but pooling and products of two computed matrices to `dense`;
their weights are constants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.c_program import Program, Ref, broadcast, row_major
from rlservo.export.compiled.names import number
from rlservo.export.compiled.static_graph import Node, refused

BLOCKS = (32, 8)
"""Columns that `dense` computes at a time, as in kernels.c."""
PLACES = 8
"""Places of an output that `windows` computes at a time, as in kernels.c."""


def dense(program: Program, source: Ref | str, weights: NDArray[Any], bias: NDArray[Any], result: Ref | str) -> None:
    """Emit `result = bias + source @ weights` for constant weights `[n, m]`."""
    program.kernels.add("dense")
    rows, columns = weights.shape
    numbers = program.constant(_blocks(weights, bias, BLOCKS), "weights")
    program.emit(f"dense({source}, {numbers}, {result}, {rows}, {columns});")


def _blocks(weights: NDArray[Any], bias: NDArray[Any], widths: Sequence[int]) -> NDArray[np.float32]:
    """Return weights `[n, m]` as one stream of memory: a block of columns after the other, each its bias first."""
    rows, columns = weights.shape
    padded = np.zeros((rows + 1, columns + -columns % widths[-1]), np.float32)
    padded[:, :columns] = np.vstack([np.broadcast_to(bias, (1, columns)), weights])
    blocks, begin = [], 0
    for width in widths:
        while begin + width <= padded.shape[1]:
            blocks.append(padded[:, begin : begin + width].ravel())
            begin += width
    return np.concatenate(blocks)


def _constants(program: Program, node: Node, names: Sequence[str]) -> list[NDArray[Any]]:
    """Return weights, 0 for absent optional ones; refuse computed weights and any but single precision."""
    if not all(program.is_constant(name) for name in names) or program.value(node.inputs[0]).dtype != np.float32:
        raise refused(node.op, "its weights are computed, or not in single precision")
    return [program.value(name) if name else np.zeros(1, np.float32) for name in names]


def _gemm(program: Program, node: Node) -> None:
    name, beta = [*node.inputs, ""][2], np.float32(node.attributes["beta"])
    apart = not program.is_constant(name) or (bool(name) and program.value(name).shape[:-1] not in ((), (1,)))
    weights, bias = _constants(program, node, [node.inputs[1], "" if apart else name])
    if node.attributes["transA"]:
        raise refused(node.op, "its first operand is transposed")
    weights = (weights.T if node.attributes["transB"] else weights) * np.float32(node.attributes["alpha"])
    result = _rows_times(program, node, weights, bias.reshape(1, -1) * beta)
    if apart:  # the bias is computed, or differs from row to row
        shape = program.value(node.outputs[0]).shape
        read = (program.ref(name), broadcast(program.value(name).shape, shape))
        program.loop(shape, [read], result, row_major(shape), f"{{y}} += {number(beta)} * {{0}};")


def _rows_times(program: Program, node: Node, weights: NDArray[Any], bias: NDArray[Any]) -> Ref:
    n, m = weights.shape
    source, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    for row in range(program.value(node.inputs[0]).size // n):
        dense(program, source.at(row * n), weights, bias, result.at(row * m))
    return result


def _matmul(program: Program, node: Node) -> None:
    a, b = (program.value(name) for name in node.inputs)
    if a.dtype == np.float32 and b.ndim == 2 and program.is_constant(node.inputs[1]):
        _rows_times(program, node, b, np.zeros(1, np.float32))
        return
    if a.dtype.kind != "f" or min(a.ndim, b.ndim) < 2:
        raise refused(node.op, f"of {a.dtype.name} values, or of a vector")
    (n, k), m, batch = a.shape[-2:], b.shape[-1], np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    x, y, result = program.ref(node.inputs[0]), program.ref(node.inputs[1]), program.new(node.outputs[0])
    shape, written = [*batch, n, k, m], [*row_major([*batch, n, m])[:-1], 0, 1]
    from_x = [*(stride * n * k for stride in broadcast(a.shape[:-2], batch)), k, 1, 0]
    from_y = [*(stride * k * m for stride in broadcast(b.shape[:-2], batch)), 0, m, 1]
    program.emit(f"memset({result}, 0, {int(np.prod([*batch, n, m]))} * sizeof({result.c_type}));")
    program.loop(shape, [(x, from_x), (y, from_y)], result, written, "{y} += {0} * {1};")


def _batch_normalization(program: Program, node: Node) -> None:
    """One factor and one summand per channel, as trained."""
    scale, shift, mean, variance = (each.astype(np.float64) for each in _constants(program, node, node.inputs[1:]))
    factor = scale / np.sqrt(variance + node.attributes["epsilon"])
    shape = program.value(node.inputs[0]).shape
    reads: list[tuple[Ref | str, Sequence[int]]] = [(program.ref(node.inputs[0]), row_major(shape))]
    for each in (factor, shift - mean * factor):
        name = program.constant(each.astype(np.float32))
        reads.append((Ref(np.dtype(np.float32), name), [0, 1, *[0] * (len(shape) - 2)]))
    program.loop(shape, reads, program.new(node.outputs[0]), row_major(shape), "{y} = {0} * {1} + {2};")


# Windows over planes


class _Windows:
    """A layer that slides a window over the planes of an input, which is padded first if necessary."""

    def __init__(self, program: Program, node: Node, kernel: Sequence[int], outside: str) -> None:
        """`outside` is the padding's value. Raises UnsupportedError for a rounding mode that torch never writes."""
        _, self.channels, *size = program.value(node.inputs[0]).shape
        ranks, given = len(kernel), node.attributes
        steps, apart = (list(given.get(name) or [1] * ranks) for name in ("strides", "dilations"))
        pads = list(given.get("pads") or [0] * 2 * ranks)
        if given.get("auto_pad", b"NOTSET") not in (b"NOTSET", b"VALID") or given.get("ceil_mode"):
            raise refused(node.op, "with auto_pad or ceil_mode")
        self.out = program.value(node.outputs[0]).shape[2:]
        self.source = program.ref(node.inputs[0])
        if any(pads):
            inside, first = self.source, pads[:ranks]
            wide = [each + low + high for each, low, high in zip(size, first, pads[ranks:], strict=True)]
            self.source = program.temporary(np.float32, self.channels * int(np.prod(wide)))
            whole, strides = [self.channels, *size], row_major([self.channels, *wide])
            corner = sum(low * stride for low, stride in zip(first, strides[1:], strict=True))
            program.loop([self.channels, *wide], [(outside, [0] * (ranks + 1))], self.source, strides, "{y} = {0};")
            program.loop(whole, [(inside, row_major(whole))], self.source.at(corner), strides, "{y} = {0};")
            size = wide
        self.strides = row_major([self.channels, *size])
        self.within = [step * stride for step, stride in zip(apart, self.strides[1:], strict=True)]
        self.between = [step * stride for step, stride in zip(steps, self.strides[1:], strict=True)]


def _convolution(program: Program, node: Node) -> None:
    """Places of the output, PLACES at a time: each a sum over the numbers that its window sees."""
    weights, bias = _constants(program, node, [*node.inputs[1:], ""][:2])
    _, inner, *kernel = weights.shape
    groups = int(node.attributes["group"])
    outer, windows = len(weights) // groups, _Windows(program, node, kernel, "0")
    result, produced = program.new(node.outputs[0]), int(np.prod(windows.out))
    program.kernels.add("windows")
    seen = program.constant(_places([inner, *kernel], [windows.strides[0], *windows.within]), "seen")
    places = _places(windows.out, windows.between)
    begin = program.constant(np.pad(places, (0, -len(places) % PLACES), mode="edge"), "places")
    bias = np.broadcast_to(bias, len(weights))
    for group in range(groups):
        mine = slice(group * outer, (group + 1) * outer)
        numbers = program.constant(_blocks(weights[mine].reshape(outer, -1).T, bias[mine], BLOCKS[-1:]), "weights")
        source, target = windows.source.at(group * inner * windows.strides[0]), result.at(group * outer * produced)
        sizes = f"{weights[0].size}, {outer}, {produced}, {produced} - p"
        program.emit(
            f"for (int p = 0; p < {produced}; p += {PLACES})\n"
            f"    windows({source}, {begin} + p, {seen}, {numbers}, {target} + p, {sizes});"
        )


def _places(shape: Sequence[int], strides: Sequence[int]) -> NDArray[np.int32]:
    """Return where each element of an array of `shape` lies in memory, in row-major order."""
    offsets = [axis * stride for axis, stride in zip(np.indices(shape), strides, strict=True)]
    return np.asarray(np.add.reduce(offsets, axis=0).ravel(), np.int32)


def _pool(program: Program, node: Node) -> None:
    """One pass for each place of the window."""
    size, out = program.value(node.inputs[0]).shape[2:], program.value(node.outputs[0]).shape
    if len([name for name in node.outputs if name]) > 1 or program.value(node.inputs[0]).dtype != np.float32:
        raise refused(node.op, "of its places, or not in single precision")
    kernel = list(size if node.op.startswith("Global") else node.attributes["kernel_shape"])
    highest = node.op.endswith("MaxPool")
    windows = _Windows(program, node, kernel, "-INFINITY" if highest else "0")
    result = program.new(node.outputs[0])
    if not highest and any(node.attributes.get("pads") or ()) and not node.attributes["count_include_pad"]:
        raise refused(node.op, "with pads that do not count")
    start, body = ("-INFINITY", "{y} = {0} > {y} || {0} != {0} ? {0} : {y};") if highest else ("0", "{y} += {0};")
    program.loop(out, [(start, [0] * len(out))], result, row_major(out), "{y} = {0};")
    for place in np.ndindex(*kernel):
        source = windows.source.at(int(np.dot(place, windows.within)))
        program.loop(out, [(source, [0, windows.strides[0], *windows.between])], result, row_major(out), body)
    if not highest:
        count = number(np.float32(np.prod(kernel)))
        program.loop(out, [(count, [0] * len(out))], result, row_major(out), "{y} /= {0};")


# Recurrent cells


def _recurrent(program: Program, node: Node) -> None:
    """LSTM and GRU, forward, one step of a sequence after another (a policy's has one)."""
    names, given = [*node.inputs, *[""] * 8][:8], node.attributes
    w, r, b = _constants(program, node, names[1:4])
    (steps, batch, width), hidden = program.value(names[0]).shape, r.shape[2]
    lstm, gates = node.op == "LSTM", len(r[0])
    unusual = given["direction"] != b"forward" or given["layout"] or batch != 1 or given.get("input_forget")
    if unusual or names[4] or names[7] or "clip" in given or "activations" in given or (
        not lstm and not given["linear_before_reset"]
    ):  # fmt: skip
        raise refused(node.op, "not forward, of several rows, or with gates other than torch's")
    program.kernels |= {"tanh", "sigmoid", node.op.lower()}
    b = np.broadcast_to(b, (1, 2 * gates))[0]
    both = program.temporary(np.float32, width + hidden)  # the input, then the memory
    h, c = both.at(width), program.temporary(np.float32, hidden)
    a = program.temporary(np.float32, gates if lstm else 2 * gates)
    for name, memory in ((names[5], h), (names[6], c)):
        given_memory = f"memcpy({memory}, {program.ref(name)}" if name else f"memset({memory}, 0"
        program.emit(f"{given_memory}, {hidden} * sizeof(float));")
    y = program.new(node.outputs[0]) if node.outputs[0] in program.graph.values else None
    for step in range(steps):
        program.emit(f"memcpy({both}, {program.ref(names[0]).at(step * width)}, {width} * sizeof(float));")
        if lstm:
            dense(program, both, np.hstack([w[0], r[0]]).T, b[:gates] + b[gates:], a)
            program.emit(f"lstm({a}, {c}, {h}, {hidden});")
        else:
            dense(program, both, w[0].T, b[:gates], a)
            dense(program, h, r[0].T, b[gates:], a.at(gates))
            program.emit(f"gru({a}, {h}, {hidden});")
        if y is not None:
            program.emit(f"memcpy({y.at(step * hidden)}, {h}, {hidden} * sizeof(float));")
    for name, memory in zip(node.outputs[1:], (h, c), strict=False):
        program.alias(name, memory)


LAYERS: dict[str, Callable[[Program, Node], None]] = {
    "Gemm": _gemm, "MatMul": _matmul, "Conv": _convolution, "MaxPool": _pool, "AveragePool": _pool,
    "GlobalMaxPool": _pool, "GlobalAveragePool": _pool,
    "BatchNormalization": _batch_normalization, "LSTM": _recurrent, "GRU": _recurrent,
}  # fmt: skip
