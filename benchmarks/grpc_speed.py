"""gRPC against HTTP on one server, sequential, by Triton's own clients taking turns; medians and their ratio.

python benchmarks/grpc_speed.py --http 127.0.0.1:8000 --grpc 127.0.0.1:8001 --model ur5

for a running `rlservo serve DIR --grpc-port 8001`. It needs `pip install 'tritonclient[grpc,http]'` in an environment
of its own: Triton's client wants an older protobuf than Ray Serve.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

ROUNDS, CALLS = 7, 300


def taken(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return (time.perf_counter() - started) * 1e3


def main() -> None:
    # Not among the project's requirements, hence imported by name here only.
    import importlib

    http, grpc = (importlib.import_module(f"tritonclient.{name}") for name in ("http", "grpc"))
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--http", default="127.0.0.1:8000")
    parser.add_argument("--grpc", default="127.0.0.1:8001")
    parser.add_argument("--model", default="ur5")
    asked = parser.parse_args()
    calls: dict[str, Callable[[], Any]] = {}
    for name, module, url in (("http", http, asked.http), ("grpc", grpc, asked.grpc)):
        client = module.InferenceServerClient(url)
        shape = client.get_model_metadata(asked.model, **({"as_json": True} if name == "grpc" else {}))["inputs"][0]
        obs = np.zeros([1, *map(int, shape["shape"][1:])], np.float32)
        given = module.InferInput(shape["name"], list(obs.shape), "FP32")
        given.set_data_from_numpy(obs)
        calls[name] = partial(client.infer, asked.model, [given])
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            times[name] += [taken(call) for _ in range(CALLS)]
    for name, values in times.items():
        p50, p95, p99 = np.percentile(values, [50, 95, 99])
        print(f"{name}: p50 {p50:.3f} ms, p95 {p95:.3f} ms, p99 {p99:.3f} ms")
    print(f"grpc / http, p50: {np.median(times['grpc']) / np.median(times['http']):.2f}")


if __name__ == "__main__":
    main()
