"""Robyn with one process and one worker: python robyn_server.py PORT POLICY.onnx."""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import json
import sys
from typing import Any

from network import network

port, onnx_file = int(sys.argv[1]), sys.argv[2]
sys.argv[1:] = ["--log-level", "ERROR"]  # Robyn reads the command line itself
from robyn import Response, Robyn  # noqa: E402

policy = network(onnx_file)
app = Robyn(__file__)


@app.post("/act")  # type: ignore[untyped-decorator]  # as above
async def act(request: Any) -> Any:
    content = json.dumps({"action": policy(json.loads(request.body)["obs"]).tolist()})
    return Response(status_code=200, headers={"content-type": "application/json"}, description=content)


if __name__ == "__main__":
    app.start(host="127.0.0.1", port=port)
