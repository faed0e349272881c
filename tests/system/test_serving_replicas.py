"""Two replicas behind the proxy: what one of them knows and the other does not, and what both have to follow."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import psutil
import pytest

from rlservo.export.contract.errors import DeadlineError, LateError
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.protocols.oip_messages import messages
from rlservo.serve_app.ray_serve import direct_server
from rlservo.serve_app.ray_serve.ports import free_ports, port_holder
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import new_key
from servers import Run, launched

# The last test leaves one replica.
pytestmark = [pytest.mark.serve, pytest.mark.slow, pytest.mark.random_order(disabled=True)]

OLD, OLD_LINE = new_key("cell-7")
NEW, NEW_LINE = new_key("cell-8")
OBS = [0.1] * 27
MODEL = "lstm_box"
# Deploys the server's application anew, changed as each line of its input says: what `serve deploy` does on a cluster.
DEPLOY = """
import json, sys
import ray
from ray import serve
from rlservo.serve_app.ray_serve import app
arguments = json.loads(sys.argv[1])
ray.init(sys.argv[2], log_to_driver=False, configure_logging=False)
for line in sys.stdin:
    arguments.update(json.loads(line))
    serve.run(app.build(app.BuildArguments(**arguments)), name=app.APPLICATION, route_prefix="/")
    print("deployed", flush=True)
"""
CLIENT: dict[str, Any] = {"api_key": OLD, "deadline_ms": 60e3}
DEPLOYED = ("policies", "replicas", "served", "settings")
SEEN = [np.random.default_rng(i).uniform(-1, 1, 3).astype(np.float32) for i in range(40)]


@pytest.fixture(scope="module")
def key_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of keys that the replicas follow."""
    file = tmp_path_factory.mktemp("keys") / "keys"
    file.write_text(OLD_LINE + "\n")
    return file


@pytest.fixture(scope="module")
def direct_port() -> int:
    return free_ports(1)[0]


@pytest.fixture(scope="module")
def server(policies: Path, recurrent: Path, key_file: Path, direct_port: int) -> Iterator[Run]:
    """A server of two replicas; SIGKILL ends its launcher, and nothing is left then."""
    settings = {"api_keys_file": str(key_file), "direct_port": direct_port}
    with launched(policies, recurrent, replicas=2, with_grpc=True, settings=settings) as run:
        run.wait_until_ready()
        yield run
        run.end(signal.SIGKILL)
    assert port_holder(direct_port) is None


def status(port: int, key: str) -> int:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        headers = {"content-type": "application/json", "authorization": f"Bearer {key}"}
        connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS}), headers)
        reply = connection.getresponse()
        reply.read()
        return reply.status


def wait_until_followed(port: int, statuses: dict[str, int]) -> None:
    """Wait until either replica answers each key so."""
    deadline = time.monotonic() + 30
    for key, expected in statuses.items():
        while not follows(port, key, expected):
            assert time.monotonic() < deadline
            time.sleep(0.02)


def follows(port: int, key: str, expected: int) -> bool:
    with contextlib.suppress(http.client.RemoteDisconnected, ConnectionError):  # of a replica that was killed
        return {status(port, key) for _ in range(20)} == {expected}
    return False


def ask(port: int, obs: np.ndarray, session_id: str, **more: bool) -> tuple[int, dict[str, Any]]:
    """Ask for an action of a session on a connection of its own: HAProxy chooses the replica; again if it is busy."""
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        headers = {"content-type": "application/json", "authorization": f"Bearer {OLD}"}
        body = json.dumps({"obs": obs.tolist(), "session_id": session_id, **more})
        connection.request("POST", f"/v1/policies/{MODEL}/act", body, headers)
        reply = connection.getresponse()
        content = json.loads(reply.read())
    return ask(port, obs, session_id, **more) if reply.status == 503 else (reply.status, content)


def serving(server: Run, direct_port: int, status: str = psutil.CONN_LISTEN) -> dict[int, int]:
    """Return by the replicas' process ids how many sockets of the direct port they have: it opens when they are up."""
    found = {}
    for pid in server.processes("ServeReplica"):
        with contextlib.suppress(psutil.NoSuchProcess):
            sockets = psutil.Process(pid).net_connections("tcp")
            found[pid] = sum(each.laddr.port == direct_port and each.status == status for each in sockets)
    return {pid: count for pid, count in found.items() if count}


def wait_for_two(server: Run, direct_port: int) -> list[int]:
    """Wait until two replicas serve; return their process ids."""
    deadline = time.monotonic() + 120
    while len(found := serving(server, direct_port)) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return list(found)


