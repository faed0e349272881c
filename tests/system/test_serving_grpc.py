"""The Open Inference Protocol over gRPC, on the embedded server, with keys on; Triton's own client included."""

from __future__ import annotations

import json
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from grpc_calls import answered, infer_request
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording
from rlservo.serve_app.engines.uvicorn_server import serve_policies
from rlservo.serve_app.protocols.open_inference.grpc_service import is_local
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.settings import ServerSettings
from servers import free_ports
from stores import control_of, load_store

pytestmark = [pytest.mark.serve, pytest.mark.slow]

CLIENT = Path(__file__).resolve().parents[1] / "clients" / "triton_grpc.py"
TRITON = ("tritonclient[http,grpc]==2.71.0",)
OBS = np.random.default_rng(6).standard_normal((5, 27)).astype(np.float32)
Call = Callable[..., Any]


@pytest.fixture(scope="module")
def call(live_server: Any) -> Iterator[Call]:
    with grpc.insecure_channel(f"127.0.0.1:{live_server.grpc_port}") as channel:

        def ask(method: str, message: Any, reply: Any, *, key: str = live_server.bearer, timeout: float = 20) -> Any:
            stub = channel.unary_unary(f"/inference.GRPCInferenceService/{method}")
            content, _ = stub.with_call(
                message if type(message) is bytes else message.SerializeToString(),
                metadata=(("authorization", key), ("x-request-id", "grpc-17")),
                timeout=timeout,
            )
            return reply.FromString(content)

        yield ask


def test_what_grpc_decides_is_recorded(live_server: Any, call: Call, ur5: Path) -> None:
    asked = infer_request(OBS[:1], sequence_id="recorded-arm")
    reply = call("ModelInfer", asked, messages.ModelInferResponse)
    deadline, mine = time.monotonic() + 20, []
    while not mine and time.monotonic() < deadline:  # written within a second
        time.sleep(0.2)
        if any(live_server.recorded.iterdir()):
            mine = [one for one in episodes(Recording(live_server.recorded)) if one.id == "recorded-arm"]
    assert len(mine) == 1 and mine[0].field("request_id") == ["grpc-17"]
    np.testing.assert_array_equal(mine[0].obs["obs"], OBS[:1])
    np.testing.assert_array_equal(mine[0].action["action"].tobytes(), reply.raw_output_contents[0])
    with Policy.load(ur5) as policy:
        np.testing.assert_array_equal(mine[0].action["action"], policy.act(OBS[:1]))


@pytest.mark.parametrize("place", ["input", "output"])
def test_parameters_of_tensors_and_outputs_are_bounded(call: Call, place: str) -> None:
    asked = infer_request(OBS[:1])
    of = asked.inputs[0] if place == "input" else asked.outputs.add(name="action")
    for number in range(50_000):
        of.parameters[f"{number}"].bool_param = True
    with pytest.raises(grpc.RpcError) as caught:
        call("ModelInfer", asked, messages.ModelInferResponse)
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert caught.value.details() == "the message has more than 1000 parameters"


def request(obs: Any, **fields: Any) -> Any:
    asked = messages.ModelInferRequest(model_name="ur5", **fields)
    asked.inputs.add(name="obs", datatype="FP32", shape=obs.shape)
    return asked


def refused(call: Call, message: Any, **options: Any) -> tuple[str, str]:
    with pytest.raises(grpc.RpcError) as caught:
        call("ModelInfer", message, messages.ModelInferResponse, **options)
    return caught.value.code().name, caught.value.details()


