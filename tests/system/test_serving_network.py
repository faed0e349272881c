"""A running server on the network: its ports, its time-outs, its share for each address, its logs."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import queue
import re
import socket
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import grpc
import numpy as np
import pytest

from rlservo.export.contract.errors import UnauthenticatedError
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.protocols.http_endpoint import PROCESS
from rlservo.serve_app.ray_serve.processes import MARK
from rlservo.serve_app.ray_serve.server_log import LOG_BYTES, cut_log
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import new_key
from servers import STREAM_IDLE_S, LiveServer, connected, served_in_thread

pytestmark = [pytest.mark.serve, pytest.mark.slow]

LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}
# Listeners that may be elsewhere than on loopback when the server is asked for loopback: (process, why). None.
ELSEWHERE: dict[str, str] = {}
BODY = json.dumps({"obs": [0.1] * 27}).encode()
ACT = b"POST /v1/policies/ur5/act HTTP/1.1\r\nhost: 127.0.0.1:%d\r\ncontent-type: application/json\r\n%s"
HANDSHAKE = (
    b"connection: upgrade\r\nupgrade: websocket\r\nsec-websocket-version: 13\r\n"
    b"sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)


@dataclass(frozen=True)
class Server:
    port: int
    grpc_port: int | None
    folder: Path
    key: str
    pids: frozenset[int]

    def listeners(self) -> dict[tuple[str, int], str]:
        """Return the process that listens, by (address as /proc writes it, port)."""
        sockets: dict[str, str] = {}
        for pid in self.pids | processes_of(self.folder):
            with contextlib.suppress(OSError):
                name = (Path("/proc") / str(pid) / "cmdline").read_bytes().split(b"\0")[0].decode()
                for link in (Path("/proc") / str(pid) / "fd").iterdir():
                    with contextlib.suppress(OSError):
                        sockets[str(link.readlink())] = name.rpartition("/")[2]
        found = {}
        for table in ("tcp", "tcp6"):
            for line in (Path("/proc/net") / table).read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == "0A" and f"socket:[{fields[9]}]" in sockets:
                    address, _, port = fields[1].rpartition(":")
                    found[address, int(port, 16)] = sockets[f"socket:[{fields[9]}]"]
        return found

    def ports(self, name: str) -> list[int]:
        return [port for (_, port), process in self.listeners().items() if process.startswith(name)]


def processes_of(folder: Path) -> frozenset[int]:
    """Return the server's processes: those that carry its mark, and those of the session that the first one leads."""
    status = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                command = (entry / "cmdline").read_bytes()
                mark = [
                    word for word in (entry / "environ").read_bytes().split(b"\0") if word.startswith(MARK.encode())
                ]
                status[int(entry.name)] = (int(fields[3]), command, mark[0] if mark else b"")
    ((session, mark),) = {
        (session, mark)
        for session, command, mark in status.values()
        if b"rlservo.serve_app.ray_serve.cluster_process" in command and str(folder).encode() in command
    }
    return frozenset(pid for pid, row in status.items() if row[0] == session or row[2] == mark)


def _folder_of(port: int) -> Path:
    """Return the folder of the server on a port, as its cluster's process was told."""
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
            if b"rlservo.serve_app.ray_serve.cluster_process" in words:
                plan = json.loads(words[words.index(b"rlservo.serve_app.ray_serve.cluster_process") + 1])
                if plan["port"] == port:
                    return Path(plan["folder"])
    raise AssertionError(f"no server runs on port {port}")


@pytest.fixture(scope="module")
def server(live_server: LiveServer) -> Server:
    folder = _folder_of(live_server.port)
    return Server(live_server.port, live_server.grpc_port, folder, live_server.key, processes_of(folder))


def act(port: int, key: str, source: str = "127.0.0.1") -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20, source_address=(source, 0))
    headers = {"content-type": "application/json", "authorization": f"Bearer {key}"}
    try:
        connection.request("POST", "/v1/policies/ur5/act", BODY, headers)
        return connection.getresponse().status
    finally:
        connection.close()


def test_nothing_listens_beyond_loopback(server: Server) -> None:
    found = server.listeners()
    assert len(found) > 10 and server.port in {port for _, port in found}  # the processes are the right ones
    names = {name for name in found.values() if name}
    assert any("raylet" in name for name in names) and any("ServeReplica" in name for name in names)
    elsewhere = {(address, port): name for (address, port), name in found.items() if address not in LOOPBACK}
    assert {key: name for key, name in elsewhere.items() if name not in ELSEWHERE} == {}


