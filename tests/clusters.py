"""A Ray cluster as an operator runs one: the shipped configuration, `serve deploy`, an admin key; two replicas."""

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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import pytest
import yaml

from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.ray_serve.environment import cluster_environment, proxy_files, proxy_ports
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.ray_serve.processes import MARK, end_marked, remove_folder
from rlservo.serve_app.server.api_keys import new_key

ROOT = Path(__file__).resolve().parents[1]
KEY, LINE = new_key("operator", admin=True)
# The cluster has another value than `rlservo cluster env` gives.
DIFFERENT, ITS_VALUE = "RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S", "1"
# [s] For slow bodies, for requests that wait, for a replica that ends and still answers somebody: none of these limits
# is what is tested here, and a busy machine stands still, or takes to replace two replicas, for longer than the usual.
PATIENCE_S = 120
RECURRENT = "lstm_box"
Check: TypeAlias = tuple[str, bool, str]  # name, whether all is well, message

# For what starts a node of the cluster. It leaves out what no test looks at: the autoscaler's monitor, the log monitor,
# and of the dashboard all but what `serve deploy` and `serve status` ask. They are an eighth of the cluster's CPU time.
LEAN_NODE = """
import functools
from ray._private import parameter, services
from rlservo.serve_app.ray_serve.cluster_process import leave_out_agent
leave_out_agent()
start = services.start_ray_process
def start_lean(command, process_type, *arguments, **more):
    if process_type == "dashboard":
        command = [*command, "--modules-to-load=ServeHead"]
    return start(command, process_type, *arguments, **more)
services.start_ray_process = start_lean
parameter.RayParams = functools.partial(parameter.RayParams, no_monitor=True, include_log_monitor=False)
"""
# A head node as `ray start --head` makes one, but gone when its standard input is.
CLUSTER = (
    LEAN_NODE
    + """
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
)


@dataclass
class Cluster:
    """A Ray cluster on which the shipped configuration is deployed, and changed."""

    address: str
    port: int
    dashboard: int
    folder: Path
    environment: dict[str, str]
    repository: Path
    configuration: dict[str, Any]
    before: tuple[int, list[Check]] = (0, [])  # what `rlservo cluster check` said when nothing was deployed
    missing: Path = Path()  # a policy folder that the configuration had then, and that is not there
    while_starting: list[Check] = field(default_factory=list)
    running: list[Check] = field(default_factory=list)  # what it said when all was well but `DIFFERENT`, left out

    @property
    def application(self) -> dict[str, Any]:
        return self.configuration["applications"][0]  # type: ignore[no-any-return]

    def deploy(
        self,
        user_config: dict[str, Any] | None = None,
        settings: dict[str, Any] | None = None,
        *,
        by_command: bool = False,
    ) -> None:
        """`serve deploy` with these changes to the file, or the request that it sends; returns when Serve took it."""
        if user_config is not None:
            deployment = {"name": "PolicyServer", "user_config": user_config, "graceful_shutdown_timeout_s": PATIENCE_S}
            self.application["deployments"] = [deployment]
        if settings is not None:
            self.application["args"]["settings"] = {**self.application["args"]["settings"], **settings}
        if not by_command:  # starting the command costs ten seconds on a busy machine
            connection = http.client.HTTPConnection("127.0.0.1", self.dashboard, timeout=120)
            headers = {
                "content-type": "application/json",
                "authorization": f"Bearer {self.environment['RAY_AUTH_TOKEN']}",
            }
            connection.request("PUT", "/api/serve/applications/", json.dumps(self.configuration), headers)
            reply = connection.getresponse()
            content = reply.read()
            connection.close()
            assert reply.status == 200, content
            return
        file = self.folder / "serve.yaml"
        file.write_text(yaml.safe_dump(self.configuration))
        program = [str(Path(sys.executable).with_name("serve")), "deploy", str(file)]
        if not Path(program[0]).exists():
            program = [sys.executable, "-m", "ray.serve.scripts", "deploy", str(file)]
        done = subprocess.run(
            [*program, "-a", f"http://127.0.0.1:{self.dashboard}"],
            env=self.environment, cwd=ROOT, capture_output=True, text=True, timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr

    def run(self, *words: object, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run a Python module as an operator does on this node."""
        return subprocess.run(
            [sys.executable, "-m", *map(str, words)],
            env={**self.environment, **variables}, capture_output=True, text=True, timeout=300,
        )  # fmt: skip

    def check(self, *words: object) -> tuple[int, list[Check]]:
        """Return the exit code of `rlservo cluster check`, and (name, ok, message) of each check."""
        done = self.run("rlservo.deploy.cli", "cluster", "check", "--address", self.address, "--json", *words)
        assert "Traceback" not in done.stderr, done.stderr
        document = json.loads(done.stdout)
        assert document["ok"] is (done.returncode == 0)
        return done.returncode, [(each["check"], each["ok"], each["message"]) for each in document["checks"]]

    def admin(self, key: str = KEY) -> AdminClient:
        return AdminClient(f"http://127.0.0.1:{self.port}", api_key=key, timeout_s=60)

    def replicas(self) -> list[dict[str, Any]]:
        with self.admin() as admin:
            return admin.replicas()

    def wait_for(
        self, condition: Callable[[list[dict[str, Any]]], bool], timeout_s: float = 2 * PATIENCE_S
    ) -> list[dict[str, Any]]:
        """Wait until what every replica tells fulfils a condition."""
        deadline = time.monotonic() + timeout_s
        seen: list[dict[str, Any]] = []
        while time.monotonic() < deadline:
            with contextlib.suppress(Exception):
                seen = self.replicas()
                if condition(seen):
                    return seen
            time.sleep(0.2)
        raise AssertionError(json.dumps(seen, indent=1))

    def status(self) -> tuple[str, str]:
        """Return (status, messages) of the application, as `serve status` tells them."""
        connection = http.client.HTTPConnection("127.0.0.1", self.dashboard, timeout=60)
        connection.request(
            "GET",
            "/api/serve/applications/",
            headers={"authorization": f"Bearer {self.environment['RAY_AUTH_TOKEN']}"},
        )
        found = json.loads(connection.getresponse().read())["applications"]["rlservo"]
        connection.close()
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
        return self.pids_of("ServeReplica:rlservo:PolicyServer")

    def pids_of(self, part: str, argument: str = "") -> list[int]:
        """Return our processes with this in their title or program, and that in an argument."""
        pids = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError):
                    title = (entry / "cmdline").read_bytes().decode(errors="replace")
                    if part in title.split("\0")[0] and argument in title and self._owns(int(entry.name)):
                        pids.append(int(entry.name))
        return sorted(pids)

    def _owns(self, pid: int) -> bool:
        while pid > 1:
            if str(self.folder).encode() in (Path("/proc") / str(pid) / "cmdline").read_bytes():
                return True
            pid = int((Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[1])
        return False


@pytest.fixture(scope="session")
def cluster_repository(
    tmp_path_factory: pytest.TempPathFactory, box_policy: Callable[..., Path], recurrent: Path
) -> Path:
    """ur5 in versions 1 to 3, 4 with a byte of its weights changed, and 5 whose actions leave the space; an LSTM."""
    root = tmp_path_factory.mktemp("repository")
    shutil.copytree(recurrent / RECURRENT, root / RECURRENT)
    box_policy(root, version="5", seed=5, action_scale=400.0)
    for seed, version in enumerate(("1", "2", "3", "4")):
        box_policy(root, version=version, seed=seed)
    weights = root / "ur5" / "4" / "policy.onnx"
    content = bytearray(weights.read_bytes())
    content[len(content) // 2] ^= 1
    weights.write_bytes(content)
    return root


def serving(*versions: str, production: str = "1", **more: Any) -> dict[str, Any]:
    """Return the `user_config` for these versions of ur5."""
    ur5 = {"versions": list(versions), "aliases": {"production": production}, **more}
    return {"policies": {"ur5": ur5, RECURRENT: {}}}


@pytest.fixture(scope="session")
def cluster(cluster_repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """The cluster, with version 1 of ur5 deployed by `serve deploy`."""
    port, grpc_port, dashboard, first, second = free_ports(5)
    folder, mark = Path(tempfile.mkdtemp(prefix="r")), secrets.token_hex(16)
    configuration = yaml.safe_load((ROOT / "deploy" / "serve.yaml").read_text())
    configuration["http_options"]["port"] = port
    configuration["grpc_options"]["port"] = grpc_port
    settings = {"api_keys": LINE, "body_timeout_s": PATIENCE_S, "max_queue_ms": 1000 * PATIENCE_S}
    configuration["applications"][0]["args"] = {
        "policies": [str(cluster_repository)], "replicas": 2, "settings": settings
    }  # fmt: skip
    own = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
    environment = own | cluster_environment(folder, one_machine=True) | proxy_ports() | proxy_files(folder) | {
        MARK: mark,
        DIFFERENT: ITS_VALUE,
        "RAY_enable_worker_prestart": "0",  # a process for each core, beside those that Serve starts
        "RAY_preload_python_modules": "rlservo.serve_app.ray_serve.lean_imports",  # as in `rlservo serve`
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(first),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(first + 20),
        "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(second),
        "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(second + 20),
    }  # fmt: skip
    plan = json.dumps({"dashboard": dashboard, "folder": str(folder)})
    errors = tmp_path_factory.mktemp("cluster") / "errors.txt"
    with errors.open("w") as stream:
        process = subprocess.Popen(
            [sys.executable, "-c", CLUSTER, plan],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    try:
        address = process.stdout.readline().strip()
        assert address, errors.read_text()[-3000:]
        made = Cluster(address, port, dashboard, folder, environment, cluster_repository, configuration)
        made.missing = tmp_path_factory.mktemp("configuration") / "gone"
        made.before = made.check("--config", _configuration_without_policies(made.missing))
        made.deploy(serving("1"), by_command=True)
        made.while_starting = made.check("--own", DIFFERENT)[1]
        made.wait_for(lambda seen: len(seen) == 2)
        made.wait_for_status("RUNNING")  # each check below is a process of seconds
        deadline = time.monotonic() + PATIENCE_S
        while (found := made.check("--own", DIFFERENT))[0] != 0:
            assert time.monotonic() < deadline, found
        made.running = found[1]
        yield made
    finally:
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(40)
        end_marked(mark, process.pid)
        process.wait()
        process.stdout.close()
        remove_folder(folder)


def _configuration_without_policies(missing: Path) -> Path:
    file = missing.with_name("serve.yaml")
    file.write_text(json.dumps({"applications": [{"args": {"policies": [str(missing)]}}]}))
    return file
