"""Minimal server of a policy over HTTP: a bare ASGI application on uvicorn, orjson, onnxruntime. Checks nothing.

    python benchmarks/peers/bare_asgi.py PORT POLICY.onnx

(granian takes the application from `build_named`.)

The WebSocket takes an observation's bytes and gives an action's.
"""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np
import orjson
import uvicorn
from network import network


def build(onnx_file: str) -> Any:
    act = network(onnx_file)

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            while (message := await receive())["type"] == "websocket.receive":
                action = act(np.frombuffer(message["bytes"], np.float32))
                await send({"type": "websocket.send", "bytes": action.tobytes()})
            return
        if scope["type"] == "lifespan":  # Ray Serve's
            for event in ("startup", "shutdown"):
                await receive()
                await send({"type": f"lifespan.{event}.complete"})
            return
        body, more = b"", True
        while more:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
        request = orjson.loads(body)
        reply = {"action": act(request["obs"]), "policy": "ur5_positioning_disturbed", "version": "1"}
        reply |= {"infer_ms": 0.0123, "seq": request["seq"]}  # as long as ours
        content = orjson.dumps(reply, option=orjson.OPT_SERIALIZE_NUMPY)
        headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(content))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": content})

    return app


def build_named() -> Any:
    return build(os.environ["POLICY_ONNX"])


if __name__ == "__main__":
    app = build(sys.argv[2])
    uvicorn.run(app, host="127.0.0.1", port=int(sys.argv[1]), log_level="warning", access_log=False, lifespan="off")
