"""Sanic in one process, without an access log: python sanic_server.py PORT POLICY.onnx."""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import sys
from typing import Any

from network import network
from sanic import Sanic, json

policy = network(sys.argv[2])
app = Sanic("policy")


@app.post("/act")  # type: ignore[untyped-decorator]  # as above
async def act(request: Any) -> Any:
    return json({"action": policy(request.json["obs"]).tolist()})


if __name__ == "__main__":
    app.run(host="127.0.0.1", port=int(sys.argv[1]), single_process=True, access_log=False, motd=False)
