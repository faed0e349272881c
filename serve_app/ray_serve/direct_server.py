"""Direct port: a replica's own HTTP server beside Serve's, for clients without a proxy in between.

It has the application, its checks and limits, and the connections of the replica's port behind HAProxy
(`http_connections.py`). What HAProxy does for those is done here: connections are bounded, altogether and by address,
and a request that waited for a replica to take its connection says since when.

Connections are taken one in a turn of the event loop, or a few where many are open. Several replicas take from one
queue (`direct_port.py`), and the one with less to do comes round sooner: that is how they share the load.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import logging
import socket
import struct
import time
from collections.abc import Awaitable
from email.utils import formatdate
from typing import Any

import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.server import ServerState

from rlservo.serve_app.protocols.http_endpoint import DirectMatch, PolicyApp
from rlservo.serve_app.ray_serve import ingress
from rlservo.serve_app.ray_serve.http_connections import TimedProtocol, refusal
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire.request_stamp import STAMP, clock_id

logger = logging.getLogger(__name__)

BACKLOG = 4096
SHARE = 8  # for so many open connections, one more is taken in a turn
MAX_CONNECTIONS = 4096  # beyond it, they wait in the kernel
OVER = 32  # connections of an address beyond its bound that are answered 429; further ones are closed without a word
KEEP_ALIVE_S = 90.0  # [s] that a connection may be idle, as on the replica's other port
DRAIN_S = 1.0  # [s] in which a client learns from its next reply that the connection ends
END_S = 5.0  # [s] after that for replies that are being written
PAUSE_S = 0.5  # [s] until the next attempt to take a connection, where descriptors or memory are short
POLL_S = 0.02
LAST_DATA_RECEIVED = 52  # in Linux' struct tcp_info: [ms] since when, an unsigned 32-bit number


class DirectServer:
    """Listens on the direct port for one replica."""

    def __init__(
        self, app: PolicyApp, listener: socket.socket, settings: ServerSettings, *, is_shared: bool = True
    ) -> None:
        """`is_shared`: whether others listen on the very same socket, so that nothing is lost when this one stops."""
        self._listener, self._is_shared = listener, is_shared
        self._per_address = settings.max_connections_per_address
        self._max_wait_s = settings.max_queue_ms / 1e3
        self.app = DirectApp(app)
        self._config = uvicorn.Config(
            self.app,
            lifespan="off",
            proxy_headers=False,  # nobody's X-Forwarded-For is believed
            access_log=False,
            log_config=None,
            log_level=None,
            timeout_keep_alive=int(KEEP_ALIVE_S),
        )
        self._config.load()
        self._state = ServerState()
        self._connections: dict[str, int] = {}  # by address
        self._total = 0
        self._beginnings: set[asyncio.Task[None]] = set()
        self._is_listening = False
        self._clock: asyncio.TimerHandle | None = None
        self._sentence = f"your address has more than {self._per_address} connections to this server: close some"
        self.is_draining = False

    def start(self) -> None:
        """Take connections in the running event loop from now on."""
        self._loop = asyncio.get_running_loop()
        self._listener.setblocking(False)
        self._listener.listen(BACKLOG)
        self._date()
        self._listen()

    async def drain(self) -> None:
        """Take no more connections, tell clients to go elsewhere, and return when the last one has its reply."""
        if self._clock is None:
            return
        self.is_draining = True
        if self._is_listening and not self._is_shared:
            while self._take():  # who waits in this queue waits for nobody else
                pass
        self._pause()
        self._listener.close()
        for connection in list(self._state.connections):
            connection.drain() if isinstance(connection, DirectConnection) else connection.shutdown()
        await self._wait_for_end(DRAIN_S)
        for connection in list(self._state.connections):
            connection.shutdown()
        await self._wait_for_end(END_S)
        for connection in list(self._state.connections):
            connection.transport.abort()
        self._clock.cancel()

    async def _wait_for_end(self, timeout_s: float) -> None:
        until = time.monotonic() + timeout_s
        while (self._state.connections or self._beginnings) and time.monotonic() < until:
            await asyncio.sleep(POLL_S)

    def _listen(self) -> None:
        if not self._is_listening and not self.is_draining:
            self._is_listening = True
            self._loop.add_reader(self._listener, self._take_some)

    def _pause(self) -> None:
        if self._is_listening:
            self._is_listening = False
            self._loop.remove_reader(self._listener)

    def _take_some(self) -> None:
        """Take a connection; with many open, whose requests make a turn long, some more."""
        for _ in range(1 + self._total // SHARE):
            if not self._take() or not self._is_listening:
                return

    def _take(self) -> bool:
        """Take one connection, if there is one."""
        try:
            connection, address = self._listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):  # another replica was quicker
            return False
        except OSError as error:
            logger.warning("no connection can be taken at the moment: %s", error)
            self._pause()
            self._loop.call_later(PAUSE_S, self._listen)
            return False
        peer = str(address[0])
        count = self._connections.get(peer, 0)
        if self._per_address and count >= self._per_address + OVER:
            connection.close()
            return True
        self._connections[peer] = count + 1
        self._total += 1
        if self._total >= MAX_CONNECTIONS:
            self._pause()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stamp = stamp_of(connection, self._max_wait_s)
        refuse = self._refuse if self._per_address and count >= self._per_address else None
        task = self._loop.create_task(self._begin(connection, peer, stamp, refuse))
        self._beginnings.add(task)
        task.add_done_callback(self._beginnings.discard)
        return True

    async def _begin(self, connection: socket.socket, peer: str, stamp: bytes | None, refuse: ASGIApp | None) -> None:
        make = functools.partial(
            DirectConnection, self, self._config, self._state, functools.partial(self._forget, peer), stamp, refuse
        )
        try:
            await self._loop.connect_accepted_socket(make, connection)
        except OSError:  # it has gone already
            connection.close()
            self._forget(peer)

    def _forget(self, peer: str) -> None:
        left = self._connections.get(peer, 0) - 1
        if left > 0:
            self._connections[peer] = left
        else:
            self._connections.pop(peer, None)
        self._total -= 1
        self._listen()

    async def _refuse(self, _scope: Scope, _receive: Receive, send: Send) -> None:
        body = json.dumps({"error": self._sentence, "code": "over-capacity"}, separators=(",", ":")).encode()
        await refusal(429, body, (b"retry-after", b"1"))(_scope, _receive, send)

    def _date(self) -> None:
        self._state.default_headers = [(b"date", formatdate(usegmt=True).encode())]
        self._clock = self._loop.call_later(1.0, self._date)


class DirectConnection(TimedProtocol):
    """A connection without a proxy before it."""

    def __init__(
        self,
        server: DirectServer,
        config: uvicorn.Config,
        state: ServerState,
        on_lost: Any,
        stamp: bytes | None,
        refuse: ASGIApp | None,
    ) -> None:
        """`stamp` is for a first request that has waited; `refuse` answers instead of the application."""
        super().__init__(config=config, server_state=state, app_state={})
        self._server = server
        self._on_lost = on_lost
        self._stamp = stamp
        self._refuse = refuse

    def on_headers_complete(self) -> None:
        """Begin to wait for the body."""
        if self._stamp is not None:
            self.headers.append((STAMP.encode(), self._stamp))
            self._stamp = None
        super().on_headers_complete()

    def client_id(self) -> object:
        """Return who asks: here a stamp is the client's own word."""
        return id(self)

    def drain(self) -> None:
        """End the connection with the next reply, or with the one that is being made."""
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.keep_alive = False

    def find_app(self, scope: Scope) -> ASGIApp | None:
        """Return what answers a request for an action; while draining none is answered so: replies end connections."""
        return None if self._server.is_draining else self._server.app.find(scope)

    def _start_asgi_task(self, cycle: Any, app: Any) -> None:
        if self._server.is_draining:
            cycle.keep_alive = False
        super()._start_asgi_task(cycle, app)


