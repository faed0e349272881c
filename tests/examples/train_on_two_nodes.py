"""Train through `simple_trainer.py --address` on a cluster of two nodes, and kill the second one on the way.

Prints the trainer's output and, last, one JSON line: its exit code, and the alive nodes before and after.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["RAY_AUTH_MODE"] = "token"
os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(16)

import ray
from ray.cluster_utils import Cluster

TRAINER = Path(__file__).resolve().parents[2] / "examples" / "simple_trainer.py"


def main(folder: Path) -> None:
    temporary = tempfile.mkdtemp(prefix="two-", dir="/tmp")
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "temp_dir": temporary, "include_dashboard": False}
    )
    trainer: subprocess.Popen[str] | None = None
    try:
        second = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        command = [
            sys.executable, str(TRAINER), "--address", cluster.address, "--num-cpus", "2", "--stop-iters", "5",
            "--set", "train_batch_size_per_learner=400", "--hidden", "16", "--checkpoint-frequency", "1",
            "--max-failures", "3", "--episodes", "1", "--set", "env_runner_health_probe_timeout_s=5",
        ]  # fmt: skip
        trainer = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert trainer.stdout is not None
        before = after = 0
        for line in trainer.stdout:
            print(line, end="", flush=True)
            if (
                line.split()[1:2] == ["2"] and not before
            ):  # the second iteration has gone by: the node dies, ungracefully
                before = alive(cluster)
                cluster.remove_node(second, allow_graceful=False)
                after = alive(cluster)
        print(json.dumps({"code": trainer.wait(60), "before": before, "after": after}))
    finally:
        if trainer is not None and trainer.poll() is None:
            trainer.kill()
            trainer.wait()
        cluster.shutdown()
        shutil.rmtree(temporary, ignore_errors=True)


def alive(cluster: Cluster) -> int:
    """Ask the cluster itself, until it has noticed."""
    deadline = time.monotonic() + 30
    ray.init(cluster.address, logging_level="ERROR", log_to_driver=False)
    try:
        while (count := sum(node["Alive"] for node in ray.nodes())) != len(cluster.list_all_nodes()):
            if time.monotonic() > deadline:
                break
            time.sleep(0.2)
        return int(count)
    finally:
        ray.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
