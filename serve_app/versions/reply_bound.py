"""Bound of what a storage's replies may bring within one call: a server that sends without end would fill memory.

s3fs, gcsfs, adlfs and fsspec's HTTP file system all read replies by aiohttp's `StreamReader.read()`, and only two of
them let their caller choose another class. So that one method is replaced; where no bound is set (any other user of
aiohttp in this process), it is aiohttp's own. What counts is what a compressed reply unpacks to, piece by piece.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from contextvars import ContextVar

PIECE = 1 << 16  # [bytes]


class TooMuchError(Exception):
    """The replies of a call bring more than they may."""


class ReplyBound:
    """Bytes that each reply of a call may bring (it may be asked again, after a connection broke), or all together."""

    def __init__(self, most: int, *, of_all: bool) -> None:
        self._most = self._left = most
        self._of_all = of_all
        self._reader: object = None
        self.is_exceeded = False
        """Whether more came; the error itself may have been wrapped by whoever read."""

    def spend(self, reader: object, size: int) -> None:
        """Count bytes of a reply. Raises TooMuchError."""
        if reader is not self._reader and not self._of_all:
            self._reader, self._left = reader, self._most
        self._left -= size
        if self._left < 0:
            self.is_exceeded = True
            raise TooMuchError


_bound: ContextVar[ReplyBound | None] = ContextVar("reply_bound", default=None)


@contextlib.contextmanager
def bounded_replies(most: int, *, of_all: bool) -> Iterator[ReplyBound]:
    """Bound what is read inside, in this thread and in the tasks that fsspec begins for it."""
    bound = ReplyBound(most, of_all=of_all)
    token = _bound.set(bound)
    try:
        yield bound
    finally:
        _bound.reset(token)


@functools.cache
def bound_aiohttp() -> None:
    """Make aiohttp's readers keep to the bounds; once for the process."""
    try:
        from aiohttp import StreamReader
    except ImportError:  # no file system of the network is installed
        return
    read_of_aiohttp = StreamReader.read

    async def read(self: StreamReader, n: int = -1) -> bytes:
        bound = _bound.get()
        if bound is None:
            return await read_of_aiohttp(self, n)
        pieces = []
        while piece := await read_of_aiohttp(self, PIECE if n < 0 else n):
            bound.spend(self, len(piece))
            pieces.append(piece)
            if n >= 0:
                break
        return b"".join(pieces)

    StreamReader.read = read  # type: ignore[method-assign]