def test_the_dashboards_agent_does_not_run(server: Server) -> None:
    commands = [(Path("/proc") / str(pid) / "cmdline").read_bytes() for pid in processes_of(server.folder)]
    assert commands and not [command for command in commands if b"dashboard/agent.py" in command[:300]]
    assert not [command for command in commands if command.startswith(b"ray::DashboardAgent")]


def get(address: int | Path, path: str) -> tuple[int, bytes]:
    with connected(address, 10) as connection, contextlib.closing(http.client.HTTPConnection("127.0.0.1")) as asking:
        asking.sock = connection
        asking.request("GET", path)
        reply = asking.getresponse()
        return reply.status, reply.read()


def http_addresses(server: Server) -> list[int | Path]:
    """Return where HTTP is spoken: HAProxy's port, the replica's and the fallback proxy's, or their Unix sockets."""
    ports = {server.port, *server.ports("ray::ServeReplica"), *server.ports("ray::ProxyActor")}
    spoken = []
    for address in (*ports, *server.folder.glob("[0-9]*.sock")):
        with contextlib.suppress(OSError, http.client.HTTPException):
            if get(address, "/healthz")[0] == 200:
                spoken.append(address)
    return spoken


def test_no_replica_has_an_http_port(server: Server) -> None:
    found = http_addresses(server)
    sockets = [address for address in found if isinstance(address, Path)]
    assert [address for address in found if address not in sockets] == [server.port] and len(sockets) == 2
    assert {path.stat().st_mode & 0o777 for path in sockets} == {0o600}
    assert {path.parent.stat().st_mode & 0o777 for path in sockets} == {0o700}


PATHS = (
    "/-/routes",
    "/-/healthz",
    "/%2d/routes",
    "/-%2froutes",
    "/-/%72outes",
    "/-/Routes",
    "//-/routes",
    "/-/routes/",
)


@pytest.mark.parametrize("path", PATHS)
def test_serves_own_paths_answer_nobody_at_any_address(server: Server, path: str) -> None:
    addresses = http_addresses(server)
    assert len(addresses) == 3
    for address in addresses:
        status, body = get(address, path)
        assert status in (400, 401, 404), (address, path)
        assert b"rlservo" not in body


def test_serves_own_methods_answer_nobody_at_any_address(server: Server) -> None:
    spoken = 0
    ports = {server.grpc_port, *server.ports("ray::ServeReplica"), *server.ports("ray::ProxyActor")}
    sockets = (f"unix:{path}" for path in server.folder.glob("[0-9]*.sock"))
    for address in (*(f"127.0.0.1:{port}" for port in ports), *sockets):
        with grpc.insecure_channel(address) as channel:
            try:
                live = channel.unary_unary("/inference.GRPCInferenceService/ServerLive")(b"", timeout=5)
            except grpc.RpcError:
                continue  # Ray's own, which wants its token
            assert live == b"\x08\x01"
            spoken += 1
            for method in ("Healthz", "ListApplications"):
                with pytest.raises(grpc.RpcError) as raised:
                    channel.unary_unary(f"/ray.serve.RayServeAPIService/{method}")(b"", timeout=5)
                assert raised.value.code() is grpc.StatusCode.UNIMPLEMENTED, (address, method)
    assert spoken == 3


def test_a_grpc_stream_may_be_silent_for_as_long_as_the_setting_says(server: Server) -> None:
    requests: queue.Queue[bytes] = queue.Queue()
    with grpc.insecure_channel(f"127.0.0.1:{server.grpc_port}") as channel:
        stream = channel.stream_stream("/inference.GRPCInferenceService/ModelStreamInfer")
        call = stream(iter(requests.get, b"end"), metadata=[("authorization", f"Bearer {server.key}")])
        requests.put(b"")
        next(call)
        time.sleep(STREAM_IDLE_S - 2)  # longer than HAProxy waits for a client of HTTP
        requests.put(b"")
        next(call)
        started = time.monotonic()
        with pytest.raises(grpc.RpcError) as raised:
            next(call)
    assert raised.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    assert raised.value.details() == f"the stream was silent for {STREAM_IDLE_S:g} s: open another one"
    assert STREAM_IDLE_S - 1 < time.monotonic() - started < STREAM_IDLE_S + 20
    requests.put(b"end")


