"""C of each ONNX operator.

Three kinds cover most: element by element (`ELEMENTWISE`, a formula each), movements of numbers, whose places are found
by moving the numbers of places once (`_move`), and along axes (`ALONG`). A network's layers are in `layers.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator

from rlservo.export.compiled.c_program import Program, Ref, broadcast, c_type, row_major
from rlservo.export.compiled.layers import LAYERS
from rlservo.export.compiled.names import number
from rlservo.export.compiled.static_graph import Node, refused

# For floats. {0}, {1}, ...: operands; {f}: the suffix of libm's functions; {T}: the type of the result.
ELEMENTWISE: dict[str, str] = {
    "Abs": "fabs{f}({0})", "Neg": "-{0}", "Sqrt": "sqrt{f}({0})", "Reciprocal": "({T})1 / {0}", "Exp": "exp{f}({0})",
    "Log": "log{f}({0})", "Floor": "floor{f}({0})", "Ceil": "ceil{f}({0})", "Round": "rint{f}({0})",
    "Sign": "({T})({0} > 0) - ({T})({0} < 0)", "Erf": "erf{f}({0})",
    **{name.capitalize(): f"{name}{{f}}({{0}})" for name in (
        "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "asinh", "acosh", "atanh", "tanh",
    )},
    "Sigmoid": "({T})1 / (({T})1 + exp{f}(-{0}))", "Relu": "{0} < 0 ? 0 : {0}",
    "LeakyRelu": "{0} < 0 ? {alpha} * {0} : {0}", "PRelu": "{0} < 0 ? {1} * {0} : {0}",
    "ThresholdedRelu": "{0} > {alpha} ? {0} : 0", "Elu": "{0} < 0 ? {alpha} * (exp{f}({0}) - 1) : {0}",
    "Celu": "{0} < 0 ? {alpha} * (exp{f}({0} / {alpha}) - 1) : {0}",
    "Selu": "{gamma} * ({0} <= 0 ? {alpha} * exp{f}({0}) - {alpha} : {0})",
    "Softplus": "{0} > 0 ? {0} + log1p{f}(exp{f}(-{0})) : log1p{f}(exp{f}({0}))",
    "Softsign": "{0} / (1 + fabs{f}({0}))", "HardSigmoid": "fmin{f}(1, fmax{f}(0, {alpha} * {0} + {beta}))",
    "HardSwish": "{0} * fmin{f}(1, fmax{f}(0, {0} / 6 + ({T})0.5))",
    "Mish": "{0} * tanh{f}({0} > 0 ? {0} + log1p{f}(exp{f}(-{0})) : log1p{f}(exp{f}({0})))",
    "Add": "{0} + {1}", "Sub": "{0} - {1}", "Mul": "{0} * {1}", "Div": "{0} / {1}", "Pow": "pow{f}({0}, ({T}){1})",
    "Max": "{0} < {1} || {1} != {1} ? {1} : {0}", "Min": "{0} > {1} || {1} != {1} ? {1} : {0}",
    "Clip": "{0} < {1} ? {1} : {0} > {2} ? {2} : {0}", "Equal": "{0} == {1}", "Less": "{0} < {1}",
    "LessOrEqual": "{0} <= {1}", "Greater": "{0} > {1}", "GreaterOrEqual": "{0} >= {1}", "IsNaN": "{0} != {0}",
    "Where": "{0} ? {1} : {2}", "And": "{0} && {1}", "Or": "{0} || {1}", "Xor": "{0} != {1}", "Not": "!{0}",
    "Fmod": "fmod{f}({0}, {1})", "IsInf": "{0} > {largest} || {0} < -{largest}",
    "Positive": "{0} > {largest}", "Negative": "{0} < -{largest}",
}  # fmt: skip
# For integers, if different. Sums wrap around as onnxruntime's do; dividing by zero gives zero.
INTEGER: dict[str, str] = {
    "Add": "(uint64_t){0} + (uint64_t){1}", "Sub": "(uint64_t){0} - (uint64_t){1}",
    "Mul": "(uint64_t){0} * (uint64_t){1}", "Neg": "0 - (uint64_t){0}", "Pow": "pow((double){0}, (double){1})",
    "Abs": "(int64_t){0} < 0 ? 0 - (uint64_t){0} : (uint64_t){0}", "Sign": "((int64_t){0} > 0) - ((int64_t){0} < 0)",
    "Div": "quotient((int64_t){0}, (int64_t){1})", "Fmod": "rest((int64_t){0}, (int64_t){1})",
    "Mod": "modulo((int64_t){0}, (int64_t){1})", "Max": "{0} < {1} ? {1} : {0}", "Min": "{0} > {1} ? {1} : {0}",
}  # fmt: skip

# Along axes, for each vector x that lies there: [K] is its element k, `EACH` goes through its n elements, y is where
# the result goes: one number, or as many as there are.
HIGHEST = "T h = -INFINITY; EACH h = h < x[K] || x[K] != x[K] ? x[K] : h; "
ALONG = {
    "ReduceSum": "T a = 0; EACH a = (T)(a + x[K]); *y = a;", "ReduceMean": "T a = 0; EACH a += x[K]; *y = a / n;",
    "ReduceProd": "T a = 1; EACH a *= x[K]; *y = a;", "ReduceL1": "T a = 0; EACH a += fabs{f}(x[K]); *y = a;",
    "ReduceSumSquare": "T a = 0; EACH a += x[K] * x[K]; *y = a;",
    "ReduceL2": "T a = 0; EACH a += x[K] * x[K]; *y = sqrt{f}(a);", "ReduceMax": f"{HIGHEST}*y = h;",
    "ReduceMin": "T h = INFINITY; EACH h = h > x[K] || x[K] != x[K] ? x[K] : h; *y = h;",
    "ReduceLogSumExp": f"{HIGHEST}T s = 0; EACH s += exp{{f}}(x[K] - h); *y = h + log{{f}}(s);",
    "Softmax": f"{HIGHEST}T s = 0; EACH s += y[K] = exp{{f}}(x[K] - h); EACH y[K] /= s;",
    "LogSoftmax": f"{HIGHEST}T s = 0; EACH s += exp{{f}}(x[K] - h); s = log{{f}}(s); EACH y[K] = x[K] - h - s;",
    "ArgMax": "T a = *x; int64_t b = 0; EACH if (x[K] > a) {{ b = k; a = x[K]; }} *y = b;",
    "ArgMin": "T a = *x; int64_t b = 0; EACH if (x[K] < a) {{ b = k; a = x[K]; }} *y = b;",
    "LayerNormalization": "T m = 0, v = 0; EACH m += x[K]; m /= n; EACH v += (x[K] - m) * (x[K] - m); "
    "v = 1 / sqrt{f}(v / n + {epsilon}); EACH y[K] = (x[K] - m) * v * {scale};",
}  # fmt: skip
OF_INTEGERS = ("ReduceSum", "ArgMax", "ArgMin")

# The operands that are moved; the others say where to, and are constant.
MOVEMENTS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Identity", "Transpose", "Slice", "Expand", "Split",
                     "Gather", "GatherND", "GatherElements", "Tile", "DepthToSpace", "SpaceToDepth", "Trilu"), (0,)),
    "ScatterND": (0, 2), "ScatterElements": (0, 2), "Pad": (0, 2),
}  # fmt: skip


def emit_node(program: Program, node: Node) -> None:
    """Add a node's statements. Raises UnsupportedError, naming the operator."""
    program.begin(f"{node.op}: {node.outputs[0]}")
    moved = range(len(node.inputs)) if node.op == "Concat" else MOVEMENTS.get(node.op, ())
    if moved and all(i in moved or program.is_constant(name) for i, name in enumerate(node.inputs)):
        _move(program, node, [i for i, name in enumerate(node.inputs) if i in moved and name])
    elif node.op in SPECIAL:
        SPECIAL[node.op](program, node)
    elif node.op in ALONG:
        _along(program, node)
    elif node.op in ELEMENTWISE or node.op in INTEGER:
        _elementwise(program, node)
    else:
        raise refused(node.op)


