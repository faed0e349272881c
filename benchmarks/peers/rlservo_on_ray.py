"""Our application in one Ray Serve replica; with POLICY.onnx instead of a folder, a bare ASGI application there.

    RAY_SERVE_ENABLE_HA_PROXY=1 RAY_SERVE_THROUGHPUT_OPTIMIZED=1 python benchmarks/peers/rlservo_on_ray.py PORT POLICIES

The bare one (`bare_asgi.py`) shows what Ray Serve itself takes.
"""

# No `from __future__ import annotations` here: Serve reads the type of `build`'s argument.

import signal
import sys
import threading
from pathlib import Path
from typing import Any

import ray
from ray import serve

from rlservo.serve_app.engines.ray_serve import BuildArguments, build


def bare(onnx_file: str) -> Any:
    from bare_asgi import build as build_asgi

    @serve.deployment(logging_config={"enable_access_log": False, "log_level": "WARNING"}, max_ongoing_requests=1000)
    @serve.ingress(lambda: build_asgi(onnx_file))
    class Bare:
        pass

    deployment: Any = Bare  # a Deployment: serve's decorator is typed as if it left the class alone
    return deployment.bind()


def main(port: int, policies: str) -> None:
    stop = threading.Event()
    # The dashboard is not on a request's way. The replica finds bare_asgi.py in this folder.
    environment = {"env_vars": {"PYTHONPATH": str(Path(__file__).parent)}}
    ray.init(include_dashboard=False, log_to_driver=False, runtime_env=environment)
    for number in (signal.SIGTERM, signal.SIGINT):  # after ray.init, which installs its own
        signal.signal(number, lambda *_: stop.set())
    try:
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        app = bare(policies) if policies.endswith(".onnx") else build(BuildArguments(policies=[policies], replicas=1))
        serve.run(app, route_prefix="/")
        stop.wait()
    finally:
        serve.shutdown()
        ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
