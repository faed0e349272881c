"""The benchmark's parts on a real server for a second or two; the benchmark itself is no test."""

from __future__ import annotations

import json
import shutil
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import uvicorn
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from rich.console import Console

import soak as soak_module
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.ray_serve.http_connections import HEAD_S
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire.msgpack_arrays import pack, unpack
from soak import Track, mix, soak
from speed import report
from speed.catalogue import BARE, DIRECTLY, RLLIB, RLSERVO, TWO, Case, binary, case_of, plain
from speed.loads import HttpLine, Load, LoadError, WebSocketLine, infer_request, wrk
from speed.machine import OTHER, PROXY, REPLICA, processes
from speed.paced import CONNECT_S
from speed.report import Result, Verdict, verdicts
from speed.rounds import (
    HEAVY,
    JSON1,
    JSON16,
    JSON64,
    MOST_ROBOTS,
    ONES,
    PLANNED_HZ,
    Rounds,
    Sample,
    check_answers,
    scaling,
)
from speed.servers import Exchange, Server, listening, running
from stores import load_store

ROOT = Path(__file__).resolve().parent.parent.parent
UR5 = ROOT / "examples" / "checkpoints" / "ur5_positioning"
needs_wrk = pytest.mark.skipif(shutil.which("wrk") is None, reason="wrk is not installed (apt-get install wrk)")


@pytest.fixture(scope="module")
def case(shipped: Path) -> Case:
    return case_of(shipped / "ur5", UR5)


@pytest.fixture(scope="module")
def server(case: Case) -> Iterator[Server]:
    """Our application in this process, behind uvicorn instead of Ray Serve."""
    store = load_store(case.bundle.path)
    app = create_app(lambda: store, ServerSettings())
    with socket.create_server(("127.0.0.1", 0)) as listener:
        uvicorn_server = uvicorn.Server(uvicorn.Config(app, log_level="critical", access_log=False))
        thread = threading.Thread(target=uvicorn_server.run, kwargs={"sockets": [listener]})
        thread.start()
        while not uvicorn_server.started:
            time.sleep(0.01)
        port = listener.getsockname()[1]
        yield Server(
            RLSERVO,
            [],
            port,
            plain(case, "/v1/policies/ur5/act"),
            batch=binary(case, 8),
            heavy=binary(case, 8),
            stream="/v1/policies/ur5/stream",
            message=pack({"obs": case.obs}),
            greets=True,
        )
        uvicorn_server.should_exit = True
        thread.join()
        store.close()


def test_lines_read_the_policys_action_over_every_protocol(server: Server, case: Case) -> None:
    check_answers([server], case)
    with closing(HttpLine(server.port, server.act)) as line:
        for _ in range(3):
            np.testing.assert_allclose(json.loads(line())["action"], case.action, atol=1e-5)
    with closing(WebSocketLine(server.port, server.stream, server.message, greets=True)) as line:
        for _ in range(3):
            np.testing.assert_allclose(unpack(line())["actions"][0], case.action, atol=1e-5)
    with closing(HttpLine(server.port, server.batch)) as line:
        answer = line()
        actions = np.frombuffer(answer[-8 * case.action.nbytes :], np.float32).reshape(8, -1)
    assert actions.shape == (8, len(case.action)) and np.isfinite(actions).all()


def test_line_refuses_an_answer_of_another_status(server: Server) -> None:
    unknown = Exchange("POST", "/v1/policies/none/act", b'{"obs": [1]}')
    with closing(HttpLine(server.port, unknown)) as line, pytest.raises(LoadError, match="404"):
        line()


def test_websocket_line_reads_messages_of_every_length_form(server: Server, case: Case) -> None:
    for rows in (1, 40, 4000):  # replies under 126 bytes do not occur; 16 and 64 bit lengths do
        message = pack({"obs": case.batch(rows)})
        with closing(WebSocketLine(server.port, server.stream, message, greets=True)) as line:
            assert unpack(line())["actions"].shape == (rows, 1, len(case.action))


@needs_wrk
def test_wrk_counts_and_refuses_errors(server: Server, tmp_path: Path) -> None:
    load = wrk(server.port, server.act, tmp_path, connections=2, seconds=1)
    assert load.count > 10 and 0 < load.p50_ms <= load.p99_ms and load.generator_cpu_s > 0
    with pytest.raises(LoadError, match="Non-2xx"):
        wrk(server.port, Exchange("POST", "/v1/policies/ur5/act", b"{}"), tmp_path, connections=1, seconds=1)


