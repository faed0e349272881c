"""The least that serves a policy with validation: uvicorn, FastAPI, pydantic and onnxruntime, nothing else.

python benchmarks/peers/bare.py PORT POLICY.onnx
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import onnxruntime
import uvicorn
from fastapi import FastAPI
from pydantic import BaseModel


class Request(BaseModel):
    obs: list[float]


class Reply(BaseModel):
    action: list[float]


def build(onnx_file: str) -> FastAPI:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx_file, options, providers=["CPUExecutionProvider"])
    app = FastAPI()

    @app.post("/act")
    async def act(request: Request) -> Reply:
        outputs: list[Any] = list(session.run(["action"], {"obs": np.array([request.obs], np.float32)}))
        return Reply(action=outputs[0][0].tolist())

    return app


if __name__ == "__main__":
    uvicorn.run(build(sys.argv[2]), host="127.0.0.1", port=int(sys.argv[1]), log_level="warning", access_log=False)
