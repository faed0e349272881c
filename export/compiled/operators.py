"""C of each ONNX operator.

Three kinds cover most: element by element (`ELEMENTWISE`, a formula each), movements of numbers, whose places
onnxruntime itself finds once (`_move`), and along axes (sums, softmax). A network's layers are in `layers.py`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper

from rlservo.export.compiled.layers import LAYERS, refused
from rlservo.export.compiled.names import number
from rlservo.export.compiled.program import (
    Program,
    Ref,
    affine,
    broadcast,
    c_type,
    collapse,
    literal,
    row_major,
)
from rlservo.export.compiled.static_graph import Node
from rlservo.export.contract.ort_session import open_ort_session

# {0}, {1}, ...: operands; {f}: the suffix of libm's functions; {T}: the type of the result. Of floats.
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
    "Equal": "{0} == {1}", "Less": "{0} < {1}", "LessOrEqual": "{0} <= {1}", "Greater": "{0} > {1}",
    "GreaterOrEqual": "{0} >= {1}", "IsNaN": "{0} != {0}", "Where": "{0} ? {1} : {2}", "And": "{0} && {1}",
    "Or": "{0} || {1}", "Xor": "{0} != {1}", "Not": "!{0}",
}  # fmt: skip
# Of integers, where they differ. Sums wrap around as onnxruntime's do; dividing by zero gives zero.
INTEGER: dict[str, str] = {
    "Add": "(uint64_t){0} + (uint64_t){1}", "Sub": "(uint64_t){0} - (uint64_t){1}",
    "Mul": "(uint64_t){0} * (uint64_t){1}", "Neg": "0 - (uint64_t){0}",
    "Abs": "{0} < 0 ? 0 - (uint64_t){0} : (uint64_t){0}",
    "Div": "{1} == 0 ? 0 : {1} == -1 ? 0 - (uint64_t){0} : (uint64_t)({0} / {1})",
    "Pow": "pow((double){0}, (double){1})",
    "Mod": "{1} == 0 || {1} == -1 ? 0 : ({0} % {1} != 0 && ({0} < 0) != ({1} < 0)) ? {0} % {1} + {1} : {0} % {1}",
    "Sign": "({0} > 0) - ({0} < 0)", "Max": "{0} < {1} ? {1} : {0}", "Min": "{0} > {1} ? {1} : {0}",
}  # fmt: skip
DEFAULTS = {
    "LeakyRelu": {"alpha": 0.01}, "Elu": {"alpha": 1.0}, "Celu": {"alpha": 1.0}, "ThresholdedRelu": {"alpha": 1.0},
    "Selu": {"alpha": 1.67326319217681884765625, "gamma": 1.05070102214813232421875},
    "HardSigmoid": {"alpha": 0.2, "beta": 0.5},
}  # fmt: skip
FOLDED = {"Sum": "Add", "Mean": "Add", "Max": "Max", "Min": "Min"}  # of any number of operands

# Along axes: the first value, what each element x adds to it, and what becomes of it; n is how many there are.
REDUCTIONS = {
    "ReduceSum": ("0", "a += x", "a"), "ReduceMean": ("0", "a += x", "a / n"), "ReduceProd": ("1", "a *= x", "a"),
    "ReduceSumSquare": ("0", "a += x * x", "a"), "ReduceL1": ("0", "a += x < 0 ? -x : x", "a"),
    "ReduceL2": ("0", "a += x * x", "sqrt{f}(a)"), "ReduceLogSum": ("0", "a += x", "log{f}(a)"),
    "ReduceMax": ("-INFINITY", "a = a < x || x != x ? x : a", "a"),
    "ReduceMin": ("INFINITY", "a = a > x || x != x ? x : a", "a"),
}  # fmt: skip
# The operands that are moved; the others say where to, and are constant.
MOVEMENTS: dict[str, tuple[int, ...] | None] = {
    **dict.fromkeys(("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Identity", "Transpose", "Slice", "Expand", "Split",
                     "Gather", "GatherND", "GatherElements", "Tile", "DepthToSpace", "SpaceToDepth", "Trilu",
                     "Dropout", "ReverseSequence"), (0,)),
    "ScatterND": (0, 2), "ScatterElements": (0, 2), "Pad": (0, 2), "Concat": None,
}  # fmt: skip


def emit_node(program: Program, node: Node) -> None:
    """Add a node's statements. Raises UnsupportedError, naming the operator."""
    program.begin(f"{node.op}: {node.outputs[0]}")
    moved = MOVEMENTS.get(node.op, ())
    sources = range(len(node.inputs)) if moved is None else [i for i in moved if i < len(node.inputs)]
    if node.op in MOVEMENTS and all(program.is_constant(x) for i, x in enumerate(node.inputs) if i not in sources):
        _move(program, node, [i for i in sources if node.inputs[i]])
    elif node.op in SPECIAL:
        SPECIAL[node.op](program, node)
    elif node.op in REDUCTIONS:
        _reduce(program, node)
    elif node.op in FOLDED and len(node.inputs) != 2:
        _fold(program, node)
    elif node.op in ELEMENTWISE or node.op in INTEGER:
        _elementwise(program, node)
    else:
        raise refused(node)


