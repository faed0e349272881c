"""A Ray cluster as an operator runs one: the shipped configuration, an admin key; two replicas."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from bundles import write_box_policy
from rlservo.client.admin_client import AdminClient
from rlservo.serve_app.server.api_keys import new_key
from servers import free_ports
from storages import RedisServer, running_redis

ROOT = Path(__file__).resolve().parents[1]
KEY, LINE = new_key("operator", admin=True)
PATIENCE_S = 120  # [s] on a busy machine
RECURRENT = "lstm_box"
SWITCHES = {
    "RAY_SERVE_ENABLE_HA_PROXY": "1",
    "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",
    "RAY_AUTH_MODE": "token",
    "RAY_worker_niceness": "0",
}

# A head node as `ray start --head` makes one, but gone when its standard input is.
CLUSTER = """
import json, sys, ray
plan = json.loads(sys.argv[1])
context = ray.init(address="local", num_cpus=4, num_gpus=0, object_store_memory=80 << 20, include_dashboard=True,
                   dashboard_host="127.0.0.1", dashboard_port=plan["dashboard"], log_to_driver=False,
                   configure_logging=False, _temp_dir=plan["folder"], _node_ip_address="127.0.0.1")
print(context.address_info["gcs_address"], flush=True)
sys.stdin.read()
from ray import serve
serve.shutdown()
ray.shutdown()
"""


@dataclass
class Cluster:
    """A Ray cluster on which the shipped configuration is deployed, and changed."""

    address: str
    port: int
    grpc_port: int
    dashboard: int
    folder: Path
    environment: dict[str, str]
    repository: Path
    configuration: dict[str, Any]
    root: psutil.Process

    @property
    def application(self) -> dict[str, Any]:
        return self.configuration["applications"][0]  # type: ignore[no-any-return]

    def deploy(self, user_config: dict[str, Any] | None = None, settings: dict[str, Any] | None = None) -> None:
        """Send the request of `serve deploy` with these changes to the file; returns when Serve took it."""
        if user_config is not None:
            deployment = {"name": "PolicyServer", "user_config": user_config, "graceful_shutdown_timeout_s": PATIENCE_S}
            self.application["deployments"] = [deployment]
        if settings is not None:
            self.application["args"]["settings"] = {**self.application["args"]["settings"], **settings}
        status, content = self._ask_dashboard("PUT", json.dumps(self.configuration))
        assert status == 200, content

    def run(self, *words: object, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run a Python module as an operator does on this node."""
        return subprocess.run(
            [sys.executable, "-m", *map(str, words)],
            env={**self.environment, **variables}, cwd=ROOT, capture_output=True, text=True, timeout=300,
        )  # fmt: skip

    def admin(self, key: str = KEY) -> AdminClient:
        return AdminClient(f"http://127.0.0.1:{self.port}", api_key=key, timeout_s=60)

    def status(self) -> tuple[str, str]:
        """Return (status, messages) of the application, as `serve status` shows them."""
        _, content = self._ask_dashboard("GET")
        found = json.loads(content)["applications"]["rlservo"]
        messages = [found["message"], *(each["message"] for each in found["deployments"].values())]
        return found["status"], " ".join(messages)

    def wait_for_status(self, wanted: str, timeout_s: float = 2 * PATIENCE_S) -> str:
        """Wait until the application has this status; return its messages."""
        deadline = time.monotonic() + timeout_s
        while (found := self.status())[0] != wanted:
            assert time.monotonic() < deadline, found
            time.sleep(0.2)
        return found[1]

    def replica_pids(self) -> list[int]:
        """Return the processes of our replicas."""
        with contextlib.suppress(psutil.Error):
            return sorted(
                process.pid for process in self.root.children(recursive=True) if "PolicyServer" in process.name() or
                any("ServeReplica:rlservo" in word for word in process.cmdline())
            )  # fmt: skip
        return []

    def _ask_dashboard(self, method: str, body: str | None = None) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.dashboard, timeout=120)
        headers = {
            "content-type": "application/json",
            "authorization": f"Bearer {self.environment['RAY_AUTH_TOKEN']}",
        }
        try:
            connection.request(method, "/api/serve/applications/", body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read()
        finally:
            connection.close()


@pytest.fixture(scope="session")
def cluster_repository(tmp_path_factory: pytest.TempPathFactory, recurrent: Path) -> Path:
    """ur5 in versions 1 to 3, 4 with a byte of its weights changed, and 5 whose actions leave the space; an LSTM."""
    root = tmp_path_factory.mktemp("repository")
    shutil.copytree(recurrent / RECURRENT, root / RECURRENT)
    write_box_policy(root, version="5", seed=5, action_scale=400.0)
    for seed, version in enumerate(("1", "2", "3", "4")):
        write_box_policy(root, version=version, seed=seed)
    weights = root / "ur5" / "4" / "policy.onnx"
    content = bytearray(weights.read_bytes())
    content[len(content) // 2] ^= 1
    weights.write_bytes(content)
    return root


def serving(*versions: str, production: str = "1", **more: Any) -> dict[str, Any]:
    """Return the `user_config` for these versions of ur5."""
    ur5 = {"versions": list(versions), "aliases": {"production": production}, **more}
    return {"policies": {"ur5": ur5, RECURRENT: {}}}


def own_ports(folder: Path) -> dict[str, str]:
    """Return variables that keep two of Ray's HAProxies on one machine apart: their ports and files; and patience."""
    stats, metrics, fallback, fallback_grpc, first, second = free_ports(6)
    return {
        "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",  # after 5 Serve kills a HAProxy that is not ready yet
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(fallback_grpc),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(first),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(first + 20),
        "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(second),
        "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(second + 20),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "a.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "state"),
    }


@pytest.fixture(scope="session")
def cluster(cluster_repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """The cluster, with two replicas, version 1 of ur5 deployed, and sessions in Redis."""
    with running_redis() as redis, _cluster(cluster_repository, tmp_path_factory, redis) as made:
        yield made


@contextlib.contextmanager
def _cluster(
    cluster_repository: Path, tmp_path_factory: pytest.TempPathFactory, redis: RedisServer
) -> Iterator[Cluster]:
    port, grpc_port, dashboard = free_ports(3)
    folder = Path(tempfile.mkdtemp(prefix="r"))
    configuration = yaml.safe_load((ROOT / "deploy" / "serve.yaml").read_text())
    configuration["http_options"]["port"] = port
    configuration["grpc_options"]["port"] = grpc_port
    configuration["applications"][0]["args"] = {
        "policies": [str(cluster_repository)], "replicas": 2, "settings": {"api_keys": LINE, "session_store": redis.url}
    }  # fmt: skip
    own = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
    environment = own | SWITCHES | own_ports(folder) | {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
    plan = json.dumps({"dashboard": dashboard, "folder": str(folder)})
    errors = tmp_path_factory.mktemp("cluster") / "errors.txt"
    with errors.open("w") as stream:
        process = subprocess.Popen(
            [sys.executable, "-c", CLUSTER, plan],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    started: list[psutil.Process] = []
    try:
        address = process.stdout.readline().strip()
        assert address, errors.read_text()[-3000:]
        made = Cluster(
            address, port, grpc_port, dashboard, folder, environment, cluster_repository, configuration,
            psutil.Process(process.pid),
        )  # fmt: skip
        made.deploy(serving("1"))
        made.wait_for_status("RUNNING")
        yield made
    finally:
        with contextlib.suppress(psutil.Error):
            started = psutil.Process(process.pid).children(recursive=True)
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(60)
        process.kill()
        process.wait()
        process.stdout.close()
        for left in started:  # none, unless the shutdown failed
            with contextlib.suppress(psutil.Error):
                left.kill()
        shutil.rmtree(folder, ignore_errors=True)
