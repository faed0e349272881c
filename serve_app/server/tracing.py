"""Spans of requests for OpenTelemetry, within the clients' traces."""

from __future__ import annotations

import os
import threading
import time

from rlservo.extras import needs_extra
from rlservo.serve_app.server.logs import OK
from rlservo.serve_app.sessions.request import TRACEPARENT, Request

CLOSE_S = 2.0  # [s]


class Tracing:
    """Sends a span of each request, with OpenTelemetry's own exporter in a thread of its own."""

    def __init__(self) -> None:
        """Raise UsageError if OpenTelemetry is not installed. Its own variables (OTEL_...) say where spans go."""
        with needs_extra("tracing", what="tracing"):
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
            from opentelemetry.trace import SpanKind, StatusCode
            from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator
        own = {} if "OTEL_SERVICE_NAME" in os.environ else {"service.name": "rlservo"}
        self._provider = TracerProvider(resource=Resource.create(own), shutdown_on_exit=False)
        self._provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._tracer = self._provider.get_tracer("rlservo")
        self._context = TraceContextTextMapPropagator()
        self._server, self._error = SpanKind.SERVER, StatusCode.ERROR

    def note(
        self, request: Request, code: str, name: str, version: str | None, taken_s: float, infer_ms: float | None
    ) -> None:
        """Note a request that was answered or refused now, `taken_s` after it arrived."""
        given = {"traceparent": request.headers.get(TRACEPARENT), "tracestate": request.headers.get(b"tracestate")}
        context = self._context.extract({key: value.decode("latin-1") for key, value in given.items() if value})
        attributes = {
            "rlservo.protocol": request.protocol, "rlservo.policy": name, "rlservo.version": version,
            "rlservo.code": code, "rlservo.request_id": request.request_id, "rlservo.seq": request.seq,
            "rlservo.infer_ms": infer_ms,
        }  # fmt: skip
        known = {key: value for key, value in attributes.items() if value is not None}
        end = time.time_ns()
        span = self._tracer.start_span(
            f"act {name}", context, self._server, known, start_time=end - round(taken_s * 1e9)
        )
        if code != OK:
            span.set_status(self._error, code)
        span.end(end)

    def close(self) -> None:
        """Send what has not been sent, unless the collector takes longer: it must not hold up the end."""
        sending = threading.Thread(target=self._provider.shutdown, daemon=True)
        sending.start()
        sending.join(CLOSE_S)