# Element by element


def _elementwise(program: Program, node: Node, template: str | None = None) -> None:
    result = program.value(node.outputs[0])
    operand = program.value(next(name for name in reversed(node.inputs) if name))
    if template is None:
        is_float = operand.dtype.kind == "f"
        template = ELEMENTWISE.get(node.op, "") if is_float else INTEGER.get(node.op, ELEMENTWISE.get(node.op, ""))
        if operand.dtype.kind == "u" and node.op in ("Div", "Mod"):
            template = f"{{1}} == 0 ? 0 : {{0}} {'/' if node.op == 'Div' else '%'} {{1}}"
        elif node.op == "Mod" and node.attributes.get("fmod"):
            template = "fmod{f}({0}, {1})" if is_float else "{1} == 0 || {1} == -1 ? 0 : {0} % {1}"
        if not template or (not is_float and "{f}" in template):
            raise refused(node, f"of {operand.dtype.name} values")
    settings = {**DEFAULTS.get(node.op, {}), **{k: v for k, v in node.attributes.items() if isinstance(v, float)}}
    kind = np.float64 if operand.dtype == np.float64 else np.float32
    names = {key: number(kind(value)) for key, value in settings.items()}
    if operand.dtype == np.float32 and node.op in ("Tanh", "Sigmoid"):
        program.kernels |= {"tanh", node.op.lower()}
        template = f"{node.op.lower()}_of({{0}})"
    expression = template.format(
        *(f"{{{i}}}" for i in range(len(node.inputs))),
        f="f" if operand.dtype == np.float32 else "", T=c_type(result.dtype), **names,
    )  # fmt: skip
    if node.op == "Pow" and program.is_constant(node.inputs[1]) and program.value(node.inputs[1]).size == 1:
        power = float(program.value(node.inputs[1]).ravel()[0])
        expression = {2.0: "{0} * {0}", 3.0: "{0} * {0} * {0}", 0.5: "sqrtf({0})" if kind is np.float32 else
                      "sqrt({0})"}.get(power, expression) if operand.dtype.kind == "f" else expression  # fmt: skip
    _each(program, node, f"{{y}} = ({c_type(result.dtype)})({expression});")


def _each(program: Program, node: Node, body: str) -> None:
    """Emit one loop over the result's elements."""
    shape = program.value(node.outputs[0]).shape
    reads = [(literal(program, name), broadcast(program.value(name).shape, shape)) for name in node.inputs]
    program.loop(shape, reads, program.new(node.outputs[0]), row_major(shape), body)


def _fold(program: Program, node: Node) -> None:
    """Max, Min, Sum and Mean of any number of operands, from left to right."""
    shape, result = program.value(node.outputs[0]).shape, program.new(node.outputs[0])
    integer = result.dtype.kind in "iu"
    formula = INTEGER.get(FOLDED[node.op], ELEMENTWISE[FOLDED[node.op]]) if integer else ELEMENTWISE[FOLDED[node.op]]
    zero = [0] * len(shape)
    first, *others = [(literal(program, name), broadcast(program.value(name).shape, shape)) for name in node.inputs]
    program.loop(shape, [first], result, row_major(shape), "{y} = {0};")
    for other in others:
        body = formula.replace("{0}", "{y}").replace("{1}", "{0}")
        program.loop(shape, [other], result, row_major(shape), f"{{y}} = ({result.c_type})({body});")
    if node.op == "Mean":
        count = number(result.dtype.type(len(node.inputs)))
        program.loop(shape, [(count, zero)], result, row_major(shape), "{y} = {y} / {0};")


