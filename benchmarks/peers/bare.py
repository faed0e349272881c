"""Minimal server of a policy with validation: uvicorn, FastAPI, pydantic and onnxruntime, and a bare WebSocket.

    python benchmarks/peers/bare.py PORT POLICY.onnx

uvicorn takes uvloop and httptools, which its extra `standard` brings. The WebSocket at /ws takes an observation's bytes
and gives an action's, without a protocol around them.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import onnxruntime
import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
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

    @app.websocket("/ws")
    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        try:
            while True:
                obs = np.frombuffer(await socket.receive_bytes(), np.float32)[None]
                outputs: list[Any] = list(session.run(["action"], {"obs": obs}))
                await socket.send_bytes(outputs[0].tobytes())
        except WebSocketDisconnect:
            pass

    return app


if __name__ == "__main__":
    uvicorn.run(build(sys.argv[2]), host="127.0.0.1", port=int(sys.argv[1]), log_level="warning", access_log=False)
