"""Publication of a bundle as a version that never changes: its files, and last its line in the index.

In object storage SHA256SUMS is written first and claims the version's number: of two publishers with different bundles,
one is refused before it has written anything else. Objects are only created, never overwritten, and read back. A folder
takes its name when it is complete. So a version that is listed is complete.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rlservo.bundle.bundle import SUMS_FILE, Bundle, digest_of
from rlservo.bundle.contract import VERSION_PATTERN, version_key
from rlservo.errors import BundleError, ConflictError, UnavailableError, UsageError
from rlservo.serve_app.repository.hub_storage import HubStorage
from rlservo.serve_app.repository.index import INDEX, Index, check_file_type
from rlservo.serve_app.repository.places import place_of
from rlservo.serve_app.repository.signature import MAX_SIGNATURE_BYTES, SIGNATURE_FILE, read_signature
from rlservo.serve_app.repository.storage import FolderStorage, storage_at

if TYPE_CHECKING:
    from rlservo.serve_app.repository.object_storage import ObjectStorage

ATTEMPTS = 20  # at the index, each after others have published


def publish(bundle: Bundle, place: str, *, card: str = "", progress: Callable[[str], object] = str) -> str:
    """Publish a bundle to a folder or URI under its own name and version; return where it is: on a hub, the commit.

    This very bundle may be there already: then its signature is published, if that is another one. `card` is the
    README.md of a hub's repository. `progress` gets a line per uploaded file. Raises ConflictError if that version is
    there, or is being published, UsageError if nothing can be written, UnavailableError if the storage fails, and
    BundleError.
    """
    storage = storage_at(place_of(place))
    is_hub = isinstance(storage, HubStorage)
    if storage.is_read_only and not is_hub:
        raise UsageError(f"{storage.uri} can only be read: publish to a folder that its server shows, or to s3://")
    target = f"{storage.uri}/{bundle.contract.name}/{bundle.contract.version}"
    for file in bundle.sums:
        check_file_type(file, bundle.path / SUMS_FILE)
    if bundle.contract.name == INDEX:
        raise BundleError(f"a policy named {INDEX} cannot be published: the index of versions has that name")
    is_signed = False
    with contextlib.suppress(FileNotFoundError):  # a malformed one is refused before anything is uploaded
        is_signed = bool(read_signature(bundle.path))
    if isinstance(storage, HubStorage):
        storage.begin(
            {f"{bundle.contract.name}/{bundle.contract.version}/{f}": copy for f, copy in _files(bundle)}, card
        )
    index, tag = Index.read(storage)
    if index.hash_of(bundle) == bundle.digest and is_signed:
        if not _put_signature(storage, bundle):
            raise ConflictError(f"{target} already exists (this very bundle, with this signature)")
        return storage.pinned if isinstance(storage, HubStorage) else target
    content = _with(index, bundle, target)
    if isinstance(storage, FolderStorage):
        _place(bundle, Path(target))
    elif not is_hub:  # its files come with the index, in one commit
        for file, copy in _files(bundle):
            progress(f"{target}/{file}")
            is_there = storage.create(f"{bundle.contract.name}/{bundle.contract.version}/{file}", copy)
            if not is_there and file != SIGNATURE_FILE:
                raise ConflictError(
                    f"{target}/{file} holds a different file from {bundle.path / file}: the version is being "
                    "published by another command, or was left unfinished; publish it as another one (--version next)"
                )
    if is_signed and not is_hub:  # an interrupted try may have left another one, or none
        _put_signature(storage, bundle)
    for attempt in range(ATTEMPTS):
        if storage.create(INDEX, content, tag):
            return storage.pinned if isinstance(storage, HubStorage) else target
        time.sleep(0.05 * attempt)
        index, tag = Index.read(storage)
        if index.hash_of(bundle) == bundle.digest:
            return target  # ours was written, and replaced by another publisher's at once
        content = _with(index, bundle, target)
    raise UnavailableError(f"{storage.uri}/{INDEX}: others keep publishing; run the same command again")


def _put_signature(storage: ObjectStorage | HubStorage | FolderStorage, bundle: Bundle) -> bool:
    """Write the signature of a bundle; return False if it is there already. Raises UnavailableError, BundleError."""
    signature = read_signature(bundle.path)
    name, there, tag = f"{bundle.contract.name}/{bundle.contract.version}/{SIGNATURE_FILE}", b"", ""
    with contextlib.suppress(FileNotFoundError):
        there, tag = storage.read(name, MAX_SIGNATURE_BYTES)
    if there == signature:
        return False
    if not storage.create(name, signature, tag):
        raise UnavailableError(f"{storage.uri}/{name}: others keep publishing; run the same command again")
    return True


def next_version(place: str, name: str) -> str:
    """Return the integer after the newest version at a folder or URI; one that was begun is not free.

    Raises UsageError and UnavailableError.
    """
    entries = {each.partition("/")[0] for each in storage_at(place_of(place)).names(name)}
    versions = [version_key(text)[0] for text in entries if re.fullmatch(VERSION_PATTERN, text)]
    return str(max(versions, default=0) + 1)


def _files(bundle: Bundle) -> Iterator[tuple[str, bytes]]:
    """Yield the name and content of each file: the hashes first, a signature last. Raises BundleError."""
    for name, digest in {SUMS_FILE: bundle.digest, **bundle.sums}.items():
        content = (bundle.path / name).read_bytes()
        if hashlib.sha256(content).hexdigest() != digest:
            raise BundleError(f"{bundle.path / name} changed while it was published")
        yield name, content
    with contextlib.suppress(FileNotFoundError):
        yield SIGNATURE_FILE, read_signature(bundle.path)


def _with(index: Index, bundle: Bundle, target: str) -> bytes:
    """Return the content of an index with one more line. Raises ConflictError if the version has one."""
    if there := index.hash_of(bundle):
        which = "this very bundle" if there == bundle.digest else "another bundle"
        raise ConflictError(
            f"{target} already exists ({which}): versions are never overwritten; publish it as another one (--version "
            "next)"
        )
    name, version = bundle.contract.name, bundle.contract.version
    versions = {**index.policies.get(name, {}), version: bundle.digest}
    return Index(policies={**index.policies, name: versions}).model_dump_json(indent=1).encode() + b"\n"


def _place(bundle: Bundle, target: Path) -> None:
    """Copy a bundle to a folder, whole at once: `rlservo serve` reads it as any other. Raises ConflictError."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".publishing-", dir=target.parent) as name:
        folder = Path(name) / target.name
        folder.mkdir()
        for file, copy in _files(bundle):
            (folder / file).write_bytes(copy)
        with contextlib.suppress(OSError):  # a folder is there: it may hold this bundle, and lack only its line
            folder.rename(target)
    if digest_of(target) != bundle.digest:
        raise ConflictError(
            f"{target} already exists and holds another bundle: versions are never overwritten; publish it as another "
            "one (--version next)"
        )
