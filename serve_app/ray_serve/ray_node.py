"""`ray start` without the dashboard's agent: python -m rlservo.serve_app.ray_serve.ray_node start --head --block ...

A raylet of Ray 2.60 waits 15 s for each of its agents to write down its ports, and aborts; on a busy machine their
imports take longer, and `ray start` tells after 30 s that the node timed out. Its options do not end all of these
waits. Serve does not need the dashboard's agent: what is missing are the dashboard's figures of the node, its logs, and
Ray's own metrics.

With `--block` it ends when the raylet has: one whose runtime environments' agent died, or that the head has given up,
ends with status 0, and `ray start --block` takes that for an end in order and stays, without a node, for ever. Whatever
runs it (systemd, a container) could not know that the node is gone.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from rlservo.serve_app.ray_serve import ray_parts
from rlservo.serve_app.ray_serve.cluster_process import leave_out_agent
from rlservo.serve_app.ray_serve.processes import describe_end


def main() -> None:
    leave_out_agent()
    end_with_raylet()
    from ray.scripts.scripts import main as ray

    ray()


def end_with_raylet() -> None:
    """Let a node of this process end with its raylet, whatever the raylet's status. Raises RuntimeError."""
    kind = ray_parts.find("ray._private.node:Node")
    dead_processes = ray_parts.find("ray._private.node:Node.dead_processes")

    def dead_or_end(node: Any) -> list[Any]:
        dead: list[Any] = dead_processes(node)  # `ray start --block` asks each second
        for name, process in dead:
            if name == "raylet":
                sys.stderr.write(f"the node ends: its process 'raylet' {describe_end(process.poll())}\n")
                sys.stderr.flush()  # nothing else does
                node.kill_all_processes(check_alive=False, allow_graceful=False)
                os._exit(1)
        return dead

    kind.dead_processes = dead_or_end


if __name__ == "__main__":
    main()
