"""A first server with Ray Serve: a FastAPI ingress over onnxruntime, on Ray Serve's defaults.

python benchmarks/peers/ray_serve_defaults.py PORT POLICY.onnx
"""

# No `from __future__ import annotations` here: Serve pickles the application, and FastAPI would not find the types.

import signal
import sys
import threading
from typing import Any

import numpy as np
import onnxruntime
import ray
from fastapi import FastAPI
from pydantic import BaseModel
from ray import serve

app = FastAPI()


class Request(BaseModel):
    obs: list[float]


class Reply(BaseModel):
    action: list[float]


@serve.deployment
@serve.ingress(app)
class PolicyServer:
    def __init__(self, onnx_file: str) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(onnx_file, options, providers=["CPUExecutionProvider"])

    @app.post("/act")
    async def act(self, request: Request) -> Reply:
        outputs: list[Any] = list(self._session.run(["action"], {"obs": np.array([request.obs], np.float32)}))
        return Reply(action=outputs[0][0].tolist())


def main(port: int, onnx_file: str) -> None:
    stop = threading.Event()
    # The dashboard is not on a request's path; without it the machine is quieter, which favours this peer.
    ray.init(include_dashboard=False, log_to_driver=False)
    for number in (signal.SIGTERM, signal.SIGINT):  # after ray.init, which installs its own
        signal.signal(number, lambda *_: stop.set())
    try:
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        deployment: Any = PolicyServer  # a Deployment: serve's decorator is typed as if it left the class alone
        serve.run(deployment.bind(onnx_file), route_prefix="/")
        stop.wait()
    finally:
        serve.shutdown()
        ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