def _cast(program: Program, node: Node) -> None:
    """Numbers that an integer type lacks become what x86 makes of them, as in onnxruntime."""
    source, target = program.value(node.inputs[0]).dtype, program.value(node.outputs[0]).dtype
    if source == target:
        program.alias(node.outputs[0], program.ref(node.inputs[0]))
        return
    expression = f"({c_type(target)}){{0}}"
    if target == np.bool_:
        expression = "{0} != 0"
    elif source.kind == "f" and target.kind in "iu":
        wide = 64 if target.itemsize == 8 or target == np.uint32 else 32
        limit = f"{2.0 ** (wide - 1):.1f}{'f' if source == np.float32 else ''}"
        inside = f"{{0}} >= -{limit} && {{0}} < {limit}"
        expression = f"({c_type(target)})({inside} ? (int{wide}_t){{0}} : INT{wide}_MIN)"
    _each(program, node, f"{{y}} = {expression};")


def _clip(program: Program, node: Node) -> None:
    low, high = ([*node.inputs[1:], "", ""][i] for i in (0, 1))
    if not low and not high:
        program.alias(node.outputs[0], program.ref(node.inputs[0]))
        return
    template = "{0} < {1} ? {1} : {0} > {2} ? {2} : {0}" if low and high else (
        "{0} < {1} ? {1} : {0}" if low else "{0} > {1} ? {1} : {0}")  # fmt: skip
    one = Node("Clip", tuple(name for name in node.inputs if name), node.outputs, {}, node.opset)
    _elementwise(program, one, template)


def _is_infinite(program: Program, node: Node) -> None:
    either = [sign for key, sign in (("detect_positive", "> "), ("detect_negative", "< -"))
              if node.attributes.get(key, 1)]  # fmt: skip
    largest = "FLT_MAX" if program.value(node.inputs[0]).dtype == np.float32 else "DBL_MAX"
    _each(program, node, f"{{y}} = {' || '.join(f'{{0}} {sign}{largest}' for sign in either) or '0'};")


# Movements


def _move(program: Program, node: Node, positions: Sequence[int]) -> None:
    """Copy numbers from place to place, or just say where they lie when they lie so already.

    The node is run once on the numbers of places instead of values: what comes out says where each number comes from.
    """
    sources = [node.inputs[position] for position in positions]
    for output, places in zip((name for name in node.outputs if name), _places(program, node, positions), strict=True):
        ends = np.cumsum([1, *(program.value(name).size for name in sources)])
        owners = np.searchsorted(ends, places, side="right") - 1
        if places.size and owners.flat[0] >= 0 and (owners == owners.flat[0]).all():
            owner = int(owners.flat[0])
            found = affine(places - ends[owner])
            if (
                found is not None
                and found[1] == _dense_strides(places.shape)
                and not program.is_constant(sources[owner])
            ):
                base = program.ref(sources[owner])
                program.alias(output, Ref(base.dtype, base.base, base.offset + found[0]))
                continue
        reads: list[Ref | str] = [literal(program, source) for source in sources]
        result = program.new(output)
        for owner, read in enumerate(["0", *reads], start=-1):
            if (owners == owner).any():
                _copy(program, read, places - ends[max(owner, 0)], owners == owner, result)


def _dense_strides(shape: Sequence[int]) -> list[int]:
    return [stride if size > 1 else 0 for size, stride in zip(shape, row_major(shape), strict=True)]


def _places(program: Program, node: Node, positions: Sequence[int]) -> list[NDArray[np.int64]]:
    """Return, for each output, where its elements come from in the sources, counted through from 1; 0 is a zero."""
    names, feed, begin = [], {}, 1
    for position, name in enumerate(node.inputs):
        if not name:
            names.append("")
            continue
        array = program.value(name)
        if position in positions:
            array = np.arange(begin, begin + array.size, dtype=np.float64).reshape(array.shape)
            begin += array.size
        names.append(f"operand_{position}")
        feed[names[-1]] = array
    outputs = [name for name in node.outputs if name]
    inputs = [
        helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(array.dtype), array.shape)
        for name, array in feed.items()
    ]
    one = helper.make_node(node.op, names, node.outputs, **node.attributes)
    empty = [onnx.ValueInfoProto(name=name) for name in outputs]
    opset = [helper.make_opsetid("", node.opset)]
    model = helper.make_model(helper.make_graph([one], "places", inputs, empty), opset_imports=opset, ir_version=8)
    with tempfile.TemporaryDirectory(prefix="rlservo-") as folder:
        file = Path(folder) / "places.onnx"
        onnx.save(model, str(file))
        found = open_ort_session(file).run(outputs, feed)
    return [np.asarray(each).astype(np.int64) for each in found]


