"""`ray start` without the dashboard's agent: python -m rlservo.serve_app.ray_serve.ray_node start --head --block ...

A raylet of Ray 2.60 waits 15 s for each of its agents to write down its ports, and aborts; on a busy machine their
imports take longer, and `ray start` tells after 30 s that the node timed out. Its options do not end all of these
waits. Serve does not need the dashboard's agent: what is missing are the dashboard's figures of the node, its logs, and
Ray's own metrics.
"""

from __future__ import annotations

from rlservo.serve_app.ray_serve.cluster_process import leave_out_agent


def main() -> None:
    leave_out_agent()
    from ray.scripts.scripts import main as ray

    ray()


if __name__ == "__main__":
    main()