def test_tritons_client_gets_everything_unchanged(
    live_server: Any, ur5: Path, policies: Path, client_environment: Callable[..., Path]
) -> None:
    done = subprocess.run(
        [str(client_environment(*TRITON)), str(CLIENT), f"127.0.0.1:{live_server.grpc_port}", live_server.key],
        input=json.dumps({"obs": OBS.tolist()}),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    got = json.loads(done.stdout)
    with Policy.load(ur5) as policy, Policy.load(policies / "ur5" / "2") as second:
        expected, other = policy.act(OBS), second.act(OBS)
    for name in ("action", "gzip", "deflate", "async"):
        np.testing.assert_allclose(got[name], expected, rtol=1e-5, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(got["version_2"], other, rtol=1e-5, atol=1e-6)
    for action in got["aio"]["actions"]:
        np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
    (first, mistake, third) = got["stream"]
    assert first[0] == "a" and third[0] == "c" and "got [5, 3]" in mistake
    np.testing.assert_allclose([first[1], third[1]], [expected, expected], rtol=1e-5, atol=1e-6)
    assert got["live"] and got["ready"] and got["seeded"] and got["aio"]["ready"] and got["id"] == "r1"
    assert got["model_ready"] == [True, True, False, False]
    assert got["server"]["name"] == "rlservo"
    assert got["model"]["inputs"] == [{"name": "obs", "datatype": "FP32", "shape": ["-1", "27"]}]
    assert [line["version"] for line in got["index"]["models"] if line["name"] == "ur5"] == ["1", "2", "10"]
    codes = {name: refusal[0].removeprefix("StatusCode.") for name, refusal in got["refused"].items()}
    assert codes == {
        "no key": "UNAUTHENTICATED",
        "wrong key": "UNAUTHENTICATED",
        "shape": "INVALID_ARGUMENT",
        "nan": "INVALID_ARGUMENT",
        "unknown": "NOT_FOUND",
        "version": "NOT_FOUND",
        "parameter": "INVALID_ARGUMENT",
        "walk": "NOT_FOUND",
        "late": "DEADLINE_EXCEEDED",
        "config": "NOT_FOUND",
        "statistics": "NOT_FOUND",
        "config without a key": "UNAUTHENTICATED",
    }
    assert got["config"] == {
        "name": "ur5",
        "platform": "onnx_onnxv1",
        "backend": "onnxruntime",
        "max_batch_size": 4096,
        "input": [{"name": "obs", "data_type": "TYPE_FP32", "dims": ["27"]}],
        "output": [{"name": "action", "data_type": "TYPE_FP32", "dims": ["6"]}],
        "default_model_filename": "policy.onnx",
        "model_transaction_policy": {},
    }
    assert {(each["name"], each["version"]) for each in got["all"]} >= {("ur5", "2"), ("ur5", "10"), ("gridworld", "1")}
    (before,), (after,) = got["before"], got["after"]
    assert (after["name"], after["version"]) == ("ur5", "2")
    assert int(after["inference_count"]) - int(before.get("inference_count", 0)) == len(OBS)
    assert int(after["execution_count"]) - int(before.get("execution_count", 0)) == 1
    assert int(after["inference_stats"]["success"]["ns"]) > int(after["inference_stats"]["compute_infer"]["ns"]) > 0
    assert "element 3 (element_3) of observation 0 is nan" in got["refused"]["nan"][1]


def test_typed_contents_are_read_and_answered_in_kind(call: Call, ur5: Path) -> None:
    asked = request(OBS, id="t")
    asked.inputs[0].contents.fp32_contents.extend(OBS.ravel().tolist())
    reply = call("ModelInfer", asked, messages.ModelInferResponse)
    assert not reply.raw_output_contents and reply.id == "t" and reply.model_version == "10"
    with Policy.load(ur5) as policy:
        action = np.reshape(reply.outputs[0].contents.fp32_contents, reply.outputs[0].shape)
        np.testing.assert_allclose(action, policy.act(OBS), rtol=1e-5, atol=1e-6)


def test_discrete_policies_take_and_give_integers(call: Call, policies: Path) -> None:
    asked = messages.ModelInferRequest(model_name="gridworld")
    asked.inputs.add(name="obs", datatype="INT64", shape=[5]).contents.int64_contents.extend(range(5))
    reply = call("ModelInfer", asked, messages.ModelInferResponse)
    with Policy.load(policies / "gridworld") as policy:
        assert list(reply.outputs[0].contents.int64_contents) == policy.act(np.arange(5)).tolist()
    assert reply.outputs[0].datatype == "INT64"
    asked.inputs[0].contents.int64_contents[2] = 9
    assert refused(call, asked)[0] == "INVALID_ARGUMENT"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda m: m.raw_input_contents.append(b"\0" * 12), "540 bytes, but its size is the number 12"),
        (lambda m: m.raw_input_contents.extend([b"", b""]), "1 inputs and 2 raw_input_contents"),
        (lambda m: m.inputs[0].contents.fp32_contents.extend([1.0] * 9), "has the shape [9], but 'shape' says [5, 27]"),
        (lambda m: m.inputs[0].contents.int_contents.extend([1] * 135), "belongs in 'fp32_contents'"),
        (lambda m: setattr(m.inputs[0], "datatype", "BYTES"), "holds strings: send numbers"),
        (lambda m: setattr(m.inputs[0], "datatype", "FP12"), "must be one of"),
        (lambda m: m.inputs[0].shape.__setitem__(0, -1), "must be a list of sizes"),
        (lambda m: m.inputs.pop(), "at least one tensor"),
        (lambda m: m.inputs.append(m.inputs[0]), "given twice"),
    ],
)
def test_a_malformed_request_is_one_sentence(call: Call, change: Callable[[Any], Any], sentence: str) -> None:
    asked = request(OBS)
    change(asked)
    code, details = refused(call, asked)
    assert code == "INVALID_ARGUMENT" and sentence in details