def _copy(program: Program, read: Ref | str, places: NDArray[np.int64], mine: NDArray[np.bool_], result: Ref) -> None:
    """Copy one source's numbers to where they belong: in loops where they are a regular block, else by a table."""
    where = np.argwhere(mine)
    corner, shape = where.min(axis=0), where.max(axis=0) - where.min(axis=0) + 1
    block = tuple(slice(c, c + s) for c, s in zip(corner, shape, strict=True))
    found = affine(places[block]) if mine[block].all() else None
    if found is not None or (isinstance(read, str) and mine[block].all()):
        start = int(np.ravel_multi_index(corner, places.shape)) if places.ndim else 0
        target = Ref(result.dtype, result.base, result.offset + start)
        first, strides = found or (0, [0] * places.ndim)
        from_ = read if isinstance(read, str) else Ref(read.dtype, read.base, read.offset + first)
        program.loop(shape.tolist(), [(from_, strides)], target, row_major(places.shape), "{y} = {0};")
        return
    to = program.constant(np.flatnonzero(mine).astype(np.int32), "places")
    if isinstance(read, str):
        program.emit(f"for (int i = 0; i < {len(where)}; i++) ({result})[{to}[i]] = {read};")
        return
    from_table = program.constant(places[mine].astype(np.int32), "places")
    program.emit(f"for (int i = 0; i < {len(where)}; i++) ({result})[{to}[i]] = ({read})[{from_table}[i]];")


def _lookup(program: Program, node: Node) -> None:
    """Gather and GatherElements by indices that are computed; an index outside is taken as the nearest."""
    data, indices = node.inputs
    axis = int(node.attributes.get("axis", 0)) % program.value(data).ndim
    shape, size = program.value(data).shape, program.value(data).shape[axis]
    out = program.value(node.outputs[0]).shape
    own = row_major(shape)
    if node.op == "Gather":
        ranks = program.value(indices).ndim
        steps = [*own[:axis], *[0] * ranks, *own[axis + 1 :]]
        picks = [*[0] * axis, *row_major(program.value(indices).shape), *[0] * (len(shape) - axis - 1)]
    else:
        steps, picks = [0 if a == axis else stride for a, stride in enumerate(own)], row_major(out)
    index, source, result = program.ref(indices), program.ref(data), program.new(node.outputs[0])
    sizes, (step, pick, write) = collapse(out, [steps, picks, row_major(out)])
    text = [f"for (int i{d} = 0; i{d} < {n}; i{d}++)" for d, n in enumerate(sizes)]
    body = (
        f"int64_t k = (int64_t)({index})[{_sum(pick)}];\n    if (k < 0) k += {size};\n"
        f"    k = k < 0 ? 0 : k > {size - 1} ? {size - 1} : k;\n"
        f"    ({result})[{_sum(write)}] = ({source})[{_sum(step)} + {own[axis]} * k];"
    )
    program.emit("\n".join(text) + " {\n    " + body + "\n}" if text else "{\n    " + body + "\n}")


def _sum(strides: Sequence[int]) -> str:
    return " + ".join(f"{stride} * i{axis}" for axis, stride in enumerate(strides) if stride) or "0"


def _one_hot(program: Program, node: Node) -> None:
    depth, (off, on) = int(program.value(node.inputs[1]).ravel()[0]), program.value(node.inputs[2]).ravel()
    ranks = program.value(node.outputs[0]).ndim
    if int(node.attributes.get("axis", -1)) % ranks != ranks - 1 or not program.is_constant(node.inputs[1]):
        raise refused(node, "its axis is not the last")
    if not program.is_constant(node.inputs[2]):
        raise refused(node, "its values are computed")
    index, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    rows = program.value(node.inputs[0]).size
    program.emit(
        f"for (int i = 0; i < {rows}; i++)\n    for (int j = 0; j < {depth}; j++)\n"
        f"        ({result})[{depth} * i + j] = "
        f"({index})[i] == j || ({index})[i] + {depth} == j ? {number(on)} : {number(off)};"
    )


# Along axes