# Element by element


def _elementwise(program: Program, node: Node) -> None:
    names = [name for name in node.inputs if name]
    dtype = program.value(names[-1 if node.op == "Where" else 0]).dtype
    op, given, settings = node.op, node.attributes, {}
    if op == "Clip" and len(names) < 3:  # only one bound
        op = "Max" if node.inputs[1] else "Min"
    elif op == "Mod" and given["fmod"]:
        op = "Fmod"
    elif op == "IsInf":
        op = {(1, 1): op, (1, 0): "Positive", (0, 1): "Negative"}[given["detect_positive"], given["detect_negative"]]
        settings["largest"] = number(np.finfo(dtype).max)
    table = ELEMENTWISE if dtype.kind == "f" else {**ELEMENTWISE, **INTEGER}
    template = table.get(op, "")
    too_large = dtype == np.uint64 and "(int64_t)" in template
    if not template or f"{{{len(names)}}}" in template or f"{{{len(names) - 1}}}" not in template or too_large or (
        dtype.kind != "f" and "{f}" in template
    ):  # fmt: skip
        raise refused(node.op, f"of {len(names)} operands of type {dtype.name}")
    if dtype.kind != "f":
        program.kernels |= {"Div": {"quotient"}, "Fmod": {"rest"}, "Mod": {"rest", "modulo"}}.get(op, set())
    if dtype == np.float32 and op in ("Tanh", "Sigmoid"):
        program.kernels |= {"tanh", op.lower()}
        template = f"{op.lower()}_of({{0}})"
    settings |= {key: number(dtype.type(value)) for key, value in given.items() if isinstance(value, float)}
    result = c_type(program.value(node.outputs[0]).dtype)
    operands = [f"{{{i}}}" for i in range(len(names))]
    _each(program, node, template.format(*operands, f="f" if dtype == np.float32 else "", T=result, **settings))


