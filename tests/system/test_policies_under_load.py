"""Changes under load cost nobody a request: real Ray Serve, two replicas, clients that never stop asking.

One cluster (clusters.py) for the whole file, in the order of the tests.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from clusters import KEY, LEAN_NODE, PATIENCE_S, RECURRENT, Cluster, serving
from rlservo.export.contract.errors import ConflictError, RefusedError, UnauthenticatedError
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.runtime.policy import Policy
from servers import ask

pytestmark = [pytest.mark.serve, pytest.mark.slow, pytest.mark.random_order(disabled=True)]

ROOT = Path(__file__).resolve().parents[2]
OBS = [round(0.01 * i, 2) for i in range(27)]
CLIENTS = 4
PAUSE_S = 0.02  # between a client's requests: the load is steady, and leaves the machine something


@dataclass
class Load:
    """What the clients saw while it ran."""

    versions: Counter[str] = field(default_factory=Counter)
    first_failures: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)  # also after one retry
    actions: set[tuple[str, tuple[float, ...]]] = field(default_factory=set)  # each that came, with its version
    longest_s: float = 0.0

    @property
    def answered(self) -> int:
        return self.versions.total()


@contextlib.contextmanager
def loaded(cluster: Cluster, path: str = "/v1/policies/ur5/act") -> Iterator[Load]:
    """Clients that ask for actions without end, each on its own connection, and retry once."""
    load, stop, lock = Load(), threading.Event(), threading.Lock()
    body = json.dumps({"obs": OBS}).encode()
    headers = {"content-type": "application/json", "authorization": f"Bearer {KEY}"}

    def once(connection: http.client.HTTPConnection) -> tuple[str, str]:
        """Return (version, failure)."""
        try:
            connection.request("POST", path, body, headers)
            reply = connection.getresponse()
            content = reply.read()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            return "", f"{type(error).__name__}: {error}"
        if reply.status != 200:
            return "", f"{reply.status} {content[:200]!r}"
        document = json.loads(content)
        with lock:
            load.actions.add((document["version"], tuple(document["action"])))
        return document["version"], ""

    def client() -> None:
        connection = http.client.HTTPConnection("127.0.0.1", cluster.port, timeout=60)
        while not stop.is_set():
            began = time.monotonic()
            version, failure = once(connection)
            if failure:
                with lock:
                    load.first_failures.append(failure)
                version, failure = once(connection)
            with lock:
                load.longest_s = max(load.longest_s, time.monotonic() - began)
                if failure:
                    load.failures.append(failure)
                else:
                    load.versions[version] += 1
            time.sleep(PAUSE_S)
        connection.close()

    threads = [threading.Thread(target=client) for _ in range(CLIENTS)]
    for thread in threads:
        thread.start()
    try:
        time.sleep(0.5)
        yield load
        time.sleep(0.5)
    finally:
        stop.set()
        for thread in threads:
            thread.join()


class Sessions:
    """Sessions by id, which all replicas know of: whatever happens to these, a new one must be able to start."""

    def __init__(self, cluster: Cluster, count: int = 8) -> None:
        self._cluster = cluster
        self._steps = {f"robot-{number}": 0 for number in range(count)}
        generator = np.random.default_rng(0)
        self._seen = [generator.uniform(-1, 1, 3).astype(np.float32) for _ in range(20)]
        with Policy.load(cluster.repository / RECURRENT) as policy:
            self._expected = [policy.act(obs) for obs in self._seen]
        assert self.step() == []

    def step(self) -> list[str]:
        """Take a step of each, compare it bit by bit, and return those that are lost; they begin anew."""
        lost = []
        for session_id, step in self._steps.items():
            code, reply = self._ask(session_id, step)
            if code == 410:
                lost.append(session_id)
                code, reply = self._ask(session_id, step := 0)
            assert (code, reply.get("session_step")) == (200, step + 1), reply
            assert np.array_equal(np.array(reply["action"], np.float32), self._expected[step])
            self._steps[session_id] = step + 1
        return lost

    def _ask(self, session_id: str, step: int) -> tuple[int, Any]:
        body = {"obs": self._seen[step].tolist(), "session_id": session_id, "reset": step == 0}
        deadline = time.monotonic() + PATIENCE_S
        while (found := ask(self._cluster.port, "POST", f"/v1/policies/{RECURRENT}/act", body, KEY))[0] == 503:
            assert time.monotonic() < deadline, found
            time.sleep(0.2)
        return found


@pytest.fixture(scope="module")
def sessions(cluster: Cluster) -> Sessions:
    return Sessions(cluster)


# Another node of the cluster, as `ray.cluster_utils` makes one: `ray start` refuses a second one on this address.
NODE = (
    LEAN_NODE
    + """