def test_a_silent_websocket_is_ended_by_the_replica_with_a_sentence(server: Server) -> None:
    head = b"GET /v1/policies/ur5/stream HTTP/1.1\r\nhost: 127.0.0.1:%d\r\nauthorization: Bearer %s\r\n%s\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=60) as connection:
        connection.sendall(head % (server.port, server.key.encode(), HANDSHAKE))
        received = b""
        started = time.monotonic()
        while b"silent for too long" not in received:
            piece = connection.recv(65536)
            assert piece, received
            received += piece
        assert time.monotonic() - started > STREAM_IDLE_S - 1


@pytest.mark.parametrize(
    "more", [b"content-length: %d\r\n\r\n%s" % (len(BODY), BODY), b"content-length: 2000000\r\n\r\n" + b"x" * 100_000]
)
@pytest.mark.parametrize("upgrade", [b"", HANDSHAKE])
def test_every_request_ends_in_time_at_every_address(server: Server, more: bytes, upgrade: bytes) -> None:
    for address in http_addresses(server):
        head = ACT % (server.port, upgrade + b"authorization: Bearer %s\r\n" % server.key.encode())
        with connected(address, 20) as connection:
            started = time.monotonic()
            connection.sendall(head.replace(b"connection: upgrade", b"connection: upgrade, close") + more)
            answer = connection.recv(65536)
            assert answer.startswith(b"HTTP/1.1 "), (address, answer)
            assert answer.split()[1] in (b"200", b"400", b"408")
            if b"x" * 100 in more:
                with contextlib.suppress(ConnectionResetError):
                    while connection.recv(65536):
                        pass
            assert time.monotonic() - started < 18  # 2 s for the body and 5 s for what the client still owes


@pytest.mark.parametrize("kind", ["upgrade", "silent", "half"])
def test_one_address_does_not_stop_the_service_for_another(server: Server, kind: str) -> None:
    authorized = b"authorization: Bearer %s\r\n" % server.key.encode()
    content = {
        "upgrade": ACT % (server.port, authorized + HANDSHAKE) + b"content-length: %d\r\n\r\n%s" % (len(BODY), BODY),
        "silent": b"",
        "half": ACT % (server.port, authorized) + b"content-length: 100000\r\n\r\n" + b"x" * 40_000,
    }[kind]
    slowest = 0.0
    held: list[socket.socket] = []
    try:
        for number in range(4200):
            with contextlib.suppress(OSError):
                connection = socket.create_connection(("127.0.0.1", server.port), timeout=5)
                held.append(connection)
                connection.setblocking(False)
                connection.send(content)
            if number % 300 == 299:
                started = time.monotonic()
                assert act(server.port, server.key, "127.0.0.2") == 200
                slowest = max(slowest, time.monotonic() - started)
        assert slowest < 10
    finally:
        for connection in held:
            connection.close()
    deadline = time.monotonic() + 30
    while act_or_none(server.port, server.key) != 200:  # as soon as its connections are gone
        assert time.monotonic() < deadline
        time.sleep(0.2)


def act_or_none(port: int, key: str) -> int | None:
    with contextlib.suppress(OSError, http.client.HTTPException):
        return act(port, key)
    return None


def test_the_logs_of_an_idle_server_do_not_grow(server: Server) -> None:
    def sizes() -> dict[str, int]:
        files = [file for file in server.folder.rglob("*") if file.is_file() and file.name != "debug_state.txt"]
        return {str(file.relative_to(server.folder)): file.stat().st_size for file in files}

    assert act(server.port, server.key) == 200
    time.sleep(5)  # the tests before this one
    before = sizes()
    assert [name for name in before if name.endswith("gcs_server.out")]  # the right folder
    time.sleep(65)  # Ray's statistics would come once a minute
    grown = {name: size - before.get(name, 0) for name, size in sizes().items() if size > before.get(name, 0)}
    assert sum(grown.values()) < 2000, grown


def test_what_is_logged_is_bounded(server: Server) -> None:
    raylets = [
        (Path("/proc") / str(pid))
        for pid in processes_of(server.folder)
        if b"raylet/raylet" in (Path("/proc") / str(pid) / "cmdline").read_bytes().split(b"\0")[0]
    ]
    assert len(raylets) == 1
    environment = (raylets[0] / "environ").read_bytes()
    assert f"RAY_ROTATION_MAX_BYTES={LOG_BYTES}".encode() in environment
    told = re.findall(rb"--logging-rotate-bytes=(\d+)", (raylets[0] / "cmdline").read_bytes())
    assert set(told) == {str(LOG_BYTES).encode()}
    assert all(file.stat().st_size < 2 * LOG_BYTES for file in server.folder.rglob("*.log"))