def _each(program: Program, node: Node, expression: str) -> None:
    """Emit one loop over the result's elements."""
    shape, names = program.value(node.outputs[0]).shape, [name for name in node.inputs if name]
    reads = [(program.operand(name), broadcast(program.value(name).shape, shape)) for name in names]
    result = program.new(node.outputs[0])
    program.loop(shape, reads, result, row_major(shape), f"{{y}} = ({result.c_type})({expression});")


def _cast(program: Program, node: Node) -> None:
    """Numbers outside an integer type's range are converted as by x86, like in onnxruntime."""
    source, target = program.value(node.inputs[0]).dtype, program.value(node.outputs[0]).dtype
    expression = "{0} != 0" if target == np.bool_ else "{0}"
    if source.kind == "f" and target.kind in "iu":
        wide = 64 if target.itemsize == 8 or target == np.uint32 else 32
        limit = number(source.type(2.0 ** (wide - 1)))
        expression = f"{{0}} >= -{limit} && {{0}} < {limit} ? (int{wide}_t){{0}} : INT{wide}_MIN"
    _each(program, node, expression)


def _one_hot(program: Program, node: Node) -> None:
    """Along a last axis; an index below zero counts from the end."""
    shape, (depth, values) = program.value(node.outputs[0]).shape, (program.value(name) for name in node.inputs[1:])
    if not all(map(program.is_constant, node.inputs[1:])) or node.attributes["axis"] not in (-1, len(shape) - 1):
        raise refused(node.op, "its axis is not the last, or its values are computed")
    index, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    choices = Ref(index.dtype, program.constant(np.arange(depth.item(), dtype=index.dtype)))
    off, on = map(number, values)
    reads = [(index, [*row_major(shape[:-1]), 0]), (choices, [*[0] * (len(shape) - 1), 1])]
    body = f"{{y}} = {{0}} == {{1}} || {{0}} + {depth.item()} == {{1}} ? {on} : {off};"
    program.loop(shape, reads, result, row_major(shape), body)


# Movements


def _move(program: Program, node: Node, positions: Sequence[int]) -> None:
    """Copy numbers from place to place, or only alias them if they are already in order.

    The node is run once on the numbers of places instead of values, counted through from 1: what comes out says where
    each number comes from, 0 from nowhere.
    """
    sources, feed, ends = [node.inputs[position] for position in positions], {}, [1]
    renamed = type(node.proto)()
    renamed.CopyFrom(node.proto)
    for position, name in enumerate(node.inputs):
        if name:
            array = program.value(name)
            if position in positions:
                ends.append(ends[-1] + array.size)
                array = np.arange(ends[-2], ends[-1], dtype=np.float64).reshape(array.shape)
            renamed.input[position] = f"operand_{position}"
            feed[renamed.input[position]] = array
    moved = ReferenceEvaluator(renamed, opsets={"": node.opset}).run(None, feed)
    for output, found in zip((name for name in node.outputs if name), moved, strict=True):
        places = np.asarray(found).astype(np.int64)
        owners = np.searchsorted(ends, places, side="right") - 1
        owner = int(owners.flat[0])
        in_order = np.array_equal(places.ravel() - places.flat[0], np.arange(places.size))
        if owner >= 0 and (owners == owner).all() and in_order and not program.is_constant(sources[owner]):
            program.alias(output, program.ref(sources[owner]).at(int(places.flat[0]) - ends[owner]))
            continue
        reads = ["0", *map(program.operand, sources)]
        result = program.new(output)
        for owner in np.unique(owners).tolist():
            _copy(program, reads[owner + 1], places - ends[max(owner, 0)], owners == owner, result)


