"""Objects below one URI: s3:// (Amazon's, and every storage of that protocol), and http(s)://, which is only read.

botocore finds credentials, region and endpoint as Amazon's own tools do, and signs a URL for each call; the calls
themselves are `storage_http.py`'s, so that a storage which sends too much or too slowly is refused.
"""

from __future__ import annotations

import io
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import quote, unquote, urlsplit

from rlservo.export.contract.errors import BundleError, UnavailableError, UsageError, first_line
from rlservo.export.contract.extras import install, needs_extra

if TYPE_CHECKING:
    from rlservo.serve_app.repository.storage_http import Reply

PAGE = 2 << 20  # [bytes] of a list: 1,000 names of at most 1,024 bytes
MOST_PAGES = 100
RETRY_AFTER_S = 0.2
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+://")  # two letters and more: C:// would be a drive
_SECRETS = re.compile(r"[A-Za-z0-9+/=_.~%-]{32,}|\b(AKIA|ASIA)[A-Z0-9]+")  # which a storage may repeat
_CONDITIONS = {"IfNoneMatch": "If-None-Match", "IfMatch": "If-Match"}


def is_uri(place: str | Path) -> bool:
    """Return whether a place is named by a protocol."""
    return isinstance(place, str) and _SCHEME.match(place) is not None


def place_of(place: str | Path) -> str:
    """Return an absolute folder (or `file://`) or a URI that holds no secret. Raises UsageError."""
    if not is_uri(place):
        return str(Path(place).expanduser().absolute())
    parts = urlsplit(str(place).rstrip("/"))
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return unquote(parts.path) or "/"
    if parts.scheme not in ("s3", "http", "https") or not parts.hostname or "@" in parts.netloc or parts.query:
        shown = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
        raise UsageError(
            f"{shown}: expected s3://bucket/policies, https://host/policies or file:///policies; a password or query "
            "may be a secret, and credentials come from the environment"
        )
    return parts.geturl()


class ObjectStorage:
    """Objects below one URI."""

    def __init__(self, uri: str, *, timeout_s: float = 15.0) -> None:
        """Nothing is asked yet. Each call may take `timeout_s`, with a large object longer. Raises UsageError."""
        self.uri = place_of(uri)
        self.timeout_s = timeout_s
        self.is_read_only = not self.uri.startswith("s3://")
        self._bucket, self._prefix = urlsplit(self.uri).netloc, urlsplit(self.uri).path.strip("/")
        self._client: Any = None

    def read(self, name: str, most: int) -> tuple[bytes, str]:
        """Return an object and its tag for `replace`.

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

    def create(self, name: str, content: bytes) -> bool:
        """Write an object unless there is one; return whether it holds this content now, no matter who wrote it.

        Raises UnavailableError, also if the storage does not keep what it was given.
        """
        return self._write(name, content, {"IfNoneMatch": "*"})

    def replace(self, name: str, content: bytes, tag: str) -> bool:
        """Write an object that has not changed since it was read; return and raise what `create` does."""
        return self._write(name, content, {"IfMatch": tag})

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
                raise UnavailableError(f"{self.uri}/{folder}: the storage did not send a list of objects")
            found += [key.removeprefix(prefix) for key in re.findall(r"<Key>([^<]+)</Key>", text)]
            if "<IsTruncated>true" not in text:
                return found
        raise UnavailableError(f"{self.uri}/{folder} has more than {len(found):,} objects")

    def _write(self, name: str, content: bytes, condition: dict[str, str]) -> bool:
        reply = self._call("put_object", name, condition, content)
        if reply.status not in (409, 412):  # there is one, or another write was under way
            self._succeeded(reply, name)
        try:  # it may be ours: the reply to a first attempt was lost; and a storage may keep something else
            return self.read(name, len(content))[0] == content
        except BundleError:
            return False
        except FileNotFoundError:
            raise UnavailableError(f"{self.uri}/{name} is not there after it was written") from None

    def _call(
        self,
        method: str,
        name: str,
        given: dict[str, str],
        body: bytes = b"",
        *,
        into: BinaryIO | None = None,
        most: int = 0,
    ) -> Reply:
        """Send a request, and once more if the connection breaks or the storage is busy."""
        with needs_extra("remote", "httpcore"):
            from rlservo.serve_app.repository.storage_http import TooLongReplyError, request
        place, timeout_s = f"{self.uri}/{name}", self.timeout_s
        headers = {header: given[key] for key, header in _CONDITIONS.items() if key in given}
        reason = ""
        for _ in range(2):
            verb, url = self._signed(method, name, given)
            into = into or io.BytesIO()
            into.seek(0)
            into.truncate()
            try:
                reply = request(verb, url, headers, body, into=into, most=most, timeout_s=timeout_s)
            except TooLongReplyError:
                kind = UnavailableError if method == "list_objects_v2" else BundleError
                raise kind(f"{place}: the storage sends more than the {most:,} bytes that it may") from None
            except TimeoutError:
                raise UnavailableError(f"{place} gave no answer within {timeout_s:.0f} s, or too slow a one") from None
            except ConnectionError as error:
                reason = _hidden(str(error))
            else:
                if reply.status < 429:
                    return reply
                reason = _said(reply)
            time.sleep(RETRY_AFTER_S)
        raise UnavailableError(f"{place} cannot be reached or read: {reason}")

    def _signed(self, method: str, name: str, given: dict[str, str]) -> tuple[str, str]:
        if self.is_read_only:
            return "GET", f"{self.uri}/{quote(name)}"
        key = {} if "Prefix" in given else {"Key": f"{self._prefix}/{name}".lstrip("/")}
        try:
            if self._client is None:
                from botocore.config import Config
                from botocore.session import get_session

                self._client = get_session().create_client("s3", config=Config(signature_version="s3v4"))
            url = self._client.generate_presigned_url(method, Params={"Bucket": self._bucket, **key, **given})
        except ImportError:
            raise UsageError(f"{self.uri} cannot be opened here: {install('remote')}") from None
        except Exception as error:  # botocore has a class for each thing that credentials may lack
            raise UnavailableError(f"{self.uri} cannot be signed for: {_hidden(first_line(error))}") from None
        return "PUT" if method == "put_object" else "GET", url

    def _succeeded(self, reply: Reply, name: str) -> Reply:
        if 200 <= reply.status < 300:
            return reply
        said = f"cannot be reached or read: {_said(reply)}"
        if reply.status in (401, 403):
            said = f"is refused with the credentials of this process's environment ({_said(reply)})"
        elif reply.status < 400:
            place = reply.headers.get("x-amz-bucket-region") or reply.headers.get("location", "").partition("?")[0]
            said = f"is redirected to {_hidden(place)}, which is not followed"
        raise UnavailableError(f"{self.uri}/{name} {said}")


def _said(reply: Reply) -> str:
    """Return what a storage says of its refusal, without secrets."""
    text = reply.refusal.decode(errors="replace")
    parts = [found[1] for tag in ("Code", "Message") if (found := re.search(f"<{tag}>([^<]+)</{tag}>", text))]
    return _hidden(": ".join(parts)) or f"status {reply.status}"


def _hidden(text: str) -> str:
    return _SECRETS.sub("...", " ".join(text.split()))[:200]
