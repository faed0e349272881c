"""The Open Inference Protocol over real bundles: Triton's own client, and hand-made requests that it never sends."""

from __future__ import annotations

import gzip
import json
import subprocess
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from grpc_calls import answered
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import Reply, exchange, over_uvicorn
from stores import control_of, load_store

LENGTH = "Inference-Header-Content-Length"
BATCH = np.random.default_rng(5).standard_normal((33, 27)).astype(np.float32)
ONE = BATCH[:1]
CLIENT = Path(__file__).resolve().parents[2] / "clients" / "triton_http.py"
Ask = Callable[..., Reply]


@pytest.fixture(scope="module")
def store(policies: Path) -> PolicyStore:
    return load_store(policies)


@pytest.fixture(scope="module")
def port(store: PolicyStore) -> Iterator[int]:
    settings = ServerSettings(max_body_bytes=200_000, max_batch=64, body_timeout_s=1.0)
    with over_uvicorn(create_app(control_of(store), settings)) as port:
        yield port


@pytest.fixture(scope="module")
def ask(port: int) -> Ask:
    return lambda method, path, body=b"", **headers: exchange(port, method, path, body, **headers)


def infer(ask: Ask, body: Any, model: str = "ur5", **headers: str) -> tuple[int, Any]:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    status, _, reply = ask("POST", f"/v2/models/{model}/infer", content, **headers)
    return status, json.loads(reply)


def tensor(data: Any, shape: list[int], datatype: str = "FP32", name: str = "obs", **more: Any) -> dict[str, Any]:
    return {"name": name, "shape": shape, "datatype": datatype, "data": data, **more}


def request(*tensors: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"inputs": list(tensors), **more}


