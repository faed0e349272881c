"""Integers over every protocol: the policy gets them exactly, or the request is refused."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from onnx import TensorProto, helper

from bundles import contract_of, rewrite_contract, save_graph, write_bundle, write_discrete_policy, write_leaky_policy
from rlservo.bundle import bundle as bundle_files
from rlservo.bundle.spaces import BoxSpec
from rlservo.errors import ObservationError, RequestError
from rlservo.policy.input_numbers import parse_array
from rlservo.policy.observation_parser import ObservationParser
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import PolicyApp, create_app
from rlservo.serve_app.protocols.open_inference.grpc_service import FIELDS, OipGrpcCodec
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.sessions.request import Request
from servers import over_uvicorn
from stores import control_of, load_store
from streams import Stream

TYPES = {"int64": TensorProto.INT64, "uint64": TensorProto.UINT64, "uint8": TensorProto.UINT8}
# As JSON has them, for a policy that observes two int64, two uint64 or two uint8.
KEPT = [
    ("int64", "9007199254740993", "INT64"),
    ("int64", "9223372036854775807", "INT64"),
    ("int64", "-9223372036854775808", "INT64"),
    ("int64", "9223372036854775807", "UINT64"),
    ("int64", "9007199254740991.0", "FP64"),
    ("int64", "16777215", "FP32"),
    ("uint64", "18446744073709551615", "UINT64"),
    ("uint64", "9223372036854775809", "UINT64"),
    ("uint8", "255", "UINT8"),
    ("uint8", "255", "FP16"),
    ("uint8", "true", "BOOL"),
]
REFUSED = [
    ("int64", "9223372036854775808", "INT64"),
    ("int64", "9223372036854775808", "UINT64"),
    ("int64", "-9223372036854775809", "INT64"),
    ("int64", "9223372036854775808.0", "FP64"),
    ("int64", "9007199254740993.0", "FP64"),
    ("int64", "16777217", "FP32"),
    ("int64", "2049", "FP16"),
    ("int64", "1.5", "INT64"),
    ("int64", "true", "INT64"),
    ("int64", "2", "BOOL"),
    ("int64", '"7"', "INT64"),
    ("uint64", "18446744073709551616", "UINT64"),
    ("uint64", "-1", "UINT64"),
    ("uint64", "-1", "INT64"),
    ("uint8", "256", "UINT8"),
    ("uint8", "256", "INT64"),
    ("uint8", "-1", "INT8"),
    ("uint8", "254.9999", "FP32"),
]


def write_counter(root: Path, dtype: str) -> Path:
    """A policy that answers with its observation's last three digits, which tell a number from its neighbours."""
    folder = root / dtype / "1"
    folder.mkdir(parents=True)
    nodes = [
        helper.make_node("Div", ["obs", "thousand"], ["whole"]),
        helper.make_node("Mul", ["whole", "thousand"], ["thousands"]),
        helper.make_node("Sub", ["obs", "thousands"], ["digits"]),
        helper.make_node("Cast", ["digits"], ["action"], to=TensorProto.FLOAT),
    ]
    save_graph(
        folder / bundle_files.ONNX_FILE,
        nodes,
        {"thousand": np.array(100 if dtype == "uint8" else 1000, dtype)},
        [("obs", TYPES[dtype], ["batch", 2])],
        [("action", TensorProto.FLOAT, ["batch", 2])],
    )
    spaces = (BoxSpec(shape=(2,), dtype=each, low=None, high=None) for each in (dtype, "float32"))
    contract = contract_of(dtype, *spaces)
    return write_bundle(folder, contract, np.arange(8, dtype=dtype).reshape(4, 2))


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> PolicyApp:
    root = tmp_path_factory.mktemp("integers")
    for dtype in TYPES:
        write_counter(root, dtype)
    store = load_store(root)
    return create_app(control_of(store), ServerSettings())


@pytest.fixture(scope="module")
def http(app: PolicyApp) -> Iterator[httpx.Client]:
    with over_uvicorn(app) as port, httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as client:
        yield client


def digits(number: str) -> list[float]:
    """Return the action for [number, 1]."""
    value = int(json.loads(number))
    size = 100 if value in (1, 255) else 1000
    return [float(abs(value) % size * (-1 if value < 0 else 1)), 1.0]


def tensor(number: str, datatype: str) -> str:
    beside = "true" if datatype == "BOOL" else "1"
    return f'{{"name": "obs", "shape": [1, 2], "datatype": "{datatype}", "data": [{number}, {beside}]}}'


def post(http: httpx.Client, path: str, body: str) -> tuple[int, Any]:
    reply = http.post(path, content=body, headers={"content-type": "application/json"})
    return reply.status_code, reply.json()