import sys
from ray._private.node import Node
node = Node(
    parameter.RayParams(gcs_address=sys.argv[1], node_ip_address="127.0.0.1", num_cpus=2, num_gpus=0, min_worker_port=0,
              max_worker_port=0, object_store_memory=80 << 20),
    head=False, shutdown_at_exit=True, spawn_reaper=False)
print("joined", flush=True)
sys.stdin.read()
"""
)


@contextlib.contextmanager
def joined(cluster: Cluster) -> Iterator[psutil.Process]:
    """Add another node to the cluster; yields the process whose descendants are all of it."""
    process = subprocess.Popen(
        [sys.executable, "-c", NODE, cluster.address],
        env=cluster.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdin is not None
    try:
        said = ""
        while not said.startswith("joined"):  # Ray may say something first
            said = process.stdout.readline()
            assert said, "the node did not start"
        yield psutil.Process(process.pid)
    finally:
        with contextlib.suppress(psutil.Error):
            kill_all(psutil.Process(process.pid))
        process.wait()
        process.stdin.close()
        process.stdout.close()


@pytest.fixture(scope="module")
def other_node(cluster: Cluster) -> Iterator[psutil.Process]:
    """Another node, which gets one of the replicas with the rolling update; the last test kills it."""
    with joined(cluster) as node:
        yield node


def kill_all(node: psutil.Process) -> None:
    """SIGKILL to all of a node at once, as when its power goes."""
    for each in [*node.children(recursive=True), node]:
        with contextlib.suppress(psutil.Error):
            each.kill()


def replicas_of(node: psutil.Process) -> list[int]:
    found = []
    for each in node.children(recursive=True):
        with contextlib.suppress(psutil.Error):
            found += [each.pid] if "ServeReplica" in "".join(each.cmdline()[:1]) else []
    return found


def set_alias(cluster: Cluster, alias: str) -> None:
    with cluster.admin() as admin:
        admin.alias("ur5", alias, "1")


def policy_of(replica: dict[str, Any]) -> dict[str, Any]:
    return next(policy for policy in replica["policies"] if policy["name"] == "ur5")


def default_of(replica: dict[str, Any]) -> str:
    return str(policy_of(replica)["version"])


def test_aliases_switch_on_every_replica_under_load_without_a_failed_request(cluster: Cluster) -> None:
    with loaded(cluster) as load, cluster.admin() as admin:
        admin.load("ur5", "2")
        for version in ("2", "1") * 5:
            reply = admin.alias("ur5", "production", version)
            assert reply["default"] == version
            # The command has returned: no replica gives the other version any more.
            assert {default_of(replica) for replica in cluster.replicas()} == {version}
        admin.rollback("ur5", "production")
        # Commands at the same time, whichever replicas they reach, all happen.
        at_once = [threading.Thread(target=set_alias, args=(cluster, f"at-once-{n}")) for n in range(6)]
        for thread in at_once:
            thread.start()
        for thread in at_once:
            thread.join()
    assert load.first_failures == [] and set(load.versions) == {"1", "2"}
    assert load.answered > 50
    for replica in cluster.replicas():
        assert default_of(replica) == "2"
        assert set(policy_of(replica)["aliases"]) == {"production", *(f"at-once-{n}" for n in range(6))}


def test_a_broken_version_is_refused_under_load_and_nothing_changes(cluster: Cluster) -> None:
    before = {default_of(replica) for replica in cluster.replicas()}
    with loaded(cluster) as load, cluster.admin() as admin:
        with pytest.raises(RefusedError, match=r"nothing has changed.*policy\.onnx is not the file that was exported"):
            admin.load("ur5", "4")
        cluster.deploy(serving("1", "4", production="4"))
        seen = cluster.wait_for(
            lambda replicas: (
                len(replicas) == 2
                and all(each["refused"] and each["refused"]["change"] == "configuration" for each in replicas)
            )
        )
    assert load.first_failures == [] and set(load.versions) == before
    for replica in seen:
        assert default_of(replica) in before
        assert "policy.onnx is not the file that was exported" in replica["refused"]["reason"]
        states = {v["version"]: v for v in policy_of(replica)["version_states"]}
        assert (states["4"]["state"], states["2"]["state"]) == ("failed", "ready")
        assert "is not the file" in states["4"]["reason"]


def test_a_changed_configuration_wins_over_earlier_commands_without_a_failed_request(cluster: Cluster) -> None:
    with loaded(cluster) as load:
        cluster.deploy(serving("1", "3", production="3"))
        cluster.wait_for(lambda replicas: len(replicas) == 2 and {default_of(each) for each in replicas} == {"3"})
    assert load.first_failures == [] and set(load.versions) >= {"3"}
    with cluster.admin() as admin:  # the alias led to 2 before, and the way back goes there, though 2 was not listed
        assert admin.rollback("ur5", "production")["default"] == "2"
        admin.alias("ur5", "production", "3")


@contextlib.contextmanager
def half_sent(cluster: Cluster) -> Iterator[Callable[[], list[int]]]:
    """A request that each replica has the first half of; yields what sends the rest and returns the statuses.

    Straight to the replicas: the proxy would keep a small one until it has all of it.
    """
    configuration = next(cluster.folder.rglob("haproxy.cfg")).read_text()
    (backend,) = re.findall(r"^backend http-\S+\n(?: .*\n|\n)*", configuration, re.MULTILINE)
    ports = {int(port) for port in re.findall(r"server SERVE_REPLICA\S+ [\d.]+:(\d+)", backend)}
    body = json.dumps({"obs": OBS}).encode()
    head = (
        f"POST /v1/policies/ur5/act HTTP/1.1\r\nhost: 127.0.0.1\r\nauthorization: Bearer {KEY}\r\n"
        f"content-type: application/json\r\ncontent-length: {len(body)}\r\n\r\n"
    ).encode()
    with contextlib.ExitStack() as stack:
        lines = [stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=60)) for port in ports]
        for line in lines:
            line.sendall(head + body[:10])

        def finish() -> list[int]:
            for line in lines:
                line.sendall(body[10:])
            return [int(line.recv(65536)[9:12] or 0) for line in lines]

        yield finish


@contextlib.contextmanager
def streaming(cluster: Cluster) -> Iterator[list[None]]:
    """A stream that asks for an action each 10 ms, and must not end before this does; yields a list of its steps."""
    stop, steps = threading.Event(), list[None]()

    def stream() -> None:
        with StreamClient(f"http://127.0.0.1:{cluster.port}", "ur5", api_key=KEY, deadline_ms=60_000) as client:
            while not stop.is_set():
                client.act(np.array(OBS, np.float32))
                steps.append(None)
                time.sleep(0.01)

    with ThreadPoolExecutor(1) as pool:
        streamed = pool.submit(stream)
        try:
            yield steps
        finally:
            stop.set()
        streamed.result()


def test_a_rolling_update_costs_no_request_keeps_streams_and_commands_and_broken_code_changes_nothing(
    cluster: Cluster, sessions: Sessions, other_node: psutil.Process
) -> None:
    """Of the settings, the environment and the place of the replicas: each alone would replace all of them, too."""
    (deployment,) = cluster.application["deployments"]
    with cluster.admin() as admin:
        admin.alias("ur5", "candidate", "1")
    with loaded(cluster) as load, streaming(cluster) as steps, half_sent(cluster) as finish:
        cluster.application["import_path"] = "rlservo.serve_app.ray_serve.not_there:build"
        cluster.deploy()
        assert "not_there" in cluster.wait_for_status("DEPLOY_FAILED")
        cluster.application["import_path"] = "rlservo.serve_app.ray_serve.app:build"
        old = {each["replica"] for each in cluster.replicas()}
        cluster.application["runtime_env"] = {"env_vars": {"RLSERVO_UPDATE": "1"}}
        deployment["max_replicas_per_node"] = 1  # those that are there know of no such limit
        cluster.deploy(settings={"max_batch": 2048})
        seen = cluster.wait_for(
            lambda replicas: len(replicas) == 2 and not old & {each["replica"] for each in replicas}
        )
        time.sleep(2)  # the old ones drain: a second, then they wait for who is being answered
        assert finish() == [200, 200]
        cluster.wait_for_status("RUNNING")
    assert load.first_failures == [], Counter(load.first_failures)
    assert set(load.versions) == {"3"}
    assert load.answered > 50 and len(steps) > 50
    assert sessions.step() == []  # handed over
    for replica in seen:
        assert policy_of(replica)["aliases"] == {"production": "3", "candidate": "1"}
    cluster.wait_for(lambda _: len(replicas_of(other_node)) == 1 and len(cluster.replica_pids()) == 2)


def test_a_killed_replica_costs_a_client_that_retries_once_nothing_and_comes_back_as_it_was(
    cluster: Cluster, sessions: Sessions
) -> None:
    with cluster.admin() as admin:
        admin.alias("ur5", "candidate", "3")
    generation = {each["generation"] for each in cluster.replicas()}
    cluster.wait_for(lambda _: len(cluster.replica_pids()) == 2)  # those before the update may still be ending
    pids = cluster.replica_pids()
    with loaded(cluster) as load:
        os.kill(pids[0], signal.SIGKILL)
        cluster.wait_for(lambda replicas: len(replicas) == 2 and pids[0] not in cluster.replica_pids())
        time.sleep(1)
    print("first failures:", Counter(load.first_failures))
    assert load.failures == [], Counter(load.failures)
    assert len(load.first_failures) <= CLIENTS  # each had one request in it at most
    assert set(load.versions) == {"3"}
    assert {each["generation"] for each in cluster.replicas()} == generation
    sessions.step()


def test_a_killed_proxy_is_back_at_once_and_nobody_is_told_that_the_policy_is_unknown(cluster: Cluster) -> None:
    manager = cluster.pids_of("ray::HAProxyManager")
    proxies = cluster.pids_of("/haproxy")
    assert len(manager) == 1 and proxies
    with loaded(cluster) as load:
        for pid in proxies:
            os.kill(pid, signal.SIGKILL)
        began = time.monotonic()
        while (now := cluster.pids_of("ray::HAProxyManager")) == manager or not now:
            assert time.monotonic() - began < PATIENCE_S
            time.sleep(0.2)
        while cluster.pids_of("/haproxy", "bridge.cfg"):
            assert time.monotonic() - began < PATIENCE_S
            time.sleep(0.2)
        answered = load.answered
        cluster.wait_for(lambda seen: len(seen) == 2 and load.answered > answered + 50)
    assert load.first_failures
    assert {failure.partition(":")[0] for failure in load.first_failures} <= {
        "ConnectionRefusedError", "RemoteDisconnected", "ConnectionResetError", "BrokenPipeError", "IncompleteRead",
    }, Counter(load.first_failures)  # fmt: skip
    assert load.answered > 50


def test_a_killed_controller_costs_nobody_anything_and_commands_work_again(cluster: Cluster) -> None:
    (controller,) = cluster.pids_of("ray::ServeController")
    with loaded(cluster) as load:
        os.kill(controller, signal.SIGKILL)
        cluster.wait_for(lambda _: cluster.pids_of("ray::ServeController") not in ([], [controller]))
        cluster.wait_for_status("RUNNING")
        with cluster.admin() as admin:
            admin.alias("ur5", "candidate", "1")
        cluster.wait_for(lambda seen: len(seen) == 2)
    assert load.failures == [], Counter(load.failures)


def test_administration_needs_the_admin_key_and_says_what_it_will_not_do(cluster: Cluster) -> None:
    with cluster.admin("nobody") as nobody, pytest.raises(UnauthenticatedError):
        nobody.replicas()
    with cluster.admin() as admin:
        with pytest.raises(ConflictError, match="in use by the alias 'production'"):
            admin.unload("ur5", "3")
        for name in ("../ur5", "..", "ur5/../../etc"):
            with pytest.raises(Exception, match=r"the path is not usable"):
                admin.load(name, "1")


def has_answered(replica: dict[str, Any]) -> bool:
    return any(version["requests"] for version in policy_of(replica)["version_states"])


def test_a_lost_node_costs_a_client_that_retries_once_nothing(
    cluster: Cluster, sessions: Sessions, other_node: psutil.Process
) -> None:
    (deployment,) = cluster.application["deployments"]
    deadline = time.monotonic() + 2 * PATIENCE_S
    while not (len(replicas_of(other_node)) == 1 and len(cluster.replica_pids()) == 2):  # of both nodes
        assert time.monotonic() < deadline, "the replicas are not apart"
        time.sleep(0.2)
    sessions.step()  # those that were begun on the other node go with it
    try:
        with loaded(cluster) as load, cluster.admin() as admin:
            while not all(map(has_answered, admin.replicas())):
                assert time.monotonic() < deadline, "a replica was asked nothing"
                time.sleep(0.2)
            before = load.answered
            kill_all(other_node)
            cluster.wait_for(lambda seen: len(seen) == 1)
            after = load.answered
    finally:
        del deployment["max_replicas_per_node"]  # the same code: the replica that is left stays
        cluster.deploy()
    assert load.failures == [] and after - before > 20
    for version in load.versions:
        with Policy.load(cluster.repository / "ur5" / version) as policy:
            expected = policy.act(np.array(OBS, np.float32))
        for action in (action for each, action in load.actions if each == version):
            assert np.array_equal(np.array(action, np.float32), expected)
    cluster.wait_for(lambda seen: len(seen) == 2)
    cluster.wait_for_status("RUNNING")
    sessions.step()
