"""Numbers that no float can hold, in every field that takes one: refused with a sentence, over every protocol."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import websockets.sync.client

import servers
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower

Serve = Callable[[Any], AbstractContextManager[int]]

KEY, LINE = new_key("operator", admin=True)
HUGE = ("1" * 310, "-" + "9" * 310, "1" * 4000, "1e999", "-1e999", "NaN", "1" + "0" * 400 + ".5")
OBS = [0.1] * 27
ROW = {"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": OBS}


@pytest.fixture(scope="module")
def port(
    policies: Path, controlled: Callable[..., AbstractContextManager[PlanFollower]], served: Serve
) -> Iterator[int]:
    with controlled(policies) as control:
        settings = ServerSettings(operator_key=LINE.split()[-1], default_policy="ur5")
        with served(create_app(control, settings)) as port:
            yield port


def post(port: int, path: str, body: str) -> tuple[int, dict[str, Any]]:
    status, document = servers.ask(port, "POST", path, body.encode(), key=KEY)
    return status, document


def with_number(document: dict[str, Any], number: str) -> str:
    return json.dumps(document).replace('"NUMBER"', number)


@pytest.mark.parametrize("number", HUGE)
@pytest.mark.parametrize("field", ["deadline_ms", "timestamp", "seed", "seq", "reward", "session_id", "last_action"])
def test_an_act_request_with_a_number_without_end_is_refused(port: int, field: str, number: str) -> None:
    body = with_number({"obs": OBS, field: "NUMBER"}, number)
    status, reply = post(port, "/v1/policies/ur5/act", body)
    assert status in (400, 422) and len(reply["error"]) < 400, (status, reply)
    status, reply = post(port, "/v1/policies/ur5/act", with_number({"obs": [*OBS[1:], "NUMBER"]}, number))
    assert status in (400, 422) and len(reply["error"]) < 400, (status, reply)


@pytest.mark.parametrize("number", HUGE)
@pytest.mark.parametrize("field", ["deadline_ms", "timestamp", "timeout", "priority", "seed", "seq", "sequence_id"])
def test_an_inference_request_with_a_number_without_end_is_refused(port: int, field: str, number: str) -> None:
    status, reply = post(
        port, "/v2/models/ur5/infer", with_number({"parameters": {field: "NUMBER"}, "inputs": [ROW]}, number)
    )
    assert status in (400, 422) and len(reply["error"]) < 400, (status, reply)
    for change in ({"data": [*OBS[1:], "NUMBER"]}, {"shape": [1, "NUMBER"]}):
        status, reply = post(port, "/v2/models/ur5/infer", with_number({"inputs": [{**ROW, **change}]}, number))
        assert status in (400, 422), (change, status, reply)


@pytest.mark.parametrize("number", HUGE)
def test_a_command_with_a_number_without_end_is_refused(port: int, number: str) -> None:
    for command, document in (
        ("canary", {"version": "1", "share": "NUMBER"}),
        ("load", {"version": "NUMBER"}),
        ("alias", {"alias": "x", "version": "NUMBER"}),
    ):
        status, reply = post(port, f"/v1/admin/policies/ur5/{command}", with_number(document, number))
        assert status in (400, 404), (command, status, reply)
        assert reply["error"]


@pytest.mark.parametrize("field", ["deadline_ms", "timestamp", "seed", "seq"])
def test_a_frame_with_an_infinite_number_is_refused(port: int, field: str) -> None:
    for number in (float("inf"), float("-inf"), float("nan")):
        with websockets.sync.client.connect(f"ws://127.0.0.1:{port}/?errors=keep") as connection:
            connection.recv()
            connection.send(msgpack.packb({"obs": OBS, field: number}))
            assert field in json.loads(connection.recv())["error"]
