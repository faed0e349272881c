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
from network import network


class PolicyAPI(litserve.LitAPI):  # type: ignore[misc]  # its base class is not in the type checker's environment
    def setup(self, device: str) -> None:  # noqa: ARG002  # LitServe's interface
        self._act = network(sys.argv[2])

    def decode_request(self, request):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201  # LitServe reads annotations
        return request["obs"]

    def predict(self, obs: Any) -> Any:
        return self._act(obs)

    def encode_response(self, action: Any) -> dict[str, Any]:
        return {"action": action.tolist()}


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
