"""BentoML: one worker, an asynchronous endpoint, no access log.

POLICY_ONNX=POLICY.onnx python -m bentoml serve bentoml_service:PolicyService --port PORT
"""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import os
from typing import Any

import bentoml
import numpy as np
import onnxruntime


@bentoml.service(workers=1, logging={"access": {"enabled": False}}, metrics={"enabled": False})
class PolicyService:
    def __init__(self) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            os.environ["POLICY_ONNX"], options, providers=["CPUExecutionProvider"]
        )

    @bentoml.api(route="/act")  # type: ignore[untyped-decorator]  # as above
    async def act(self, obs: list[float]) -> dict[str, list[float]]:
        outputs: Any = self._session.run(["action"], {"obs": np.array([obs], np.float32)})
        return {"action": outputs[0][0].tolist()}