def _copy(program: Program, read: Ref | str, places: NDArray[np.int64], mine: NDArray[np.bool_], result: Ref) -> None:
    """Copy one source's numbers to their places: in loops if they are a regular block, else by a table."""
    where = np.argwhere(mine)
    corner, shape = where.min(axis=0), where.max(axis=0) - where.min(axis=0) + 1
    block = places[tuple(slice(c, c + s) for c, s in zip(corner, shape, strict=True))]
    first = int(block.flat[0])
    strides = [int(np.take(block, min(1, n - 1), axis).flat[0]) - first for axis, n in enumerate(block.shape)]
    even = isinstance(read, str) or np.array_equal(first + np.tensordot(strides, np.indices(block.shape), 1), block)
    if even and block.size == mine.sum():
        start = int(corner @ row_major(places.shape))
        source = read if isinstance(read, str) else read.at(first)
        program.loop(block.shape, [(source, strides)], result.at(start), row_major(places.shape), "{y} = {0};")
        return
    to, source = program.constant(np.flatnonzero(mine).astype(np.int32), "places"), read
    if isinstance(read, Ref):
        source = f"({read})[{program.constant(places[mine].astype(np.int32), 'places')}[i]]"
    program.emit(f"for (int i = 0; i < {len(where)}; i++) ({result})[{to}[i]] = {source};")


def _lookup(program: Program, node: Node) -> None:
    """Gather by computed indices; an index out of range becomes the nearest valid one."""
    shape = program.value(node.inputs[0]).shape
    outer, size, inner = _around(shape, [int(node.attributes["axis"]) % len(shape)])
    count = program.value(node.inputs[1]).size
    data, indices, result = (*map(program.ref, node.inputs), program.new(node.outputs[0]))
    program.emit(
        f"for (int o = 0; o < {outer}; o++)\n    for (int j = 0; j < {count}; j++) {{\n"
        f"        int64_t k = (int64_t)({indices})[j];\n        if (k < 0) k += {size};\n"
        f"        k = k < 0 ? 0 : k > {size - 1} ? {size - 1} : k;\n        for (int i = 0; i < {inner}; i++)\n"
        f"            ({result})[({count} * o + j) * {inner} + i] = ({data})[({size} * o + k) * {inner} + i];\n    }}"
    )


# Along axes


def _around(shape: Sequence[int], axes: Sequence[int]) -> tuple[int, int, int]:
    """Return how many elements lie before, along and after axes, which are neighbours."""
    first, last = min(axes), max(axes)
    return int(np.prod(shape[:first])), int(np.prod(shape[first : last + 1])), int(np.prod(shape[last + 1 :]))


def _along(program: Program, node: Node) -> None:
    data, *others = node.inputs
    value, given, scale = program.value(data), node.attributes, ""
    if node.op.startswith("Reduce"):  # an attribute, or since opset 13 or 18 an operand
        named = program.value(others[0]).tolist() if others else given.get("axes") or []
        axes = named or list(range(0 if given.get("noop_with_empty_axes") else value.ndim))
    else:
        axes = [int(given["axis"])]
    axes = sorted(axis % value.ndim for axis in axes)
    if node.op == "LayerNormalization":
        axes = list(range(axes[0], value.ndim))
        scale = " + ".join(f"{program.ref(name)}[k]" for name in others)
    if not axes or axes != list(range(axes[0], axes[-1] + 1)) or not all(map(program.is_constant, others)):
        raise refused(node.op, "its axes are not adjacent, or are computed")
    if (value.dtype.kind != "f" and node.op not in OF_INTEGERS) or (node.opset < 13 and "Softmax" in node.op):
        raise refused(node.op, f"of {value.dtype.name} values in opset {node.opset}")
    outer, n, inner = _around(value.shape, axes)
    if scale and (any(node.outputs[1:]) or any(program.value(name).size != n for name in others)):
        raise refused(node.op, "its scale does not have its input's size, or its mean is an output")
    source, result = program.ref(data), program.new(node.outputs[0])
    epsilon = number(value.dtype.type(given.get("epsilon", 0)))
    text = ALONG[node.op].format(f="f" if value.dtype == np.float32 else "", scale=scale, epsilon=epsilon)
    if given.get("select_last_index"):
        text = text.replace("> a", ">= a").replace("< a", "<= a")
    words = {"T": source.c_type, "n": str(n), "K": f"{inner} * k", "EACH": f"for (int k = 0; k < {n}; k++)"}
    text = re.sub(r"\b(T|n|K|EACH)\b", lambda word: words[word[0]], text)
    step = f"{n * inner} * o" if "y[K]" in ALONG[node.op] else f"{inner} * o"
    program.emit(
        f"for (int o = 0; o < {outer}; o++)\n    for (int i = 0; i < {inner}; i++) {{\n"
        f"        const {source.c_type} *restrict x = {source} + {n * inner} * o + i;\n"
        f"        {result.c_type} *restrict y = {result} + {step} + i;\n        {text}\n    }}"
    )


SPECIAL: dict[str, Callable[[Program, Node], None]] = {
    **LAYERS, "Cast": _cast, "Gather": _lookup, "OneHot": _one_hot,
}  # fmt: skip
