"""API keys, kept as hashes, and their roles; `access_checks.py` checks requests against them.

A key is 256 random bits, so storing its plain SHA-256 is enough: a dictionary attack is hopeless. A line of the
key file, or an entry of RLSERVO_API_KEYS (separated by commas), is

    <label> <act|explore|admin> sha256:<64 hexadecimal digits> [rate=<requests a second> [burst=<requests at once>]]

`rlservo key LABEL` makes a key and its line.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import secrets
import stat
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path

from typing_extensions import Self

from rlservo.bundle.regular_files import NotReadableError, blocks, open_regular
from rlservo.client.formats.addresses import is_loopback
from rlservo.errors import UsageError
from rlservo.serve_app.server.settings import ServerSettings

LINE = re.compile(
    r"(?P<label>[A-Za-z0-9][A-Za-z0-9._-]{0,63})\s+(?P<role>act|explore|admin)\s+sha256:(?P<digest>[0-9a-f]{64})"
    r"(?:\s+rate=(?![0.]+(?:\s|$))(?P<rate>[0-9]{1,6}(?:\.[0-9]{1,3})?)(?:\s+burst=(?P<burst>[1-9][0-9]{0,5}))?)?"
)
KEY_PREFIX = "rlservo_"  # so that scanners for leaked secrets recognise it
A_KEY = re.compile(re.escape(KEY_PREFIX) + r"[A-Za-z0-9_-]{16,}")
KEY_BYTES = 32
LONGEST_FILE = 1 << 20  # [bytes] of the key file: some ten thousand keys
SCHEMES = (b"bearer", b"api-key")  # openpi's clients send the second


class Role(str, Enum):
    """Role of a key; each role includes those before it."""

    act = "act"
    explore = "explore"
    """Also actions drawn from the policy's distribution, from which `rlservo learn` learns."""
    admin = "admin"


class Access(Enum):
    """Access to a route or a method."""

    open = "open"
    """Every client, without a key: probes of orchestrators, and web pages that hold no data of policies."""

    act = "act"
    """Clients with a key; if the server has no keys, all clients."""

    admin = "admin"
    """Clients with an admin key or the operator's; if the server has none, no one."""


@dataclass(frozen=True)
class RateLimit:
    """Rate limit of a key, on each replica."""

    rate: float  # requests a second
    burst: int  # requests at once, after a pause


@dataclass(frozen=True)
class Key:
    """A stored key: its hash, not the key itself."""

    label: str
    role: Role
    digest: bytes
    limit: RateLimit | None = None

    @property
    def may_explore(self) -> bool:
        return self.role is not Role.act


@dataclass(frozen=True)
class Keys:
    """The keys that a server accepts; if there are none, it requires none."""

    keys: tuple[Key, ...] = ()
    operator: Key | None = None
    """For administration; a server with only this key requires none for actions."""

    @cached_property
    def _by_digest(self) -> dict[bytes, Key]:
        return {key.digest: key for key in (*self.keys, *filter(None, [self.operator]))}

    def find(self, presented: bytes) -> Key | None:
        """Return the key that was presented. The time of a look-up by its SHA-256 helps no one to guess it."""
        return self._by_digest.get(hashlib.sha256(presented).digest())

    @classmethod
    def from_settings(cls, settings: ServerSettings, *, file_content: bytes | None = None) -> Self:
        """Read the file (unless its content is given) and the entries in the settings. Raises UsageError."""
        lines: list[tuple[str, str]] = []
        if settings.api_keys_file is not None:
            file = Path(settings.api_keys_file)
            lines += _lines(file, read_key_file(file) if file_content is None else file_content)
        entries = [entry.strip() for entry in settings.api_keys.split(",")]
        lines += [(f"entry {n} of RLSERVO_API_KEYS", entry) for n, entry in enumerate(entries, start=1) if entry]
        keys = []
        for where, line in lines:
            match = LINE.fullmatch(line)
            if match is None:  # the line is not shown: it may hold a key by mistake
                raise UsageError(
                    f"{where}: expected '<label> <act|explore|admin> sha256:<64 hexadecimal digits>', as 'rlservo key "
                    "LABEL' makes it, optionally followed by 'rate=<requests a second> burst=<requests>', each above 0"
                )
            limit = None
            if match["rate"] is not None:  # without a burst, one second's requests may come at once
                limit = RateLimit(float(match["rate"]), int(match["burst"] or math.ceil(float(match["rate"]))))
            keys.append(Key(match["label"], Role(match["role"]), bytes.fromhex(match["digest"]), limit))
        if (settings.api_keys_file is not None or settings.api_keys.strip()) and not keys:
            raise UsageError(
                "RLSERVO_API_KEYS and RLSERVO_API_KEYS_FILE hold no key and would leave the server open: add a key, or "
                "remove them"
            )
        digest = settings.operator_key.removeprefix("sha256:")
        return cls(tuple(keys), Key("operator", Role.admin, bytes.fromhex(digest)) if digest else None)


