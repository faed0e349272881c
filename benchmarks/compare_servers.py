"""Two running servers of one policy, asked by turns over JSON and WebSocket: p50 of each, and the median of the ratios.

python benchmarks/compare_servers.py 8000 8001 --model ur5

for two `rlservo serve DIR --port ...`, of which the second differs in what is to be measured: `--record`, a setting, a
checkout.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
import urllib.request
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from rlservo.serve_app.wire.msgpack_arrays import pack
from speed.loads import HttpLine, WebSocketLine
from speed.servers import Exchange


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("ports", type=int, nargs=2, help="of the first and the second server, on this machine")
    parser.add_argument("--model", default="ur5")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--requests", type=int, default=500, help="in a round, of each server and protocol")
    asked = parser.parse_args()
    path = f"/v1/policies/{asked.model}"
    with urllib.request.urlopen(f"http://127.0.0.1:{asked.ports[0]}{path}", timeout=10) as reply:
        size = int(np.prod(json.load(reply)["observation_space"]["shape"]))
    obs = np.random.default_rng(0).uniform(-0.5, 0.5, size).astype(np.float32).tolist()
    act = Exchange("POST", f"{path}/act", json.dumps({"obs": obs}).encode())
    message = pack({"obs": obs})
    kinds: dict[str, Callable[[int], HttpLine | WebSocketLine]] = {
        "JSON": partial(HttpLine, exchange=act),
        "WebSocket": partial(WebSocketLine, path=f"{path}/stream", message=message, greets=True),
    }
    for kind, connect in kinds.items():
        lines = [connect(port) for port in asked.ports]
        rounds = [measure_round(lines, asked.requests, first=number % 2) for number in range(asked.rounds)]
        for line in lines:
            line.close()
        first, second = (statistics.median(one[side] for one in rounds) * 1e6 for side in (0, 1))
        ratio = statistics.median(one[1] / one[0] for one in rounds)
        print(f"{kind}: p50 {first:.0f} us and {second:.0f} us, {ratio:.3f} times (median of {asked.rounds} rounds)")


def measure_round(lines: Sequence[Callable[[], bytes]], requests: int, *, first: int) -> tuple[float, float]:
    """Return the p50 [s] of each line, `first` being asked first."""
    found = [0.0, 0.0]
    for side in (first, 1 - first):
        taken = []
        for _ in range(requests):
            began = time.perf_counter()
            lines[side]()
            taken.append(time.perf_counter() - began)
        found[side] = statistics.median(taken)
    return found[0], found[1]


if __name__ == "__main__":
    main()
