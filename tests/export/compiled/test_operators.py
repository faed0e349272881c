"""C of every operator, in one graph beside onnxruntime; what has no C is refused by name."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from bundles import contract_of, save_graph, write_bundle
from rlservo.bundle.spaces import BoxSpec
from rlservo.errors import UnsupportedError
from rlservo.export.compiled.compile import compile_bundle

WIDTH = 60  # of the observation: as a plane of 2 x 5 x 6, or a table of 10 x 6
RNG = np.random.default_rng(0)


def some(*shape: int) -> NDArray[np.float32]:
    return (RNG.standard_normal(shape) * 0.5).astype(np.float32)


def ints(*values: int) -> NDArray[np.int64]:
    return np.array(values, np.int64)


X, PLANE, TABLE, COUNTS = "obs", "plane", "table", "counts"
FLOAT, INT64, INT32, UINT8, BOOL, DOUBLE = (
    TensorProto.FLOAT, TensorProto.INT64, TensorProto.INT32, TensorProto.UINT8, TensorProto.BOOL, TensorProto.DOUBLE,
)  # fmt: skip
# (operator, operands: names or constants, attributes)
CASES: list[tuple[str, list[Any], dict[str, Any]]] = [
    *((name, [X], {}) for name in (
        "Abs", "Neg", "Exp", "Floor", "Ceil", "Round", "Sign", "Erf", "Sin", "Cos", "Atan", "Sinh", "Asinh", "Tanh",
        "Sigmoid", "Relu", "LeakyRelu", "Elu", "Celu", "Selu", "Softplus", "Softsign", "HardSigmoid", "HardSwish",
        "ThresholdedRelu", "Identity", "Mish",
    )),
    *((name, ["positive"], {}) for name in ("Sqrt", "Log", "Reciprocal", "Acosh")),
    *((name, ["small"], {}) for name in ("Asin", "Acos", "Atanh", "Tan", "Cosh")),
    *((name, [X, some(WIDTH)], {}) for name in ("Add", "Sub", "Mul", "Max", "Min", "PRelu")),
    ("Div", [X, np.abs(some(WIDTH)) + 1], {}), ("Pow", ["positive", np.float32(1.5)], {}), ("Pow", [X, ints(2)], {}),
    ("Mod", [X, np.abs(some(WIDTH)) + 1], {"fmod": 1}), ("Clip", [X, np.float32(-0.3), np.float32(0.4)], {}),
    ("Clip", [X, np.float32(-0.3)], {}), ("Where", ["is_high", X, some(WIDTH)], {}),
    *((name, ["is_high", "is_low"], {}) for name in ("And", "Or", "Xor", "Equal")), ("Not", ["is_high"], {}),
    *((name, [X, some(WIDTH)], {}) for name in ("Less", "LessOrEqual", "Greater", "GreaterOrEqual")),
    ("IsNaN", [X], {}), ("IsInf", [X], {}), ("Cast", ["bytes"], {"to": INT32}), ("Cast", ["is_high"], {"to": DOUBLE}),
    *((name, [COUNTS, ints(3)], {}) for name in ("Add", "Sub", "Mul", "Div", "Mod", "Max", "Min", "Equal", "Less")),
    ("Mod", [COUNTS, ints(-3)], {"fmod": 1}), ("Abs", [COUNTS], {}), ("Neg", [COUNTS], {}), ("Sign", [COUNTS], {}),
    ("Transpose", [PLANE], {"perm": [0, 3, 1, 2]}),
    ("Slice", [PLANE, ints(4, 0), ints(0, 6), ints(2, 3), ints(-2, 3)], {}),
    ("Gather", [TABLE, ints(3, 0, 3, -1)], {"axis": 1}), ("Concat", [X, "small", X], {"axis": 1}),
    ("Pad", [PLANE, ints(0, 0, 1, 2, 0, 0, 0, 1), np.float32(0.7)], {}),
    ("Pad", [PLANE, ints(0, 0, 1, 1, 0, 0, 1, 1)], {"mode": "reflect"}), ("Tile", [TABLE, ints(1, 1, 2)], {}),
    ("Expand", ["column", ints(1, 10, 3)], {}), ("Trilu", [TABLE], {}), ("DepthToSpace", ["deep"], {"blocksize": 2}),
    ("Gather", [some(20, 3), "choices"], {"axis": 0}), ("Clip", [X, "", np.float32(0.4)], {}),
    ("OneHot", ["choices", ints(20), np.float32([0.0, 1.0])], {}),
    *((name, [TABLE, ints(1)], {"keepdims": 0}) for name in (
        "ReduceMean", "ReduceMax", "ReduceMin", "ReduceL1", "ReduceL2", "ReduceProd", "ReduceSumSquare",
        "ReduceLogSumExp",
    )),
    ("ReduceSum", [TABLE, ints(1, 2)], {}), ("ReduceSum", [COUNTS, ints(1)], {"keepdims": 1}),
    ("Softmax", [TABLE], {"axis": 1}), ("LogSoftmax", [TABLE], {"axis": -1}), ("ArgMax", [TABLE], {"axis": 1}),
    ("ArgMin", [TABLE], {"axis": -1, "select_last_index": 1}),
    ("LayerNormalization", [TABLE, some(6), some(6)], {}), ("LayerNormalization", [TABLE, some(10, 6)], {"axis": 1}),
    ("BatchNormalization", [PLANE, some(2), some(2), some(2), np.abs(some(2)) + 0.1], {}),
    ("Gemm", [X, some(WIDTH, 70), some(70)], {"alpha": 0.5, "beta": 2.0}), ("MatMul", [X, some(WIDTH, 9)], {}),
    ("MatMul", [TABLE, "flipped"], {}), ("MatMul", [some(3, 10), TABLE], {}), ("IsInf", [X], {"detect_negative": 0}),
    ("Conv", [PLANE, some(3, 2, 3, 3), some(3)], {"pads": [1, 0, 1, 2], "strides": [2, 1]}),
    ("Conv", [PLANE, some(4, 1, 2, 2)], {"group": 2, "dilations": [2, 1]}),
    ("Conv", ["rows", some(4, 10, 3)], {}), ("MaxPool", [PLANE], {"kernel_shape": [2, 2], "strides": [2, 2]}),
    ("MaxPool", [PLANE], {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1]}),
    ("AveragePool", [PLANE], {"kernel_shape": [2, 3]}), ("GlobalAveragePool", [PLANE], {}),
    ("AveragePool", [PLANE], {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1], "count_include_pad": 1}),
    ("GlobalMaxPool", [PLANE], {}),
]  # fmt: skip
RECURRENT: list[tuple[str, list[Any], dict[str, Any]]] = [
    ("LSTM", ["steps", some(1, 12, 6), some(1, 12, 3), some(1, 24)], {}),
    ("LSTM", ["steps", some(1, 12, 6), some(1, 12, 3)], {}),
    ("GRU", ["steps", some(1, 9, 6), some(1, 9, 3), some(1, 18)], {"linear_before_reset": 1}),
]  # fmt: skip
PREPARED: list[tuple[str, str, list[Any], dict[str, Any]]] = [
    (PLANE, "Reshape", [X, ints(0, 2, 5, 6)], {}), (TABLE, "Reshape", [X, ints(0, 10, 6)], {}),
    ("deep", "Reshape", [X, ints(0, 4, 3, 5)], {}), ("rows", "Identity", [TABLE], {}),
    ("column", "Slice", [TABLE, ints(0), ints(1), ints(2)], {}), ("flipped", "Transpose", [TABLE], {"perm": [0, 2, 1]}),
    ("steps", "Transpose", [TABLE], {"perm": [1, 0, 2]}),
    ("magnitude", "Abs", [X], {}), ("positive", "Add", ["magnitude", np.float32(1.0)], {}),
    ("soft", "Tanh", [X], {}), ("small", "Mul", ["soft", np.float32(0.9)], {}),
    ("is_high", "Greater", [X, np.float32(0.2)], {}), ("is_low", "Less", [X, np.float32(-0.2)], {}),
    ("tens", "Mul", ["soft", np.float32(9.7)], {}), (COUNTS, "Cast", ["tens"], {"to": INT64}),
    ("byte", "Abs", ["tens"], {}), ("bytes", "Cast", ["byte"], {"to": UINT8}),
    ("few", "Slice", [COUNTS, ints(0), ints(4), ints(1)], {}), ("choices", "Abs", ["few"], {}),
]  # fmt: skip


def all_operators(root: Path, *more: tuple[str, list[Any], dict[str, Any]], cases: bool = True) -> Path:
    """Write a bundle whose action is what every case computes of the observation, one beside the other."""
    folder = root / "operators" / "1"
    folder.mkdir(parents=True)
    nodes, constants, parts = [], {}, []

    def add(op: str, operands: list[Any], outputs: list[str], attributes: dict[str, Any]) -> None:
        names = []
        for operand in operands:
            name = operand if isinstance(operand, str) else f"constant_{len(constants)}"
            if not isinstance(operand, str):
                constants[name] = np.asarray(operand)
            names.append(name)
        nodes.append(helper.make_node(op, names, outputs, **attributes))

    for name, op, operands, attributes in PREPARED:
        add(op, operands, [name], attributes)
    wanted = [*CASES, *RECURRENT, *more] if cases else list(more)
    for number, (op, operands, attributes) in enumerate(wanted):
        outputs = [f"out_{number}"]
        if op in ("LSTM", "GRU"):
            attributes, outputs = {"hidden_size": 3, **attributes}, [f"all_{number}", f"last_{number}"]
        add(op, operands, outputs, attributes)
        for output in outputs:
            if op in ("LSTM", "GRU"):  # [steps, 1, batch, 3] and [1, batch, 3]
                perm = [2, 0, 1, 3] if output.startswith("all") else [1, 0, 2]
                add("Transpose", [output], [f"batch_{output}"], {"perm": perm})
                output = f"batch_{output}"
            add("Cast", [output], [f"float_{output}"], {"to": FLOAT})
            add("Flatten", [f"float_{output}"], [f"flat_{output}"], {"axis": 1})
            parts.append(f"flat_{output}")
    add("Concat", parts, ["all"], {"axis": 1})
    add("Identity", ["all"], ["action"], {})
    return bundle_of(folder, nodes, constants, np.clip(some(16, WIDTH) * 2, -1, 1))


def bundle_of(folder: Path, nodes: list[Any], constants: dict[str, Any], golden: NDArray[np.float32]) -> Path:
    """Write a bundle of a graph from `obs` to `action`."""
    save_graph(
        folder / "policy.onnx", nodes, constants, [(X, FLOAT, ["batch", WIDTH])], [("action", FLOAT, ["batch", "n"])]
    )
    import onnxruntime

    (action,) = onnxruntime.InferenceSession(folder / "policy.onnx").run(["action"], {X: golden})
    size = action.shape[1]
    contract = contract_of(
        folder.parent.name,
        BoxSpec(shape=(WIDTH,), dtype="float32", low=-1.0, high=1.0),
        BoxSpec(shape=(size,), dtype="float32", low=None, high=None),
    )
    return write_bundle(folder, contract, golden)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_every_operator_computes_what_onnxruntime_computes(tmp_path: Path) -> None:
    made = compile_bundle(all_operators(tmp_path), tmp_path / "c")
    assert made.proof is not None
    assert made.proof.max_rel < 1


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_what_rounding_explains_is_allowed_and_counted(tmp_path: Path) -> None:
    """Large numbers that cancel out: what is left depends on the order in which they are added."""
    folder = tmp_path / "cancelling" / "1"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    order, matrix = rng.permutation(WIDTH), rng.standard_normal((WIDTH, 3)).astype(np.float32) * 1000
    nodes = [
        helper.make_node("Sin", [X], ["sine"]),
        helper.make_node("Gather", ["sine", "order"], ["shuffled"], axis=1),
        helper.make_node("MatMul", ["sine", "matrix"], ["one"]),
        helper.make_node("MatMul", ["shuffled", "shuffled_matrix"], ["other"]),
        helper.make_node("Sub", ["one", "other"], ["action"]),
    ]
    constants = {"order": order, "matrix": matrix, "shuffled_matrix": matrix[order]}
    made = compile_bundle(bundle_of(folder, nodes, constants, np.zeros((4, WIDTH), np.float32)), tmp_path / "c")
    assert made.proof is not None and made.proof.max_rel <= 1
    assert 100 < made.proof.rounding_used < 10_000 and made.proof.rounding_most > 1


@pytest.mark.parametrize(
    ("case", "sentence"),
    [
        (("Det", ["square"], {}), "the operator Det of the policy's graph cannot be compiled to C"),
        (("LSTM", ["steps", some(1, 12, 6), some(1, 12, 3)], {"direction": "reverse"}), "the operator LSTM .* forward"),
        (("GRU", ["steps", some(1, 9, 6), some(1, 9, 3)], {}), "the operator GRU .* gates other than torch's"),
        (("Max", [X, X, X], {}), "the operator Max .*: of 3 operands"),
        (("Hardmax", [X], {}), "the operator Hardmax"),
    ],
)
def test_an_operator_without_c_is_refused_by_name(
    tmp_path: Path, case: tuple[str, list[Any], dict[str, Any]], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    square = ("square", "Slice", [TABLE, ints(0), ints(6), ints(1)], {})
    monkeypatch.setattr(f"{__name__}.PREPARED", [*PREPARED, square])
    bundle = all_operators(tmp_path, case, cases=False)
    with pytest.raises(UnsupportedError, match=sentence):
        compile_bundle(bundle, tmp_path / "c")
    assert not (tmp_path / "c").exists()
