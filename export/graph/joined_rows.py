"""Operators of an ONNX file that join a batch's observations into one number, on which the outputs depend.

No comparison of actions is sure to show them: a stop for all if one observation is far out, or if not all quaternions
have length 1, may be the same for every sample.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from rlservo.export.graph.onnx_file import reads
from rlservo.export.recipe.runners import Inputs
from rlservo.policy.data_dependence import SIZES, deciding_by_data
from rlservo.policy.ort_session import open_ort_session

ROWS = (5, 7)
"""Numbers of observations: what has the same shape for both has no axis for them."""


def joined_rows(file: Path, example: Inputs) -> str:
    """Return the first operator that the outputs depend on and that loses the batch's axis; '' if there is none.

    `example` is one row or more of every input.
    """
    if deciding_by_data(file.read_bytes()):
        return ""  # sizes depend on the observations: no policy is loaded from such a file
    model = onnx.load(str(file))
    batches = [{name: np.repeat(rows[:1], size, axis=0) for name, rows in example.items()} for size in ROWS]
    try:
        shapes = [_shapes(model, batch) for batch in batches]
    except Exception:  # onnxruntime's own, for a size that is baked in: the proof reports it
        return ""
    has_axis = set(example) | {name for name, shape in shapes[0].items() if shape != shapes[1][name]}
    computed, joined = set(example), dict[str, str]()
    for node in model.graph.node:
        given = computed.intersection(reads(node))
        if not given or node.op_type in SIZES:
            continue
        computed.update(node.output)
        before = next((joined[name] for name in reads(node) if name in joined), "")
        for name in node.output:
            if before or (given & has_axis and name not in has_axis):
                joined[name] = before or f"{node.op_type} '{node.name or name}'"
    return next((joined[output.name] for output in model.graph.output if output.name in joined), "")


def _shapes(model: onnx.ModelProto, inputs: Inputs) -> dict[str, Any]:
    """Return the shape of every value that the model computes; of a sequence, those of its parts."""
    opened: Any = onnx.ModelProto()
    opened.CopyFrom(model)
    known = {output.name for output in model.graph.output}
    for name in (name for node in model.graph.node for name in node.output if name and name not in known):
        opened.graph.output.append(onnx.helper.make_empty_tensor_value_info(name))
    with tempfile.TemporaryDirectory() as folder:
        onnx.save(opened, f"{folder}/opened.onnx")
        ort_session = open_ort_session(Path(folder, "opened.onnx"))
    names = [output.name for output in ort_session.get_outputs()]
    values: Any = ort_session.run(names, {one.name: inputs[one.name] for one in ort_session.get_inputs()})
    shapes = ([np.shape(part) for part in value] if isinstance(value, list) else np.shape(value) for value in values)
    return dict(zip(names, shapes, strict=True))
