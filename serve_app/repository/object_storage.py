"""Objects below one URI: s3:// (Amazon's, and every storage of that protocol), and http(s)://, which is only read.

botocore finds credentials, region and endpoint as Amazon's own tools do, and signs a URL for each call. The calls are
our own and bounded, so that a storage which sends too much or too slowly is refused; redirects are not followed.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO
from urllib.parse import quote, urlsplit

from rlservo.client.formats.http_connection import Connection, ServerRoute
from rlservo.errors import BundleError, UnavailableError, UsageError, first_line
from rlservo.extras import install
from rlservo.serve_app.repository.places import TIMEOUT_S, place_of

PAGE = 2 << 20  # [bytes] of a list: 1,000 names of at most 1,024 bytes
MOST_PAGES = 100
SLOWEST = 256 << 10  # [bytes/s] of a body, after the time-out
REFUSAL = 4096  # [bytes] of a refusal's body, for the error message
RETRY_AFTER_S = 0.2
_SECRETS = re.compile(r"[A-Za-z0-9+/=_.~%-]{32,}|\b(AKIA|ASIA)[A-Z0-9]+")  # which a storage may repeat
_CONDITIONS = {"IfNoneMatch": "If-None-Match", "IfMatch": "If-Match"}


@dataclass(frozen=True)
class Reply:
    """Answer of a storage; the body of a success is elsewhere."""

    status: int
    headers: Mapping[str, str]
    refusal: str = ""  # the beginning of its body

    @property
    def reason(self) -> str:
        """The reason that the storage gave for refusing, without secrets."""
        parts = re.findall(r"<(?:Code|Message)>([^<]+)</", self.refusal)
        return _hidden(": ".join(parts[:2])) or f"status {self.status}"


class ObjectStorage:
    """Objects below one URI."""

    def __init__(self, uri: str, *, timeout_s: float = TIMEOUT_S / 2) -> None:
        """Nothing is asked yet. Each call may take `timeout_s`, with a large object longer. Raises UsageError."""
        self.uri = place_of(uri)
        self.timeout_s = timeout_s
        self.is_read_only = not self.uri.startswith("s3://")
        self._bucket, self._prefix = urlsplit(self.uri).netloc, urlsplit(self.uri).path.strip("/")
        self._client: Any = None

    def read(self, name: str, most: int) -> tuple[bytes, str]:
        """Return an object and its tag for `create`.

        Raises FileNotFoundError, UnavailableError, and BundleError beyond `most` bytes.
        """
        content = io.BytesIO()
        reply = self.copy(name, most, content)
        return content.getvalue(), reply.headers.get("etag", "")

    def copy(self, name: str, most: int, into: BinaryIO) -> Reply:
        """Copy an object into an empty file. Raises what `read` raises."""
        reply = self._call("get_object", name, {}, into=into, most=most)
        if reply.status == 404:
            raise FileNotFoundError(f"{self.uri}/{name}")
        return self._succeeded(reply, name)

    def create(self, name: str, content: bytes, tag: str = "") -> bool:
        """Write an object unless there is one; return whether it holds this content now, no matter who wrote it.

        With a `tag` it replaces the object that was read with it, if no one has changed that since. Raises
        UnavailableError, also if the storage does not keep what it was given.
        """
        reply = self._call("put_object", name, {"IfMatch": tag} if tag else {"IfNoneMatch": "*"}, content)
        if reply.status not in (409, 412):  # there is one, or another write was under way
            self._succeeded(reply, name)
        try:  # it may be ours: the reply to a first attempt was lost; and a storage may keep something else
            return self.read(name, len(content))[0] == content
        except BundleError:
            return False
        except FileNotFoundError:
            raise UnavailableError(f"{self.uri}/{name} is not there after it was written") from None

    def names(self, folder: str) -> list[str]:
        """Return the names of all objects below a folder. Raises UnavailableError."""
        prefix = f"{self._prefix}/{folder}/".lstrip("/")
        found: list[str] = []
        for _ in range(MOST_PAGES):
            page = io.BytesIO()
            given = {"Prefix": prefix, "StartAfter": prefix + found[-1] if found else ""}
            self._succeeded(self._call("list_objects_v2", folder, given, into=page, most=PAGE), folder)
            text = page.getvalue().decode(errors="replace")
            if "<ListBucketResult" not in text:
                raise UnavailableError(f"{self.uri}/{folder}: the reply lists no objects: check AWS_ENDPOINT_URL")
            found += [key.removeprefix(prefix) for key in re.findall(r"<Key>([^<]+)</Key>", text)]
            if "<IsTruncated>true" not in text:
                return found
        raise UnavailableError(f"{self.uri}/{folder} has more than {len(found):,} objects")

    def _call(
        self,
        method: str,
        name: str,
        given: dict[str, str],
        body: bytes | None = None,
        *,
        into: BinaryIO | None = None,
        most: int = 0,
    ) -> Reply:
        """Send a request, and once more if the connection breaks or the storage is busy.

        Raises UnavailableError, and BundleError beyond `most` bytes.
        """
        place, into, reason = f"{self.uri}/{name}", into or io.BytesIO(), ""
        fields = "".join(f"{_CONDITIONS[key]}: {given[key]}\r\n" for key in given if key in _CONDITIONS).encode()
        for _ in range(2):
            url = self._signed(method, name, given)
            into.seek(0)
            into.truncate()
            try:
                reply = self._exchange(url, fields, body, into, most)
            except BundleError as error:
                error.prefix(place)
                raise
            except TimeoutError:
                raise UnavailableError(
                    f"{place} gave no answer within {self.timeout_s:.0f} s, or answered too slowly"
                ) from None
            except ConnectionError as error:
                length = into.tell()
                reason = f"the connection broke after {length:,} bytes" if length else _hidden(first_line(error))
            else:
                if reply.status < 429:
                    return reply
                reason = reply.reason
            time.sleep(RETRY_AFTER_S)
        raise UnavailableError(f"{place} cannot be reached or read: {reason}")

    def _exchange(self, url: str, fields: bytes, body: bytes | None, into: BinaryIO, most: int) -> Reply:
        """Put a body or get one; write that of a success, never unpacked, into `into`.

        Raises BundleError beyond `most` bytes, ConnectionError, and TimeoutError when connecting takes longer than the
        time-out, or the rest longer than that plus the time that the received bytes take at `SLOWEST`.
        """
        deadline, length, refusal = time.monotonic() + self.timeout_s + len(body or b"") / SLOWEST, 0, b""
        parts, route = urlsplit(url), ServerRoute.to(url, os.environ.get("AWS_CA_BUNDLE"))
        target = f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}".encode()
        with contextlib.closing(Connection(route, min(deadline, time.monotonic() + self.timeout_s))) as connection:
            connection.ask(route.request("GET" if body is None else "PUT", target, fields, body), deadline)
            while not connection.is_complete and len(refusal) < REFUSAL:
                connection.receive(min(deadline + length / SLOWEST, time.monotonic() + self.timeout_s))
                block, connection.body = connection.body, bytearray()
                length += len(block)
                if not 200 <= connection.status < 300:
                    refusal += block[:REFUSAL]
                elif length > most:
                    raise BundleError(f"the storage sent more than the {most:,} bytes allowed")
                else:
                    into.write(block)
        found = {name.decode("latin-1"): value.decode("latin-1") for name, value in connection.headers}
        return Reply(connection.status, found, refusal.decode(errors="replace"))

    def _signed(self, method: str, name: str, given: dict[str, str]) -> str:
        if self.is_read_only:
            return f"{self.uri}/{quote(name)}"
        key = {} if "Prefix" in given else {"Key": f"{self._prefix}/{name}".lstrip("/")}
        try:
            if self._client is None:
                from botocore.config import Config
                from botocore.session import get_session

                self._client = get_session().create_client("s3", config=Config(signature_version="s3v4"))
            params = {"Bucket": self._bucket, **key, **given}
            return str(self._client.generate_presigned_url(method, Params=params))
        except ImportError:
            raise UsageError(f"{self.uri} cannot be opened here: {install('remote')}") from None
        except Exception as error:  # botocore has a class for each thing that credentials may lack
            raise UnavailableError(f"{self.uri} cannot be signed for: {_hidden(first_line(error))}") from None

    def _succeeded(self, reply: Reply, name: str) -> Reply:
        if 200 <= reply.status < 300:
            return reply
        said = f"cannot be reached or read: {reply.reason}"
        if reply.status in (401, 403):
            said = f"is refused with the credentials of this process's environment ({reply.reason})"
        elif reply.status < 400:
            place = reply.headers.get("x-amz-bucket-region") or reply.headers.get("location", "").partition("?")[0]
            said = f"is redirected to {_hidden(place)}, which is not followed"
        raise UnavailableError(f"{self.uri}/{name} {said}")


def _hidden(text: str) -> str:
    return _SECRETS.sub("...", " ".join(text.split()))[:200]
