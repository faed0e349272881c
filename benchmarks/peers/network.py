"""The policy's network in onnxruntime with one thread, as every peer of `serving_peers.py` runs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray


def network(onnx_file: str) -> Callable[[Any], NDArray[np.float32]]:
    """Return a function that gives the action of one observation."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx_file, options, providers=["CPUExecutionProvider"])

    def act(obs: Any) -> NDArray[np.float32]:
        outputs: Any = session.run(["action"], {"obs": np.asarray(obs, np.float32)[None]})
        action: NDArray[np.float32] = outputs[0][0]
        return action

    return act
