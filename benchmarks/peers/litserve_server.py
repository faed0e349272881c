"""LitServe: one worker, one API server, its fast queue.

    python benchmarks/peers/litserve_server.py PORT POLICY.onnx

No batching: it would make a lone request wait for others.
"""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import sys
from typing import Any

import litserve
import numpy as np
import onnxruntime


class PolicyAPI(litserve.LitAPI):  # type: ignore[misc]  # its base class is not in the type checker's environment
    def setup(self, device: str) -> None:  # noqa: ARG002  # LitServe's interface
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(sys.argv[2], options, providers=["CPUExecutionProvider"])

    def decode_request(self, request):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201  # LitServe reads annotations
        return np.array([request["obs"]], np.float32)

    def predict(self, obs: Any) -> Any:
        return self._session.run(["action"], {"obs": obs})[0]

    def encode_response(self, action: Any) -> dict[str, Any]:
        return {"action": action[0].tolist()}


if __name__ == "__main__":
    server = litserve.LitServer(
        PolicyAPI(api_path="/act"), accelerator="cpu", workers_per_device=1, fast_queue=True, timeout=30
    )
    server.run(
        host="127.0.0.1",
        port=int(sys.argv[1]),
        num_api_servers=1,
        log_level="warning",
        access_log=False,
        generate_client_file=False,
    )
