"""Streams over WebSocket. Arrays are packed as openpi's client packs them, by code that is not rlservo's."""

from __future__ import annotations

import functools
import json
from typing import Any

import msgpack
import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import ConnectionClosed

ARRAY = b"__ndarray__"


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {ARRAY: True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return value


def _unpack_array(value: Any) -> Any:
    if ARRAY in value:
        return np.ndarray(buffer=value[b"data"], dtype=np.dtype(value[b"dtype"]), shape=value[b"shape"])
    return value


pack = functools.partial(msgpack.packb, default=_pack_array)
unpack = functools.partial(msgpack.unpackb, object_hook=_unpack_array)


class Stream:
    """A connection as openpi's WebsocketClientPolicy has it: metadata first, then request and response."""

    def __init__(self, port: int, path: str = "", **headers: str) -> None:
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        self._connection = websockets.sync.client.connect(
            f"ws://127.0.0.1:{port}{path}", compression=None, max_size=None, additional_headers=sent
        )
        self.socket = self._connection.__enter__()
        self.metadata = self._receive()

    def ask(self, **request: Any) -> Any:
        """Send a request; return the reply, or the document of an error: a text frame."""
        return self.exchange(pack(request))

    def exchange(self, content: bytes | str) -> Any:
        self.socket.send(content)
        return self._receive()

    def _receive(self) -> Any:
        received = self.socket.recv(timeout=60)
        return json.loads(received) if isinstance(received, str) else unpack(received)

    def close_code(self) -> int | None:
        """Return the code with which the server closes the connection."""
        with pytest.raises(ConnectionClosed):
            self.socket.recv(timeout=60)
        return self.socket.close_code

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.__exit__(None, None, None)