def test_bytes_that_are_no_message_are_a_bad_request(call: Call) -> None:
    code, details = refused(call, b"\xff\xff\xff")
    assert code == "INVALID_ARGUMENT" and "not a ModelInferRequest" in details


def test_a_deadline_that_has_passed_is_not_worked_for(ur5: Path) -> None:
    handler = RequestHandler(control_of(load_store(ur5)), ServerSettings())
    statuses = [answered(handler, infer_request(OBS), remaining_s=left)[1].code for left in (0.0, 5.0, None)]
    assert statuses == [grpc.StatusCode.DEADLINE_EXCEEDED, None, None]


def test_a_key_is_needed_for_all_but_health(live_server: Any) -> None:
    with grpc.insecure_channel(f"127.0.0.1:{live_server.grpc_port}") as channel:
        for method in ("ServerMetadata", "ModelReady", "ModelMetadata", "ModelInfer", "RepositoryIndex"):
            with pytest.raises(grpc.RpcError) as caught:
                channel.unary_unary(f"/inference.GRPCInferenceService/{method}")(b"", timeout=20)
            assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
            assert ("rlservo-code", "unauthenticated") in caught.value.trailing_metadata()
        ready = channel.unary_unary("/inference.GRPCInferenceService/ServerReady")(b"", timeout=20)
        assert messages.ServerReadyResponse.FromString(ready).ready
        stream = channel.stream_stream("/inference.GRPCInferenceService/ModelStreamInfer")(iter([b""]), timeout=20)
        with pytest.raises(grpc.RpcError) as caught:
            next(stream)
        assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED


def test_a_message_beyond_the_limit_is_refused_compressed_or_not(live_server: Any) -> None:
    with grpc.insecure_channel(
        f"127.0.0.1:{live_server.grpc_port}", options=[("grpc.max_send_message_length", -1)]
    ) as channel:
        stub = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
        for compression in (None, grpc.Compression.Gzip):
            with pytest.raises(grpc.RpcError) as caught:
                stub(b"\0" * (64 << 20), compression=compression, timeout=60)
            assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED


def test_a_request_id_comes_back(live_server: Any) -> None:
    with grpc.insecure_channel(f"127.0.0.1:{live_server.grpc_port}") as channel:
        stub = channel.unary_unary("/inference.GRPCInferenceService/ServerLive")
        _, done = stub.with_call(b"", metadata=(("x-request-id", "cell-7/81"),), timeout=20)
        assert ("x-request-id", "cell-7/81") in done.trailing_metadata()


@pytest.mark.parametrize(
    ("peer", "local"),
    [
        ("ipv4:127.0.0.1:4711", True),
        ("ipv6:%5B::1%5D:4711", True),
        ("ipv6:[::ffff:127.0.0.1]:4711", True),
        ("unix:/run/x", True),
        ("ipv4:10.0.0.7:4711", False),
        ("ipv6:%5Bfe80::1%5D:4711", False),
        ("ipv6:[::ffff:10.0.0.7]:1", False),
        ("", False),
        ("ipv4:localhost:1", False),
    ],
)
def test_who_is_on_this_machine(peer: str, local: bool) -> None:
    assert is_local(peer) is local


def test_a_taken_grpc_port_is_said_before_anything_starts(policies: Path) -> None:
    (port,) = free_ports(1)
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(UsageError, match="port"):
        serve_policies([policies], port=port, grpc_port=taken.getsockname()[1])


def test_health_is_told_without_a_key(live_server: Any) -> None:
    with grpc.insecure_channel(f"127.0.0.1:{live_server.grpc_port}") as channel:
        for service in ("", "inference.GRPCInferenceService"):
            request = health_pb2.HealthCheckRequest(service=service)
            reply = health_pb2_grpc.HealthStub(channel).Check(request, timeout=20)
            assert reply.status == health_pb2.HealthCheckResponse.SERVING
