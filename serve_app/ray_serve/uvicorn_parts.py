"""uvicorn's and websockets' private names that a replica's connections need, looked up in one place, as `ray_parts.py`.

Where one is gone, the start is refused with the version and the name. docs/operations.md, "What must change for the
next Ray", says what each is for.
"""

from __future__ import annotations

import uvicorn
from websockets.version import version as websockets_version

UVICORN = "0.54"
"""The uvicorn these names are of."""


def refusal(name: str) -> RuntimeError:
    """Return the error for a name that is missing."""
    return RuntimeError(
        f"uvicorn {uvicorn.__version__} (with websockets {websockets_version}) has no {name}, without which a "
        f"replica's connections have no time-outs: install a uvicorn that this version of rlservo knows, such as "
        f"{UVICORN}"
    )


try:
    from uvicorn.protocols.http import auto
    from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle
    from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

    # In C where that is there; neither mypy nor pyright takes it for the module's own.
    from websockets.frames import apply_mask  # type: ignore[attr-defined]  # pyright: ignore[reportPrivateImportUsage]
    from websockets.protocol import OPEN
    from websockets.server import ServerProtocol
except ImportError as missing:  # its name is in the sentence of Python's
    raise refusal(f"what this imports: {missing}") from None

__all__ = [
    "OPEN",
    "STATUS_LINE",
    "HttpToolsProtocol",
    "RequestResponseCycle",
    "WebSocketsSansIOProtocol",
    "apply_mask",
    "auto",
    "check",
]

METHODS: dict[type, tuple[str, ...]] = {
    HttpToolsProtocol: (
        *("_should_upgrade", "_start_asgi_task", "_unset_keepalive_if_required", "handle_websocket_upgrade"),
        *("on_message_begin", "on_headers_complete", "on_message_complete", "on_response_complete"),
        *("send_400_response", "shutdown"),
    ),
    RequestResponseCycle: ("run_asgi", "send"),
    WebSocketsSansIOProtocol: (
        "handle_cont",
        "handle_ping",
        "handle_pong",
        "receive",
        "run_asgi",
        "send",
        "stop_keepalive",
    ),
    ServerProtocol: ("data_to_send", "fail", "state"),
}
"""What is overridden or called."""

FIELDS: dict[type, tuple[str, ...]] = {
    HttpToolsProtocol: (
        *("access_log", "access_logger", "app", "client", "config", "cycle", "flow", "headers", "logger", "loop"),
        *("parser", "pipeline", "scope", "server_state", "tasks", "timeout_keep_alive", "transport"),
        "ws_protocol_class",
    ),
    RequestResponseCycle: (
        *("body", "chunked_encoding", "default_headers", "disconnected", "expected_content_length", "flow"),
        *("keep_alive", "message_event", "more_body", "on_response", "response_complete", "response_started"),
        *("scope", "transport"),
    ),
    WebSocketsSansIOProtocol: (
        *("client", "close_sent", "conn", "disconnected", "handshake_initiated", "loop", "queue", "read_paused"),
        *("transport", "writable"),
    ),
}
"""What is read or set of an object."""


def check() -> None:
    """Raise RuntimeError where this uvicorn lacks a name that is needed."""
    if auto.AutoHTTPProtocol is not HttpToolsProtocol and not issubclass(auto.AutoHTTPProtocol, HttpToolsProtocol):
        raise refusal("httptools")
    for kind, names in METHODS.items():
        for name in names:
            if not hasattr(kind, name):
                raise refusal(f"{kind.__name__}.{name}")
    for kind, names in FIELDS.items():
        set_by_init = vars(kind)["__init__"].__code__.co_names  # of an object there is none yet
        for name in names:
            if name not in set_by_init:
                raise refusal(f"{kind.__name__}.{name}")
