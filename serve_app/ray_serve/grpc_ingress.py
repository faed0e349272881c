"""Registration of the Open Inference Protocol with Ray Serve's gRPC servers: methods, and raw bytes.

`grpc_options.grpc_servicer_functions: [rlservo.serve_app.ray_serve.grpc_ingress:add_service]` names it to Serve, whose
proxies and replicas import it: it needs nothing but grpcio. `oip_grpc.py` has the methods.

Serve passes a request on to the replica's method of the same name. Messages stay bytes until they are there: garbage
is then answered like every other error, and Ray's own proxy (which pickles what it passes on) needs no message classes.

In a replica, calls go straight to the methods, as HTTP requests for actions do (`ingress.py`, which says why): what
Serve does with one takes longer than the rest of it. Streams go by way of Serve.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import grpc

SERVICE = "inference.GRPCInferenceService"
UNARY = (
    "ServerLive",
    "ServerReady",
    "ServerMetadata",
    "ModelReady",
    "ModelMetadata",
    "ModelConfig",
    "ModelStatistics",
    "ModelInfer",
    "RepositoryIndex",
)
STREAMS = ("ModelStreamInfer",)
Incoming = tuple[bytes, float | None]  # a request, and how many seconds its caller still waits for the answer
APPLICATION = "application"  # metadata that names one of Serve's applications: Serve refuses another's
LONGEST_S = 86400.0  # [s] gRPC says "no deadline" as one far away


def add_service(_servicer: Any, server: Any) -> None:
    """Register the service's methods at one of Serve's gRPC servers."""
    handlers = {name: grpc.unary_unary_rpc_method_handler(_nothing) for name in UNARY}
    handlers |= {name: grpc.stream_stream_rpc_method_handler(_nothing) for name in STREAMS}
    service: Any = grpc.method_handlers_generic_handler(SERVICE, handlers)
    server.add_generic_rpc_handlers((service,))
    # Serve has put its own functions in by now, and does not tell them the caller's deadline (ray 2.60).
    if not hasattr(service, "_method_handlers"):
        raise RuntimeError(
            f"grpcio {grpc.__version__} keeps a service's methods in another way than 1.85 does: install such a one"
        )
    for path, handler in service._method_handlers.items():
        if not handler.request_streaming:
            name = path.rpartition("/")[2]
            service._method_handlers[path] = handler._replace(unary_unary=_with_deadline(name, handler.unary_unary))


class ServeBypass:
    """What answers the calls of this process, where it is a replica's."""

    def __init__(self) -> None:
        """Leave everything to Serve, as in a proxy."""
        self._answer: Callable[[str, Incoming, Any], Awaitable[Any]] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def install(self, answer: Callable[[str, Incoming, Any], Awaitable[Any]]) -> None:
        """From now on, in this event loop, let `answer` make the reply's message."""
        self._answer, self._loop = answer, asyncio.get_running_loop()

    def find(self) -> Callable[[str, Incoming, Any], Awaitable[Any]] | None:
        """Return what answers a call in this event loop; None where Serve does."""
        return self._answer if asyncio.get_running_loop() is self._loop else None


bypass = ServeBypass()


def _with_deadline(
    name: str, serve: Callable[[Any, Any], Awaitable[bytes]]
) -> Callable[[bytes, Any], Awaitable[bytes]]:
    async def call(content: bytes, context: Any) -> bytes:
        remaining = context.time_remaining()
        incoming = (content, None if remaining is None or remaining > LONGEST_S else remaining)
        answer = bypass.find()
        if answer is None or any(key == APPLICATION for key, _ in context.invocation_metadata() or ()):
            return await serve(incoming, context)
        reply: bytes = (await answer(name, incoming, context)).SerializeToString()
        return reply

    return call


def _nothing(_request: Any, _context: Any) -> None:
    """Serve puts its own function in this one's place."""
