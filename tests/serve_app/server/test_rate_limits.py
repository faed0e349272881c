"""Rate limits per API key: over every protocol, by label, and only for keys whose line sets one."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from typer.testing import CliRunner
from websockets.exceptions import InvalidStatus

from bundles import controlled
from grpc_calls import GrpcCall, answered, infer_request
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.deploy.cli import app as command_line
from rlservo.errors import RateLimitError, UsageError
from rlservo.serve_app.protocols.asgi_app import PolicyApp, create_app
from rlservo.serve_app.protocols.open_inference.grpc_service import Grpc
from rlservo.serve_app.server.api_keys import Key, Keys, RateLimit, Role, new_key
from rlservo.serve_app.server.rate_limits import RateLimits
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import exchange, over_uvicorn
from stores import control_of, load_store
from streams import Stream

OBS = [0.1] * 27
BURST = 3
LIMITED, LIMITED_LINE = new_key("cell-7", rate=0.001, burst=BURST)  # in a test's time no further one
FREE, FREE_LINE = new_key("cell-8")
ALSO_LIMITED, ALSO_LIMITED_LINE = new_key("cell-9", rate=0.001, burst=BURST)


@pytest.fixture(scope="module")
def store(ur5: Path) -> PolicyStore:
    return load_store(ur5)


@pytest.fixture
def app(store: PolicyStore) -> PolicyApp:
    settings = ServerSettings(api_keys=f"{LIMITED_LINE},{FREE_LINE},{ALSO_LIMITED_LINE}", default_policy="ur5")
    return create_app(control_of(store), settings, replica="r1")


@pytest.fixture
def port(app: PolicyApp) -> Iterator[int]:
    with over_uvicorn(app) as port:
        yield port


def ask(port: int, method: str, path: str, body: Any = None, key: str = LIMITED) -> tuple[int, dict[str, str], bytes]:
    return exchange(port, method, path, body, authorization=f"Bearer {key}")


ACT = ("POST", "/v1/policies/ur5/act", {"obs": OBS})
INFER = (
    "POST",
    "/v2/models/ur5/infer",
    {"inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": OBS}]},
)
LIST = ("GET", "/v1/policies", None)


def test_a_key_gets_its_burst_over_all_of_http_and_then_429_with_a_time_to_wait(port: int) -> None:
    assert [ask(port, *request)[0] for request in (ACT, INFER, LIST)] == [200] * BURST
    for request in (ACT, INFER, LIST):
        status, headers, content = ask(port, *request)
        document = json.loads(content)
        assert (status, document["code"]) == (429, "rate-limited")
        assert "the key 'cell-7' allows 0.001 requests a second in this process, 3 at once: wait" in document["error"]
        assert 900 < int(headers["retry-after"]) <= 1000 and 900 < document["details"]["retry_after_s"] <= 1000
    for _ in range(5 * BURST):  # another key's, and who needs none
        assert ask(port, *ACT, key=FREE)[0] == 200
        assert ask(port, "GET", "/v2/health/live")[0] == 200
    text = ask(port, "GET", "/metrics", key=FREE)[2].decode()
    assert 'rlservo_rate_limited_total{key="cell-7",replica="r1"} 3.0' in text
    assert 'key="cell-8"' not in text and 'code="rate-limited"' in text


def test_attempts_at_what_the_key_may_not_do_count_as_well(policies: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="rlservo")
    with controlled(policies) as control:
        app = create_app(control, ServerSettings(api_keys=LIMITED_LINE))
        with over_uvicorn(app) as port:
            load = ("POST", "/v1/admin/policies/ur5/load", {})
            assert [ask(port, *load)[0] for _ in range(BURST + 1)] == [403] * BURST + [429]
    entries = [record.__dict__["fields"] for record in caplog.records if record.name == "rlservo.administration"]
    assert [(each["code"], each["key"]) for each in entries] == [
        *[("forbidden", "cell-7")] * BURST, ("rate-limited", "cell-7"),
    ]  # fmt: skip


def test_our_client_raises_it_at_once_and_says_how_long(port: int) -> None:
    with PolicyClient(f"http://127.0.0.1:{port}", "ur5", api_key=LIMITED) as client:
        client.act(OBS)  # the contract is a request, too
        client.act(OBS)
        began = time.monotonic()
        with pytest.raises(RateLimitError, match="wait") as caught:
            client.act(OBS)
    assert caught.value.details["retry_after_s"] > 900 and time.monotonic() - began < 60


def test_a_websockets_frames_count_and_one_too_many_ends_it_or_not(port: int) -> None:
    def connect(query: str = "", key: str = LIMITED) -> Stream:
        return Stream(port, f"/{query}", authorization=f"Bearer {key}")

    with connect("?errors=keep") as stream:  # the upgrade is the first
        assert all("actions" in stream.ask(obs=OBS) for _ in range(BURST - 1))
        for _ in range(2):
            assert stream.ask(obs=OBS)["code"] == "rate-limited"
    with pytest.raises(InvalidStatus) as caught:
        connect()
    assert caught.value.response.status_code == 429
    assert 900 < int(caught.value.response.headers["retry-after"]) <= 1000
    with connect(key=ALSO_LIMITED) as stream:
        assert all("actions" in stream.ask(obs=OBS) for _ in range(BURST - 1))
        assert stream.ask(obs=OBS)["code"] == "rate-limited"
        assert stream.close_code() == 1011


def test_our_stream_raises_it_and_stays_open(port: int) -> None:
    with StreamClient(f"http://127.0.0.1:{port}", "ur5", api_key=LIMITED) as client:
        for _ in range(BURST - 2):  # after the contract and the handshake
            client.act(OBS)
        for _ in range(2):
            with pytest.raises(RateLimitError):
                client.act(OBS)
        assert client.reconnects == 0


def test_grpc_says_resource_exhausted(app: PolicyApp) -> None:
    *good, refused = (answered(app.handler, infer_request([OBS]), key=LIMITED)[1] for _ in range(BURST + 1))
    assert [context.code for context in good] == [None] * BURST
    assert refused.code is grpc.StatusCode.RESOURCE_EXHAUSTED and "'cell-7' allows" in refused.details
    assert refused.trailing["rlservo-code"] == "rate-limited" and 900 < int(refused.trailing["retry-after"]) <= 1000


def test_a_grpc_streams_messages_count_and_it_goes_on(app: PolicyApp) -> None:
    async def requests() -> AsyncIterator[bytes]:
        for _ in range(BURST + 2):
            yield infer_request([OBS]).SerializeToString()

    async def replies() -> list[str]:
        stream = Grpc(app.handler).stream(requests(), context)
        return [reply.error_message async for reply in stream]

    context = GrpcCall(LIMITED)
    errors = asyncio.run(replies())
    # Opening it is a request, too.
    assert errors[: BURST - 1] == [""] * (BURST - 1) and all("allows" in error for error in errors[BURST - 1 :])
    assert len(errors) == BURST + 2 and context.code is None


def test_grpc_refuses_exploring_to_a_key_for_actions_alone(app: PolicyApp) -> None:
    async def requests() -> AsyncIterator[bytes]:
        yield infer_request([OBS], explore=True).SerializeToString()
        yield infer_request([OBS]).SerializeToString()

    async def replies() -> list[str]:
        return [reply.error_message async for reply in Grpc(app.handler).stream(requests(), GrpcCall(FREE))]

    _, refused = answered(app.handler, infer_request([OBS], explore=True), key=FREE)
    streamed = asyncio.run(replies())
    assert refused.code is grpc.StatusCode.PERMISSION_DENIED and "may not request exploring" in refused.details
    assert "may not request exploring" in streamed[0] and streamed[1] == ""


def test_a_bucket_fills_with_time_up_to_its_burst_and_is_its_labels() -> None:
    now = [0.0]
    limits = RateLimits(lambda: now[0])
    limit = RateLimit(rate=10, burst=4)
    old, new = (Key("cell-7", Role.act, bytes([n]) * 32, limit) for n in range(2))

    def count(key: Key) -> int:
        passed = 0
        try:
            while passed < 100:
                limits.spend(key, limit)
                passed += 1
        except RateLimitError as error:
            assert 0 < error.details["retry_after_s"] <= 0.1
        return passed

    assert (count(old), count(new)) == (4, 0)  # two keys of one label, as while one takes the other's place
    now[0] += 0.25
    assert count(new) == 2
    now[0] += 1e6
    assert count(old) == 4
    assert limits.refused["cell-7"] == 4


@pytest.mark.parametrize(
    ("more", "limit"),
    [
        ("", None),
        (" rate=20", RateLimit(20, 20)),
        (" rate=0.5", RateLimit(0.5, 1)),
        ("\trate=20  burst=40", RateLimit(20, 40)),
    ],
)
def test_a_line_says_the_limit_or_nothing(more: str, limit: RateLimit | None) -> None:
    (key,) = Keys.from_settings(ServerSettings(api_keys=FREE_LINE + more)).keys
    assert key.limit == limit


@pytest.mark.parametrize(
    "more", [" rate=0", " rate=0.000", " rate=-1", " rate=x", " burst=3", " rate=1 burst=0", " 20"]
)
def test_a_line_that_says_it_wrongly_refuses_the_start_and_is_not_shown(more: str) -> None:
    with pytest.raises(UsageError, match="entry 1 of RLSERVO_API_KEYS") as caught:
        Keys.from_settings(ServerSettings(api_keys=FREE_LINE + more))
    assert FREE_LINE.split(":")[1] not in caught.value.message


def test_the_command_writes_such_lines() -> None:
    done = CliRunner().invoke(command_line, ["key", "cell-9", "--rate", "20", "--burst", "40", "--json"])
    line = json.loads(done.stdout)["line"]
    assert line.endswith(" rate=20 burst=40")
    assert Keys.from_settings(ServerSettings(api_keys=line)).keys[0].limit == RateLimit(20, 40)
    for rate, burst in ((0, None), (float("nan"), None), (1e9, None), (None, 4), (1, 0)):
        with pytest.raises(UsageError, match="rate"):
            new_key("cell-9", rate=rate, burst=burst)
