"""Our application in one Ray Serve replica; with POLICY.onnx instead of a folder, a bare ASGI application there.

    RAY_SERVE_ENABLE_HA_PROXY=1 RAY_SERVE_THROUGHPUT_OPTIMIZED=1 python benchmarks/peers/rlservo_on_ray.py PORT POLICIES

The bare one (`bare_asgi.py`) shows the cost of Ray Serve itself.
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
    folder = str(Path(__file__).parent)

    @serve.deployment(logging_config={"enable_access_log": False, "log_level": "WARNING"}, max_ongoing_requests=1000)
    @serve.ingress()
    class Bare:
        def __serve_build_asgi_app__(self) -> Any:  # Serve's hook: the app is built in the replica
            sys.path.insert(0, folder)
            from bare_asgi import build

            return build(onnx_file)

    deployment: Any = Bare  # a Deployment: serve's decorator is typed as if it left the class alone
    return deployment.bind()


def main(port: int, policies: str) -> None:
    stop = threading.Event()
    ray.init(include_dashboard=False, log_to_driver=False)  # the dashboard is not on a request's path
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