@pytest.mark.parametrize(("policy", "number", "datatype"), KEPT)
def test_an_integer_that_fits_is_acted_on_exactly(http: httpx.Client, policy: str, number: str, datatype: str) -> None:
    status, reply = post(http, f"/v2/models/{policy}/infer", f'{{"inputs": [{tensor(number, datatype)}]}}')
    assert status == 200 and reply["outputs"][0]["data"] == digits(number), reply
    status, reply = post(http, f"/v1/policies/{policy}/act", f'{{"obs": [{number}, 1]}}')
    assert status == 200 and reply["action"] == digits(number), reply


@pytest.mark.parametrize("policy", TYPES)
def test_flags_alone_are_0_and_1_for_every_integer_dtype(http: httpx.Client, app: PolicyApp, policy: str) -> None:
    for obs, expected in (([True, False], [1, 0]), ([[False, True], [True, True]], [[0, 1], [1, 1]])):
        status, reply = post(http, f"/v1/policies/{policy}/act", json.dumps({"obs": obs}))
        assert (status, reply.get("action")) == (200, expected), reply
    flags = '{"inputs": [{"name": "obs", "shape": [1, 2], "datatype": "BOOL", "data": [true, false]}]}'
    status, reply = post(http, f"/v2/models/{policy}/infer", flags)
    assert status == 200 and reply["outputs"][0]["data"] == [1, 0], reply
    assert app.handler.store().get(policy).act(np.array([True, False])).tolist() == [1, 0]


@pytest.mark.parametrize(("policy", "number", "datatype"), REFUSED)
def test_an_integer_that_does_not_fit_is_refused(http: httpx.Client, policy: str, number: str, datatype: str) -> None:
    flat = tensor(number, datatype)
    nested = tensor(f"[{number}", datatype).replace("]}", "]]}")
    for given in (flat, nested):
        status, reply = post(http, f"/v2/models/{policy}/infer", f'{{"inputs": [{given}]}}')
        assert status == 422 and len(reply["error"]) < 300, reply


@pytest.mark.parametrize("number", ["9223372036854775808", "-9223372036854775809", "9007199254740993.0", "1.5"])
def test_json_observations_are_held_to_the_same(http: httpx.Client, number: str) -> None:
    for obs in (f"[{number}, 1]", f"[[{number}, 1], [1, 1]]", f"[1, {number}]"):
        status, reply = post(http, "/v1/policies/int64/act", f'{{"obs": {obs}}}')
        assert status == 422 and "integer" in reply["error"], reply


@pytest.mark.parametrize(
    ("policy", "array"),
    [
        ("int64", np.array([2**63, 1], np.float64)),
        ("int64", np.array([2**53, 1], np.float64)),
        ("int64", np.array([2**24, 1], np.float32)),
        ("int64", np.array([2**63, 1], np.uint64)),
        ("uint64", np.array([-1, 1], np.int64)),
        ("uint64", np.array([2**64, 1], np.float64)),
        ("uint8", np.array([256, 1], np.int16)),
        ("uint8", np.array([0.5, 1], np.float16)),
    ],
)
def test_so_are_bytes(http: httpx.Client, app: PolicyApp, policy: str, array: Any) -> None:
    datatype = {"float64": "FP64", "float32": "FP32", "float16": "FP16"}.get(array.dtype.name, array.dtype.name.upper())
    head = json.dumps(
        {"inputs": [{"name": "obs", "shape": [1, 2], "datatype": datatype,
                     "parameters": {"binary_data_size": array.nbytes}}]}
    ).encode()  # fmt: skip
    reply = http.post(
        f"/v2/models/{policy}/infer",
        content=head + array.tobytes(),
        headers={"Inference-Header-Content-Length": str(len(head))},
    )
    assert reply.status_code == 422 and "integer" in reply.json()["error"]
    with pytest.raises(ObservationError, match="integer"):
        over_grpc(app, policy, datatype, array, raw=True)
    if datatype in FIELDS:
        with pytest.raises(ObservationError, match="integer"):
            over_grpc(app, policy, datatype, array, raw=False)
    with Stream(http.base_url.port or 0, f"/v1/policies/{policy}/stream") as stream:
        assert "integer" in stream.ask(obs=array)["error"]


def over_grpc(app: PolicyApp, policy: str, datatype: str, array: Any, *, raw: bool) -> Any:
    handler = app.handler
    asked = messages.ModelInferRequest(model_name=policy)
    given = asked.inputs.add(name="obs", datatype=datatype, shape=[1, 2])
    if raw:
        asked.raw_input_contents.append(array.tobytes())
    else:
        getattr(given.contents, FIELDS[datatype]).extend(array.tolist())
    request = Request("grpc", "", None, time.perf_counter())
    return asyncio.run(handler.answer(OipGrpcCodec(), request, asked.SerializeToString()))