def _axes(program: Program, node: Node) -> list[int]:
    """Return the axes that a reduction goes along: an attribute, or since opset 13 or 18 an operand."""
    ranks = program.value(node.inputs[0]).ndim
    given = node.attributes.get("axes")
    if given is None and len(node.inputs) > 1 and node.inputs[1]:
        if not program.is_constant(node.inputs[1]):
            raise refused(node, "its axes are computed")
        given = program.value(node.inputs[1]).tolist()
    if not given:
        return [] if node.attributes.get("noop_with_empty_axes") else list(range(ranks))
    return [int(axis) % ranks for axis in given]


def _split_axes(program: Program, name: str, axes: Sequence[int]) -> tuple[str, str, list[str]]:
    """Return (loops over the kept axes and over the reduced ones, where they begin and the step to an element)."""
    shape, strides = program.value(name).shape, row_major(program.value(name).shape)
    kept = [axis for axis in range(len(shape)) if axis not in axes]
    outer = "".join(f"for (int i{a} = 0; i{a} < {shape[a]}; i{a}++) " for a in kept if shape[a] > 1)
    inner = "".join(f"for (int i{a} = 0; i{a} < {shape[a]}; i{a}++) " for a in axes if shape[a] > 1)
    terms = [" + ".join(f"{strides[a]} * i{a}" for a in part if shape[a] > 1) or "0" for part in (kept, list(axes))]
    return outer, inner, terms


def _reduce(program: Program, node: Node) -> None:
    source, axes = program.ref(node.inputs[0]), _axes(program, node)
    start, step, end = REDUCTIONS[node.op]
    kind, count = source.c_type, int(np.prod([program.value(node.inputs[0]).shape[axis] for axis in axes]))
    if source.dtype.kind != "f":
        limits = {"-INFINITY": f"{number(np.iinfo(source.dtype).min)}", "INFINITY": number(source.dtype.type(-1))}
        if "{f}" in end or start in ("INFINITY",) or node.op == "ReduceMean":
            raise refused(node, f"of {source.dtype.name} values")
        start, step = limits.get(start, start), step.replace(" || x != x", "")
    outer, inner, (kept, reduced) = _split_axes(program, node.inputs[0], axes)
    result = program.new(node.outputs[0])
    end = end.format(f="f" if kind == "float" else "").replace("n", str(count)) if "/ n" in end else end.format(
        f="f" if kind == "float" else "")  # fmt: skip
    program.emit(
        f"{{\n    int o = 0;\n    {outer}{{\n        {kind} a = {start};\n        {inner}{{\n"
        f"            const {kind} x = ({source})[{kept} + {reduced}];\n"
        f"            {_widened(step, kind)};\n        }}\n"
        f"        ({result})[o++] = {end};\n    }}\n}}"
    )


def _widened(step: str, kind: str) -> str:
    """Return `a += x` with the cast that small integers need."""
    left, operator, right = step.partition(" += ")
    return f"{left} = ({kind})({left} + ({right}))" if operator and kind not in ("float", "double") else step


def _softmax(program: Program, node: Node) -> None:
    """Softmax, LogSoftmax and ReduceLogSumExp, with the largest subtracted first."""
    source = program.ref(node.inputs[0])
    if node.op == "ReduceLogSumExp":
        axes = _axes(program, node)
    elif node.opset < 13:
        raise refused(node, "of an opset below 13")
    else:
        axes = [int(node.attributes.get("axis", -1)) % program.value(node.inputs[0]).ndim]
    outer, inner, (kept, reduced) = _split_axes(program, node.inputs[0], axes)
    result, kind = program.new(node.outputs[0]), source.c_type
    f = "f" if kind == "float" else ""
    place = f"[{kept} + {reduced}]"
    ends = {
        "Softmax": f"{inner}({result}){place} = exp{f}(({source}){place} - high) / sum;",
        "LogSoftmax": f"{inner}({result}){place} = ({source}){place} - high - log{f}(sum);",
        "ReduceLogSumExp": f"({result})[o++] = high + log{f}(sum);",
    }
    counter = "    int o = 0;\n" if node.op == "ReduceLogSumExp" else ""
    program.emit(
        f"{{\n{counter}    {outer}{{\n        {kind} high = -INFINITY, sum = 0;\n"
        f"        {inner}{{\n            const {kind} x = ({source}){place};\n"
        f"            high = high < x || x != x ? x : high;\n        }}\n"
        f"        {inner}sum += exp{f}(({source}){place} - high);\n        {ends[node.op]}\n    }}\n}}"
    )