class DirectApp:
    """The replica's application as it is without Serve: no prefix, and no offer of a port that is in use already."""

    def __init__(self, app: PolicyApp) -> None:
        self._app = app

    def find(self, scope: Scope) -> ASGIApp | None:
        """Return what answers a request for an action, or a stream."""
        match = self._app.find_direct(scope, scope["path"])
        return None if match is None else functools.partial(self._answer, match)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one connection or request."""
        await (self.find(scope) or self._app.answer)(scope, receive, send)

    def _answer(self, match: DirectMatch, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        if scope["type"] == "http" and not self._app.admit_ahead():
            return ingress.turn_away(scope, receive, send)
        return self._app.answer_found(match, scope, receive, send)


def stamp_of(connection: socket.socket, limit_s: float) -> bytes | None:
    """Return a stamp for what a new connection has brought, where that has waited for longer than `limit_s`.

    While no replica takes connections the kernel does, and what they carry grows old there.
    """
    info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, LAST_DATA_RECEIVED + 4)
    (age_ms,) = struct.unpack_from("=I", info, LAST_DATA_RECEIVED)  # since the connection was made, before any data
    if age_ms / 1e3 <= limit_s:
        return None
    with contextlib.suppress(OSError):
        connection.setblocking(False)
        if connection.recv(1, socket.MSG_PEEK):
            return b"%d-%s-direct" % (time.time() * 1e3 - age_ms, clock_id().encode())
    return None
