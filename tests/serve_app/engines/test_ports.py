"""Sentences about ports that are not available."""

from __future__ import annotations

import pytest

from rlservo.errors import UsageError
from rlservo.serve_app.engines.ports import listen


def test_a_port_given_twice_is_not_another_process() -> None:
    with listen("127.0.0.1", 0) as first:
        port = first.getsockname()[1]
        with pytest.raises(
            UsageError, match=f"^port {port} is in use by this process itself, as by --port: choose another"
        ):
            listen("127.0.0.1", port, option="--grpc-port")
