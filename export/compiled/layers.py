"""C of a network's layers: dense, convolution, pooling, recurrent cells, normalization, matrix products.

All but products of two computed matrices come down to one kernel, `dense`, whose weights are constants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.names import number
from rlservo.export.compiled.program import Program, Ref, broadcast, row_major
from rlservo.export.compiled.static_graph import Node
from rlservo.export.contract.errors import UnsupportedError

ACTIVATIONS = {
    "tanh": "tanh_of({0})", "sigmoid": "sigmoid_of({0})", "relu": "({0} < 0 ? 0 : {0})", "affine": "({0})",
}  # fmt: skip


def refused(node: Node, why: str = "") -> UnsupportedError:
    """Return the error for a node that has no C here."""
    what = f"the operator {node.op} of the policy's graph cannot be compiled to C"
    return UnsupportedError(f"{what}{f': {why}' if why else ''}", {"operator": node.op})


def dense(program: Program, source: Ref, weights: NDArray[Any], bias: NDArray[Any] | None, result: Ref) -> None:
    """Emit `result = bias + source @ weights` for constant weights `[n, m]`."""
    program.kernels.add("dense")
    rows, columns = weights.shape
    padded = np.zeros(-(-columns // 8) * 8, np.float32)
    padded[:columns] = 0.0 if bias is None else np.broadcast_to(bias, (columns,))
    names = f"{program.constant(_packed(weights), 'weights')}, {program.constant(padded, 'bias')}"
    program.emit(f"dense({source}, {names}, {result}, {rows}, {columns});")


def _packed(weights: NDArray[Any]) -> NDArray[np.float32]:
    """Return `[n, m]` as `dense` reads it: blocks of 64 columns, then of 8, the last filled up with zeros."""
    rows, columns = weights.shape
    wide = columns // 64 * 64
    padded = np.zeros((rows, wide + -(-(columns - wide) // 8) * 8), np.float32)
    padded[:, :columns] = weights
    blocks = [padded[:, o : o + 64] for o in range(0, wide, 64)]
    blocks += [padded[:, o : o + 8] for o in range(wide, padded.shape[1], 8)]
    return np.concatenate([block.ravel() for block in blocks])


def at(ref: Ref, offset: int) -> Ref:
    """Return the place so many elements further on."""
    return Ref(ref.dtype, ref.base, ref.offset + offset)


def _constants(program: Program, node: Node, names: Sequence[str]) -> list[NDArray[Any] | None]:
    """Return weights, None where an optional one is absent; refuse computed ones and other than single precision."""
    if not all(program.is_constant(name) for name in names):
        raise refused(node, "its weights are computed")
    if program.value(node.inputs[0]).dtype != np.float32:
        raise refused(node, f"of {program.value(node.inputs[0]).dtype.name} values")
    return [program.value(name) if name else None for name in names]


def _gemm(program: Program, node: Node) -> None:
    weights, bias = _constants(program, node, [*node.inputs[1:], ""][:2])
    assert weights is not None
    if node.attributes.get("transA") or (bias is not None and bias.ndim > 1 and bias.shape[0] > 1):
        raise refused(node, "its first operand is transposed, or its bias differs from row to row")
    weights = (weights.T if node.attributes.get("transB") else weights) * np.float32(node.attributes.get("alpha", 1.0))
    bias = None if bias is None else bias.ravel() * np.float32(node.attributes.get("beta", 1.0))
    _rows_times(program, node, weights, bias)


def _rows_times(program: Program, node: Node, weights: NDArray[Any], bias: NDArray[Any] | None) -> None:
    n, m = weights.shape
    source, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    for row in range(program.value(node.inputs[0]).size // n):
        dense(program, at(source, row * n), weights, bias, at(result, row * m))


def _matmul(program: Program, node: Node) -> None:
    a, b = (program.value(name) for name in node.inputs)
    if a.dtype == np.float32 and b.ndim == 2 and program.is_constant(node.inputs[1]):
        _rows_times(program, node, b, None)
        return
    left, right = (a[None] if a.ndim == 1 else a), (b[:, None] if b.ndim == 1 else b)
    (n, k), m = left.shape[-2:], right.shape[-1]
    batch = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    x, y, result = program.ref(node.inputs[0]), program.ref(node.inputs[1]), program.new(node.outputs[0])
    sizes = [*batch, n, m]
    steps = [
        [*(stride * n * k for stride in broadcast(left.shape[:-2], batch)), k, 0],
        [*(stride * k * m for stride in broadcast(right.shape[:-2], batch)), 0, 1],
        row_major(sizes),
    ]
    from_x, from_y, to = (" + ".join(f"{s} * i{d}" for d, s in enumerate(step)) for step in steps)
    opened = " ".join(f"for (int i{d} = 0; i{d} < {size}; i{d}++)" for d, size in enumerate(sizes))
    add = f"({x})[{from_x} + k] * ({y})[{from_y} + {m} * k]"
    sum_of = f"sum += {add}" if a.dtype.kind == "f" else f"sum = ({result.c_type})((uint64_t)sum + (uint64_t)({add}))"
    program.emit(
        f"{opened} {{\n    {result.c_type} sum = 0;\n    for (int k = 0; k < {k}; k++) {sum_of};\n"
        f"    ({result})[{to}] = sum;\n}}"
    )


# Windows over planes


def _window(program: Program, node: Node, kernel: Sequence[int], inside: str, outside: str) -> str:
    """Return loops over the window at output p0, p1, ...: `inside` for a place q of the input, `outside` around it."""
    size, out = program.value(node.inputs[0]).shape[2:], program.value(node.outputs[0]).shape[2:]
    ranks = len(kernel)
    strides, dilations = (node.attributes.get(name) or [1] * ranks for name in ("strides", "dilations"))
    pads = list(node.attributes.get("pads") or [0] * 2 * ranks)
    auto = node.attributes.get("auto_pad", b"NOTSET").decode()
    lines, checks = [], []
    for d in range(ranks):
        if auto in ("SAME_UPPER", "SAME_LOWER"):
            total = max((out[d] - 1) * strides[d] + (kernel[d] - 1) * dilations[d] + 1 - size[d], 0)
            pads[d] = total // 2 if auto == "SAME_UPPER" else total - total // 2
        lines.append(f"for (int w{d} = 0; w{d} < {kernel[d]}; w{d}++)")
        if pads[d] > 0:
            checks.append(f"q{d} >= 0")
        if strides[d] * (out[d] - 1) + dilations[d] * (kernel[d] - 1) - pads[d] >= size[d]:
            checks.append(f"q{d} < {size[d]}")
    lines[-1] += " {"
    lines += [f"    const int q{d} = {strides[d]} * p{d} + {dilations[d]} * w{d} - {pads[d]};" for d in range(ranks)]
    place = " + ".join(f"{step} * q{d}" for d, step in enumerate(row_major(size)))
    test = f"if ({' && '.join(checks)}) " if checks else ""
    lines.append(f"    {test}{inside.replace('PLACE', place)}")
    if checks and outside:
        lines.append(f"    else {outside}")
    return "\n".join([*lines, "}"])


def _positions(shape: Sequence[int]) -> tuple[str, str]:
    """Return (loops over the places of a plane, where in it p0, p1, ... is)."""
    opened = " ".join(f"for (int p{d} = 0; p{d} < {size}; p{d}++)" for d, size in enumerate(shape))
    return opened, " + ".join(f"{step} * p{d}" for d, step in enumerate(row_major(shape)))


def _convolution(program: Program, node: Node) -> None:
    """Each place of the output is a dense layer of the patch that it sees."""
    weights, bias = _constants(program, node, [*node.inputs[1:], ""][:2])
    assert weights is not None
    groups, inner, outer = int(node.attributes.get("group", 1)), weights.shape[1], weights.shape[0]
    outer //= groups
    planes, out = program.value(node.inputs[0]).shape[2:], program.value(node.outputs[0]).shape[2:]
    plane, produced = int(np.prod(planes)), int(np.prod(out))
    source, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    patch, row = program.temporary(np.float32, weights[0].size), program.temporary(np.float32, outer)
    opened, place = _positions(out)
    for group in range(groups):
        read = f"({at(source, group * inner * plane)})[{plane} * c + PLACE]"
        window = _window(program, node, weights.shape[2:], f"({patch})[k++] = {read};", f"({patch})[k++] = 0;")
        program.emit(f"{opened} {{\nint k = 0;\nfor (int c = 0; c < {inner}; c++)\n{window}")
        mine = slice(group * outer, (group + 1) * outer)
        matrix = weights[mine].reshape(outer, -1).T
        dense(program, patch, matrix, None if bias is None else bias[mine], row)
        written = f"({at(result, group * outer * produced)})[{produced} * c + {place}]"
        program.emit(f"for (int c = 0; c < {outer}; c++) {written} = ({row})[c];\n}}")


def _pool(program: Program, node: Node) -> None:
    shape, out = program.value(node.inputs[0]).shape, program.value(node.outputs[0]).shape
    if len([name for name in node.outputs if name]) > 1 or program.value(node.inputs[0]).dtype != np.float32:
        raise refused(node, "of its places, or not in single precision")
    kernel = shape[2:] if node.op.startswith("Global") else node.attributes["kernel_shape"]
    plane, produced = int(np.prod(shape[2:])), int(np.prod(out[2:]))
    source, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    opened, place = _positions(out[2:])
    x = f"({source})[{plane} * c + PLACE]"
    if node.op.endswith("MaxPool"):
        start, inside, end = "-INFINITY", f"{{ const float x = {x}; a = a < x || x != x ? x : a; }}", "a"
        outside = ""
    else:
        start, inside, end = "0", f"{{ a += {x}; k++; }}", "a / (float)k"
        outside = "k++;" if node.attributes.get("count_include_pad") else ""
    counter = "" if end == "a" else " int k = 0;"
    window = _window(program, node, kernel, inside, outside)
    program.emit(
        f"for (int c = 0; c < {shape[0] * shape[1]}; c++)\n{opened} {{\nfloat a = {start};{counter}\n{window}\n"
        f"({result})[{produced} * c + {place}] = {end};\n}}"
    )


# Normalization


def _layer_normalization(program: Program, node: Node) -> None:
    """(x - mean) / sqrt(variance + epsilon), scaled and moved."""
    shape = program.value(node.inputs[0]).shape
    axis = int(node.attributes.get("axis", -1)) % len(shape)
    rows, count = int(np.prod(shape[:axis])), int(np.prod(shape[axis:]))
    scale, shift = _constants(program, node, [*node.inputs[1:], ""][:2])
    if scale is None or scale.size != count or any(node.outputs[1:]):
        raise refused(node, "its scale is not of its input's size, or its mean is an output")
    source, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    move = f" + {program.constant(shift)}[i]" if shift is not None else ""
    epsilon = number(np.float32(node.attributes.get("epsilon", 1e-5)))
    program.emit(
        f"for (int r = 0; r < {rows}; r++) {{\n    const float *restrict x = {source} + {count} * r;\n"
        f"    float mean = 0, square = 0;\n    for (int i = 0; i < {count}; i++) mean += x[i];\n    mean /= {count};\n"
        f"    for (int i = 0; i < {count}; i++) square += (x[i] - mean) * (x[i] - mean);\n"
        f"    square = 1 / sqrtf(square / {count} + {epsilon});\n    for (int i = 0; i < {count}; i++)\n"
        f"        ({result})[{count} * r + i] = (x[i] - mean) * square * {program.constant(scale)}[i]{move};\n}}"
    )


def _batch_normalization(program: Program, node: Node) -> None:
    """As trained: one factor and one summand a channel."""
    found = _constants(program, node, node.inputs[1:5])
    if node.attributes.get("training_mode"):
        raise refused(node, "in training mode")
    scale, shift, mean, variance = (np.asarray(each, np.float64) for each in found)
    factor = scale / np.sqrt(variance + float(node.attributes.get("epsilon", 1e-5)))
    shape = program.value(node.inputs[0]).shape
    along = [0, 1, *[0] * (len(shape) - 2)]
    per_channel = [np.asarray(each, np.float32) for each in (factor, shift - mean * factor)]
    reads: list[tuple[Ref | str, Sequence[int]]] = [(program.ref(node.inputs[0]), row_major(shape))]
    reads += [(Ref(each.dtype, program.constant(each)), along) for each in per_channel]
    program.loop(shape, reads, program.new(node.outputs[0]), row_major(shape), "{y} = {0} * {1} + {2};")


# Recurrent cells


def _recurrent(program: Program, node: Node) -> None:
    """LSTM, GRU and RNN, forward, a step of a sequence after the other (a policy's has one)."""
    names = [*node.inputs, *[""] * 8][:8]
    w, r, b = _constants(program, node, names[1:4])
    assert w is not None and r is not None
    if node.attributes.get("direction", b"forward") != b"forward" or node.attributes.get("layout") or any(
        (names[7], not program.is_constant(names[4]), "clip" in node.attributes, "input_forget" in node.attributes)
    ):  # fmt: skip
        raise refused(node, "not forward, or with peepholes, lengths or a clip")
    steps, batch, width = program.value(names[0]).shape
    hidden = r.shape[2]
    if batch != 1:
        raise refused(node, "of several rows")
    biases = (b[0][: len(b[0]) // 2], b[0][len(b[0]) // 2 :]) if b is not None else (None, None)
    functions = [name.decode().lower() for name in node.attributes.get("activations", ())]
    functions = functions or {"LSTM": ["sigmoid", "tanh", "tanh"], "GRU": ["sigmoid", "tanh"], "RNN": ["tanh"]}[node.op]
    if not set(functions) <= set(ACTIVATIONS):
        raise refused(node, f"with the activation {', '.join(functions)}")
    program.kernels |= {"tanh", "sigmoid"} if "sigmoid" in functions else {"tanh"}
    sequence = program.ref(names[0])
    h, c = (program.temporary(np.float32, hidden) for _ in range(2))
    for name, memory in ((names[5], h), (names[6], c) if node.op == "LSTM" else ("", h)):
        if name or memory is not h or not names[5]:
            value = f"({program.ref(name)})[i]" if name else "0"
            program.emit(f"for (int i = 0; i < {hidden}; i++) ({memory})[i] = {value};")
    outputs = [*node.outputs, "", ""][:3]
    y = program.new(outputs[0]) if outputs[0] in program.graph.values else None
    emit_cell = {"LSTM": _lstm, "GRU": _gru, "RNN": _rnn}[node.op]
    for step in range(steps):
        emit_cell(program, Cell(node, at(sequence, step * width), h, c, w[0], r[0], biases, functions))
        if y is not None:
            program.emit(f"for (int i = 0; i < {hidden}; i++) ({at(y, step * hidden)})[i] = ({h})[i];")
    for name, memory in ((outputs[1], h), (outputs[2], c)):
        if name in program.graph.values:
            last = program.new(name)
            program.emit(f"for (int i = 0; i < {hidden}; i++) ({last})[i] = ({memory})[i];")


class Cell(NamedTuple):
    """One step of a recurrent layer: its input, its memory, and its weights, gate by gate."""

    node: Node
    x: Ref
    h: Ref
    c: Ref
    """An LSTM's cell state; room for as many numbers elsewhere."""
    w: NDArray[Any]
    r: NDArray[Any]
    biases: tuple[NDArray[Any] | None, NDArray[Any] | None]
    functions: list[str]

    @property
    def width(self) -> int:
        return int(self.r.shape[1])


def _gates(program: Program, cell: Cell) -> tuple[Ref, Ref]:
    """Return W x + its bias and R h + its bias."""
    found = []
    for source, weights, bias in ((cell.x, cell.w, cell.biases[0]), (cell.h, cell.r, cell.biases[1])):
        found.append(program.temporary(np.float32, len(weights)))
        dense(program, source, weights.T, bias, found[-1])
    return found[0], found[1]


def _lstm(program: Program, cell: Cell) -> None:
    n, h, c = cell.width, cell.h, cell.c
    a, b = _gates(program, cell)
    i, o, f, g = (f"({a})[i + {k * n}] + ({b})[i + {k * n}]" for k in range(4))
    gate, inner, outer = (ACTIVATIONS[name] for name in cell.functions[:3])
    program.emit(
        f"for (int i = 0; i < {n}; i++) {{\n    ({c})[i] = {gate.format(f)} * ({c})[i] + {gate.format(i)} * "
        f"{inner.format(g)};\n    ({h})[i] = {gate.format(o)} * {outer.format(f'({c})[i]')};\n}}"
    )


def _gru(program: Program, cell: Cell) -> None:
    n, h, c = cell.width, cell.h, cell.c
    gate, inner = (ACTIVATIONS[name] for name in cell.functions[:2])
    a, b = _gates(program, cell)
    reset = gate.format(f"({a})[i + {n}] + ({b})[i + {n}]")
    if cell.node.attributes.get("linear_before_reset"):
        candidate = f"({a})[i + {2 * n}] + {reset} * ({b})[i + {2 * n}]"
    else:  # the reset comes before the product
        program.emit(f"for (int i = 0; i < {n}; i++) ({c})[i] = {reset} * ({h})[i];")
        bias = None if cell.biases[1] is None else cell.biases[1][2 * n :]
        dense(program, c, cell.r[2 * n :].T, bias, at(b, 2 * n))
        candidate = f"({a})[i + {2 * n}] + ({b})[i + {2 * n}]"
    program.emit(
        f"for (int i = 0; i < {n}; i++) {{\n    const float z = {gate.format(f'({a})[i] + ({b})[i]')};\n"
        f"    ({h})[i] = (1 - z) * {inner.format(candidate)} + z * ({h})[i];\n}}"
    )


def _rnn(program: Program, cell: Cell) -> None:
    a, b = _gates(program, cell)
    value = ACTIVATIONS[cell.functions[0]].format(f"(({a})[i] + ({b})[i])")
    program.emit(f"for (int i = 0; i < {cell.width}; i++) ({cell.h})[i] = {value};")


LAYERS: dict[str, Callable[[Program, Node], None]] = {
    "Gemm": _gemm, "MatMul": _matmul, "Conv": _convolution, "MaxPool": _pool, "AveragePool": _pool,
    "GlobalMaxPool": _pool, "GlobalAveragePool": _pool, "LayerNormalization": _layer_normalization,
    "BatchNormalization": _batch_normalization, "LSTM": _recurrent, "GRU": _recurrent, "RNN": _recurrent,
}  # fmt: skip