def test_typed_contents_of_64_bits_are_kept_exactly(app: PolicyApp) -> None:
    for policy, values in (("uint64", [2**63 + 1, 1]), ("int64", [2**53 + 1, 1])):
        reply = over_grpc(app, policy, policy.upper(), np.array(values, policy), raw=False)
        assert list(reply.outputs[0].contents.fp32_contents) == [values[0] % 1000, 1.0]


def test_a_bool_is_a_byte_of_0_or_1(http: httpx.Client, app: PolicyApp) -> None:
    array = np.array([2, 1], np.uint8)
    head = json.dumps(
        {"inputs": [{"name": "obs", "shape": [1, 2], "datatype": "BOOL", "parameters": {"binary_data_size": 2}}]}
    ).encode()
    headers = {"Inference-Header-Content-Length": str(len(head))}
    reply = http.post("/v2/models/uint8/infer", content=head + array.tobytes(), headers=headers)
    assert reply.status_code == 422 and "2 is not an integer in 0..1" in reply.json()["error"]
    with pytest.raises(ObservationError, match=r"0\.\.1"):
        over_grpc(app, "uint8", "BOOL", array, raw=True)


@pytest.mark.parametrize("given", [[1.7, 1], [2**63, 1], [np.float32(2**24), 1], np.array([300, 1]), ["1", "1"]])
def test_in_process_too(app: PolicyApp, given: Any) -> None:
    policy: Policy = app.handler.store().get("uint8")
    with pytest.raises(ObservationError, match=r"integer|number"):
        policy.act(given)


@pytest.mark.parametrize("value", [1.7, 2.0**63, 10**6 + 9, "1", [None], True])
def test_a_last_action_is_read_as_an_observation_is(tmp_path: Path, value: Any) -> None:
    policy = Policy.load(write_discrete_policy(tmp_path, start=10**6))
    if value is True:
        value = np.array(2**40 + 10**6, np.int64)
    with pytest.raises(RequestError, match="last_action"):
        policy.step(2, last_action=value)


@pytest.mark.parametrize("text", ["1", "\N{ARABIC-INDIC DIGIT THREE}", b"1"])
def test_digits_in_a_text_are_no_number_wherever_they_are_sent(tmp_path: Path, text: Any) -> None:
    policy = Policy.load(write_leaky_policy(tmp_path))
    for given in (
        {"obs": [text, 0, 0]},
        {"obs": [0, 0, 0], "state": {"h": [text, 0]}},
        {"obs": [0, 0, 0], "state": {"h": [0, 0]}, "last_action": [text, 0]},
    ):
        with pytest.raises((RequestError, ObservationError), match=r"the string|a bytes"):
            policy.step(given.pop("obs"), **given)  # type: ignore[arg-type]
    with pytest.raises(RequestError, match=r"the string|a bytes"):
        parse_array(text, "float32", "the reward")


@pytest.mark.parametrize(
    ("dtype", "sent", "used"),
    [
        ("float32", 1e-40, 1e-40),
        ("float32", 1e-46, 0.0),
        ("float32", 2**24 + 1, 2.0**24),
        ("float32", 0.1, 0.1),
        ("float64", 2**53 + 1, 2.0**53),
        ("float64", 5e-324, 5e-324),
        ("float16", 65519.0, 65504.0),
        ("float16", 6e-8, 6e-8),
    ],
)
def test_a_float_is_the_nearest_one_that_its_space_has(dtype: str, sent: float, used: float) -> None:
    parser = ObservationParser("p", BoxSpec(shape=(2,), dtype=dtype, low=None, high=None))
    for obs in ([sent, 1], np.array([sent, 1], np.float64), [[sent, 1], [1, 1]]):
        found = parser.parse(obs).arrays["obs"]
        assert found.dtype == dtype and found[0, 0] == np.dtype(dtype).type(used)
    with pytest.raises(ObservationError, match=r"too large|not a finite"):
        parser.parse([{"float16": 65520.0, "float32": 3.5e38, "float64": float("inf")}[dtype], 1])


def test_clipping_one_element_leaves_the_others_as_they_are(tmp_path: Path) -> None:
    folder = write_counter(tmp_path, "int64")
    low, high = (None, 0), (None, 10)
    rewrite_contract(folder, observation_space=BoxSpec(shape=(2,), dtype="int64", low=low, high=high))
    policy = Policy.load(folder, options=PolicyOptions(out_of_bounds="clip"), check_golden=False)
    assert policy.act([2**53 + 1, 99]).tolist() == [993.0, 10.0]