def test_states_streams_and_ids_keep_an_episode(server: Run, recurrent: Path, key_file: Path, direct_port: int) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(server.port, {OLD: 200})
    wait_for_two(server, direct_port)
    with Policy.load(recurrent / MODEL) as policy:
        expected = [policy.act(obs) for obs in SEEN]
    url = f"http://127.0.0.1:{server.port}"
    with (
        PolicyClient(url, MODEL, api_key=OLD) as carrying,
        StreamClient(url, MODEL, api_key=OLD, server_state=True) as streaming,
        PolicyClient(url, MODEL, api_key=OLD, server_state=True) as named,
    ):
        for obs, action in zip(SEEN, expected, strict=True):
            np.testing.assert_allclose(carrying.act(obs), action, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(streaming.act(obs), action, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(named.act(obs), action, rtol=1e-4, atol=1e-5)
    ids = [f"cell-{number}" for number in range(8)]
    for step, (obs, action) in enumerate(zip(SEEN, expected, strict=True)):
        for session_id in ids:
            code, reply = ask(server.port, obs, session_id, reset=step == 0, end=step == len(SEEN) - 1)
            assert (code, reply.get("session_step")) == (200, step + 1), reply
            np.testing.assert_allclose(reply["action"], action, rtol=1e-4, atol=1e-5)
    assert ask(server.port, SEEN[0], ids[0])[0] == 410


def test_both_follow_the_file_of_keys_and_end_grpc_streams(server: Run, key_file: Path) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(server.port, {OLD: 200})
    request = messages.ModelInferRequest(model_name="ur5")
    tensor = request.inputs.add(name="obs", datatype="FP32", shape=[1, 27])
    tensor.contents.fp32_contents.extend(OBS)
    go_on, stop = threading.Semaphore(1), threading.Event()

    def requests() -> Iterator[bytes]:
        while not stop.is_set():
            if go_on.acquire(timeout=1):
                yield request.SerializeToString()

    try:
        with grpc.insecure_channel(f"127.0.0.1:{server.grpc_port}") as channel:
            stream = channel.stream_stream("/inference.GRPCInferenceService/ModelStreamInfer")(
                requests(), metadata=[("application", "rlservo"), ("authorization", f"Bearer {OLD}")]
            )
            assert not messages.ModelStreamInferResponse.FromString(next(stream)).error_message
            key_file.write_text(NEW_LINE)
            wait_until_followed(server.port, {OLD: 401, NEW: 200})
            go_on.release()
            with pytest.raises(grpc.RpcError) as caught:
                next(stream)
            assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
    finally:
        stop.set()


def test_sessions_of_a_killed_replica_are_lost_and_the_others_go_on(
    server: Run, recurrent: Path, key_file: Path, direct_port: int
) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(server.port, {OLD: 200})
    with Policy.load(recurrent / MODEL) as policy:
        expected = [policy.act(obs) for obs in SEEN[:3]]
    ids = [f"robot-{number}" for number in range(24)]
    for step in range(2):
        for session_id in ids:
            assert ask(server.port, SEEN[step], session_id, reset=step == 0)[0] == 200
    before = wait_for_two(server, direct_port)
    os.kill(before[0], signal.SIGKILL)
    wait_until_followed(server.port, {OLD: 200})  # HAProxy has heard of it
    replies = [ask(server.port, SEEN[2], session_id) for session_id in ids]
    lost = {session_id for session_id, (code, _) in zip(ids, replies, strict=True) if code == 410}
    assert 0 < len(lost) < len(ids)
    for code, reply in replies:
        assert code in (200, 410), reply
        if code == 200:
            np.testing.assert_allclose(reply["action"], expected[2], rtol=1e-4, atol=1e-5)
    assert before[0] not in wait_for_two(server, direct_port)
    for session_id in lost:  # whoever comes after the dead one has nothing of it
        assert ask(server.port, SEEN[2], session_id)[0] == 410
        assert ask(server.port, SEEN[0], session_id, reset=True)[0] == 200


def test_over_the_direct_port_our_clients_go_on_when_a_replica_is_killed(
    server: Run, direct_port: int, policies: Path, key_file: Path
) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(direct_port, {OLD: 200, NEW: 401})
    with Policy.load(policies / "ur5" / "10") as local:
        expected = local.act(OBS)

    wait_for_two(server, direct_port)
    stop, url = threading.Event(), f"http://127.0.0.1:{server.port}"
    clients = [kind(url, "ur5", api_key=OLD, deadline_ms=30e3) for kind in (PolicyClient, StreamClient) * 3]
    asked, direct = [0] * len(clients), [0] * len(clients)

    def drive(number: int) -> None:
        with clients[number] as policy:
            while not stop.is_set():
                # On a busy machine the other replica may stand still for seconds: refused as late, or not answered.
                with contextlib.suppress(LateError, DeadlineError):
                    np.testing.assert_allclose(policy.act(OBS), expected, rtol=1e-4, atol=1e-5)
                    asked[number] += 1
                    direct[number] += policy.is_direct

    def wait_for(more: int) -> None:
        until, deadline = [count + more for count in asked], time.monotonic() + 120
        while any(count < least for count, least in zip(asked, until, strict=True)):
            assert time.monotonic() < deadline, asked
            for each in driven:
                if each.done():
                    each.result()
            time.sleep(0.02)

    with ThreadPoolExecutor(len(clients)) as pool:
        driven = [pool.submit(drive, number) for number in range(len(clients))]
        try:
            wait_for(30)
            assert all(direct), direct
            connections = serving(server, direct_port, psutil.CONN_ESTABLISHED)
            os.kill(max(connections, key=lambda pid: connections[pid]), signal.SIGKILL)
            wait_for(30)
        finally:
            stop.set()
        for each in driven:
            each.result(60)


@contextlib.contextmanager
def deploying(server: Run) -> Iterator[Callable[..., None]]:
    """Give what deploys the server's application with changes, and returns when Serve has it."""
    (pid,) = server.processes("ray_serve.cluster_process")
    cluster = psutil.Process(pid)
    plan = json.loads(cluster.cmdline()[-1])
    (raylet,) = server.processes("/raylet/raylet ")
    address = next(word for word in psutil.Process(raylet).cmdline() if word.startswith("--gcs-address="))
    command = [sys.executable, "-c", DEPLOY, json.dumps({name: plan[name] for name in DEPLOYED})]
    command.append(address.partition("=")[2])
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=cluster.environ(), cwd=server.folder
    ) as process:

        def deploy(**changes: Any) -> None:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(json.dumps(changes) + "\n")
            process.stdin.flush()
            assert process.stdout.readline() == "deployed\n"

        try:
            yield deploy
        finally:
            process.kill()


class Load:
    """Clients of the direct port that ask without end, and what they lost."""

    def __init__(self, server: Run, direct_port: int) -> None:
        self._stop = threading.Event()
        self.asked: dict[str, int] = {}
        self.direct = 0
        """Actions of the one who takes the server's offer, by that way."""
        plain = partial(self._keep, direct_port)
        # A stream that takes the server's offer does so when it connects, or not at all where that took too long.
        clients: dict[str, tuple[type[PolicyClient] | type[StreamClient], int]] = {
            "offered": (PolicyClient, server.port),
            "stream": (StreamClient, direct_port),
        }
        self._loads: dict[str, Callable[[str], None]] = {"plain": plain, "another plain": plain}
        for name, (kind, port) in clients.items():
            self._loads[name] = partial(self._drive, partial(kind, f"http://127.0.0.1:{port}", "ur5", **CLIENT))

    def __enter__(self) -> Load:
        self._pool = ThreadPoolExecutor(len(self._loads))
        self._driven = [self._pool.submit(load, name) for name, load in self._loads.items()]
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown()
        for each in self._driven:
            each.result()

    def wait_for(self, more: int) -> None:
        """Wait until each of them got so many more actions."""
        until, deadline = {name: self.asked.get(name, 0) + more for name in self._loads}, time.monotonic() + 240
        while any(self.asked.get(name, 0) < count for name, count in until.items()):
            assert time.monotonic() < deadline, self.asked
            for each in self._driven:
                if each.done():
                    each.result()  # raises what it lost
            time.sleep(0.02)

    def _drive(self, make: Callable[[], PolicyClient | StreamClient], name: str) -> None:
        with make() as policy:
            while not self._stop.is_set():
                # On a busy machine a replica may stand still for seconds: refused as late, or not answered by HAProxy.
                with contextlib.suppress(LateError, DeadlineError):
                    policy.act(OBS)
                    self._count(name)
                    self.direct += policy.is_direct

    def _keep(self, port: int, name: str) -> None:
        """Ask on a kept connection until a reply says that it ends: no client needs to know more."""
        headers = {"content-type": "application/json", "authorization": f"Bearer {OLD}"}
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
            answered = time.monotonic()
            while not self._stop.is_set():
                idle_s = time.monotonic() - answered
                try:
                    connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS}), headers)
                    reply = connection.getresponse()  # closed by http.client where the reply says so
                    content = json.loads(reply.read())
                except (ConnectionError, http.client.HTTPException):
                    if idle_s < direct_server.DRAIN_S / 2:  # else it was idle, and may be closed: ask anew
                        raise
                    connection.close()
                    continue
                finally:
                    answered = time.monotonic()
                assert reply.status == 200 or content["code"] == LateError.code, content
                self._count(name)

    def _count(self, name: str) -> None:
        self.asked[name] = self.asked.get(name, 0) + 1
        time.sleep(0.005)


def test_an_update_and_one_to_fewer_replicas_lose_nothing_on_the_direct_port(
    server: Run, direct_port: int, key_file: Path
) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(direct_port, {OLD: 200, NEW: 401})
    old = set(wait_for_two(server, direct_port))
    settings = {"api_keys_file": str(key_file), "direct_port": direct_port, "max_streams": 200}

    def wait_until_gone(gone: set[int]) -> None:
        deadline = time.monotonic() + 240
        while gone & set(server.processes("ServeReplica")):
            assert time.monotonic() < deadline
            load.wait_for(1)

    with deploying(server) as deploy, Load(server, direct_port) as load:
        load.wait_for(20)
        deploy(settings=settings)
        wait_until_gone(old)
        wait_for_two(server, direct_port)
        load.wait_for(20)
        assert load.direct > 20
        deploy(replicas=1)
        deadline = time.monotonic() + 240
        while len(left := server.processes("ServeReplica")) > 1:
            assert time.monotonic() < deadline
            load.wait_for(1)
        load.wait_for(20)
        assert left and not set(left) & old
