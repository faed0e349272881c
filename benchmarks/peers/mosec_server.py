"""Mosec with one worker, which reads and writes JSON: python mosec_server.py --port PORT, with POLICY_ONNX.

Its front end, written in Rust, hands each request to the worker's process.
"""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import os
from typing import Any

from mosec import Server, Worker
from network import network


class PolicyWorker(Worker):  # type: ignore[misc]
    """Answers with the policy's action."""

    def __init__(self) -> None:
        self._act = network(os.environ["POLICY_ONNX"])

    def forward(self, data: Any) -> dict[str, Any]:
        return {"action": self._act(data["obs"]).tolist()}


if __name__ == "__main__":
    server = Server()
    server.append_worker(PolicyWorker, num=1)
    server.run()
