"""RLlib's own example of serving an RLModule, unchanged, on Ray Serve's defaults (its proxy, no HAProxy).

The deployment is `ray.rllib.examples.ray_serve.classes.cartpole_deployment`: a torch RLModule in the replica, JSON in
and out. It answers an argmax whatever the policy is; only its time is compared here, not its answer.

    python benchmarks/peers/rllib_example.py PORT RL_MODULE_CHECKPOINT
"""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any

import ray
from ray import serve
from ray.rllib.examples.ray_serve.classes.cartpole_deployment import ServeRLlibRLModule


def main(port: int, checkpoint: str) -> None:
    stop = threading.Event()
    # The dashboard is not on a request's path; without it the machine is quieter, which favours this peer.
    ray.init(include_dashboard=False, log_to_driver=False)
    for number in (signal.SIGTERM, signal.SIGINT):  # after ray.init, which installs its own
        signal.signal(number, lambda *_: stop.set())
    try:
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        deployment: Any = ServeRLlibRLModule  # a Deployment: serve's decorator is typed as if it left the class alone
        serve.run(deployment.bind(checkpoint), route_prefix="/rllib-rlmodule")
        stop.wait()
    finally:
        serve.shutdown()
        ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
