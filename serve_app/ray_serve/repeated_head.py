"""Head of a request that comes again: a robot asks a hundred times a second, and only the body's length varies.

Reading a head costs more than all else that a connection does: a dozen calls from the parser into Python. What the
parser made of one holds for every other that is the same byte by byte, but for two values that are looked at here: how
long the body is, and a proxy's stamp. All other requests are for the parser.
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from rlservo.serve_app.wire.request_stamp import STAMP

LENGTH = b"content-length"
VARYING = (LENGTH, STAMP.encode())
VALUES = re.compile(rb"(?<=\r\n)(%s|%s): ?([^\r\n]+)(?=\r\n)" % VARYING, re.IGNORECASE)
LONGEST = 128  # of such a value
OTHERWISE = frozenset({b"transfer-encoding", b"expect", b"upgrade", b"connection"})
"""Headers that change how a body is read, or what becomes of the connection."""
KEPT = (b"connection", b"keep-alive")  # which changes nothing


class RepeatedHead(NamedTuple):
    """What the parser made of a head, and where its varying values are."""

    begin: bytes
    """Up to the first of them."""
    values: tuple[tuple[int, bytes, bytes], ...]
    """Of each: its header's place and name, and the bytes from its end to the next one, or to the body."""
    scope: dict[str, Any]
    """Of the request that had it."""

    @classmethod
    def learn(cls, data: bytes, scope: Any) -> RepeatedHead | None:
        """Return what is known of the head of `data`, a whole request of this `scope`; None for an unusual one."""
        headers = scope["headers"]
        names = [name for name, _ in headers]
        end = data.find(b"\r\n\r\n") + 4
        matches = list(VALUES.finditer(data, 0, end - 2))
        found = [(match[1].lower(), match[2]) for match in matches]
        odd = not OTHERWISE.isdisjoint(name for name, value in headers if (name, value.lower()) != KEPT)
        if odd or scope["http_version"] != "1.1":
            return None
        if found != [header for header in headers if header[0] in VARYING]:
            return None
        if len(dict(found)) != len(found) or LENGTH not in dict(found):  # twice the same would be at one place
            return None
        starts = [match.start(2) for match in matches] + [end]
        ends = [0] + [match.end(2) for match in matches]
        begin, *rests = (data[since:until] for since, until in zip(ends, starts, strict=True))
        values = tuple((names.index(name), name, rest) for (name, _), rest in zip(found, rests, strict=True))
        known = cls(begin, values, {**scope, "headers": [*headers]})
        return known if known.read(data) else None

    def read(self, data: bytes) -> tuple[dict[str, Any], bytes] | None:
        """Return (scope, body) of `data` where that is one whole request with this head."""
        if not data.startswith(self.begin):
            return None
        at, length, headers = len(self.begin), -1, self.scope["headers"].copy()
        for place, name, rest in self.values:
            end = data.find(b"\r", at, at + LONGEST)
            if end < 0 or not data.startswith(rest, end):
                return None
            value = data[at:end]
            if name == LENGTH:
                if not value.isdigit():
                    return None
                length = int(value)
            elif not value.replace(b"-", b"").isalnum():
                return None
            headers[place] = (name, value)
            at = end + len(rest)
        if len(data) - at != length:
            return None
        return {**self.scope, "headers": headers}, data[at:]
