"""WebSocket connection to a policy server: binary frames, each sent and read within a deadline.

The HTTP client shakes hands. The package `websockets` provides the protocol without input and output; the socket's
operations all end at the given deadline, even if nothing arrives, half a frame, or one byte at a time.
"""

from __future__ import annotations

import contextlib
import socket
import time

from rlservo.export.contract.errors import DeadlineError, UnavailableError
from rlservo.export.contract.extras import needs_extra
from rlservo.serve_app.client.http_transport import Transport
from rlservo.serve_app.client.replies import decode_error

with needs_extra("client", what="the WebSocket client"):
    from websockets.client import ClientProtocol
    from websockets.datastructures import Headers
    from websockets.exceptions import InvalidHandshake
    from websockets.frames import Frame, Opcode
    from websockets.http11 import Response
    from websockets.protocol import Protocol, Side
    from websockets.uri import parse_uri

MAX_FRAME_BYTES = 64 << 20  # larger than any action or contract
RECEIVE_BYTES = 65536


class WebSocket:
    """An open connection; any failure closes it and raises BrokenError."""

    def __init__(self, transport: Transport, path: str, deadline: float) -> None:
        """Shake hands by `deadline` (`time.monotonic`).

        Raises BrokenError, DeadlineError, or what the server names.
        """
        self._url = url = transport.url
        client = ClientProtocol(parse_uri(f"{url}{path}"))
        offered = [(n.encode(), v.encode()) for n, v in client.connect().headers.raw_items() if n != "Host"]
        try:
            self._response, first = transport.upgrade(path, offered, deadline)
        except UnavailableError as error:
            raise BrokenError(error.message, error.details) from error
        if self._response.status != 101:
            raise decode_error(url, self._response.status, first)
        self._socket: socket.socket = self._response.extensions["network_stream"].get_extra_info("socket")
        self._protocol = Protocol(Side.CLIENT, max_size=MAX_FRAME_BYTES)
        self._pieces: list[bytes] = []
        self._text = False
        headers = Headers([(name.decode("latin-1"), value.decode("latin-1")) for name, value in self._response.headers])
        try:
            client.process_response(Response(101, "", headers))
        except InvalidHandshake as failure:
            self.close()
            raise BrokenError(f"{url} is not a stream ({failure}): is it an rlservo server?") from failure
        self._protocol.receive_data(first)
        self._events = self._protocol.events_received()
        self.last_receive_at = time.monotonic()
        """Time of the server's last bytes."""

    def send(self, content: bytes, deadline: float) -> None:
        """Send one binary frame. Raises BrokenError or DeadlineError; the connection is then closed."""
        try:
            self._protocol.send_binary(content)
            self._flush(deadline)
        except TimeoutError:
            self.close()  # half a frame has been sent: nothing can follow it
            raise DeadlineError(f"{self._url} did not take the request in time") from None
        except Exception as error:  # the protocol refuses to send on a closed connection
            self.close()
            raise BrokenError(f"{self._url} dropped the connection: {error}") from error

    def receive(self, deadline: float) -> bytes | str:
        """Return the next message.

        Raises DeadlineError if it was not complete in time (the connection stays open, and a later call continues), or
        BrokenError if the connection is lost.
        """
        while True:
            while self._events:
                message = self._message(self._events.pop(0))
                if message is not None:
                    return message
            try:
                self._receive_bytes(deadline)
                self._events += self._protocol.events_received()
                self._flush(deadline)  # the reply to a ping or a close
            except TimeoutError:
                raise DeadlineError(f"{self._url} did not answer in time") from None
            except OSError as error:
                self.close()
                raise BrokenError(f"{self._url} dropped the connection: {error}") from error
            if not self._events and self._protocol.state.name in ("CLOSING", "CLOSED"):
                code = self._protocol.close_code
                self.close()
                raise BrokenError(f"{self._url} closed the connection (code {code})")

    def close(self) -> None:
        """Close, with a close frame if it can be sent without waiting."""
        with contextlib.suppress(Exception):
            self._protocol.send_close(1000)
            self._flush(time.monotonic() + 0.05)
        with contextlib.suppress(OSError):
            self._response.close()

    def _message(self, frame: object) -> bytes | str | None:
        """Return a message when `frame` completes one."""
        if not isinstance(frame, Frame) or frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
            return None
        if frame.opcode is not Opcode.CONT:
            self._pieces, self._text = [], frame.opcode is Opcode.TEXT
        self._pieces.append(bytes(frame.data))
        if not frame.fin:
            return None
        content = b"".join(self._pieces)
        return content.decode("utf-8", "replace") if self._text else content

    def _receive_bytes(self, deadline: float) -> None:
        self._socket.settimeout(_remaining(deadline))
        data = self._socket.recv(RECEIVE_BYTES)
        self.last_receive_at = time.monotonic()
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()

    def _flush(self, deadline: float) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._socket.settimeout(_remaining(deadline))
                self._socket.sendall(data)


class BrokenError(UnavailableError):
    """The connection is missing or closed: a new one may be opened."""

    code = "connection-broken"


def _remaining(deadline: float) -> float:
    remaining = deadline - time.monotonic()
    if remaining <= 0:
        raise TimeoutError("the deadline has passed")
    return remaining
