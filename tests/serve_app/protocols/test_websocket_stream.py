"""The WebSocket protocol over real bundles and a real socket, with a client as openpi's is written."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray
from uvicorn.protocols.utils import ClientDisconnected
from websockets.exceptions import InvalidStatus

from rlservo.bundle.contract import Contract
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.sampled_metrics import exposition
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import over_uvicorn
from stores import control_of, load_store
from streams import ARRAY, Stream, pack, unpack

OBS = (np.arange(27) * 0.01).astype(np.float32)


@pytest.fixture(scope="module")
def store(policies: Path) -> PolicyStore:
    return load_store(policies)


@pytest.fixture(scope="module")
def port(store: PolicyStore) -> Iterator[int]:
    settings = ServerSettings(max_body_bytes=100_000, max_batch=64, default_policy="ur5")
    with over_uvicorn(create_app(control_of(store), settings)) as port:
        yield port


def expected(store: PolicyStore, obs: Any = OBS, name: str = "ur5", version: str | None = None) -> NDArray[Any]:
    return store.get(name, version).act(obs)


def test_an_openpi_client_at_the_root_gets_metadata_and_actions(port: int, store: PolicyStore) -> None:
    with Stream(port) as client:
        assert (client.metadata["policy"], client.metadata["version"]) == ("ur5", "10")
        assert Contract.model_validate(client.metadata["contract"]) == store.get("ur5").contract
        first = client.ask(obs=OBS)
        assert first["actions"].shape == (1, 6) and first["actions"].dtype == np.float32
        np.testing.assert_array_equal(first["actions"][0], expected(store))
        assert set(first["server_timing"]) == {"infer_ms"} and first["server_timing"]["infer_ms"] > 0
        second = client.ask(obs=2 * OBS, seq=7)
        np.testing.assert_array_equal(second["actions"][0], expected(store, 2 * OBS))
        assert second["seq"] == 7 and second["server_timing"]["prev_total_ms"] > first["server_timing"]["infer_ms"]


def test_a_policy_and_a_version_have_streams_of_their_own(port: int, store: PolicyStore) -> None:
    with Stream(port, "/v1/policies/ur5/versions/2/stream") as client:
        reply = client.ask(obs=OBS)
        assert (reply["version"], client.metadata["version"]) == ("2", "2")
        np.testing.assert_array_equal(reply["actions"][0], expected(store, version="2"))
    with Stream(port, "/v1/policies/gridworld/stream") as client:
        assert client.ask(obs=np.int64(2))["actions"].tolist() == [expected(store, 2, "gridworld").item()]
        assert client.ask(obs=2)["actions"].shape == (1,)


def test_observations_come_as_named_elements_lists_batches_and_other_dtypes(port: int, store: PolicyStore) -> None:
    with Stream(port) as client:
        named = {f"element_{i}": value for i, value in enumerate(OBS)}
        for obs in (named, {"obs": named}, {"obs": OBS.tolist()}, {"obs": OBS.astype(">f8")}):
            np.testing.assert_array_equal(client.ask(**obs)["actions"][0], expected(store))
        batch = np.stack([OBS, -OBS, 3 * OBS])
        actions = client.ask(obs=batch)["actions"]
        assert actions.shape == (3, 1, 6)  # a chunk of one for each, so that no client plays the batch as a chunk
        np.testing.assert_array_equal(actions[:, 0], expected(store, batch))


def test_what_openpis_examples_send_beside_observations_is_ignored(port: int, store: PolicyStore) -> None:
    named = {f"element_{i}": value for i, value in enumerate(OBS)}
    beside = {"prompt": "pick up the block", "env_id": 3}
    with Stream(port) as client:
        assert client.metadata["action_horizon"] == 1
        for request in ({"obs": OBS, **beside}, {"obs": named, **beside, "seq": 1}, {**named, **beside, "reset": True}):
            np.testing.assert_array_equal(client.ask(**request)["actions"][0], expected(store))
    with Stream(port) as client:
        assert "unknown 'language'" in client.ask(**named, language="pick up the block")["error"]


def as_msgpack_numpy(array: Any, **changes: Any) -> dict[bytes, Any]:
    """Return an array as PyPI's msgpack-numpy 0.4.8 packs it."""
    document = {b"nd": True, b"type": array.dtype.str, b"kind": b"", b"shape": array.shape, b"data": array.tobytes()}
    return {**document, **{key.encode(): value for key, value in changes.items()}}


def test_arrays_of_msgpack_numpy_are_read_as_data(port: int, store: PolicyStore) -> None:
    with Stream(port) as client:
        reply = client.ask(obs=as_msgpack_numpy(OBS))
        np.testing.assert_array_equal(reply["actions"][0], expected(store))
        named = {
            f"element_{i}": {b"nd": False, b"type": "<f4", b"data": value.tobytes()} for i, value in enumerate(OBS)
        }
        np.testing.assert_array_equal(client.ask(obs=named)["actions"][0], expected(store))
    for changes in ({"kind": b"O"}, {"kind": b"V"}, {"type": "|O"}, {"type": 7}, {"shape": [28]}, {"data": "x"}):
        with Stream(port) as client:
            assert "array in the message" in client.ask(obs=as_msgpack_numpy(OBS, **changes))["error"]


def test_a_reset_is_taken_where_nothing_is_remembered(port: int, store: PolicyStore) -> None:
    named = {f"element_{i}": value for i, value in enumerate(OBS)}
    with Stream(port) as client:
        for request in ({"obs": OBS, "reset": True}, {**named, "reset": True}):
            np.testing.assert_array_equal(client.ask(**request)["actions"][0], expected(store))


