"""A node of a Ray cluster whose traffic is encrypted: who is refused, and its end with the raylet."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
from cluster_resources import make_certificates

from rlservo.serve_app.ray_serve.environment import cluster_environment
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.ray_serve.processes import MARK, end_marked, remove_folder

pytestmark = [
    pytest.mark.serve,
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="there is no openssl (Debian: apt-get install openssl)"),
    pytest.mark.random_order(disabled=True),
]

PATIENCE_S = 240
NODE = (sys.executable, "-m", "rlservo.serve_app.ray_serve.ray_node", "start", "--block", "--num-cpus=1")
# Asks the head what any client, and any node that joins, asks first.
CLIENT = """
import sys
from ray._raylet import GcsClient
client = GcsClient(address=sys.argv[1])
print("ANSWERED", len(client.get_all_node_info(timeout=60)), flush=True)
"""


@dataclass
class Head:
    """A head node; `environment` is that of all nodes, `without_certificate` the same but for TLS."""

    address: str
    process: subprocess.Popen[str]
    environment: dict[str, str]
    without_certificate: dict[str, str]


def run_until(command: list[str], environment: dict[str, str], words: str) -> str:
    """Run a command until it has said this, and end it; return what it said."""
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    assert process.stdout is not None
    said = ""
    try:
        while words not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
    return said


@pytest.fixture(scope="module")
def head() -> Iterator[Head]:
    folder, mark = Path(tempfile.mkdtemp(prefix="r")), secrets.token_hex(16)  # sockets need a short path
    (port,) = free_ports(1)
    own = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
    plain = own | cluster_environment(folder) | {MARK: mark, "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    environment = plain | make_certificates(folder)
    words = ["--head", f"--port={port}", "--node-ip-address=127.0.0.1", "--include-dashboard=false"]
    words += [f"--temp-dir={folder / 'ray'}", f"--object-store-memory={80 << 20}"]
    process = subprocess.Popen(
        [*NODE, *words], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    try:
        said = ""
        while "Ray runtime started." not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        yield Head(f"127.0.0.1:{port}", process, environment, plain)
    finally:
        end_marked(mark)
        process.wait()
        process.stdout.close()
        remove_folder(folder)


def test_who_has_the_token_without_the_certificate_gets_no_answer_and_does_not_join(head: Head) -> None:
    """What has it is let in before and after; Ray tries for 5 s, says so, and tries again, a node without end."""
    client = [sys.executable, "-c", CLIENT, head.address]
    node = [*NODE, f"--address={head.address}", "--node-ip-address=127.0.0.1"]
    assert run_until(client, head.environment, "ANSWERED 1")
    for command in (client, node):
        said = run_until(command, head.without_certificate, "Failed to connect to GCS")
        assert "ANSWERED" not in said and "Ray runtime started." not in said, said
    assert run_until(client, head.environment, "ANSWERED 1")


def test_a_node_whose_raylet_ends_in_order_ends_and_says_why(head: Head) -> None:
    children = psutil.Process(head.process.pid).children(recursive=True)
    (agent,) = [each for each in children if "RuntimeEnvAgent" in "".join(each.cmdline())]
    os.kill(agent.pid, signal.SIGKILL)  # the raylet ends with it, with status 0
    said, _ = head.process.communicate(timeout=PATIENCE_S)
    assert head.process.returncode == 1
    assert "the node ends: its process 'raylet' ended with exit status 0" in said.splitlines(), said
    deadline = time.monotonic() + PATIENCE_S
    while any(each.is_running() and each.status() != psutil.STATUS_ZOMBIE for each in children):
        assert time.monotonic() < deadline
        time.sleep(0.1)
