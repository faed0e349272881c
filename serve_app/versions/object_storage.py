"""Objects below one URI in any storage that fsspec reads: s3://, gs://, az://, http(s)://, memory:// ...

Every call ends by itself: what takes longer than the time-out is an error, and an error is one sentence that names the
object. Credentials come from the environment and the provider's own chain, never from a URI. What a storage says of its
objects (sizes, ETags) is believed for nothing but looking again.
"""

from __future__ import annotations

import contextlib
import logging
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from rlservo.export.contract.errors import BundleError, UnavailableError, UsageError, first_line
from rlservo.serve_app.versions.reply_bound import bound_aiohttp, bounded_replies

logger = logging.getLogger(__name__)

BESIDE = 1 << 16  # [bytes] that a call's replies may bring beside what was asked for: metadata, errors
LISTING = 32 << 20  # [bytes] of a folder's list: S3 sends some 324 for each version of a policy
BLOCK = 8 << 20  # [bytes] asked for at once; each has the time-out for itself
SLOWEST = 256 << 10  # [bytes/s] by which a larger block may take longer than the time-out
SILENCE_S = 10.0  # [s] after which it is said what is waited for
READ_ONLY = ("http", "https")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+://")  # two letters and more: C:// would be a drive
_SECRETS = re.compile(
    r"[A-Za-z0-9+/=_.~%-]{32,}|\b(AKIA|ASIA)[A-Z0-9]+"
)  # tokens and signatures that a storage repeats


def is_uri(place: str | Path) -> bool:
    """Return whether a place is named by a protocol."""
    return isinstance(place, str) and _SCHEME.match(place) is not None


def place_of(place: str | Path) -> str:
    """Return an absolute folder (`file://` is one, too) or a URI that holds no secret. Raises UsageError."""
    if not is_uri(place):
        return str(Path(place).expanduser().absolute())
    uri = str(place).rstrip("/")
    parts = urlsplit(uri)
    if parts.password is not None:
        shown = uri.replace(parts.netloc, f"...@{parts.netloc.rpartition('@')[2]}")
        raise UsageError(f"{shown} holds a password: credentials come from the environment, never from the URI")
    if parts.query or parts.fragment:
        raise UsageError(
            f"{uri.partition('?')[0].partition('#')[0]}: a query or fragment may hold a secret: leave it out"
        )
    if "::" in uri:
        raise UsageError(f"{uri}: expected one protocol, such as s3://bucket/policies")
    if parts.scheme == "file":
        if parts.netloc not in ("", "localhost"):
            raise UsageError(f"{uri}: expected file:///absolute/path")
        return unquote(parts.path) or "/"
    return uri