def test_nothing_of_the_server_waits_for_the_machines_other_work(server: Server) -> None:
    """Ray's workers run at nice 15 otherwise, and with them replicas and HAProxy."""
    levels = set()
    for pid in processes_of(server.folder):
        with contextlib.suppress(ProcessLookupError):
            levels.add(os.getpriority(os.PRIO_PROCESS, pid))
    assert levels == {os.getpriority(os.PRIO_PROCESS, 0)}


def test_a_log_is_cut_to_its_last_lines(tmp_path: Path) -> None:
    file = tmp_path / "server.log"
    with file.open("ab") as writer:
        for number in range(20_000):
            writer.write(b"line %d\n" % number)
        writer.flush()
        cut_log(file, max_bytes=1 << 20)
        assert file.stat().st_size > 100_000  # within its bound
        cut_log(file, max_bytes=100_000)
        writer.write(b"next\n")
    lines = file.read_text().splitlines()
    assert lines[-2:] == ["line 19999", "next"] and 100 < len(lines) < 1000
    assert lines[0].startswith("line ")


@pytest.fixture(scope="module")
def after_serve(policies: Path) -> Iterator[Server]:
    """A server whose requests pass through Ray Serve's own handling, and that has no gRPC port."""
    key, line = new_key("tests")
    settings = {"ahead_of_serve": False, "default_policy": "ur5", "max_ongoing_requests": 1, "api_keys": line}
    with served_in_thread([policies], settings=settings) as port:
        folder = _folder_of(port)
        yield Server(port, None, folder, key, processes_of(folder))


def test_without_a_grpc_port_nobody_speaks_grpc(after_serve: Server) -> None:
    for port in {port for _, port in after_serve.listeners()}:
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            for method in ("inference.GRPCInferenceService/ServerLive", "ray.serve.RayServeAPIService/Healthz"):
                with pytest.raises(grpc.RpcError) as raised:
                    channel.unary_unary(f"/{method}")(b"", timeout=3)
                assert raised.value.code() is not grpc.StatusCode.OK


def test_after_serves_own_handling_actions_and_streams_are_the_policys_own(after_serve: Server, ur5: Path) -> None:
    url, policy = f"http://127.0.0.1:{after_serve.port}", Policy.load(ur5)
    observations = np.random.default_rng(5).uniform(-0.5, 0.5, (20, 27)).astype(np.float32)
    with PolicyClient(url, "ur5", api_key=after_serve.key, timeout_s=20) as client:
        for obs in observations:
            np.testing.assert_array_equal(client.act(obs), policy.act(obs))
    with StreamClient(url, "ur5", api_key=after_serve.key, deadline_ms=20_000) as client:
        for obs in observations:
            np.testing.assert_array_equal(client.act(obs), policy.act(obs))


def test_after_serves_own_handling_it_is_serve_that_numbers_requests(after_serve: Server) -> None:
    """The setting does what it says: Serve's ids are UUIDs, those of requests that go ahead of it are ours."""
    with pytest.raises(ValueError):
        uuid.UUID(f"{PROCESS.decode()}-1")
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", after_serve.port, timeout=20)) as connection:
        headers = {"content-type": "application/json", "authorization": f"Bearer {after_serve.key}"}
        connection.request("POST", "/v1/policies/ur5/act", BODY, headers)
        assert uuid.UUID(connection.getresponse().headers["x-request-id"])


def test_after_serves_own_handling_keys_are_asked_for(after_serve: Server) -> None:
    assert act(after_serve.port, "") == act(after_serve.port, f"{after_serve.key}x") == 401
    with (
        pytest.raises(UnauthenticatedError, match="key"),
        StreamClient(f"http://127.0.0.1:{after_serve.port}", "ur5", deadline_ms=20_000) as client,
    ):
        client.act(np.zeros(27, np.float32))


def test_after_serves_own_handling_what_is_too_much_gets_503(after_serve: Server) -> None:
    """At most one request at a time is taken on: of those that arrive in one turn of the loop the others are not."""
    seen: set[int] = set()
    deadline = time.monotonic() + 60
    with ThreadPoolExecutor(16) as threads:
        while not {200, 503} <= seen and time.monotonic() < deadline:
            seen |= set(threads.map(lambda _: act(after_serve.port, after_serve.key), range(64)))
    assert seen == {200, 503}
    assert act(after_serve.port, after_serve.key) == 200