def array(**changes: Any) -> bytes:
    document = {ARRAY: True, b"data": OBS.tobytes(), b"dtype": "<f4", b"shape": [27]}
    document.update({key.encode(): value for key, value in changes.items()})
    return msgpack.packb({"obs": document})


@pytest.mark.parametrize(
    ("content", "code", "sentence"),
    [
        ("text", "bad-request", "text frame: send msgpack in a binary frame"),
        (b"\xc1", "bad-request", "is not msgpack"),
        (b"", "bad-request", "is not msgpack"),
        (pack({"obs": OBS}) + b"\0", "bad-request", "is not msgpack"),
        (b"\x91" * 5000 + b"\xc0", "bad-request", "is not msgpack"),
        (pack([1]), "bad-request", "must be a map"),
        (pack({1: 2}), "bad-request", "is not msgpack"),
        (pack({"obs": OBS, "sed": 1}), "bad-request", "unknown field 'sed'"),
        (pack({"obs": OBS} | {f"k{i}": 0 for i in range(3000)}), "bad-request", "'k6', 'k7': expected one of deadline"),
        (pack({"obs": OBS, "seed": -1}), "bad-request", "'seed' must be greater than or equal to 0"),
        *((pack({"obs": OBS, field: number}), "bad-request", f"'{field}'")
          for field in ("deadline_ms", "timestamp", "seed", "seq") for number in (float("inf"), float("nan"))),
        (pack({"obs": OBS[:26]}), "bad-observation", "expects obs of shape (27,), got (26,)"),
        (pack({"obs": OBS * np.float32(np.nan)}), "bad-observation", "element 0 (element_0) is nan"),
        (pack({"obs": msgpack.ExtType(5, b"x")}), "bad-observation", "cannot read obs"),
        (pack({"element_0": 1.0}), "bad-observation", "missing 'element_1'"),
        (array(dtype="|O"), "bad-observation", "has dtype '|O': send numbers"),
        (array(dtype="<c8"), "bad-observation", "has dtype '<c8'"),
        (array(dtype="f4,f4"), "bad-observation", "has dtype 'f4,f4'"),
        (array(dtype="<f8"), "bad-observation", "needs 216 bytes, got 108 bytes"),
        (array(shape=[-1]), "bad-observation", "has the shape [-1]"),
        (array(shape=[2**40, 2**40]), "bad-observation", "expected a list of sizes"),
        (array(data="x" * 108), "bad-observation", "needs 108 bytes, got a str"),
        (pack({"obs": {b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"}}), "bad-observation", "holds a str"),
        (pack({"obs": np.zeros((65, 27), np.float32)}), "too-large", "a batch of 65 observations"),
        (pack({"obs": np.zeros(30_000, np.float32)}), "too-large", "larger than 100000 bytes"),
        (pack({"obs": OBS, "deadline_ms": 0}), "deadline-passed", "no action was computed"),
    ],
)  # fmt: skip
def test_an_error_is_a_text_frame_then_close_1011(port: int, content: bytes | str, code: str, sentence: str) -> None:
    with Stream(port) as client:
        reply = client.exchange(content)
        assert reply["code"] == code and sentence in reply["error"], reply
        assert client.close_code() == 1011


@pytest.mark.parametrize("path", ["/v1/policies/nobody/stream", "/v1/policies/ur5/versions/99/stream", "/other"])
def test_a_stream_that_does_not_exist_is_refused_with_404_in_our_form(port: int, path: str) -> None:
    with pytest.raises(InvalidStatus) as caught:
        Stream(port, path)
    response = caught.value.response
    assert response.status_code == 404
    assert json.loads(response.body or b"")["code"] in ("unknown-policy", "unknown-version")


def test_without_a_default_policy_the_root_says_where_to_connect(store: PolicyStore) -> None:
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as port:
        with pytest.raises(InvalidStatus) as caught:
            Stream(port)
        assert b"no default policy among gridworld, ur5" in (caught.value.response.body or b"")


def test_a_server_that_is_loading_refuses_streams_with_503() -> None:
    with over_uvicorn(create_app(control_of(None), ServerSettings())) as port:
        with pytest.raises(InvalidStatus) as caught:
            Stream(port)
        assert caught.value.response.status_code == 503 and caught.value.response.headers["retry-after"] == "1"


def test_a_client_that_goes_while_it_is_answered_is_no_failure_of_the_server(
    store: PolicyStore, caplog: pytest.LogCaptureFixture
) -> None:
    app = create_app(control_of(store), ServerSettings())
    frames = iter([{"type": "websocket.connect"}, {"type": "websocket.receive", "bytes": pack({"obs": OBS})}])
    sent: list[str] = []

    async def receive() -> Any:
        return next(frames)

    async def send(message: Any) -> None:
        sent.append(message["type"])
        if len(sent) > 2:  # after the acceptance and the metadata
            raise ClientDisconnected

    scope = {"type": "websocket", "path": "/v1/policies/ur5/stream", "headers": [], "query_string": b""}
    asyncio.run(app(scope, receive, send))
    assert sent == ["websocket.accept", "websocket.send", "websocket.send"]
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
    assert b'code="internal"' not in asyncio.run(exposition(app.handler))


def test_many_robots_stream_at_once_and_none_gets_anothers_action(port: int, store: PolicyStore) -> None:
    clients = [Stream(port) for _ in range(20)]
    for _ in range(5):
        for index, client in enumerate(clients):
            client.socket.send(pack({"obs": OBS * index, "seq": index}))
        for index, client in enumerate(clients):
            reply = unpack(client.socket.recv())
            assert reply["seq"] == index
            np.testing.assert_array_equal(reply["actions"][0], expected(store, OBS * index))
    for client in clients:
        client.close()
