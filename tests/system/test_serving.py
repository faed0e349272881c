"""The real thing: the launcher and `serve run`, with Ray, HAProxy, signals, and a look at what they leave behind."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.export.contract.errors import BundleError, UsageError
from rlservo.serve_app.ray_serve.environment import cluster_environment
from rlservo.serve_app.ray_serve.launcher import serve_policies
from rlservo.serve_app.ray_serve.processes import check_port, free_ports, port_holder
from rlservo.serve_app.runtime.policy import Policy

pytestmark = [pytest.mark.serve, pytest.mark.slow]

ROOT = Path(__file__).resolve().parents[2]
OBS = [round(0.01 * i, 2) for i in range(27)]
START_S = 120
SPOOR = "RLSERVO_TEST"  # inherited by every process a test starts, however far down

# Runs the launcher in a process's main thread, as the command line does, and tells when it is ready.
LAUNCH = """
import json, pathlib, sys
from rlservo.serve_app.ray_serve.launcher import serve_policies
plan = json.loads(sys.argv[1])
serve_policies(
    plan["dirs"],
    port=plan["port"],
    admin_key_file=pathlib.Path(plan["key_file"]),
    on_ready=lambda served: print("READY", served.url, flush=True),
)
print("ENDED", flush=True)
"""


@dataclass
class Run:
    process: subprocess.Popen[str]
    port: int
    spoor: str
    key_file: Path | None = None

    def wait_until_ready(self) -> None:
        """Wait for the launcher's own word."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("READY"), line + self.process.stdout.read()

    def left(self) -> list[str]:
        """Return the command lines of processes this run started that still live."""
        return [name for pid, name in trail(self.spoor).items() if pid != self.process.pid]

    def nothing_is_left(self, *, folders: bool = True) -> None:
        """Assert that no process, no listener and, with `folders`, no file is left within 20 seconds."""
        deadline = time.monotonic() + 20
        while (left := self.left() + (own_folders(self.spoor) if folders else [])) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert left == []
        assert self.key_file is None or not self.key_file.exists()
        assert port_holder(self.port) is None
        check_port("127.0.0.1", self.port)


def trail(spoor: str) -> dict[int, str]:
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if f"{SPOOR}={spoor}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
    return found


def own_folders(spoor: str) -> list[str]:
    return [str(path) for path in Path(os.environ.get("TMPDIR", "/tmp"), f"t{spoor}").glob("*")]


@contextlib.contextmanager
def running(arguments: list[str], port: int, **environment: str) -> Iterator[Run]:
    """Start a program with a temporary folder of its own, and end whatever is left of it in the end."""
    spoor = secrets.token_hex(2)
    temporary = Path(tempfile.gettempdir()) / f"t{spoor}"
    temporary.mkdir()
    variables = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    variables.update({SPOOR: spoor, "TMPDIR": str(temporary), **environment})
    process = subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=variables,
        cwd=ROOT,
        # A shell's background job starts with Ctrl-C ignored, and so would all it starts, `serve run` among them.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        yield Run(process, port, spoor)
    finally:
        for pid in trail(spoor):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def launched(policies: Path, *, prefix: tuple[str, ...] = (), **environment: str) -> Iterator[Run]:
    (port,) = free_ports(1)
    with tempfile.TemporaryDirectory() as keys:
        plan = json.dumps({"dirs": [str(policies)], "port": port, "key_file": f"{keys}/admin.key"})
        with running([*prefix, sys.executable, "-c", LAUNCH, plan], port, **environment) as run:
            run.key_file = Path(keys, "admin.key")
            yield run


def ask(port: int, method: str, path: str, body: Any = None) -> tuple[int, Any]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        content = body if body is None or isinstance(body, bytes) else json.dumps(body)
        connection.request(method, path, content, {"content-type": "application/json"})
        reply = connection.getresponse()
        received = reply.read()
        return reply.status, json.loads(received) if received[:1] in (b"{", b"[") else received
    finally:
        connection.close()


