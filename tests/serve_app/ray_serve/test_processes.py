"""Ports and marked processes, with real sockets and real processes."""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
import time

import pytest

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.ray_serve.processes import (
    MARK,
    check_port,
    claim_port,
    end_marked,
    find_marked,
    free_ports,
    is_free,
)


def test_a_port_in_use_names_its_holder() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(UsageError, match=rf"port {port} on 127.0.0.1 is in use by '.+' \(process {os.getpid()}\)"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)


@pytest.mark.parametrize(
    ("host", "port", "sentence"),
    [
        ("127.0.0.1", 0, "port must be in 1..65535"),
        ("127.0.0.1", 70000, "port must be in 1..65535"),
        ("203.0.113.7", 8000, "not an address of this machine"),
        ("no such host", 8000, "not an address of this machine"),
    ],
)
def test_an_address_that_cannot_be_is_refused(host: str, port: int, sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        check_port(host, port)


def test_free_ports_are_different_and_can_be_listened_on() -> None:
    ports = free_ports(5)
    assert len(set(ports)) == 5
    for port in ports:
        check_port("127.0.0.1", port)


def test_a_port_chosen_by_another_process_is_not_ours_until_that_process_ends() -> None:
    choose = (
        "from rlservo.serve_app.ray_serve.processes import free_ports; print(free_ports(1)[0], flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", choose], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        port = int(other.stdout.readline())
        assert is_free(port)
        assert not claim_port(port)
        other.communicate("\n")
    assert claim_port(port)
    assert claim_port(port)  # ours: asked again it still is
    assert not {port, *free_ports(3)} & {*free_ports(3)}  # but what was chosen once is not chosen again


def test_marked_processes_are_ended_with_their_children_and_others_are_left() -> None:
    mark, other = secrets.token_hex(8), secrets.token_hex(8)
    nap = "import time; time.sleep(60)"
    code = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', '{nap}']); {nap}"
    parent = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, MARK: mark})
    bystander = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], env={**os.environ, MARK: other})
    try:
        deadline = time.monotonic() + 20
        while len(find_marked(mark)) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(find_marked(mark)) == 2
        assert end_marked(mark) == []
        assert find_marked(mark) == []
        assert bystander.poll() is None
    finally:
        parent.kill()
        bystander.kill()
        parent.wait()
        bystander.wait()


def test_a_process_that_lost_its_mark_is_found_by_its_session() -> None:
    """Ray's workers overwrite the memory of their environment with their title."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], env={}, start_new_session=True)
    try:
        assert process.pid in find_marked("no such mark", process.pid)
        assert find_marked("no such mark") == []
        assert end_marked("no such mark", process.pid) == []
        assert process.wait(5) == -9
    finally:
        process.kill()
        process.wait()
