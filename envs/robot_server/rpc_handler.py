"""gRPC handler of robo-gym's services: every failure is a reply and a line in the log.

robo-gym repeats a refused request ten times: the same failure within a minute is not logged again. Requests are parsed
by the calls rather than by gRPC, so that garbage is answered like every other error.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

import grpc
from google.protobuf.message import DecodeError

REPEATED_S = 60.0


def rpc_handler(
    service: str, calls: Mapping[str, Callable[[bytes], Any]], fail: Callable[[str, str], Any], log: logging.Logger
) -> grpc.GenericRpcHandler:
    """Return the handler for a gRPC server; `fail` makes the reply from a failed call's name and the reason."""
    last, last_at = "", 0.0

    def is_new(line: str) -> bool:
        nonlocal last, last_at
        before, before_at = last, last_at
        last, last_at = line, time.monotonic()
        return line != before or last_at - before_at > REPEATED_S

    def answering(name: str, call: Callable[[bytes], Any]) -> grpc.RpcMethodHandler:
        def answer(request: bytes, _context: grpc.ServicerContext) -> bytes:
            try:
                message = call(request)
            except (DecodeError, ValueError) as error:
                is_garbage = isinstance(error, DecodeError)
                reason = f"{len(request)} bytes that are not a valid message" if is_garbage else str(error)
                if is_new(f"{name}: {reason}"):
                    log.error("%s: %s", name, reason)
                message = fail(name, reason)
            except Exception as error:
                log.exception("%s failed", name)
                message = fail(name, f"{type(error).__name__} in the server, see its log")
            reply: bytes = message.SerializeToString()
            return reply

        return grpc.unary_unary_rpc_method_handler(answer)

    return grpc.method_handlers_generic_handler(service, {name: answering(name, call) for name, call in calls.items()})
