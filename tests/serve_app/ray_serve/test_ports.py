"""TCP ports, with real sockets and real processes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.ray_serve.ports import check_port, claim_port, free_ports, is_free


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
    choose = "from rlservo.serve_app.ray_serve.ports import free_ports; print(free_ports(1)[0], flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", choose], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        port = int(other.stdout.readline())
        assert is_free(port)
        assert not claim_port(port)
        other.communicate("\n")
    assert claim_port(port)
    assert not {port, *free_ports(3)} & {*free_ports(3)}  # but what was chosen once is not chosen again
