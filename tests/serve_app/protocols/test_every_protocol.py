"""Behaviour common to every protocol, by a request over each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servers
from bundles import write_box_policy
from grpc_calls import answered, infer_request
from rlservo.serve_app.protocols.asgi_app import PolicyApp, create_app
from rlservo.serve_app.server.settings import ServerSettings
from stores import control_of, load_store
from streams import Stream

OBS = (np.arange(27) * 0.01).astype(np.float32)


@pytest.fixture(scope="module")
def app(ur5: Path, tmp_path_factory: pytest.TempPathFactory) -> PolicyApp:
    unsafe = write_box_policy(tmp_path_factory.mktemp("unsafe"), name="unsafe", action_scale=5.0)
    return create_app(control_of(load_store(ur5, unsafe)), ServerSettings())


@pytest.fixture(scope="module")
def port(app: PolicyApp) -> Iterator[int]:
    with servers.over_uvicorn(app) as port:
        yield port


class Refused(Exception):
    """A reply without an action; its argument is the error's code."""


def json_act(app: PolicyApp, port: int, policy: str, obs: Any, **fields: Any) -> Any:
    status, reply = servers.ask(port, "POST", f"/v1/policies/{policy}/act", {"obs": obs.tolist(), **fields})
    if status != 200:
        raise Refused(reply["code"])
    return reply["action"]


def oip(app: PolicyApp, port: int, policy: str, obs: Any, **fields: Any) -> Any:
    tensor = {"name": "obs", "shape": [1, obs.size], "datatype": "FP32", "data": obs.tolist()}
    body = {"inputs": [tensor], "parameters": fields}
    status, reply = servers.ask(port, "POST", f"/v2/models/{policy}/infer", body)
    if status != 200:
        raise Refused(reply["code"])
    return reply["outputs"][0]["data"]


def grpc(app: PolicyApp, port: int, policy: str, obs: Any, **fields: Any) -> Any:
    reply, call = answered(app.handler, infer_request([obs], policy, **fields))
    if call.code is not None:
        raise Refused(call.trailing["rlservo-code"])
    return np.frombuffer(reply.raw_output_contents[0], np.float32)


def websocket(app: PolicyApp, port: int, policy: str, obs: Any, **fields: Any) -> Any:
    with Stream(port, f"/v1/policies/{policy}/stream") as stream:
        reply = stream.ask(obs=obs, **fields)
    if "code" in reply:
        raise Refused(reply["code"])
    return reply["actions"][0]


@pytest.fixture(params=[json_act, oip, grpc, websocket])
def act(request: pytest.FixtureRequest, app: PolicyApp, port: int) -> Callable[..., Any]:
    return lambda policy, obs=OBS, **fields: np.float32(request.param(app, port, policy, obs, **fields)).ravel()


def test_an_exploring_action_is_repeatable_by_seed(act: Callable[..., Any]) -> None:
    first, again, other = (act("ur5", explore=True, seed=seed).tolist() for seed in (1, 1, 2))
    assert first == again != other


def test_an_unsafe_action_does_not_leave(act: Callable[..., Any]) -> None:
    with pytest.raises(Refused, match="unsafe-action"):
        act("unsafe", np.full(27, 100.0, np.float32))
