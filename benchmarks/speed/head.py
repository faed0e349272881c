"""The head node of a Ray cluster: what `ray start --head` makes, but ended by SIGTERM with all it started.

python head.py '{"dashboard": PORT, "folder": FOLDER, "cpus": N}'
"""

from __future__ import annotations

import json
import signal
import sys
import threading


def main() -> None:
    plan = json.loads(sys.argv[1])
    stop = threading.Event()
    import ray

    ray.init(
        address="local",
        num_cpus=plan["cpus"],
        num_gpus=0,
        object_store_memory=80 << 20,
        include_dashboard=True,
        dashboard_host="127.0.0.1",
        dashboard_port=plan["dashboard"],
        log_to_driver=False,
        configure_logging=False,
        _temp_dir=plan["folder"],
        _node_ip_address="127.0.0.1",
    )
    signal.signal(signal.SIGTERM, lambda *_: stop.set())  # after Ray has set its own
    stop.wait()
    from ray import serve

    serve.shutdown()
    ray.shutdown()


if __name__ == "__main__":
    main()