@pytest.fixture(scope="module")
def server(policies: Path) -> Iterator[Run]:
    """A server started as a shell script's background job is: with SIGINT ignored. And a RAY_ADDRESS to nowhere."""
    ignoring = ("sh", "-c", "trap '' INT; exec \"$@\"", "sh")
    with launched(policies, prefix=ignoring, RAY_ADDRESS="127.0.0.1:1") as run:
        run.wait_until_ready()
        yield run
        # The last test of this server: SIGINT ends it, in order, with nothing left.
        run.process.send_signal(signal.SIGINT)
        assert run.process.wait(timeout=60) == 0
        run.nothing_is_left()


def test_the_served_action_is_the_policys_own(server: Run, policies: Path) -> None:
    status, reply = ask(server.port, "POST", "/v1/policies/ur5/act", {"obs": OBS, "seq": 3})
    assert (status, reply["version"], reply["seq"]) == (200, "10", 3)
    np.testing.assert_allclose(reply["action"], Policy.load(policies / "ur5" / "10").act(OBS), rtol=1e-6)
    assert ask(server.port, "POST", "/v1/policies/gridworld/act", {"obs": 1})[0] == 200


def test_errors_pass_the_proxy_unchanged_and_the_server_goes_on(server: Run) -> None:
    cases = [
        ("/v1/policies/ur5/act", {"obs": OBS[:26]}, 422, "bad-observation"),
        ("/v1/policies/ur5/act", b'{"obs": [NaN]}', 422, "bad-observation"),
        ("/v1/policies/ur5/act", b"{", 400, "bad-request"),
        ("/v1/policies/ur6/act", {"obs": OBS}, 404, "unknown-policy"),
        ("/v1/policies/ur5/act", {"obs": OBS, "deadline_ms": 0}, 408, "deadline-passed"),
    ]
    for path, body, status, code in cases * 5:
        got, reply = ask(server.port, "POST", path, body)
        assert (got, reply["code"]) == (status, code)
    assert ask(server.port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 200


def test_health_and_documentation_are_served(server: Run) -> None:
    assert ask(server.port, "GET", "/v2/health/ready") == (200, {"ready": True})
    assert ask(server.port, "GET", "/healthz") == (200, b"OK")
    assert ask(server.port, "GET", "/openapi.json")[1]["openapi"] == "3.0.3"
    assert b"swagger-ui-bundle.js" in ask(server.port, "GET", "/docs")[1]


def test_a_replica_loads_no_torch_and_nothing_else_it_does_not_need(server: Run) -> None:
    replicas = [pid for pid, name in trail(server.spoor).items() if "ServeReplica" in name]
    assert len(replicas) == 1
    maps = Path(f"/proc/{replicas[0]}/maps").read_text()
    assert "onnxruntime" in maps  # the right process is looked at
    for library in ("/torch/", "/mujoco/", "/onnx/"):
        assert library not in maps, library


def test_importing_the_application_pulls_in_no_training_code() -> None:
    heavy = ["torch", "ray.rllib", "ray.tune", "gymnasium", "mujoco", "onnx"]
    code = f"import sys, rlservo.serve_app.ray_serve.app; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1] == "[]"


def test_only_the_asked_for_address_serves_http(server: Run) -> None:
    """Replicas, statistics and metrics of HAProxy listen on loopback; 0100007F is 127.0.0.1 as /proc writes it."""
    ours = set()
    for pid, name in trail(server.spoor).items():
        if "haproxy" in name:
            for link in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    ours.add(str(link.readlink()))
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    listening = [row[1].split(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in ours]
    assert len(listening) >= 3 and set(listening) == {"0100007F"}


def test_a_second_server_on_the_port_is_refused_before_anything_starts(server: Run, policies: Path) -> None:
    before = set(trail(server.spoor))
    held = rf"port {server.port} on 127.0.0.1 is in use by 'haproxy' .*running server: stop that server"
    with pytest.raises(UsageError, match=held):
        serve_policies([policies], port=server.port)
    assert set(trail(server.spoor)) == before


def test_arguments_and_bundles_are_checked_before_anything_starts(policies: Path, tmp_path: Path) -> None:
    (port,) = free_ports(1)
    with pytest.raises(BundleError, match="does not exist"):
        serve_policies([tmp_path / "nowhere"], port=port)
    with pytest.raises(UsageError, match="replicas must be 1 or more"):
        serve_policies([policies], port=port, replicas=0)
    with pytest.raises(UsageError, match="threads"):
        serve_policies([policies], port=port, settings={"threads": -1})


@pytest.mark.parametrize(
    ("number", "after_s"),
    [(signal.SIGINT, 2.0), (signal.SIGTERM, 4.5), (signal.SIGKILL, 3.5)],
    ids=["SIGINT", "SIGTERM", "SIGKILL"],
)
def test_a_server_ended_while_it_starts_leaves_nothing(policies: Path, number: signal.Signals, after_s: float) -> None:
    with launched(policies) as run:
        deadline = time.monotonic() + 60
        while not run.left() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(after_s)
        run.process.send_signal(number)
        run.process.wait(timeout=60)
        if number == signal.SIGKILL:  # it could not remove its folder; the cluster's process must
            assert run.process.returncode == -signal.SIGKILL
        run.nothing_is_left()


@pytest.mark.parametrize("signals", [[signal.SIGKILL], [signal.SIGINT, signal.SIGINT], [signal.SIGTERM]])
def test_a_running_server_leaves_nothing_however_it_is_ended(policies: Path, signals: list[signal.Signals]) -> None:
    with launched(policies) as run:
        run.wait_until_ready()
        assert ask(run.port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 200
        assert run.key_file is not None and run.key_file.exists()
        for number in signals:
            run.process.send_signal(number)
            time.sleep(0.3)
        run.process.wait(timeout=60)
        run.nothing_is_left()


def test_a_stop_event_ends_a_server_started_in_a_thread(policies: Path) -> None:
    (port,) = free_ports(1)
    ready, stop = threading.Event(), threading.Event()
    thread = threading.Thread(
        target=lambda: serve_policies([policies], port=port, on_ready=lambda _: ready.set(), stop=stop)
    )
    thread.start()
    assert ready.wait(START_S)
    assert ask(port, "GET", "/v2/health/ready")[0] == 200
    stop.set()
    thread.join(60)
    assert not thread.is_alive() and port_holder(port) is None


def wait_until_served(run: Run) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and run.process.poll() is None:
        with contextlib.suppress(OSError, http.client.HTTPException):
            if ask(run.port, "GET", "/v2/health/ready")[0] == 200:
                return
        time.sleep(0.2)
    raise AssertionError("the server did not become ready")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serve_run_with_the_shipped_configuration_answers_and_ends_clean(
    policies: Path, tmp_path: Path, number: signal.Signals
) -> None:
    import grpc
    import yaml

    (port, stats, metrics, fallback, grpc_port, grpc_fallback) = free_ports(6)
    configuration = yaml.safe_load((ROOT / "deploy" / "serve.yaml").read_text())
    configuration["http_options"]["port"] = port
    configuration["grpc_options"]["port"] = grpc_port
    configuration["applications"][0]["args"]["policies"] = [str(policies)]
    file = tmp_path / "serve.yaml"
    file.write_text(yaml.safe_dump(configuration))
    ray_folder = Path(tempfile.mkdtemp(prefix="r"))
    environment = {
        **cluster_environment(ray_folder),
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_TMPDIR": str(ray_folder),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(grpc_fallback),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(ray_folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(ray_folder / "a.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(ray_folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(ray_folder / "state"),
    }
    try:
        program = str(Path(sys.executable).with_name("serve"))
        with running([program, "run", str(file)], port, **environment) as run:
            output: list[str] = []
            assert run.process.stdout is not None
            # Read on, so that the pipe never fills.
            drain = threading.Thread(target=output.extend, args=(run.process.stdout,), daemon=True)
            drain.start()
            wait_until_served(run)
            status, reply = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})
            assert status == 200, "".join(output)
            assert len(reply["action"]) == 6
            with grpc.insecure_channel(f"127.0.0.1:{grpc_port}") as channel:
                live = channel.unary_unary("/inference.GRPCInferenceService/ServerLive")
                assert live(b"", timeout=20, wait_for_ready=True) == b"\x08\x01"  # field 1, true
            run.process.send_signal(number)
            run.process.wait(timeout=90)
            run.nothing_is_left(folders=False)  # Ray's dashboard leaves an empty one
            drain.join()
    finally:
        shutil.rmtree(ray_folder, ignore_errors=True)
