"""Bounds of content: bodies larger than any batch needs are refused unparsed, and every allowed batch fits."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import orjson
import pytest

from rlservo.bundle.bundle import read_contract
from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import BoxSpec, DictSpec, DiscreteSpec, Element, TupleSpec
from rlservo.client.formats.msgpack_arrays import pack, unpack
from rlservo.errors import TooLargeError
from rlservo.serve_app.protocols.asgi_app import PolicyApp, create_app
from rlservo.serve_app.protocols.open_inference.grpc_service import OipGrpcCodec
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.server.content_bounds import ContentBounds
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.sessions.request import Request
from servers import over_uvicorn
from stores import control_of, load_store
from streams import Stream

ROWS = 64
MANY = 300_000
LISTS = ",".join(["[]"] * MANY)
FIELDS = ",".join(f'"f{i}":0' for i in range(MANY // 2))
DEEP = ",".join(["[" * 1000 + "]" * 1000] * 300)
ZEROS = ",".join("0" * MANY)


def tensor(data: str) -> str:
    return '{"name":"obs","shape":[1,27],"datatype":"FP32","data":[' + data + "]}"


ACT, INFER, INDEX = "/v1/policies/ur5/act", "/v2/models/ur5/infer", "/v2/repository/index"
BODIES = {
    "obs of lists": (ACT, '{"obs":[' + LISTS + "]}"),
    "last_action of lists": (ACT, '{"obs":[0],"last_action":[' + LISTS + "]}"),
    "state of lists": (ACT, '{"obs":[0],"state":{"h":[' + LISTS + "]}}"),
    "unknown fields": (ACT, "{" + FIELDS + "}"),
    "names": (ACT, '{"obs":{' + FIELDS + "}}"),
    "lists in lists": (ACT, '{"obs":[' + DEEP + "]}"),
    "zeros": (ACT, '{"obs":[' + ZEROS + "]}"),
    "a long text": (ACT, '{"obs":[0],"session_id":"' + "x" * 1_000_000 + '"}'),
    "data of lists": (INFER, '{"inputs":[' + tensor(LISTS) + "]}"),
    "inputs": (INFER, '{"inputs":[' + ",".join([tensor("")] * 9000) + "]}"),
    "outputs": (INFER, '{"inputs":[' + tensor("0") + '],"outputs":[' + LISTS + "]}"),
    "parameters": (INFER, '{"inputs":[' + tensor("0") + '],"parameters":{' + FIELDS + "}}"),
    "unknown fields of infer": (INFER, '{"inputs":[' + tensor("0") + "]," + FIELDS + "}"),
    "fields of an index": (INDEX, "{" + FIELDS + "}"),
}
FRAMES = {
    "lists": b"\x81\xa3obs\xdd" + MANY.to_bytes(4, "big") + b"\x90" * MANY,
    "maps": b"\x81\xa3obs\xdd" + MANY.to_bytes(4, "big") + b"\x80" * MANY,
    "numbers": b"\x81\xa3obs\xdd" + MANY.to_bytes(4, "big") + b"\x01" * MANY,
    "fields": msgpack.packb({f"f{i}": 0 for i in range(MANY)}),
    "bytes": msgpack.packb({"obs": b"\0" * 1_000_000}),
}


@pytest.fixture(scope="module")
def app(ur5: Path) -> PolicyApp:
    store = load_store(ur5)
    return create_app(control_of(store), ServerSettings(max_batch=ROWS, default_policy="ur5"))


@pytest.fixture(scope="module")
def http(app: PolicyApp) -> Iterator[httpx.Client]:
    with over_uvicorn(app) as port, httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as client:
        yield client


@pytest.mark.parametrize("name", BODIES)
def test_a_body_of_more_than_a_batch_needs_is_not_parsed(http: httpx.Client, name: str) -> None:
    path, body = BODIES[name]
    reply = http.post(path, content=body, headers={"content-type": "application/json"})
    assert (reply.status_code, reply.json()["code"]) == (413, "too-large"), reply.text
    assert len(reply.text) < 300


@pytest.mark.parametrize("name", FRAMES)
def test_a_frame_of_more_than_a_batch_needs_is_not_unpacked(http: httpx.Client, name: str) -> None:
    with Stream(http.base_url.port or 0) as stream:
        assert stream.exchange(FRAMES[name])["code"] == "too-large"


def parameters(place: Any, count: int) -> None:
    for number in range(count):
        place.parameters[f"p{number}"].bool_param = True


def grpc_message(name: str) -> Any:
    message = messages.ModelInferRequest(model_name="ur5", id="x" * 1_000_000 if name == "a long text" else "")
    if name == "inputs":
        for number in range(5000):
            message.inputs.add(name=f"i{number}")
    elif name == "parameters":
        parameters(message, 5000)
    elif name == "parameters of tensors":
        for number in range(10):
            parameters(message.inputs.add(name=f"i{number}"), 500)
    elif name == "parameters of outputs":
        parameters(message.outputs.add(name="action"), 5000)
    elif name == "sizes":
        message.inputs.add(name="obs", datatype="FP32", shape=[1] * 100_000)
    elif name == "numbers":
        message.inputs.add(name="obs", datatype="BOOL", shape=[100_000]).contents.bool_contents.extend([True] * 100_000)
    return message


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("inputs", "1000 inputs"),
        ("parameters", "1000 parameters"),
        ("parameters of tensors", "1000 parameters"),
        ("parameters of outputs", "1000 parameters"),
        ("sizes", "1000 sizes"),
        ("numbers", r"\d+ numbers"),
        ("a long text", r"\d+ bytes"),
    ],
)
def test_a_grpc_message_of_more_than_a_batch_needs_is_refused(app: PolicyApp, name: str, what: str) -> None:
    request = Request("grpc", "", None, time.perf_counter())
    with pytest.raises(TooLargeError, match=f"more than {what}"):
        asyncio.run(app.handler.answer(OipGrpcCodec(), request, grpc_message(name).SerializeToString()))


IMAGE = BoxSpec(shape=(20, 20, 4), dtype="uint8", low=0, high=255)
NAMED = BoxSpec(
    shape=(3,), dtype="float32", low=None, high=None, elements=tuple(Element(name=f"a,[{i}]:{{") for i in range(3))
)
SPACES = {
    "image": IMAGE,
    "choice": DiscreteSpec(n=5),
    "named": NAMED,
    "nested": DictSpec(spaces={"a": TupleSpec(spaces=(DiscreteSpec(n=3), NAMED)), "image": IMAGE}),
    "scalars": DictSpec(spaces={name: DiscreteSpec(n=2) for name in "abcdef"}),
}


def sample(space: Any, rows: int | None = None) -> Any:
    """Return an observation, or a batch: of the shortest numbers."""
    if isinstance(space, DictSpec):
        return {key: sample(child, rows) for key, child in space.spaces.items()}
    if isinstance(space, TupleSpec):
        return [sample(child, rows) for child in space.spaces]
    return np.zeros(space.shape if rows is None else (rows, *space.shape), int).tolist()


def bounds_for(contract: Contract, space: Any) -> ContentBounds:
    return ContentBounds.of(contract.model_copy(update={"observation_space": space}), ROWS)


@pytest.mark.parametrize("name", SPACES)
def test_the_largest_batch_fits_in_every_form(ur5: Path, name: str) -> None:
    space = SPACES[name]
    bounds = bounds_for(read_contract(ur5), space)
    forms = [sample(space, ROWS), [sample(space)] * ROWS]
    if name == "named":
        forms.append({element.name: [0] * ROWS for element in NAMED.elements})
    for form in forms:
        document = {"obs": form, "seed": 1}
        for text in (orjson.dumps(document), json.dumps(document, indent=4).encode()):
            assert bounds.exceeded_by(text) == "" and len(text) <= bounds.content_bytes
    if name == "scalars":  # as openpi's clients send numbers
        forms.append([{key: np.zeros(()) for key in space.spaces}] * ROWS)
    for form in forms:
        assert unpack(pack({"obs": form, "seed": 1}), most=bounds.values)["seed"] == 1


def test_lists_of_nothing_are_fewer_than_images_of_that_size_have(ur5: Path) -> None:
    bounds = bounds_for(read_contract(ur5), IMAGE)
    image = orjson.dumps({"obs": [sample(IMAGE)] * 20})
    assert bounds.exceeded_by(image) == ""
    assert "lists" in bounds.exceeded_by(b"[" + b"[]," * (len(image) // 3) + b"[]]")
