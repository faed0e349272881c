"""The end of a process whose collector of spans does not answer."""

from __future__ import annotations

import socket
import threading

import pytest

from rlservo.serve_app.server.tracing import Tracing
from rlservo.serve_app.sessions.request import Request

pytest.importorskip("opentelemetry.exporter.otlp.proto.http")


def test_a_collector_that_never_answers_does_not_hold_up_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as hole:
        hole.settimeout(60)
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{hole.getsockname()[1]}")
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "600")
        tracing = Tracing()
        tracing.note(Request("rest"), "ok", "ur5", "1", 0.01, 1.0)
        closing = threading.Thread(target=tracing.close, daemon=True)
        closing.start()
        connection, _ = hole.accept()
        with connection:
            assert connection.recv(1 << 16)  # the span is being sent
            closing.join(15)  # OpenTelemetry itself waits 30 s
            assert not closing.is_alive()
