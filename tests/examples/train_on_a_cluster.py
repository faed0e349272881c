"""Train through `simple_trainer.py --address` on one cluster: too small, growing, and then losing a node.

The last line it prints is JSON: how each run ended, and its output.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import runpy
import secrets
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

TRAINER = Path(__file__).resolve().parents[2] / "examples" / "simple_trainer.py"
sys.path.insert(0, str(TRAINER.parent))
import shared.ray_settings  # noqa: E402, F401  # before Ray

os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(16))  # a trainer's process imports this module, too

import ray  # noqa: E402
from ray.cluster_utils import Cluster  # noqa: E402

# A trainer's process is forked from one that has imported RLlib, which takes longer than any of the three trains.
FORKED = multiprocessing.get_context("forkserver")
FORKED.set_forkserver_preload(["quick_rllib", "ray.rllib.algorithms.ppo", "ray.tune"])
NODE_GROUP = "RAY_NODE_TYPE_NAME"  # what an autoscaler sets for the nodes it starts


def main(folder: Path) -> None:
    results: dict[str, Any] = {}
    # Cluster writes its address there, whatever its own folder (ray 2.60).
    Path(tempfile.gettempdir(), "ray").mkdir(exist_ok=True)
    temporary = tempfile.mkdtemp(prefix="grow-", dir="/tmp")
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "temp_dir": temporary, "include_dashboard": False}
    )
    try:
        results["refused"] = Trainer(cluster, folder, 2).end()
        os.environ[NODE_GROUP] = "workers"
        cluster.add_node(num_cpus=0)
        ray.init(cluster.address, logging_level="ERROR", log_to_driver=False)
        results["interrupted"] = interrupted(Trainer(cluster, folder, 2))
        results["grew"] = grown_and_shrunk(Trainer(cluster, folder, 2, "--max-failures", "3"), cluster)
    finally:
        ray.shutdown()
        cluster.shutdown()
        shutil.rmtree(temporary, ignore_errors=True)
    print(json.dumps(results))


def run_trainer(output: Connection, folder: Path, *arguments: str) -> None:
    for number in (1, 2):
        os.dup2(output.fileno(), number)
    os.chdir(folder)
    sys.argv = [str(TRAINER), *arguments]
    runpy.run_path(str(TRAINER), run_name="__main__")


class Trainer:
    """A trainer with this many environment runners; each has a core, and so has its driver."""

    def __init__(self, cluster: Cluster, folder: Path, runners: int, *more: str) -> None:
        arguments = (
            "--address", cluster.address, "--num-cpus", str(runners), "--stop-iters", "5",
            "--set", "train_batch_size_per_learner=400", "--hidden", "16", "--checkpoint-frequency", "1",
            "--episodes", "1", "--set", "env_runner_health_probe_timeout_s=5", *more,
        )  # fmt: skip
        read, written = FORKED.Pipe(duplex=False)
        self.process = FORKED.Process(target=run_trainer, args=(written, folder, *arguments))
        self.process.start()
        written.close()
        self.output = os.fdopen(os.dup(read.fileno()))
        self.said = ""

    def lines(self) -> Iterator[str]:
        for line in self.output:
            self.said += line
            yield line

    def seconds_until(self, words: str) -> float:
        """Wait for a line with these words; return how long after it began to train that came [s]."""
        began = time.monotonic()
        for line in self.lines():
            if line.startswith("run: "):
                began = time.monotonic()
            if words in line:
                return time.monotonic() - began
        return -1.0

    def end(self) -> dict[str, Any]:
        try:
            self.process.join(timeout=240)
        finally:
            self.process.kill()
            self.process.join()
        return {"code": self.process.exitcode, "said": self.said + self.output.read()}


def interrupted(trainer: Trainer) -> dict[str, Any]:
    trainer.seconds_until("waiting for")
    assert trainer.process.pid is not None
    os.kill(trainer.process.pid, signal.SIGINT)
    return trainer.end()


def grown_and_shrunk(trainer: Trainer, cluster: Cluster) -> dict[str, Any]:
    """Add the node that the trainer waits for; when its second iteration has gone by, the node dies, ungracefully."""
    after_s = trainer.seconds_until("waiting for")
    node = cluster.add_node(num_cpus=1)
    before = after = 0
    for line in trainer.lines():
        if line.split()[1:2] == ["2"] and not before:
            before = alive(3)
            cluster.remove_node(node, allow_graceful=False)
            after = alive(2)
    return trainer.end() | {"after_s": after_s, "before": before, "after": after}


def alive(expected: int) -> int:
    """Ask the cluster itself, until it has noticed."""
    deadline = time.monotonic() + 30
    while (count := sum(node["Alive"] for node in ray.nodes())) != expected and time.monotonic() < deadline:
        time.sleep(0.2)
    return int(count)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
