"""Cost of a step of a session by id: with one replica, with two (a record's read, half of them a hop), state carried.

    python benchmarks/session_hop.py POLICY_FOLDER [--steps 2000]

for the folder of one policy with a recurrent state, such as the export of examples/checkpoints/mir100_sparse_fixes.
"""

from __future__ import annotations

import argparse
import json
import secrets
import signal
import sys
import tempfile
import time
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np

from speed.catalogue import case_of, rlservo
from speed.servers import running

SESSIONS = 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--steps", type=int, default=2000)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the server is ended then, too
    bundle = max(path.parent for path in arguments.policy.absolute().rglob("contract.json"))
    case = case_of(bundle, Path())
    obs = case.obs.tolist()
    with tempfile.TemporaryDirectory(prefix="rlsh-") as name:
        for replicas in (1, 2):
            server = rlservo(case, Path(name), replicas=replicas)
            server.act = type(server.act)("POST", server.act.path, json.dumps({"obs": obs, "state": {}}).encode())
            with running(server, Path(name), secrets.token_hex(8)):
                time.sleep(5.0)  # the last replica, and the HAProxy that knows it
                connection = HTTPConnection("127.0.0.1", server.port, timeout=30)
                for kind in ("session by id", "state carried"):
                    taken = measure(connection, server.act.path, obs, arguments.steps, by_id=kind == "session by id")
                    low, p50, high, p99 = np.percentile(taken, [25, 50, 75, 99]) * 1e3
                    print(
                        f"{replicas} replica(s), {kind}: p25 {low:.2f}, p50 {p50:.2f}, p75 {high:.2f}, p99 {p99:.2f} ms"
                    )
                connection.close()


def measure(connection: HTTPConnection, path: str, obs: Any, steps: int, *, by_id: bool) -> list[float]:
    """Return what each of so many steps took [s], in turns of several sessions."""
    taken: list[float] = []
    states: list[Any] = [{} for _ in range(SESSIONS)]
    for number in range(steps + SESSIONS):
        which = number % SESSIONS
        begins = number < SESSIONS
        episode = {"session_id": f"s{which}", "reset": begins} if by_id else {"state": states[which]}
        body = json.dumps({"obs": obs, **episode})
        began = time.perf_counter()
        connection.request("POST", path, body, {"content-type": "application/json"})
        reply = json.loads(connection.getresponse().read())
        if not begins:
            taken.append(time.perf_counter() - began)
        states[which] = reply["state"] if not by_id else {}
        if "action" not in reply:
            raise SystemExit(f"no action: {reply}")
    return taken


if __name__ == "__main__":
    main()