def without_keys(text: str) -> str:
    """Return a client's text with any keys in it replaced by dots."""
    return A_KEY.sub(f"{KEY_PREFIX}...", text)


def new_key(
    label: str, *, admin: bool = False, explore: bool = False, rate: float | None = None, burst: int | None = None
) -> tuple[str, str]:
    """Return (the key, for the client; its line, for the server). Raises UsageError."""
    if burst is not None and rate is None:
        raise UsageError("--burst needs a rate: also give the requests per second")
    role = "admin" if admin else "explore" if explore else "act"
    key = KEY_PREFIX + secrets.token_urlsafe(KEY_BYTES)
    line = f"{label} {role} sha256:{hashlib.sha256(key.encode()).hexdigest()}"
    if LINE.fullmatch(line) is None:
        raise UsageError(f"label {label[:80]!r}: expected 1 to 64 letters, digits, '.', '_' and '-'")
    line += "" if rate is None else f" rate={rate:.3f}".rstrip("0").rstrip(".")
    line += "" if burst is None else f" burst={burst}"
    if LINE.fullmatch(line) is None:
        raise UsageError("expected a rate of 0.001 to 999999 requests a second, and a burst of 1 to 999999")
    return key, line


def check_exposure(host: str, settings: ServerSettings) -> Keys:
    """Return the keys; raise UsageError if other machines could request actions without one."""
    keys = Keys.from_settings(settings)
    if not keys.keys and not settings.allow_unauthenticated and not is_loopback(host):
        raise UsageError(
            f"listening on {host} without API keys would let anyone who can reach this port request actions: make a "
            "key with 'rlservo key LABEL' and name its file in RLSERVO_API_KEYS_FILE, listen on 127.0.0.1, or set "
            "RLSERVO_ALLOW_UNAUTHENTICATED=1"
        )
    return keys


def read_key_file(file: Path) -> bytes:
    """Return the file's content. Raises UsageError if it cannot be read, or if every user can write it."""
    try:
        with open_regular(file, LONGEST_FILE) as stream:
            mode = os.fstat(stream.fileno()).st_mode
            content = b"".join(blocks(stream, LONGEST_FILE))
    except NotReadableError as error:
        raise UsageError(f"the key file {file} {error}") from None
    except OSError as error:
        raise UsageError(f"the key file {file} cannot be read: {error.strerror}") from None
    if mode & stat.S_IWOTH:
        raise UsageError(f"the key file {file} is writable by every user of this machine: run chmod o-w {file}")
    return content


def _lines(file: Path, content: bytes) -> list[tuple[str, str]]:
    try:
        lines = content.decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"the key file {file} cannot be read: {error}") from None
    stripped = ((number, line.strip()) for number, line in enumerate(lines, start=1))
    return [(f"{file}, line {number}", line) for number, line in stripped if line and not line.startswith("#")]
