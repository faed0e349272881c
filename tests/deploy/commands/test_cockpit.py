"""The command `rlservo cockpit`: start, end without leftovers, and one sentence for bad input."""

from __future__ import annotations

import http.client
import signal
import socket
import subprocess
import sys
import urllib.request
from importlib.metadata import version
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the cockpit draws with viser")

from command_line import rlservo_here
from servers import free_ports, running

COMMAND = [sys.executable, "-m", "rlservo.deploy.cli", "cockpit"]


def refused(*arguments: str) -> tuple[int, str]:
    done = rlservo_here("cockpit", *arguments)
    assert "Traceback" not in done.stderr and done.stderr.count("\n") == 1, done.stderr
    return done.returncode, done.stderr


def handshake(port: int, **more: str) -> int:
    """Return the status that a WebSocket gets with these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    headers = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Protocol": f"viser-v{version('viser')}",
        **more,
    }
    connection.request("GET", "/", headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_a_page_on_loopback_and_leaves_nothing(shipped: Path, number: signal.Signals) -> None:
    (port,) = free_ports(1)
    with running([*COMMAND, "--bundle", str(shipped), "--port", str(port)], port) as run:
        assert run.process.stdout is not None
        assert run.process.stdout.readline() == f"cockpit at http://127.0.0.1:{port}; Ctrl-C stops\n"
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as reply:
            assert b"<html" in reply.read().lower()
            assert "frame-ancestors 'none'" in reply.headers["Content-Security-Policy"]
            assert reply.headers["X-Frame-Options"] == "DENY"
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", port), timeout=5):
            pass  # it listens on 127.0.0.1 alone
        own = f"127.0.0.1:{port}"
        for headers, status in (
            ({}, 101),  # a program
            ({"Origin": f"http://{own}"}, 101),
            ({"Origin": "http://localhost:9000", "Host": "localhost:9000"}, 101),  # a port forwarded to ours
            ({"Origin": f"http://127.0.0.1:{port + 1}"}, 403),  # another server of this machine
            ({"Origin": f"http://localhost:{port}"}, 403),
            ({"Origin": "http://elsewhere.example"}, 403),
            ({"Origin": "null"}, 403),
            ({"Origin": f"http://elsewhere.example:{port}", "Host": f"elsewhere.example:{port}"}, 403),
        ):
            assert handshake(port, **headers) == status, headers
        assert run.end(number) == 0
        assert run.process.stdout.read() == ""


def test_bad_input_is_one_sentence_and_exit_code_2(shipped: Path, tmp_path: Path) -> None:
    bundle = str(shipped / "ur5")
    (port,) = free_ports(1)
    with socket.create_server(("127.0.0.1", port)):
        code, sentence = refused("--bundle", bundle, "--port", str(port))
        assert code == 2 and f"127.0.0.1:{port}: the port is taken" in sentence
    for arguments, expected in (
        ((), "expected one of --url"),
        (("--bundle", bundle, "--url", "http://127.0.0.1:1"), "expected one of --url"),
        (("--bundle", bundle, "--env", "rlservo/Nothing-v0"), "'rlservo/Nothing-v0' is not registered"),
        (("--bundle", bundle, "--env", "crane:Crane-v0"), "draws only rlservo's own simulators"),
        (("--bundle", bundle, "--env", "rlservo/NoObstacleNavigationMir100Sim-v0"), "does not fit"),
        (("--bundle", bundle, "--env-arg", "ur_model=ur7"), "'ur7' does not exist"),
        (("--bundle", bundle, "--policy", "nobody"), "there is no policy 'nobody'"),
        (("--bundle", bundle, "--version", "9"), "no version '9'"),
    ):
        code, sentence = refused(*arguments)
        assert (code, expected in sentence) == (2, True), sentence
    for arguments, expected in (
        (("--recording", str(tmp_path / "none.mcap")), "does not exist"),
        (("--robot-server", "127.0.0.1:1"), "no robot server answers at 127.0.0.1:1"),
        (("--url", "http://127.0.0.1:1"), "cannot be reached"),
        (("--bundle", str(tmp_path)), "holds no policy bundle"),
    ):
        code, sentence = refused(*arguments)
        assert (code, expected in sentence) == (1, True), sentence


def test_the_tunnel_to_the_internet_is_closed() -> None:
    from rlservo.deploy.cockpit.page import served_page

    with served_page(free_ports(1)[0], "a test") as server:
        assert server.request_share_url() is None


def test_without_viser_the_sentence_names_the_extra(shipped: Path) -> None:
    program = (
        "import sys; sys.modules['viser'] = None; from rlservo.deploy.cli import main; "
        f"sys.argv = ['rlservo', 'cockpit', '--bundle', {str(shipped)!r}]; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and "pip install '.[cockpit]'" in done.stderr
