"""A client's trace in reply, log and recording, and its spans at a collector that speaks OTLP.

The format of the header is W3C's (https://www.w3.org/TR/trace-context/), the collector reads OpenTelemetry's messages.
"""

from __future__ import annotations

import http.server
import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest

from grpc_calls import infer_request
from rlservo import PolicyClient, StreamClient
from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording
from servers import Run, exchange, launched
from streams import Stream
from waiting import wait_for

collector = pytest.importorskip("opentelemetry.proto.collector.trace.v1.trace_service_pb2")
pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
TracerProvider = pytest.importorskip("opentelemetry.sdk.trace").TracerProvider
pytestmark = [pytest.mark.serve, pytest.mark.slow]

TRACES = [f"{number:032x}" for number in (0xA1, 0xB2, 0xC3, 0xD4)]
SPAN = "00f067aa0ba902b7"
ACT = "/v1/policies/ur5/act"
OBS = [0.1] * 27


def parent(trace: str, flags: str = "01") -> str:
    return f"00-{trace}-{SPAN}-{flags}"


@pytest.fixture
def spans() -> Iterator[tuple[str, dict[str, Any]]]:
    """A collector: its URL, and the spans it got, by trace."""
    got: dict[str, Any] = {}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            content = self.rfile.read(int(self.headers["content-length"]))
            for resource in collector.ExportTraceServiceRequest.FromString(content).resource_spans:
                names = {each.key: each.value.string_value for each in resource.resource.attributes}
                for scope in resource.scope_spans:
                    got.update({span.trace_id.hex(): (names["service.name"], span) for span in scope.spans})
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None: ...

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", got
        server.shutdown()
        thread.join()


def act_over_grpc(run: Run, trace: str) -> dict[str, Any]:
    with grpc.insecure_channel(f"127.0.0.1:{run.grpc_port}") as channel:
        stub = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
        _, call = stub.with_call(
            infer_request([OBS]).SerializeToString(), metadata=[("traceparent", parent(trace))], timeout=20
        )
        return dict(call.trailing_metadata())


def test_a_request_is_followed_from_the_client_to_the_network(
    ur5: Path, tmp_path: Path, spans: tuple[str, dict[str, Any]]
) -> None:
    url, got = spans
    settings = {
        "tracing": True, "record": str(tmp_path / "recorded"), "log_file": str(tmp_path / "log"), "log_requests": True,
    }  # fmt: skip
    variables = {"OTEL_EXPORTER_OTLP_ENDPOINT": url, "OTEL_BSP_SCHEDULE_DELAY": "200"}
    answered, refused, streamed, called = TRACES
    with launched(ur5, with_grpc=True, settings=settings, **variables) as run:
        run.wait_until_ready()
        began = time.time_ns()
        reply = exchange(run.port, "POST", ACT, {"obs": OBS, "seq": 7}, traceparent=parent(answered))
        assert (reply.status, dict(reply.headers)["traceparent"]) == (200, parent(answered))
        assert exchange(run.port, "POST", ACT, {"obs": [0.1]}, traceparent=parent(refused)).status == 422
        with Stream(run.port, "/v1/policies/ur5/stream", traceparent=parent(streamed)) as stream:
            assert "actions" in stream.ask(obs=OBS)
        assert act_over_grpc(run, called)["traceparent"] == parent(called)
        for other in ("00-" + "0" * 32 + f"-{SPAN}-01", f"ff-{answered}-{SPAN}-01", "x", parent("b" * 32, "00")):
            reply = exchange(run.port, "POST", ACT, {"obs": OBS}, traceparent=other)
            assert reply.status == 200 and ("traceparent" in dict(reply.headers)) == (other[3:6] == "bbb")
        wait_for(lambda: set(TRACES) <= set(got), "the spans")
        ended = time.time_ns()
        assert run.end(signal.SIGINT) == 0
    for trace in TRACES:
        service, span = got[trace]
        about = {each.key: each.value.string_value or each.value.int_value for each in span.attributes}
        assert (service, span.name, span.parent_span_id.hex()) == ("rlservo", "act ur5", SPAN)
        assert began <= span.start_time_unix_nano < span.end_time_unix_nano <= ended
        assert span.kind == span.SPAN_KIND_SERVER and span.span_id.hex() != SPAN
        assert (about["rlservo.code"] == "ok") == (trace != refused) == (span.status.code != 2)
        if trace != refused:
            assert about["rlservo.version"] == "10"
    seven = {each.key: each.value for each in got[answered][1].attributes}
    assert seven["rlservo.seq"].int_value == 7
    taken_ms = (got[answered][1].end_time_unix_nano - got[answered][1].start_time_unix_nano) / 1e6
    assert 0 < seven["rlservo.infer_ms"].double_value <= taken_ms
    # A client that does not sample asks for no span; the three that are no contexts begin traces of their own.
    assert "b" * 32 not in got
    assert sum(not span.parent_span_id for _, span in got.values()) == 3
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert {line["trace_id"] for line in lines if "trace_id" in line} == {*TRACES, "b" * 32}
    recorded = [
        trace
        for episode in episodes(Recording(tmp_path / "recorded"))
        for trace in episode.field("trace_id")
        if trace is not None
    ]
    assert sorted(recorded) == sorted([answered, streamed, called, "b" * 32])  # one observation fits no recording


def test_our_clients_requests_belong_to_the_callers_span(ur5: Path, tmp_path: Path) -> None:
    """Without OpenTelemetry on the server: the log and the recording have the trace."""
    settings = {"log_file": str(tmp_path / "log"), "log_requests": True}
    with launched(ur5, settings=settings) as run:
        run.wait_until_ready()
        url = f"http://127.0.0.1:{run.port}"
        with PolicyClient(url, "ur5", timeout_s=20) as client:
            client.act(OBS)
            with TracerProvider().get_tracer("robot").start_as_current_span("step") as step:
                client.act(OBS)
                with StreamClient(url, "ur5", timeout_s=20) as stream:
                    stream.act(OBS)
            client.act(OBS)
        assert run.end(signal.SIGINT) == 0
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    traces = [line.get("trace_id") for line in lines if line["message"] == "answered"]
    mine = f"{step.get_span_context().trace_id:032x}"
    assert traces == [None, mine, mine, None]


def test_a_collector_that_is_away_stops_nothing(ur5: Path) -> None:
    with launched(ur5, settings={"tracing": True}, OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:1") as run:
        run.wait_until_ready()
        for _ in range(20):
            assert exchange(run.port, "POST", ACT, {"obs": OBS}).status == 200
        assert run.end(signal.SIGINT) == 0
