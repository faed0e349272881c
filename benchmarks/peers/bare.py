"""Minimal server of a policy with validation: uvicorn, FastAPI, pydantic and onnxruntime, and a bare WebSocket.

    python benchmarks/peers/bare.py PORT POLICY.onnx

uvicorn takes uvloop and httptools, which its extra `standard` brings. The WebSocket at /ws takes an observation's bytes
and gives an action's, without a protocol around them.
"""

from __future__ import annotations

import sys

import numpy as np
import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from network import network
from pydantic import BaseModel


class Request(BaseModel):
    obs: list[float]


class Reply(BaseModel):
    action: list[float]


def build(onnx_file: str) -> FastAPI:
    policy = network(onnx_file)
    app = FastAPI()

    @app.post("/act")
    async def act(request: Request) -> Reply:
        return Reply(action=policy(request.obs).tolist())

    @app.websocket("/ws")
    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        try:
            while True:
                await socket.send_bytes(policy(np.frombuffer(await socket.receive_bytes(), np.float32)).tobytes())
        except WebSocketDisconnect:
            pass

    return app


if __name__ == "__main__":
    uvicorn.run(build(sys.argv[2]), host="127.0.0.1", port=int(sys.argv[1]), log_level="warning", access_log=False)