def _arg(program: Program, node: Node) -> None:
    """The place of the largest (smallest), of equals the first or last."""
    source = program.ref(node.inputs[0])
    axis = int(node.attributes.get("axis", 0)) % program.value(node.inputs[0]).ndim
    outer, _, (kept, _) = _split_axes(program, node.inputs[0], [axis])
    stride, count = row_major(program.value(node.inputs[0]).shape)[axis], program.value(node.inputs[0]).shape[axis]
    beyond = {"ArgMax": (">", ">="), "ArgMin": ("<", "<=")}[node.op][int(node.attributes.get("select_last_index", 0))]
    result = program.new(node.outputs[0])
    program.emit(
        f"{{\n    int o = 0;\n    {outer}{{\n        int64_t best = 0;\n"
        f"        {source.c_type} a = ({source})[{kept}];\n"
        f"        for (int k = 1; k < {count}; k++) {{\n"
        f"            const {source.c_type} x = ({source})[{kept} + {stride} * k];\n"
        f"            if (x {beyond} a) {{\n                a = x;\n                best = k;\n            }}\n"
        f"        }}\n        ({result})[o++] = best;\n    }}\n}}"
    )


def _cumulative_sum(program: Program, node: Node) -> None:
    source, result = program.ref(node.inputs[0]), program.new(node.outputs[0])
    if not program.is_constant(node.inputs[1]) or node.attributes.get("exclusive") or node.attributes.get("reverse"):
        raise refused(node, "exclusive, reversed, or along a computed axis")
    axis = int(program.value(node.inputs[1]).ravel()[0]) % program.value(node.inputs[0]).ndim
    outer, inner, (kept, reduced) = _split_axes(program, node.inputs[0], [axis])
    place = f"[{kept} + {reduced}]"
    program.emit(
        f"{outer}{{\n    {source.c_type} sum = 0;\n    {inner}{{\n"
        f"        sum = ({source.c_type})(sum + ({source}){place});\n"
        f"        ({result}){place} = sum;\n    }}\n}}"
    )


def _top_k(program: Program, node: Node) -> None:
    """The k largest (smallest) in order, the first of equals first: k passes, for the few choices of a policy."""
    source = program.ref(node.inputs[0])
    shape = program.value(node.inputs[0]).shape
    axis = int(node.attributes.get("axis", -1)) % len(shape)
    if axis != len(shape) - 1 or not program.is_constant(node.inputs[1]):
        raise refused(node, "not along the last axis, or of a computed number")
    k, count = int(program.value(node.inputs[1]).ravel()[0]), shape[-1]
    better = ">" if node.attributes.get("largest", 1) else "<"
    named = [*node.outputs, ""][:2]
    values = program.new(named[0]) if named[0] in program.graph.values else program.temporary(source.dtype, k)
    places = program.new(named[1]) if named[1] in program.graph.values else program.temporary(np.int64, k * _rows(
        shape))  # fmt: skip
    program.emit(
        f"for (int r = 0; r < {_rows(shape)}; r++)\n    for (int k = 0; k < {k}; k++) {{\n"
        f"        const {source.c_type} *x = {source} + {count} * r;\n"
        f"        const int64_t *before = {places} + {k} * r;\n        int best = -1;\n"
        f"        for (int i = 0; i < {count}; i++) {{\n            int used = 0;\n"
        f"            for (int j = 0; j < k; j++) used |= before[j] == i;\n"
        f"            if (!used && (best < 0 || x[i] {better} x[best])) best = i;\n        }}\n"
        f"        ({places})[{k} * r + k] = best;\n        ({values})[{k} * r + k] = x[best];\n    }}"
    )


def _rows(shape: Sequence[int]) -> int:
    """Return how many rows an array has along its last axis."""
    return int(np.prod(shape[:-1]))


SPECIAL: dict[str, Callable[[Program, Node], None]] = {
    **LAYERS,
    "Cast": _cast, "Clip": _clip, "IsInf": _is_infinite, "Gather": _lookup, "GatherElements": _lookup,
    "OneHot": _one_hot, "Softmax": _softmax, "LogSoftmax": _softmax, "ReduceLogSumExp": _softmax, "ArgMax": _arg,
    "ArgMin": _arg, "CumSum": _cumulative_sum, "TopK": _top_k,
}  # fmt: skip