@needs_wrk
def test_a_round_samples_every_measure_it_can(server: Server, case: Case, tmp_path: Path) -> None:
    samples = Rounds(case, [server], tmp_path, 1, fleets=[(4, 20.0)]).run(1, lambda _: None)
    assert all(len(taken) == 1 and taken[0].load.count > 0 for taken in samples.values())
    assert {(JSON1, RLSERVO), (JSON16, RLSERVO), (JSON64, RLSERVO)} < samples.keys()
    for protocol in ("json", "websocket"):
        ((load,),) = [
            [taken[0].load] for (measure, _), taken in samples.items() if measure.startswith(f"paced {protocol}")
        ]
        assert 0 < load.p50_ms <= load.p99_ms <= (load.p999_ms or 0) and load.late is not None
        waited_s = (load.p999_ms or 0) / 1e3  # before the seconds that count, on a busy machine
        # No more than robots ask, however quick the server is.
        assert load.count <= 4 * 20 * (load.seconds + waited_s) + 10


@needs_wrk
def test_one_replica_and_two_are_measured_by_every_way_in(server: Server, tmp_path: Path) -> None:
    samples = scaling([server, replace(server, name=RLSERVO + DIRECTLY)], tmp_path, 1)
    assert samples.keys() == {(measure, RLSERVO + way) for measure in (ONES, HEAVY) for way in ("", DIRECTLY)}
    assert all(taken.load.count > 0 for taken in samples.values())


def test_grpc_request_is_what_the_protocols_message_reads(case: Case) -> None:
    """The hand-written bytes against protobuf's own parser, with the fields of the protocol's specification."""
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="oip.proto", package="inference", syntax="proto3")
    request = file.message_type.add(name="ModelInferRequest")
    tensor = request.nested_type.add(name="InferInputTensor")
    tensor.field.add(name="name", number=1, type=kinds.TYPE_STRING, label=kinds.LABEL_OPTIONAL)
    tensor.field.add(name="datatype", number=2, type=kinds.TYPE_STRING, label=kinds.LABEL_OPTIONAL)
    tensor.field.add(name="shape", number=3, type=kinds.TYPE_INT64, label=kinds.LABEL_REPEATED)
    request.field.add(name="model_name", number=1, type=kinds.TYPE_STRING, label=kinds.LABEL_OPTIONAL)
    request.field.add(
        name="inputs",
        number=5,
        type=kinds.TYPE_MESSAGE,
        label=kinds.LABEL_REPEATED,
        type_name=".inference.ModelInferRequest.InferInputTensor",
    )
    request.field.add(name="raw_input_contents", number=7, type=kinds.TYPE_BYTES, label=kinds.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName("inference.ModelInferRequest"))
    obs = case.batch(300)
    read = message.FromString(infer_request("ur5", obs))
    assert read.model_name == "ur5"
    assert (read.inputs[0].name, read.inputs[0].datatype, list(read.inputs[0].shape)) == ("obs", "FP32", [300, 27])
    np.testing.assert_array_equal(np.frombuffer(read.raw_input_contents[0], "<f4").reshape(obs.shape), obs)


def sample(p50_ms: float, per_s: float = 1000.0) -> Sample:
    load = Load(p50_ms, p50_ms * 2, per_s, 1000, 1.0, 0.1)
    return Sample(load, {REPLICA: 0.5, PROXY: 0.1, OTHER: 0.0})


def test_ratios_are_taken_within_rounds_and_their_median_counts(tmp_path: Path) -> None:
    samples = {
        (JSON1, RLSERVO): [sample(0.3), sample(3.0), sample(0.2)],  # the machine was slow in the second round
        (JSON1, BARE): [sample(0.2), sample(2.0), sample(0.2)],
        (JSON1, RLLIB): [sample(6.0), sample(60.0), sample(6.0)],
        (JSON16, RLSERVO): [sample(1.0, 4000.0)],
        (JSON16, BARE): [sample(1.0, 5000.0)],
        (JSON16, RLLIB): [sample(1.0, 100.0)],
        (ONES, RLSERVO): [sample(1.0, 4000.0)],
        (ONES, TWO): [sample(1.0, 5000.0)],
        (HEAVY, RLSERVO + DIRECTLY): [sample(1.0, 2000.0)],
        (HEAVY, TWO + DIRECTLY): [sample(1.0, 3300.0)],
    }
    result = Result(samples, {RLSERVO: 8.0, RLLIB: 16.0}, {RLSERVO: 100.0}, {RLSERVO: 800.0}, {"bentoml": "no network"})
    by_name = {verdict.what: verdict for verdict in verdicts(result)}
    bare = by_name["sequential JSON p50, over the bare server's"]
    assert bare.measured == pytest.approx(1.5) and bare.holds
    assert by_name["sequential JSON p50 of RLlib's example, over ours"].measured == pytest.approx(20.0)
    assert by_name["cold start to the first answer, over the RLlib example's"].measured == pytest.approx(0.5)
    two = by_name["requests/s of two replicas, over one's, single observations"]
    assert two.holds is False and "replica 0.50" in two.note
    assert by_name["requests/s of two replicas, over one's, batches of 64, direct port"].holds
    assert by_name["memory of a replica, over the RLlib example's"].holds is None  # the peer's was not measured
    facts = {"cores": 2, "rounds": 3, "seconds": 1, "load_average": (0.5, 0.5, 0.5)}
    text = report.markdown(result, facts)
    assert "MISSED: requests/s of two replicas" in text and "not measured: bentoml: no network" in text
    json.dumps(report.document(result, facts))
    report.chart(result, tmp_path / "chart.svg")
    assert "rlservo serve" in (tmp_path / "chart.svg").read_text()


