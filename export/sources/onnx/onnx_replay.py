"""A given ONNX file in onnxruntime, step after step: the reference of its export."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from rlservo.errors import CheckpointError, first_line
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.sources.leapp_description import StageTensor
from rlservo.export.sources.onnx.onnx_tensors import Tensors
from rlservo.policy.ort_session import open_ort_session

TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16,
         "tensor(int64)": np.int64, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}  # fmt: skip


def open_given(file: Path) -> Any:
    """Return onnxruntime's session of a file. Raises CheckpointError."""
    try:
        return open_ort_session(file)
    except Exception as error:  # onnxruntime's exceptions share no base but Exception
        raise CheckpointError(f"{file} cannot be opened by onnxruntime: {first_line(error)}") from error


def one_row(file: Path, session: Any) -> tuple[Inputs, Outputs]:
    """Return zeros for each input, sizes that the file leaves open 1, and what the file gives for them."""
    inputs: Inputs = {
        one.name: np.zeros(
            [size if isinstance(size, int) and size > 0 else 1 for size in one.shape], TYPES.get(one.type, np.uint8)
        )
        for one in session.get_inputs()
    }
    names = [one.name for one in session.get_outputs()]
    try:
        return inputs, dict(zip(names, session.run(names, inputs), strict=True))
    except Exception as error:
        raise CheckpointError(
            f"{file} does not run on one row of zeros ({_shapes(inputs)}): {first_line(error)}"
        ) from error


def _shapes(inputs: Inputs) -> str:
    return ", ".join(f"{name} {values.dtype} {list(values.shape)}" for name, values in inputs.items())


def golden_sets(file: Path, session: Any) -> int:
    """Run the file's own test vectors (`test_data_set_*/input_0.pb`, as ONNX's model zoo has them); return their count.

    Raises CheckpointError if the file does not give them.
    """
    folders = sorted(file.parent.glob("test_data_set_*"))
    for folder in folders:
        given, wanted = (
            [numpy_helper.to_array(onnx.load_tensor(str(one))) for one in sorted(folder.glob(f"{side}_*.pb"))]
            for side in ("input", "output")
        )
        sides = session.get_inputs(), session.get_outputs()
        if (len(given), len(wanted)) != (len(sides[0]), len(sides[1])):
            raise CheckpointError(
                f"{folder} has {len(given)} inputs and {len(wanted)} outputs, but {file.name} has {len(sides[0])} and "
                f"{len(sides[1])}: expected one file for each, input_0.pb and so on"
            )
        feed = dict(zip([one.name for one in sides[0]], given, strict=True))
        try:
            found = session.run(None, feed)
        except Exception as error:
            raise CheckpointError(f"{file} does not run on {folder.name}: {first_line(error)}") from error
        for one, ours, theirs in zip(sides[1], found, wanted, strict=True):
            if ours.shape != theirs.shape or not np.allclose(ours, theirs, 1e-4, 1e-5):
                raise CheckpointError(
                    f"{folder.name} beside {file} has '{one.name}' {theirs.ravel()[:3].tolist()} ..., but onnxruntime "
                    f"gives {ours.ravel()[:3].tolist()} ...: they do not belong together"
                )
    return len(folders)


class OrtLoop:
    """The file with one row after the other, each row's state apart."""

    def __init__(self, file: Path, tensors: Tensors, given: Mapping[str, StageTensor], recipe: Recipe) -> None:
        """`given` are the observation's tensors by the policy's names."""
        self._session, self._tensors, self._given, self._recipe = open_given(file), tensors, given, recipe
        self._rows: list[dict[str, NDArray[Any]]] = []

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return the action in the environment's units and the next state, for every row."""
        self._rows = self._rows or [{}] * len(restart)
        rows = []
        for row, begins in enumerate(restart.tolist()):
            state = {} if begins else self._rows[row]
            feed = {tensor.name: inputs[name][row].reshape(tensor.shape) for name, tensor in self._given.items()}
            for into in self._tensors.zeros:
                feed[into.name] = state.get(into.name, np.zeros(into.shape, into.dtype))
            answers = [self._tensors.action, *(out for _, out in self._tensors.states.values())]
            found = self._session.run([tensor.name for tensor in answers], feed)
            action, *after = found
            named = zip(self._tensors.states.items(), after, strict=True)
            self._rows[row] = {}
            outputs = {"action": self._sent(action.reshape(self._tensors.action.row), inputs, row)}
            for (name, (into, _)), values in named:
                self._rows[row][into.name] = values
                outputs[f"state_out.{name}"] = values.reshape(into.row)
            rows.append(outputs)
        return {name: np.stack([each[name] for each in rows]) for name in rows[0]}

    def _sent(self, action: NDArray[Any], inputs: Inputs, row: int) -> NDArray[Any]:
        if self._recipe.affine is not None:
            action = self._recipe.affine.apply(action)
        if (present := self._recipe.present) is not None:
            action = np.clip(action, present.low, present.high) + present.positions(inputs["obs"][row])
        space = self._recipe.action_space
        return np.asarray(np.clip(action, space.low, space.high), np.float32)
