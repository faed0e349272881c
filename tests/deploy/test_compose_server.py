"""Server of compose, as its container runs it: what outlives it in Redis when all of it is killed."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.ray_serve.processes import MARK, end_marked, remove_folder
from rlservo.serve_app.server.api_keys import new_key
from servers import ROOT, free_ports

pytestmark = [
    pytest.mark.serve,
    pytest.mark.slow,
    pytest.mark.skipif(
        "RLSERVO_TEST_COMPOSE" not in os.environ,
        reason="a minute of CPU for two starts: RLSERVO_TEST_COMPOSE=1 runs it, with Debian's redis-server",
    ),
]

COMPOSE = ROOT / "deploy" / "compose"
PATIENCE_S = 240


@pytest.fixture
def redis(tmp_path: Path) -> Iterator[tuple[int, str]]:
    """A Redis of our own, with compose's arguments; gives its port and password.

    It goes on while the server is killed, so what it syncs every second is not at stake.
    """
    assert shutil.which("redis-server") is not None, "no Redis (Debian: apt-get install redis-server)"
    (port,), password = free_ports(1), secrets.token_hex(16)
    services = yaml.safe_load((ROOT / "deploy" / "compose.yaml").read_text())["services"]
    shell, option, script = services["redis"]["command"]
    ours = {"$$(cat /run/secrets/redis_password)": password, "--dir /data": f"--dir {tmp_path}"}
    for theirs, own in ours.items():
        assert script.count(theirs) == 1
        script = script.replace(theirs, own)
    process = subprocess.Popen([shell, option, f"{script} --port {port} --bind 127.0.0.1"], stdout=subprocess.DEVNULL)
    try:
        yield port, password
    finally:
        process.terminate()
        process.wait(30)


def test_aliases_outlive_the_container_when_all_in_it_is_killed(
    redis: tuple[int, str], policies: Path, tmp_path: Path
) -> None:
    key, line = new_key("operator", admin=True)
    folder, mark = Path(tempfile.mkdtemp(prefix="r")), secrets.token_hex(16)  # sockets need a short path
    port, grpc_port, gcs, dashboard, stats, proxy_metrics, fallback, fallback_grpc, first, second = free_ports(10)
    configuration = yaml.safe_load((COMPOSE / "serve.yaml").read_text())
    configuration["http_options"] = {"host": "127.0.0.1", "port": port}
    configuration["grpc_options"]["port"] = grpc_port
    arguments = configuration["applications"][0]["args"]
    assert arguments["settings"] == {"api_keys_file": "/run/secrets/api_keys"}
    arguments["policies"] = [str(policies)]
    arguments["settings"]["api_keys_file"] = str(folder / "api_keys")
    files = {"serve.yaml": yaml.safe_dump(configuration), "api_keys": line, "token": secrets.token_hex(32)}
    for name, content in {**files, "password": redis[1]}.items():
        (folder / name).write_text(content)
    own = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_", "PYTHON"))}
    environment = own | {
        MARK: mark,
        "HOME": str(folder),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "RAY_AUTH_TOKEN_FILE": str(folder / "token"),
        "RLSERVO_REDIS": f"127.0.0.1:{redis[0]}",
        "RLSERVO_REDIS_PASSWORD_FILE": str(folder / "password"),
        "RLSERVO_DASHBOARD_PORT": str(dashboard),
        # In a container these are its own; here other servers run beside.
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(first),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(first + 20),
        "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(second),
        "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(second + 20),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(proxy_metrics),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(fallback_grpc),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "a.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "state"),
    }
    command = [
        str(COMPOSE / "server.sh"), str(folder / "serve.yaml"), "--port", str(gcs), "--temp-dir", str(folder / "ray"),
        "--num-cpus", "2",
    ]  # fmt: skip
    log = tmp_path / "server.log"

    @contextlib.contextmanager
    def container() -> Iterator[AdminClient]:
        with log.open("ab") as output:
            process = subprocess.Popen(command, env=environment, stdout=output, stderr=output, cwd=folder)
        try:
            with AdminClient(f"http://127.0.0.1:{port}", api_key=key, timeout_s=20) as admin:
                deadline = time.monotonic() + PATIENCE_S
                while True:
                    assert process.poll() is None and time.monotonic() < deadline, log.read_text()
                    with contextlib.suppress(Exception):
                        if admin.replicas():
                            break
                    time.sleep(0.5)
                yield admin
        finally:
            end_marked(mark)  # without a word, as where the power goes
            process.wait(60)
            remove_folder(folder / "ray")  # a container's /tmp is new

    try:
        with container() as admin:
            assert default(admin) == "10"
            admin.alias("ur5", "production", "2")
            assert default(admin) == "2"
        with container() as admin:
            assert default(admin) == "2"
    finally:
        end_marked(mark)
        remove_folder(folder)


def default(admin: AdminClient) -> str:
    (replica,) = admin.replicas()
    return str(next(each for each in replica["policies"] if each["name"] == "ur5")["version"])
