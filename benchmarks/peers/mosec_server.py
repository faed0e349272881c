"""Mosec with one worker, which reads and writes JSON: python mosec_server.py --port PORT, with POLICY_ONNX.

Its front end, written in Rust, hands each request to the worker's process.
"""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import os
from typing import Any

import numpy as np
import onnxruntime
from mosec import Server, Worker


class PolicyWorker(Worker):  # type: ignore[misc]
    """Answers with the policy's action."""

    def __init__(self) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            os.environ["POLICY_ONNX"], options, providers=["CPUExecutionProvider"]
        )

    def forward(self, data: Any) -> dict[str, Any]:
        obs = np.asarray(data["obs"], np.float32)[None]
        outputs: Any = self._session.run(["action"], {"obs": obs})
        return {"action": outputs[0][0].tolist()}


if __name__ == "__main__":
    server = Server()
    server.append_worker(PolicyWorker, num=1)
    server.run()
