"""Requests of the Open Inference Protocol over gRPC, and its methods called without a connection."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np

from rlservo.serve_app.protocols.open_inference.grpc_service import Grpc
from rlservo.serve_app.protocols.open_inference.oip_messages import messages

KINDS = {bool: "bool_param", int: "int64_param", float: "double_param", str: "string_param"}


def infer_request(obs: Any, policy: str = "ur5", **parameters: Any) -> Any:
    """Return a ModelInferRequest for a batch of float32 observations."""
    batch = np.float32(obs)
    asked = messages.ModelInferRequest(model_name=policy, raw_input_contents=[batch.tobytes()])
    asked.inputs.add(name="obs", datatype="FP32", shape=batch.shape)
    for name, value in parameters.items():
        setattr(asked.parameters[name], KINDS[type(value)], value)
    return asked


class GrpcCall:
    """What a method is given of its call, and tells it."""

    def __init__(self, key: str = "") -> None:
        self._metadata = (("authorization", f"Bearer {key}"),) if key else ()
        self.code: Any = None
        self.details = ""
        self.trailing: dict[str, str] = {}

    def peer(self) -> str:
        return "ipv4:127.0.0.1:4711"

    def invocation_metadata(self) -> Any:
        return self._metadata

    def set_code(self, code: Any) -> None:
        self.code = code

    def set_details(self, details: str) -> None:
        self.details = details

    def set_trailing_metadata(self, pairs: Any) -> None:
        self.trailing.update(pairs)


def answered(
    handler: Any, message: Any, *, method: str = "ModelInfer", key: str = "", remaining_s: float | None = None
) -> tuple[Any, GrpcCall]:
    """Return (reply, the call) of a method."""
    call = GrpcCall(key)
    return asyncio.run(Grpc(handler).answer(method, message.SerializeToString(), call, remaining_s)), call
