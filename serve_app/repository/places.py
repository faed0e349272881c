"""Names of the places that hold bundles and plans: folders, and URIs of storages."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

from rlservo.errors import UsageError

TIMEOUT_S = 30.0
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+://")  # two letters and more: C:// would be a drive

_HUB = re.compile(r"hf://[\w.-]+/[\w.-]+(@[\w./-]+)?")


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
    known = _HUB.fullmatch(parts.geturl()) if parts.scheme == "hf" else parts.scheme in ("s3", "http", "https")
    if not known or not parts.hostname or "@" in parts.netloc or parts.query:
        shown = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
        raise UsageError(
            f"{shown}: expected s3://bucket/policies, hf://owner/name (@revision), https://host/policies or "
            "file:///policies; a password or query may be a secret, and credentials come from the environment"
        )
    return parts.geturl()