def test_a_verdict_holds_up_to_its_bound_and_no_further() -> None:
    assert Verdict("a ratio", 1.6, at_most=1.6).holds and not Verdict("a ratio", 1.61, at_most=1.6).holds
    assert Verdict("a ratio", 1.5, at_least=1.5).holds and not Verdict("a ratio", 1.49, at_least=1.5).holds


def test_a_server_is_ended_with_what_it_started(tmp_path: Path, case: Case) -> None:
    """It starts a child in a session of its own that ignores SIGTERM, as some peers' workers do."""
    (port,) = free_ports(1)
    child = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
    script = tmp_path / "server.py"
    script.write_text(
        "import http.server, subprocess, sys\n"
        f"subprocess.Popen([sys.executable, '-c', {child!r}], start_new_session=True)\n"
        "class Answer(http.server.BaseHTTPRequestHandler):\n"
        "    def do_POST(self):\n"
        "        self.send_response(200)\n"
        "        self.end_headers()\n"
        "        self.wfile.write(b'{}')\n"
        f"http.server.HTTPServer(('127.0.0.1', {port}), Answer).serve_forever()\n"
    )
    peer = Server("peer", [sys.executable, str(script)], port, plain(case, "/"))
    with running(peer, tmp_path, "a-mark-of-this-test"):
        assert peer.cold_start_s > 0
        started = set(peer.members())
        assert len(started) == 2
    assert not listening(port)
    assert not started & processes().keys()


# The soak


def test_soak_asks_every_protocol_and_finds_no_wrong_answer(server: Server, case: Case) -> None:
    with ExitStack() as cleanup:
        asks = mix(case, server, cleanup)
        counts, failures, _ = soak(asks, server, 2.0, 60.0, Console(quiet=True))
    assert not failures
    assert set(counts) == set(asks) and sum(counts.values()) <= 125  # the rate is a bound


def test_soak_counts_what_is_answered_wrongly(server: Server, case: Case) -> None:
    wrong = Case(case.bundle, case.checkpoint, case.obs, case.action + 1)
    with ExitStack() as cleanup:
        asks = mix(wrong, server, cleanup)
        _, failures, _ = soak({"json": asks["json"]}, server, 0.2, 50.0, Console(quiet=True))
    assert isinstance(failures, Counter) and failures and "a wrong action" in next(iter(failures))


def test_growth_is_a_line_after_the_warm_up() -> None:
    times = [float(t) for t in range(0, 600, 5)]
    settled = Track("replica", REPLICA, times, [100.0 + min(t, 100.0) for t in times])  # grows, then is flat
    leaking = Track("replica", REPLICA, times, [100.0 + t / 60 for t in times])  # a megabyte a minute
    assert abs(settled.growth(180.0)[0]) < 0.01
    growth, slope = leaking.growth(180.0)
    assert slope == pytest.approx(60.0) and growth == pytest.approx(415 / 60)


def test_soak_begins_when_every_replica_has_answered(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak_module, "SETTLE_S", 0.0)
    soak_module.settle(server, 1)
    monkeypatch.setattr(soak_module, "START_S", 0.3)
    with pytest.raises(SystemExit, match="did not start 2 replicas"):
        soak_module.settle(server, 2)  # there is one


def test_the_most_robots_have_connected_before_the_first_is_closed_for_its_silence() -> None:
    slowest = min(PLANNED_HZ)
    assert MOST_ROBOTS * CONNECT_S + 1 / slowest < HEAD_S
