"""Sanic in one process, without an access log: python sanic_server.py PORT POLICY.onnx."""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import onnxruntime
from sanic import Sanic, json

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession(sys.argv[2], options, providers=["CPUExecutionProvider"])
app = Sanic("policy")


@app.post("/act")  # type: ignore[untyped-decorator]  # as above
async def act(request: Any) -> Any:
    outputs: Any = session.run(["action"], {"obs": np.asarray([request.json["obs"]], np.float32)})
    return json({"action": outputs[0][0].tolist()})


if __name__ == "__main__":
    app.run(host="127.0.0.1", port=int(sys.argv[1]), single_process=True, access_log=False, motd=False)
