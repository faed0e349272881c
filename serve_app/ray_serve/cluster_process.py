"""Child process of the launcher: a private Ray cluster with the server, until its stdin ends.

`launcher.py` starts it as `python -m rlservo.serve_app.ray_serve.cluster_process PLAN`, with the environment Ray's
processes are to inherit. It reports on the file descriptor the plan names, one JSON object per line, and shuts
everything down when its standard input ends: because the launcher closed it, or because the launcher is no more.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from rlservo.serve_app.ray_serve import ray_parts
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.ray_serve.processes import describe_end, end_marked, remove_folder
from rlservo.serve_app.ray_serve.server_log import SERVER_LOG, cut_log, error_line
from rlservo.serve_app.server.admin_key import remove_key

CLEAN_UP = "--clean-up"
CHECK_PERIOD_S = 0.5  # between checks of whether Ray's own processes live
ORDERLY_END_S = 25.0  # [s] less than the launcher waits
LOG_CHECK_PERIOD_S = 60.0
AGENT_PORT = re.compile(r"(--runtime[-_]env[-_]agent[-_]port)=0\b")
REGISTRATION_S = 10.0  # [s] to look often for the raylet; then Ray looks once a second, as it does without us
OBJECT_STORE_BYTES = 80 << 20  # Ray's least is 75 MiB; requests do not go through it


def main() -> int:
    plan: dict[str, Any] = json.loads(sys.argv[-1])
    if CLEAN_UP in sys.argv:
        _leave_nothing(plan)
        return 0
    # A terminal's Ctrl-C reaches the whole process group. What to do about it is the launcher's decision.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = threading.Event()
    started = threading.Event()
    threading.Thread(target=_watch_input, args=(stop, started, plan), daemon=True).start()
    try:
        from rlservo.serve_app.ray_serve import lean_imports  # here: who imports this module keeps its pandas

        ray_parts.check()
        import ray
        from ray import serve

        from rlservo.serve_app.ray_serve import app

        leave_out_extras()
        _poll_for_node()
        ray.init(
            address="local",  # whatever RAY_ADDRESS or a running cluster says
            num_cpus=max(1, plan["replicas"]),
            num_gpus=0,
            object_store_memory=OBJECT_STORE_BYTES,
            include_dashboard=False,
            log_to_driver=False,
            configure_logging=False,
            _temp_dir=plan["ray_folder"],
            _node_ip_address="127.0.0.1",  # where Ray's ports listen, with the variable that `launcher.py` sets
            _system_config={"enable_worker_prestart": False, "preload_python_modules": [lean_imports.__name__]},
        )
        app.start(
            plan["policies"],
            host=plan["host"],
            port=plan["port"],
            grpc_port=plan["grpc_port"],
            replicas=plan["replicas"],
            served=plan["served"],
            settings=plan["settings"],
        )
    except Exception as error:
        _report(plan, {"error": error_line(error)})
        raise
    started.set()
    _report(plan, {"ready": True})
    log_checked = time.monotonic()
    while not stop.wait(CHECK_PERIOD_S):
        if (cause := _ray_ended()) is not None:
            _report(plan, {"died": cause})
            _leave_nothing(plan)
            return 1
        if time.monotonic() - log_checked > LOG_CHECK_PERIOD_S:
            log_checked = time.monotonic()
            cut_log(Path(plan["folder"]) / SERVER_LOG)
    serve.shutdown()  # proxies first, then replicas, then the controller
    ray.shutdown()
    _leave_nothing(plan)
    return 0


def leave_out_extras() -> None:
    """Keep Ray (2.60) from starting what nothing here uses and an answer waits for, where its own switches do not.

    The autoscaler's monitor and the log forwarder are 165 MB and a second; `ray start` has flags for both, `ray.init`
    none. Without a dashboard its process starts all the same, to send usage statistics that are off, and `ray.init`
    waits until it is up. Where these private names have moved (`ray_parts.SPARED`), everything starts.

    The dashboard's agent is 80 MB, opens a port to every interface, which three half-open connections block, and logs
    a traceback a second about the dashboard that is not there. The raylet insists on a process, so it gets one that
    does nothing. Raises RuntimeError where Ray starts it in another way.
    """
    if ray_parts.is_there("ray._private.parameter:RayParams"):
        parameter = ray_parts.find("ray._private.parameter")
        parameter.RayParams = functools.partial(parameter.RayParams, no_monitor=True, include_log_monitor=False)
    services = ray_parts.find("ray._private.services")
    if ray_parts.is_there("ray._private.services:start_api_server"):
        services.start_api_server = lambda *_, **__: ("", None)  # address and process of none
    if ray_parts.is_there("ray._private.utils:get_dashboard_dependency_error"):
        # It imports aiohttp, OpenCensus and more to see whether the agent could be complete.
        ray_parts.find("ray._private.utils").get_dashboard_dependency_error = lambda: None
    leave_out_agent()


def _poll_for_node() -> None:
    """Let `ray.init` find its raylet when it is there: Ray (2.60) looks after 0.1 s, often in vain, and then 1 s later.

    Where these private names have moved (`ray_parts.SPARED`), that second stays.
    """
    if not ray_parts.is_there("ray._private.services:get_node"):
        return
    services = ray_parts.find("ray._private.services")
    get_node: Any = services.get_node

    def poll(address: str, node: str) -> Any:
        until = time.monotonic() + REGISTRATION_S
        with contextlib.suppress(Exception):  # Ray's own look finds out what is wrong
            client = ray_parts.find("ray._raylet:GcsClient")(address=address)
            while node not in {one.hex() for one in client.get_all_node_info(timeout=1)} and time.monotonic() < until:
                time.sleep(0.02)
        return get_node(address, node)

    services.get_node = poll


def leave_out_agent() -> None:
    """Let raylets that this process starts have no dashboard's agent. Raises RuntimeError as `without_agent` does."""
    services = ray_parts.find("ray._private.services")
    start: Any = services.start_ray_process

    def start_ray_process(command: list[str], process_type: str, *arguments: Any, **more: Any) -> Any:
        if process_type == "raylet":
            command = without_agent(command)
        return start(command, process_type, *arguments, **more)

    services.start_ray_process = start_ray_process


