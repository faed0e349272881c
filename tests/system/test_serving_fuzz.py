"""Malformed bodies, frames and messages against a real server: errors have a name, and nothing hangs.

Seeded and bounded; RLSERVO_FUZZ=20 sends twenty times as much, RLSERVO_FUZZ_SEED changes the input.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import random
import socket
import struct
import subprocess
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import msgpack
import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import ConnectionClosed

from grpc_calls import infer_request
from rlservo.serve_app.protocols.open_inference.oip_messages import messages

pytestmark = [pytest.mark.serve, pytest.mark.slow]

TIMES = float(os.environ.get("RLSERVO_FUZZ", "1"))
SEED = int(os.environ.get("RLSERVO_FUZZ_SEED", "7"))
SLOWEST_S = 15.0  # [s] on a machine that does other things as well; a hang is longer
SCHEMATHESIS = ("schemathesis==4.32.5",)
CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"
NUMBERS: list[Any] = [0, -0.0, 1e308, -1, 2**63, 2**64, 1e-320, 10**40, True, None, "1", "NaN", [], {}]
PATHS = [
    "..%2f..%2fetc%2fpasswd/act",
    "%00/act",
    "ur5/versions/%2e%2e/act",
    "a" * 3000 + "/infer",
    "ur5/infer;x=1",
    "%ff/act",
]
NAMES = ["obs", "inputs", "outputs", "parameters", "seed", "seq", "explore", "deadline_ms", "id", "shape", "data", "\0"]


@pytest.fixture(autouse=True)
def well_afterwards(live_server: Any) -> Iterator[None]:
    """The server continues after anything, and its log holds no traceback."""
    yield
    connection = http.client.HTTPConnection("127.0.0.1", live_server.port, timeout=SLOWEST_S)
    connection.request(
        "POST",
        "/v1/policies/ur5/act",
        json.dumps({"obs": [0.1] * 27}),
        {"content-type": "application/json", "authorization": live_server.bearer},
    )
    reply = connection.getresponse()
    assert (reply.status, len(json.loads(reply.read())["action"])) == (200, 6)
    connection.close()
    assert '"exception"' not in live_server.log.read_text()


def junk(rng: random.Random, depth: int = 0) -> Any:
    """Return a JSON value of any shape."""
    kind = rng.randrange(6 if depth < 4 else 3)
    if kind < 3:
        return rng.choice([*NUMBERS, rng.uniform(-9, 9), "x" * rng.randrange(99), "\u202e\ud83d\ude00"])
    if kind == 3:
        return [junk(rng, depth + 1) for _ in range(rng.randrange(5))]
    if kind == 4:
        return [rng.choice([0.5, *NUMBERS[:8]])] * rng.choice([26, 27, 28])
    return {rng.choice(NAMES): junk(rng, depth + 1) for _ in range(rng.randrange(4))}


def mutate(rng: random.Random, content: bytes) -> bytes:
    """Return `content` with some of its bytes changed, removed, doubled or cut off."""
    changed = bytearray(content)
    for _ in range(rng.randrange(1, 6)):
        at = rng.randrange(len(changed) + 1)
        kind = rng.randrange(4)
        if kind == 0 and at < len(changed):
            changed[at] = rng.randrange(256)
        elif kind == 1:
            del changed[at : at + rng.randrange(1, 30)]
        elif kind == 2:
            changed[at:at] = changed[at : at + rng.randrange(1, 30)]
        else:
            changed[at:at] = rng.randbytes(rng.randrange(1, 9))
    return bytes(changed)


def http_requests(rng: random.Random) -> Iterator[tuple[str, bytes, dict[str, str]]]:
    act, infer = "/v1/policies/ur5/act", "/v2/models/ur5/infer"
    plain, octets = {"content-type": "application/json"}, {"content-type": "application/octet-stream"}
    good = json.dumps({"obs": [0.25] * 27, "seed": 3, "explore": True, "seq": 1}).encode()
    tensor = {"name": "obs", "shape": [1, 27], "datatype": "FP32"}
    oip = json.dumps({"id": "a", "inputs": [{**tensor, "data": [0.25] * 27}]}).encode()
    head = json.dumps({"inputs": [{**tensor, "parameters": {"binary_data_size": 108}}]}).encode()
    yield act, b"[" * 100_000, plain
    yield act, b'{"obs":' * 20_000, plain
    yield act, b'{"obs": ' + b"9" * 100_000 + b"}", plain
    yield act, b'{"obs": [' + b"1e999," * 26 + b"1]}", plain
    yield infer, zlib.compress(b"0" * (1 << 28)), {**octets, "content-encoding": "deflate"}
    yield infer, head, {"inference-header-content-length": str(len(head) * 10**9)}
    for _ in range(int(120 * TIMES)):
        yield act, mutate(rng, good), plain
        yield act, json.dumps({"obs": junk(rng), rng.choice(NAMES): junk(rng)}).encode(), plain
        yield infer, mutate(rng, oip), plain
        yield infer, json.dumps({"inputs": [{**tensor, rng.choice(NAMES): junk(rng)}]}).encode(), plain
        length = rng.choice([len(head), rng.randrange(len(head) + 200), 0])
        yield infer, mutate(rng, head + bytes(108)), {**octets, "inference-header-content-length": str(length)}
        yield rng.choice(["/v1/policies/", "/v2/models/", "/v2/repository/"]) + rng.choice(PATHS), good, plain


def test_http_bodies(live_server: Any) -> None:
    rng = random.Random(SEED)
    connection = http.client.HTTPConnection("127.0.0.1", live_server.port, timeout=SLOWEST_S)
    codes: set[str] = set()
    for path, body, headers in http_requests(rng):
        connection.request("POST", path, body, {**headers, "authorization": live_server.bearer})
        reply = connection.getresponse()
        content = reply.read()
        assert reply.status < 500, (path, body[:300], content)
        if reply.status != 200:
            document = json.loads(content)
            assert document["error"] and b"Traceback" not in content, (path, body[:300], content)
            codes.add(document["code"])
    connection.close()
    assert codes >= {"bad-request", "bad-observation", "too-large"}


def test_what_is_not_http_at_all(live_server: Any) -> None:
    rng = random.Random(SEED)
    good = (
        b"POST /v1/policies/ur5/act HTTP/1.1\r\nhost: 127.0.0.1\r\n"
        b"content-type: application/json\r\ncontent-length: 9\r\n\r\n"
    )
    with contextlib.ExitStack() as stack:
        clients = []
        for _ in range(int(40 * TIMES)):
            client = socket.create_connection(("127.0.0.1", live_server.port), timeout=SLOWEST_S)
            clients.append(stack.enter_context(client))
            client.sendall(mutate(rng, good) + b'{"obs":1}')
        answers = [client.recv(4096) for client in clients]  # all of them: a half-sent request also ends
    statuses = {int(answer[9:12]) for answer in answers if answer}
    assert statuses and max(statuses) < 500 and not any(b"Traceback" in answer for answer in answers), statuses


def frames(rng: random.Random) -> Iterator[bytes]:
    array = {b"__ndarray__": True, b"data": bytes(108), b"dtype": "<f4", b"shape": [27]}
    good = msgpack.packb({"obs": array, "seq": 1})
    yield b""
    yield b"\x91" * 100_000
    yield b"\xdd\xff\xff\xff\xff"
    for change in ({b"shape": [2**40, 2**40]}, {b"dtype": "O"}, {b"dtype": "V9"}, {b"shape": [-1]}, {b"data": 3}):
        yield msgpack.packb({"obs": {**array, **change}})
    for _ in range(int(60 * TIMES)):
        yield mutate(rng, good)
        with contextlib.suppress(OverflowError, ValueError, UnicodeEncodeError):
            yield msgpack.packb({"obs": junk(rng), rng.choice(NAMES): junk(rng)})


def test_websocket_frames(live_server: Any) -> None:
    rng = random.Random(SEED)
    codes = set()
    url, headers = f"ws://127.0.0.1:{live_server.port}/", {"authorization": live_server.bearer}
    for frame in frames(rng):
        with websockets.sync.client.connect(url, additional_headers=headers, open_timeout=SLOWEST_S) as stream:
            stream.recv(timeout=SLOWEST_S)
            stream.send(frame)
            reply = stream.recv(timeout=SLOWEST_S)
            if isinstance(reply, bytes):
                assert "actions" in msgpack.unpackb(reply)
                continue
            document = json.loads(reply)
            assert document["code"] not in ("internal", "unsafe-action") and "Traceback" not in reply, (frame, reply)
            codes.add(document["code"])
            with pytest.raises(ConnectionClosed) as caught:
                stream.recv(timeout=SLOWEST_S)
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 1011
    assert codes >= {"bad-request", "bad-observation"}


def test_broken_websocket_frames_end_their_connection_only(live_server: Any) -> None:
    rng = random.Random(SEED)
    for _ in range(int(20 * TIMES)):
        with socket.create_connection(("127.0.0.1", live_server.port), timeout=SLOWEST_S) as client:
            client.sendall(
                b"GET / HTTP/1.1\r\nhost: 127.0.0.1\r\nupgrade: websocket\r\nconnection: upgrade\r\n"
                b"sec-websocket-version: 13\r\nsec-websocket-key: AAAAAAAAAAAAAAAAAAAAAA==\r\nauthorization: "
                + live_server.bearer.encode()
                + b"\r\n\r\n"
            )
            assert b" 101 " in client.recv(100)
            client.sendall(rng.randbytes(rng.randrange(2, 60)) + struct.pack("!H", 0xFFFF))
            client.shutdown(socket.SHUT_WR)
            started = time.perf_counter()
            while client.recv(65536):
                assert time.perf_counter() - started < SLOWEST_S


def grpc_messages(rng: random.Random) -> Iterator[bytes]:
    asked = infer_request(np.zeros((1, 27)), seed=3)
    typed = messages.ModelInferRequest(model_name="ur5")
    typed.inputs.add(name="obs", datatype="FP32", shape=[1, 27]).contents.fp32_contents.extend([0.5] * 27)
    for name in ("", "ur6", "\0"):
        yield messages.ModelInferRequest(model_name=name).SerializeToString()
    for shape in ([2**31, 2**31], [-1, 27], [0, 27], [1] * 40):
        wrong = messages.ModelInferRequest()
        wrong.CopyFrom(typed)
        wrong.inputs[0].shape[:] = shape
        yield wrong.SerializeToString()
    for name, value in (
        ("double_param", float("nan")),
        ("int64_param", -(2**63)),
        ("string_param", "\0"),
        ("uint64_param", 2**64 - 1),
    ):
        for parameter in ("seed", "deadline_ms", "timeout", "seq", "explore", "sequence_id"):
            wrong = messages.ModelInferRequest()
            wrong.CopyFrom(asked)
            setattr(wrong.parameters[parameter], name, value)
            yield wrong.SerializeToString()
    for _ in range(int(150 * TIMES)):
        yield mutate(rng, rng.choice([asked, typed]).SerializeToString())


def test_grpc_messages(live_server: Any) -> None:
    rng = random.Random(SEED)
    allowed = {"INVALID_ARGUMENT", "NOT_FOUND", "RESOURCE_EXHAUSTED", "DEADLINE_EXCEEDED"}
    metadata = (("authorization", live_server.bearer),)
    found = set()
    with grpc.insecure_channel(f"127.0.0.1:{live_server.grpc_port}") as channel:
        for content in grpc_messages(rng):
            method = rng.choice(["ModelInfer"] * 8 + ["ModelReady", "ModelMetadata"])
            try:
                channel.unary_unary(f"/inference.GRPCInferenceService/{method}")(
                    content, metadata=metadata, timeout=SLOWEST_S
                )
            except grpc.RpcError as error:
                assert error.code().name in allowed, (method, content, error.details())
                assert "Traceback" not in error.details()
                found.add(error.code().name)
        stream = channel.stream_stream("/inference.GRPCInferenceService/ModelStreamInfer")
        sent = [mutate(rng, content) for content in list(grpc_messages(rng))[:40]]
        replies = list(stream(iter(sent), metadata=metadata, timeout=4 * SLOWEST_S))
    assert found >= {"INVALID_ARGUMENT", "NOT_FOUND"}
    assert len(replies) == 40
    assert all(
        "server failed" not in messages.ModelStreamInferResponse.FromString(reply).error_message for reply in replies
    )


def test_no_page_of_another_origin_is_let_in(live_server: Any) -> None:
    """Without CORS headers a browser shows a page nothing, and asks before it sends JSON; asking gets a no."""
    connection = http.client.HTTPConnection("127.0.0.1", live_server.port, timeout=SLOWEST_S)
    for method, path in (
        ("OPTIONS", "/v1/policies/ur5/act"),
        ("GET", "/healthz"),
        ("GET", "/v1/policies"),
        ("OPTIONS", "/v2/models/ur5/infer"),
        ("POST", "/v1/policies/ur5/act"),
    ):
        headers = {
            "origin": "https://evil.example",
            "access-control-request-method": "POST",
            "access-control-request-headers": "content-type",
            "authorization": live_server.bearer,
        }
        connection.request(method, path, b"", headers)
        reply = connection.getresponse()
        reply.read()
        assert not [name for name in reply.headers if name.lower().startswith("access-control")], (method, path)
        assert method != "OPTIONS" or reply.status == 405
    connection.close()


def test_what_the_openapi_document_promises_holds(
    live_server: Any, client_environment: Callable[..., Path], tmp_path: Path
) -> None:
    """Schemathesis sends what the document allows and what it does not, and reads what comes back against it."""
    schemathesis = client_environment(*SCHEMATHESIS).parent / "schemathesis"
    done = subprocess.run(
        [
            str(schemathesis), "run", f"http://127.0.0.1:{live_server.port}/openapi.json",
            "--header", f"Authorization: {live_server.bearer}",
            "--seed", str(SEED), "--max-examples", str(int(5 * TIMES) or 1), "--request-timeout", str(SLOWEST_S),
            "--phases", "examples,coverage,fuzzing", "--no-color",
            "--checks", CHECKS,
        ],
        capture_output=True,
        text=True,
        timeout=400,
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