@pytest.mark.slow
def test_tritons_own_client_works_unchanged(
    client_environment: Callable[..., Path], port: int, store: PolicyStore
) -> None:
    python = client_environment("tritonclient[http,grpc]==2.71.0")
    done = subprocess.run(
        [str(python), str(CLIENT), f"127.0.0.1:{port}"],
        input=json.dumps({"obs": BATCH.tolist()}),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["live"] and facts["ready"] and facts["aio_ready"]
    assert facts["model_ready"] == [True, True, False, False]
    assert facts["server"]["name"] == "rlservo" and "binary_tensor_data" in facts["server"]["extensions"]
    assert facts["model"] == {
        "name": "ur5",
        "versions": ["1", "2", "10"],
        "platform": "onnx_onnxv1",
        "inputs": [{"name": "obs", "datatype": "FP32", "shape": [-1, 27]}],
        "outputs": [{"name": "action", "datatype": "FP32", "shape": [-1, 6]}],
    }
    assert facts["version"]["versions"] == ["2"]
    assert {"name": "ur5", "version": "10", "state": "READY", "reason": ""} in facts["index"]
    assert len(facts["index"]) == 4
    older = facts["older"]
    assert (older["id"], older["model_version"], older["parameters"]["seq"]) == ("r-7", "2", 5)
    measured = facts["measured"]
    assert measured["config"]["max_batch_size"] == 64
    assert measured["config"]["input"] == [{"name": "obs", "data_type": "TYPE_FP32", "dims": [27]}]
    (before,), (after,) = measured["before"]["model_stats"], measured["after"]["model_stats"]
    assert (after["name"], after["version"]) == ("ur5", "2")
    assert after["inference_count"] - before["inference_count"] == 3 + len(BATCH)
    assert after["execution_count"] - before["execution_count"] == 4
    gained = {name: after["inference_stats"][name]["count"] - before["inference_stats"][name]["count"]
              for name in ("success", "fail")}  # fmt: skip
    assert gained == {"success": 4, "fail": 1}
    assert [(each["name"], each["version"]) for each in measured["all"]["model_stats"]] == [
        ("gridworld", "1"), ("ur5", "1"), ("ur5", "2"), ("ur5", "10")
    ]  # fmt: skip
    assert facts["dtypes"] == ["float32"]
    expected = store.get("ur5").act(BATCH)
    np.testing.assert_array_equal(np.float32(facts["actions"].pop("older")), store.get("ur5", "2").act(BATCH))
    assert len(facts["actions"]) == 4 + 1 + 4 + 8 + 2
    for name, action in facts["actions"].items():
        np.testing.assert_array_equal(np.float32(action), expected, err_msg=name)
    assert facts["unknown"] == ["404", "no policy 'nobody' is loaded: this server has gridworld, ur5"]
    assert facts["short"][0] == "422" and "of shape [-1, 27] (-1 is the batch), got [33, 26]" in facts["short"][1]
    assert facts["nan"][0] == "422" and "element 0 (element_0) is nan" in facts["nan"][1]
    assert facts["late"][0] == "408" and "no action was computed" in facts["late"][1]


def test_json_data_may_be_nested_or_flat_and_of_any_number_type(ask: Ask, store: PolicyStore) -> None:
    expected = store.get("ur5").act(BATCH)
    flat = infer(ask, request(tensor(BATCH.ravel().tolist(), [33, 27])))[1]
    nested = infer(ask, request(tensor(BATCH.tolist(), [33, 27], "FP64"), id="a"))[1]
    assert flat["outputs"] == nested["outputs"] and nested["id"] == "a" and "id" not in flat
    assert flat["outputs"][0]["datatype"] == "FP32" and flat["outputs"][0]["shape"] == [33, 6]
    np.testing.assert_array_equal(np.float32(flat["outputs"][0]["data"]).reshape(33, 6), expected)
    whole = infer(ask, request(tensor([1] * 27, [1, 27], "INT8")))[1]["outputs"][0]["data"]
    np.testing.assert_array_equal(np.float32(whole), store.get("ur5").act(np.ones(27, np.float32)))
    discrete = infer(ask, request(tensor([0, 1, 4], [3], "INT64")), "gridworld")[1]["outputs"][0]
    assert (discrete["datatype"], discrete["shape"]) == ("INT64", [3])
    assert discrete["data"] == store.get("gridworld").act([0, 1, 4]).tolist()


@pytest.mark.parametrize("pad", range(8))  # so that the tensor begins at every alignment
def test_binary_tensors_go_in_and_come_out(ask: Ask, store: PolicyStore, pad: int) -> None:
    header = json.dumps(
        {
            "inputs": [
                {
                    "name": "obs",
                    "shape": [33, 27],
                    "datatype": "FP32",
                    "parameters": {"binary_data_size": BATCH.nbytes},
                }
            ],
            "outputs": [{"name": "action", "parameters": {"binary_data": True}}],
            "id": "x" * pad,
        }
    ).encode()
    status, headers, reply = ask("POST", "/v2/models/ur5/infer", header + BATCH.tobytes(), **{LENGTH: str(len(header))})
    assert status == 200 and headers["content-type"] == "application/octet-stream"
    length = int(headers[LENGTH.lower()])
    document = json.loads(reply[:length])
    (output,) = document["outputs"]
    assert output["parameters"]["binary_data_size"] == len(reply) - length == 33 * 6 * 4 and "data" not in output
    action = np.frombuffer(reply[length:], "<f4").reshape(output["shape"])
    np.testing.assert_array_equal(action, store.get("ur5").act(BATCH))


def test_output_parameters_override_the_requests_own(ask: Ask) -> None:
    body = request(tensor(ONE.tolist(), [1, 27]), parameters={"binary_data_output": True})
    content = json.dumps(body).encode()
    assert LENGTH.lower() in ask("POST", "/v2/models/ur5/infer", content)[1]
    body["outputs"] = [{"name": "action", "parameters": {"binary_data": False}}]
    assert "data" in infer(ask, body)[1]["outputs"][0]


@pytest.mark.parametrize(("name", "pack"), [("gzip", gzip.compress), ("deflate", zlib.compress)])
def test_bodies_may_be_compressed_both_ways(ask: Ask, name: str, pack: Callable[[bytes], bytes]) -> None:
    content = json.dumps(request(tensor(BATCH.tolist(), [33, 27]))).encode()
    plain = ask("POST", "/v2/models/ur5/infer", content)
    assert "content-encoding" not in plain[1]
    status, headers, reply = ask(
        "POST", "/v2/models/ur5/infer", pack(content), content_encoding=name, accept_encoding=name
    )
    assert (status, headers["content-encoding"]) == (200, name)
    unpacked = gzip.decompress(reply) if name == "gzip" else zlib.decompress(reply)
    assert json.loads(unpacked)["outputs"] == json.loads(plain[2])["outputs"]
    refused = ask("POST", "/v2/models/ur5/infer", content, accept_encoding=f"{name};q=0")
    assert refused[0] == 200 and "content-encoding" not in refused[1]


@pytest.mark.parametrize("more", [{"data": []}, {"parameters": {"binary_data_size": 0}}])
def test_an_empty_tensor_that_numpy_cannot_make_is_refused(ask: Ask, more: dict[str, Any]) -> None:
    given = {"name": "obs", "datatype": "FP32", "shape": [0, *[2**31 - 1] * 5], **more}
    status, reply = infer(ask, json.dumps({"inputs": [given]}).encode())
    assert status == 400 and "'shape' must be" in reply["error"]


def test_over_grpc_it_is_refused_too(store: PolicyStore) -> None:
    handler = create_app(control_of(store), ServerSettings()).handler
    for raw in ([b""], []):
        asked = messages.ModelInferRequest(model_name="ur5", raw_input_contents=raw)
        asked.inputs.add(name="obs", datatype="FP32", shape=[0, *[2**31 - 1] * 5])
        assert "'shape' must be" in answered(handler, asked)[1].details


def test_a_body_that_unpacks_to_too_much_is_refused(ask: Ask) -> None:
    bomb = gzip.compress(b"[" + b"0," * 5_000_000 + b"0]")
    assert len(bomb) < 20_000
    status, reply = infer(ask, bomb, content_encoding="gzip")
    assert (status, reply["code"]) == (413, "too-large")


@pytest.mark.parametrize("name", ["gzip", "deflate"])
def test_a_damaged_compressed_body_is_refused(ask: Ask, name: str) -> None:
    packed = (gzip.compress if name == "gzip" else zlib.compress)(json.dumps(request(tensor([0], [1]))).encode())
    for damaged in (b"", b"not packed", packed[:-3], packed + b"more", packed[:-9] + b"\0" * 9):
        status, reply = infer(ask, damaged, content_encoding=name)
        assert status == 400 and name in reply["error"], (damaged, reply)
    assert infer(ask, packed, content_encoding="br")[0] == 415


ROW = ONE[0].tolist()


def test_the_models_name_may_be_said_again(ask: Ask) -> None:
    """KServe's client does."""
    status, reply = infer(ask, request(tensor(ROW, [1, 27])) | {"model_name": "ur5"})
    assert (status, reply["model_name"]) == (200, "ur5")


@pytest.mark.parametrize(
    ("body", "status", "sentence"),
    [
        (b"", 400, "the request body is empty"),
        (b"[]", 400, "must be a JSON object such as {\"inputs\""),
        ({"inputs": []}, 400, "'inputs' must hold at least one tensor"),
        ({"inputs": [7]}, 400, "must be an object, got the number 7"),
        (request(tensor(ROW, [1, 27])) | {"extra": 1}, 400, "unknown field 'extra'"),
        (request(tensor(ROW, [1, 27])) | {"model_name": "ur10"}, 400, "'model_name' differs from 'ur5'"),
        (request(tensor(ROW, [1, 27]), id=7), 400, "'id' must be a string, got the number 7"),
        (request(tensor(ROW, [27])), 422, "expects input 'obs' of shape [-1, 27] (-1 is the batch), got [27]"),
        (request(tensor([], [0, 27])), 422, "got an empty batch"),
        (request(tensor(ROW[:26], [1, 27])), 422, "'data' has the shape [26], but 'shape' says [1, 27]"),
        (request(tensor([[1, 2], [3]], [1, 27])), 422, "differ in length"),
        (request(tensor([*ROW[:26], "x"], [1, 27])), 422, "cannot be read: it holds the string 'x', not numbers"),
        (request(tensor([*ROW[:26], None], [1, 27])), 422, "it holds null"),
        (
            b'{"inputs": [{"name": "obs", "shape": [2], "datatype": "FP32", "data": [NaN, %d]}]}' % 10**30,
            422,
            "more than 64 bits",
        ),
        (request(tensor([*ROW[:26], 300], [1, 27], "INT8")), 422, "is not an integer in -128..127"),
        (request(tensor([*ROW[:26], 1e39], [1, 27])), 422, "element 26 (element_26) is inf"),
        (b'{"inputs": [{"name": "obs", "shape": [1], "datatype": "FP32", "data": [NaN]}]}', 422, "of shape [-1, 27]"),
        (request(tensor(ROW, [1, 27], "FP8")), 400, "datatype must be one of BOOL, UINT8"),
        (request(tensor(ROW, [1, 27], "BYTES")), 400, "holds strings: send numbers"),
        (request(tensor(ROW, [-1, 27])), 400, "'shape' must be a list of sizes"),
        (request(tensor(ROW, [1, 2**62])), 400, "'shape' must be a list of sizes"),
        (request(tensor(ROW, ["x"] * 1000)), 400, "'inputs.0.shape' must have at most 32 items"),
        (request(tensor(ROW, [1, 27], name="image")), 422, "has no input 'image': expected 'obs'"),
        (request(tensor(ROW, [1, 27]), tensor(ROW, [1, 27])), 400, "input 'obs' is given twice"),
        (request(tensor(ROW, [1, 27], parameters={"shared_memory_region": "r"})), 400, "shared memory"),
        (request(tensor(ROW, [1, 27], parameters={"binary_data_size": 108})), 400, "both 'data' and"),
        (request(tensor(ROW, [1, 27]), outputs=[{"name": "value"}]), 400, "expected 'action'"),
        (request(tensor(ROW, [1, 27]), outputs=[{"name": "action", "parameters": {"classification": 3}}]), 400, "not"),
        (request(tensor(ROW, [1, 27]), parameters={"binary_data_output": 1}), 400, "must be true or false"),
        (request(tensor(ROW, [1, 27]), parameters={"explor": True}), 400, "unknown parameter 'explor'"),
        (request(tensor(ROW, [1, 27]), parameters={"seed": -1}), 400, "'seed' must be greater than or equal to 0"),
        (request(tensor(ROW, [1, 27]), parameters={"sequence_id": True}), 400, "'sequence_id' must be an integer"),
        (request(tensor(ROW, [1, 27]), parameters={"deadline_ms": 0}), 408, "no action was computed"),
        (request(tensor([0.0] * 27 * 65, [65, 27])), 413, "a batch of 65 observations is too large: at most 64"),
    ],
)  # fmt: skip
def test_a_wrong_request_is_told_what_is_wrong(ask: Ask, body: Any, status: int, sentence: str) -> None:
    got, reply = infer(ask, body)
    assert got == status and sentence in reply["error"], reply


@pytest.mark.parametrize(
    ("length", "raw", "sentence"),
    [
        ("9999999", 108, "Inference-Header-Content-Length is 9999999, but the body has"),
        ("-1", 108, "must be the length of the JSON, got '-1'"),
        ("0", 108, "must be the length of the JSON, got '0'"),
        (None, 104, "needs 108 bytes after the JSON, but the body has 104 left"),
        (None, 112, "the body has 4 bytes after the last tensor's data"),
    ],
)
def test_binary_lengths_must_add_up(ask: Ask, length: str | None, raw: int, sentence: str) -> None:
    header = json.dumps(
        {"inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "parameters": {"binary_data_size": 108}}]}
    ).encode()
    status, reply = infer(ask, header + b"\0" * raw, **{LENGTH: length or str(len(header))})
    assert status == 400 and sentence in reply["error"], reply


def test_the_repository_index_reads_the_protocols_filter(ask: Ask) -> None:
    assert ask("POST", "/v2/repository/index", b'{"ready": true}')[0] == 200
    assert ask("POST", "/v2/repository/index", b"[")[0] == 400