def without_agent(raylet: list[str]) -> list[str]:
    """Return the raylet's command with an idle process as the dashboard's agent, and no wait for agents' ports.

    A raylet waits 15 s for each agent to write down the port that it chose, and aborts: on a busy or slow computer the
    imports alone take longer. So the runtime environments' agent gets a port here, in all that the raylet starts.

    Raises RuntimeError where the command is another than that of Ray 2.60.
    """
    import ray

    (port,) = free_ports(1)
    raylet = [AGENT_PORT.sub(rf"\1={port}", word) for word in raylet]
    changed = {
        "--dashboard_agent_command": shlex.join([shutil.which("sleep") or "sleep", "infinity"]),
        "--metrics-agent-port": "-1",
        "--metrics_export_port": "-1",
    }
    for option in (*changed, "--runtime_env_agent_port"):
        if (count := sum(word.startswith(f"{option}=") for word in raylet)) != 1:
            raise RuntimeError(f"Ray {ray.__version__} starts its raylet with {count} of {option}: 2.60 has one")
    kept = [word for word in raylet if word.partition("=")[0] not in changed]
    return [*kept, *(f"{option}={value}" for option, value in changed.items()), "--dashboard_agent_listen_port=-1"]


def _ray_ended() -> str | None:
    """Return which process without which nothing is served has ended, and how; None while all of them live.

    Ray (2.60) leaves the driver of a cluster whose raylet is gone waiting for ever.
    """
    node: Any = ray_parts.find("ray._private.worker:_global_node")
    for name, process in [] if node is None else node.dead_processes():
        return f"its process '{name}' {describe_end(process.poll())}"
    return None


def _watch_input(stop: threading.Event, started: threading.Event, plan: dict[str, Any]) -> None:
    while os.read(0, 4096):
        pass
    stop.set()
    if started.is_set():
        time.sleep(ORDERLY_END_S)  # a daemon thread: an end in time ends this sleep, too
    # Otherwise nothing has been served yet, so there is nothing to drain; a half-started cluster has no orderly end.
    # In a process of its own: Ray's library ends this one as soon as the GCS or the raylet is gone.
    subprocess.run([sys.executable, "-m", __spec__.name, CLEAN_UP, json.dumps(plan)], check=False)
    os._exit(0)


def _leave_nothing(plan: dict[str, Any]) -> None:
    """End what is left, remove the folder and the key's file. The launcher does the same, unless it was killed."""
    if plan["key_file"] is not None:
        remove_key(Path(plan["key_file"]), plan["settings"]["operator_key"])
    end_marked(plan["mark"], os.getsid(0))
    remove_folder(Path(plan["folder"]))


def _report(plan: dict[str, Any], message: dict[str, Any]) -> None:
    os.write(plan["report_fd"], json.dumps(message).encode() + b"\n")


if __name__ == "__main__":
    sys.exit(main())
