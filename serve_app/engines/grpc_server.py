"""gRPC server of the Open Inference Protocol, in the HTTP server's event loop, with gRPC's own health service."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import methodcaller
from typing import Any

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from rlservo.client.formats.addresses import is_loopback
from rlservo.errors import UnavailableError
from rlservo.serve_app.protocols.open_inference.grpc_service import Grpc
from rlservo.serve_app.protocols.open_inference.oip_messages import SERVICE, STREAM, UNARY
from rlservo.serve_app.server.request_handler import RequestHandler

LONGEST_S = 86400.0  # [s] gRPC expresses "no deadline" as one far away
DRAIN_S = 5.0
OVERHEAD_BYTES = 4096  # of a message in addition to `max_body_bytes`
MAX_CALLS = 1024


class GrpcServer:
    """Serves one process's gRPC calls."""

    def __init__(self, handler: RequestHandler, host: str, port: int, *, is_shared: bool) -> None:
        """`is_shared`: whether several processes listen on the port, which the kernel then shares out."""
        settings = handler.settings
        self._address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self._grpc = Grpc(handler, local_only=is_loopback(host))
        self._server = grpc.aio.server(
            maximum_concurrent_rpcs=MAX_CALLS,
            options=[
                ("grpc.so_reuseport", int(is_shared)),
                ("grpc.max_receive_message_length", settings.max_body_bytes + OVERHEAD_BYTES),
                ("grpc.max_connection_idle_ms", int(settings.stream_idle_s * 1000)),
            ],
        )
        written: Callable[[Any], bytes] = methodcaller("SerializeToString")
        methods: dict[str, Any] = {
            name: grpc.unary_unary_rpc_method_handler(partial(self._answer, name), response_serializer=written)
            for name in UNARY
        }
        methods[STREAM] = grpc.stream_stream_rpc_method_handler(self._grpc.stream, response_serializer=written)
        self._server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, methods),))
        service: Any = health  # its asyncio part is not in its type stubs
        self._health = service.aio.HealthServicer()  # probed by orchestrators, without a key
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)

    async def start(self) -> None:
        """Listen, and report the health status "serving". Raises UnavailableError if it cannot listen on the port."""
        try:
            self._server.add_insecure_port(self._address)
        except RuntimeError as error:
            raise UnavailableError(f"gRPC cannot listen on {self._address}: {error}") from None
        await self._server.start()
        for service in ("", SERVICE):
            await self._health.set(service, health_pb2.HealthCheckResponse.SERVING)

    async def stop(self) -> None:
        """Report the health status "not serving", and end once the calls in progress are answered."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(DRAIN_S)

    async def _answer(self, name: str, content: bytes, context: Any) -> Any:
        remaining = context.time_remaining()
        deadline = None if remaining is None or remaining > LONGEST_S else remaining
        return await self._grpc.answer(name, content, context, deadline)
