"""Train through `simple_trainer.py --address` on a cluster of one core: as it is, and as one that grows.

Prints, last, one JSON line: how each run ended and what it said.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ["RAY_AUTH_MODE"] = "token"
os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(16)

from ray.cluster_utils import Cluster

TRAINER = Path(__file__).resolve().parents[2] / "examples" / "simple_trainer.py"
NODE_GROUP = "RAY_NODE_TYPE_NAME"  # what an autoscaler sets for the nodes it starts


def main(folder: Path) -> None:
    results: dict[str, Any] = {}
    cluster, temporary = start()
    try:
        trainer = train(cluster, folder)
        results["refused"] = ended(trainer)
    finally:
        end(cluster, temporary)
    os.environ[NODE_GROUP] = "head"
    cluster, temporary = start()
    try:
        trainer = train(cluster, folder)
        said, _ = read_until(trainer, "waiting for")
        trainer.send_signal(signal.SIGINT)
        results["interrupted"] = ended(trainer, said)
        trainer = train(cluster, folder)
        said, after_s = read_until(trainer, "waiting for")
        cluster.add_node(num_cpus=2)
        results["grew"] = ended(trainer, said) | {"after_s": after_s}
    finally:
        end(cluster, temporary)
    print(json.dumps(results))


def start() -> tuple[Cluster, str]:
    Path("/tmp/ray").mkdir(exist_ok=True)  # Cluster writes its address there, whatever its own folder (ray 2.60)
    temporary = tempfile.mkdtemp(prefix="room-", dir="/tmp")
    arguments = {"num_cpus": 1, "temp_dir": temporary, "include_dashboard": False}
    return Cluster(initialize_head=True, head_node_args=arguments), temporary


def end(cluster: Cluster, temporary: str) -> None:
    cluster.shutdown()
    shutil.rmtree(temporary, ignore_errors=True)


def train(cluster: Cluster, folder: Path) -> subprocess.Popen[str]:
    command = [
        sys.executable, str(TRAINER), "--address", cluster.address, "--num-cpus", "2", "--stop-iters", "1",
        "--set", "train_batch_size_per_learner=400", "--hidden", "16", "--no-export",
    ]  # fmt: skip
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def read_until(trainer: subprocess.Popen[str], words: str) -> tuple[str, float]:
    """Return what it said up to a line with these words, and how long after it began to train that came [s]."""
    assert trainer.stdout is not None
    said, began = "", time.monotonic()
    for line in trainer.stdout:
        said += line
        if line.startswith("run: "):
            began = time.monotonic()
        if words in line:
            return said, time.monotonic() - began
    return said, -1.0


def ended(trainer: subprocess.Popen[str], said: str = "") -> dict[str, Any]:
    try:
        rest, _ = trainer.communicate(timeout=240)
    finally:
        trainer.kill()
        trainer.wait()
    return {"code": trainer.returncode, "said": said + rest}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
