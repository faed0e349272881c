"""Applications on Ray Serve, one replica each.

    python benchmarks/peers/on_ray.py PORT KIND SOURCE

KIND and SOURCE: `ours` and a folder of bundles; `bare` and POLICY.onnx, the ASGI application of `bare_asgi.py`, which
shows the cost of Ray Serve itself; `defaults` and POLICY.onnx, a first server: a FastAPI ingress; `rllib` and an
RLModule's checkpoint, RLlib's own example, unchanged (a torch RLModule in the replica; it answers an argmax whatever
the policy is, so only its time is compared).
"""

# No `from __future__ import annotations` here: FastAPI and Serve read types that are local to a function.

import signal
import sys
import threading
from typing import Any

import ray
from ray import serve


def ours(policies: str) -> Any:
    from rlservo.serve_app.engines.ray_serve import BuildArguments, build

    return build(BuildArguments(policies=[policies], replicas=1))


def bare(onnx_file: str) -> Any:
    @serve.deployment(logging_config={"enable_access_log": False, "log_level": "WARNING"}, max_ongoing_requests=1000)
    @serve.ingress()
    class Bare:
        def __serve_build_asgi_app__(self) -> Any:  # Serve's hook: the app is built in the replica
            from bare_asgi import build

            return build(onnx_file)

    return _bound(Bare)


def defaults(onnx_file: str) -> Any:
    from fastapi import FastAPI
    from pydantic import BaseModel

    app = FastAPI()

    class Request(BaseModel):
        obs: list[float]

    class Reply(BaseModel):
        action: list[float]

    @serve.deployment
    @serve.ingress(app)
    class PolicyServer:
        def __init__(self) -> None:
            from network import network

            self._act = network(onnx_file)

        @app.post("/act")
        async def act(self, request: Request) -> Reply:
            return Reply(action=self._act(request.obs).tolist())

    return _bound(PolicyServer)


def rllib(checkpoint: str) -> Any:
    from ray.rllib.examples.ray_serve.classes.cartpole_deployment import ServeRLlibRLModule

    return _bound(ServeRLlibRLModule, checkpoint)


def _bound(deployment: Any, *arguments: str) -> Any:
    """Return the application of a Deployment: serve's decorator is typed as if it left the class alone."""
    return deployment.bind(*arguments)


def main(port: int, kind: str, source: str) -> None:
    stop = threading.Event()
    # The dashboard is not on a request's path; without it the machine is quieter, which favours Ray.
    ray.init(include_dashboard=False, log_to_driver=False)
    for number in (signal.SIGTERM, signal.SIGINT):  # after ray.init, which installs its own
        signal.signal(number, lambda *_: stop.set())
    try:
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        serve.run({"ours": ours, "bare": bare, "defaults": defaults, "rllib": rllib}[kind](source), route_prefix="/")
        stop.wait()
    finally:
        serve.shutdown()
        ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