class ObjectStorage:
    """Objects below one URI."""

    def __init__(self, uri: str, *, timeout_s: float = 15.0) -> None:
        self.uri = place_of(uri)
        self.timeout_s = timeout_s
        self._opened: tuple[Any, str] | None = None

    @property
    def is_read_only(self) -> bool:
        """Whether nothing can be written there."""
        return self.uri.partition("://")[0] in READ_ONLY

    def entries(self, name: str = "") -> dict[str, Any]:
        """Return what is directly below a folder, by name: for a file what changes with it (None: unknown), for a
        folder False. Empty where there is no such folder. Raises UnavailableError.
        """
        filesystem, _ = self._open()
        filesystem.invalidate_cache()
        try:
            entries = self._call(name, "ls", self._path(name) + "/" * self.is_read_only, detail=True, most=LISTING)
        except FileNotFoundError:
            return {}
        return {entry["name"].rstrip("/").rpartition("/")[2]: _stamp(entry) for entry in entries}

    def read(self, name: str, most: int) -> bytes:
        """Return at most `most` bytes of an object.

        Raises FileNotFoundError, UnavailableError, and BundleError where the storage sends more.
        """
        content: bytes = self._call(name, "cat_file", self._path(name), start=0, end=most, size=most, most=most)
        return content[:most]

    def blocks(self, name: str, size: int) -> Iterator[bytes]:
        """Yield the `size` bytes that an object should have.

        Raises FileNotFoundError, UnavailableError, and BundleError where the storage sends more.
        """
        done = 0
        while done < size:
            wanted = min(BLOCK, size - done)
            most = wanted if done else size  # a server that knows no ranges sends all of it at once
            block = self._call(
                name, "cat_file", self._path(name), start=done, end=done + wanted, size=wanted, most=most
            )
            if done == 0 and len(block) >= size:
                block = block[:size]
            elif len(block) != wanted:
                raise UnavailableError(f"{self.uri}/{name} ends after {done + len(block):,} of {size:,} bytes")
            done += len(block)
            yield block

    def create(self, name: str, content: bytes) -> bool:
        """Write an object that is not there; return False where the storage says that it is.

        A storage without conditional writes may overwrite it: whoever needs to know reads it again. Raises
        UnavailableError.
        """
        try:
            self._call(name, "pipe_file", self._path(name), content, mode="create", size=len(content))
        except FileExistsError:
            return False
        except FileNotFoundError as error:  # the bucket, say
            raise UnavailableError(f"{self.uri}/{name} cannot be written: {first_line(error)}") from None
        return True

    def _path(self, name: str) -> str:
        _, root = self._open()
        return f"{root}/{name}" if name else root

    def _open(self) -> tuple[Any, str]:
        """Return the file system and the root's path on it. Nothing is asked yet."""
        if self._opened is None:
            options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
            if self.uri.startswith("s3://"):  # botocore would try for longer than anybody waits, and not say why
                options["config_kwargs"] = {"connect_timeout": self.timeout_s / 2, "retries": {"max_attempts": 1}}
            try:
                import fsspec

                filesystem, root = fsspec.core.url_to_fs(self.uri, **options)
            except (ImportError, ValueError) as error:
                raise UsageError(
                    f"{self.uri} cannot be opened here: pip install 'rlservo[remote]' for s3:// and http(s)://; other "
                    f"protocols need fsspec's package for them ({first_line(error)})"
                ) from None
            bound_aiohttp()
            self._opened = filesystem, root.rstrip("/")
        return self._opened

    def _call(self, name: str, method: str, *arguments: Any, size: int = 0, most: int = 0, **options: Any) -> Any:
        """Call the file system, which may send or get `size` bytes and read `most`."""
        filesystem, _ = self._open()
        timeout_s = self.timeout_s + size / SLOWEST
        if filesystem.async_impl:
            options["timeout"] = timeout_s
        place = f"{self.uri}/{name}".rstrip("/")
        with bounded_replies(most + BESIDE, of_all=method == "ls") as bound:  # of which pages may come without end
            try:
                reply = getattr(filesystem, method)(*arguments, **options)
            except (FileNotFoundError, FileExistsError):
                if not bound.is_exceeded:
                    raise
            except Exception as error:  # each file system has errors of its own
                if not bound.is_exceeded:
                    raise UnavailableError(f"{place} {_reason(error, timeout_s)}") from None
            else:
                if not bound.is_exceeded:
                    return reply
        kind = BundleError if method == "cat_file" else UnavailableError
        raise kind(f"{place}: the storage sends more than the {most:,} bytes that it may")


def _reason(error: Exception, timeout_s: float) -> str:
    if "Timeout" in type(error).__name__:
        return f"gave no answer within {timeout_s:.0f} s"
    said = _SECRETS.sub("...", first_line(error))[:200]
    if isinstance(error, PermissionError) or "Credential" in type(error).__name__:
        return f"is refused with the credentials of this process's environment ({said})"
    if isinstance(error, NotImplementedError):
        return "is in a storage that is only read here"
    return f"cannot be reached or read: {said}"


def _stamp(entry: dict[str, Any]) -> Any:
    if entry["type"] == "directory":
        return False
    stamps = [
        entry.get(key) for key in ("ETag", "etag", "md5Hash", "LastModified", "last_modified", "mtime", "created")
    ]
    return (entry.get("size"), *map(str, stamps)) if any(stamps) else None


@contextlib.contextmanager
def announced(what: Callable[[], str], period_s: float = SILENCE_S) -> Iterator[None]:
    """Log what is waited for, as `what` says it then, for as long as the inside takes."""
    done = threading.Event()

    def announce() -> None:
        waited_s = 0.0
        while not done.wait(period_s):
            waited_s += period_s
            logger.warning("waiting for %s (%.0f s)", what(), waited_s)

    threading.Thread(target=announce, name="announcement", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def listed(names: Sequence[str]) -> str:
    """Return names for a sentence: the first few of many."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
