"""WebSocket connection to a policy server: binary frames, each sent and read within a deadline.

The HTTP client shakes hands. The package `websockets` provides the protocol without input and output; the socket's
operations all end at the given deadline, even if nothing arrives, half a frame, or one byte at a time.
"""

from __future__ import annotations

import contextlib
import time

from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.uri import parse_uri

from rlservo.client.http_transport import MAX_REPLY_BYTES, BrokenError, Transport
from rlservo.client.replies import decode_error
from rlservo.errors import DeadlineError


class WebSocket:
    """An open connection; any failure closes it and raises BrokenError."""

    def __init__(self, transport: Transport, path: str, deadline: float) -> None:
        """Shake hands by `deadline` (`time.monotonic`).

        Raises BrokenError, DeadlineError, or what the server names.
        """
        self._url = url = transport.url
        self._protocol = ClientProtocol(parse_uri(f"{url}{path}"), max_size=MAX_REPLY_BYTES)
        offered = self._protocol.connect().headers.raw_items()
        fields = "".join(f"{name}: {value}\r\n" for name, value in offered if name != "Host").encode()
        response = self._connection = transport.exchange("GET", path, fields, None, deadline)
        if response.status != 101:
            response.close()
            raise decode_error(url, response.status, bytes(response.body))
        self._frames: list[Frame] = []  # of an incomplete message
        head = b"".join(b"%s: %s\r\n" % header for header in response.headers)
        self._protocol.receive_data(b"HTTP/1.1 101 Switching Protocols\r\n%s\r\n%s" % (head, response.rest))
        self._events = self._protocol.events_received()
        if self._protocol.handshake_exc is not None:
            self.close()
            raise BrokenError(f"{url} is not a stream ({self._protocol.handshake_exc}): is it an rlservo server?")

    @property
    def last_receive_at(self) -> float:
        """Time of the server's last bytes."""
        return self._connection.used_at

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
                frame = self._events.pop(0)
                if isinstance(frame, Frame) and frame.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                    self._frames.append(frame)
                    if frame.fin:
                        frames, self._frames = self._frames, []
                        content = b"".join(each.data for each in frames)
                        return content.decode("utf-8", "replace") if frames[0].opcode is Opcode.TEXT else content
            try:
                if data := self._connection.read(deadline):
                    self._protocol.receive_data(data)
                else:
                    self._protocol.receive_eof()
                self._events += self._protocol.events_received()
                self._flush(deadline)  # the reply to a ping or a close
            except TimeoutError:
                raise DeadlineError(f"{self._url} did not answer in time") from None
            except ConnectionError as error:
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
        self._connection.close()

    def _flush(self, deadline: float) -> None:
        self._connection.send(b"".join(self._protocol.data_to_send()), deadline)
