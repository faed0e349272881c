"""BentoML: one worker, an asynchronous endpoint, no access log.

POLICY_ONNX=POLICY.onnx python -m bentoml serve bentoml_service:PolicyService --port PORT
"""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import os

import bentoml
from network import network


@bentoml.service(workers=1, logging={"access": {"enabled": False}}, metrics={"enabled": False})
class PolicyService:
    def __init__(self) -> None:
        self._act = network(os.environ["POLICY_ONNX"])

    @bentoml.api(route="/act")  # type: ignore[untyped-decorator]  # as above
    async def act(self, obs: list[float]) -> dict[str, list[float]]:
        return {"action": self._act(obs).tolist()}
