"""Differences of a compiled policy from onnxruntime: rounding is allowed, as far as its last bits explain it."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from bundles import contract_of, save_graph, write_bundle
from rlservo.bundle.spaces import BoxSpec
from rlservo.errors import ParityError
from rlservo.export.compiled import proof
from rlservo.export.compiled.compile import compile_bundle

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

Layers = tuple[list[Any], dict[str, NDArray[Any]]]
SHAPES = {  # image, then channels and kernels of its convolutions
    "one channel": ((24, 24, 1), (8, 5), (5, 3)),
    "colours": ((20, 28, 3), (16, 11), (4, 3)),
    "frames": ((21, 21, 4), (32,), (8,)),
}


def network(shape: tuple[int, ...], channels: tuple[int, ...], kernels: tuple[int, ...], gain: float) -> Layers:
    """Return a network on raw bytes: its numbers before the action's bounds are some hundreds."""
    rng = np.random.default_rng(3)
    nodes = [
        helper.make_node("Cast", ["obs"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["float"], ["x0"], perm=[0, 3, 1, 2]),
    ]
    constants: dict[str, NDArray[Any]] = {}
    inner, (height, width) = shape[2], shape[:2]

    def weights(*size: int) -> NDArray[np.float32]:
        return (gain * rng.standard_normal(size) / np.sqrt(np.prod(size[1:]))).astype(np.float32)

    for layer, (outer, kernel) in enumerate(zip(channels, kernels, strict=True)):
        constants[f"w{layer}"], constants[f"b{layer}"] = weights(outer, inner, kernel, kernel), weights(outer, 4)[:, 0]
        operands = [f"x{layer}", f"w{layer}", f"b{layer}"]
        nodes.append(helper.make_node("Conv", operands, [f"c{layer}"], strides=[2, 2]))
        nodes.append(helper.make_node("Relu", [f"c{layer}"], [f"x{layer + 1}"]))
        inner, height, width = outer, (height - kernel) // 2 + 1, (width - kernel) // 2 + 1
    constants["w"], constants["low"], constants["high"] = (
        weights(3, inner * height * width).T.copy(), np.float32(-1), np.float32(1)
    )  # fmt: skip
    nodes += [
        helper.make_node("Flatten", [f"x{len(channels)}"], ["flat"], axis=1),
        helper.make_node("MatMul", ["flat", "w"], ["raw"]),
        helper.make_node("Clip", ["raw", "low", "high"], ["action"]),
    ]
    return nodes, constants


def bundle(folder: Path, shape: tuple[int, ...], layers: Layers) -> Path:
    """Write a bundle from an image of bytes to three bounded numbers."""
    folder.mkdir(parents=True)
    nodes, constants = layers
    observed, acted = ("obs", TensorProto.UINT8, ["batch", *shape]), ("action", TensorProto.FLOAT, ["batch", 3])
    save_graph(folder / "policy.onnx", nodes, constants, [observed], [acted])
    obs = BoxSpec(shape=shape, dtype="uint8", low=0, high=255)
    contract = contract_of("image", obs, BoxSpec(shape=(3,), dtype="float32", low=-1.0, high=1.0))
    return write_bundle(folder, contract, np.random.default_rng(0).integers(0, 256, (8, *shape), np.uint8))


@pytest.mark.parametrize("kind", SHAPES)
def test_convolutions_of_bytes_round_by_more_than_the_contracts_tolerance(kind: str, tmp_path: Path) -> None:
    """Bytes have no last bit to move: only the weights' show that these sums round by 1e-4 of the action's range."""
    made = compile_bundle(
        bundle(tmp_path / "image" / "1", SHAPES[kind][0], network(*SHAPES[kind], 4.0)), tmp_path / "c"
    )
    assert made.proof is not None and made.proof.max_rel <= 0.7
    assert made.proof.rounding_used > 0 and made.proof.rounding_most > 1


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("fault", ["a weight of 1%", "another bias", "a weight in another place"])
def test_a_wrong_weight_is_no_rounding(kind: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = proof.build

    def build(compiler: str, folder: Path, prefix: str, library: str) -> tuple[str, ...]:
        file = folder / f"{prefix}.c"
        text = file.read_text()
        tables = re.findall(r"\bweights_\d+\[\d+\] ALIGNED = {\n(.*?)\n};", text, re.DOTALL)
        values = [[float.fromhex(each.rstrip("f")) for each in re.findall(r"[^\s,]+", table)] for table in tables]
        place, most = max(enumerate(values), key=lambda item: max(map(abs, item[1])))
        largest = max(range(len(most)), key=lambda i: abs(most[i]))
        if fault == "a weight of 1%":
            most[largest] *= 1.01
        elif fault == "another bias":
            place, most = 0, values[0]
            most[0] += 1.0  # a layer's stream begins with its bias
        else:
            other = largest + (8 if largest + 8 < len(most) else -8)
            most[largest], most[other] = most[other], most[largest]
        file.write_text(text.replace(tables[place], ", ".join(f"{each.hex()}f" for each in most)))
        return written(compiler, folder, prefix, library)

    monkeypatch.setattr(proof, "build", build)
    with pytest.raises(ParityError, match=r"does not reproduce the golden vectors|observation \d+: output 'action'"):
        compile_bundle(
            bundle(tmp_path / "image" / "1", SHAPES[kind][0], network(*SHAPES[kind], 4.0)),
            tmp_path / "c",
        )
