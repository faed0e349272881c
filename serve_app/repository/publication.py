"""Publication of a bundle as a version that never changes: its files, and last its line in the index.

SHA256SUMS is written first and claims the version's number: of two publishers with different bundles, one is refused
before it has written anything else. Objects are only created, never overwritten, and read back; the index is replaced
only if no other writer has replaced it. So a version that is listed is complete.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rlservo.export.contract.bundle import SUMS_FILE, Bundle, digest_of
from rlservo.export.contract.contract import VERSION_PATTERN, version_key
from rlservo.export.contract.errors import BundleError, ConflictError, UnavailableError, UsageError
from rlservo.serve_app.repository.remote_repository import INDEX, Index, check_file_type
from rlservo.serve_app.repository.storage import (
    TIMEOUT_S,
    FolderStorage,
    is_uri,
    object_storage,
    place_of,
)

if TYPE_CHECKING:
    from rlservo.serve_app.repository.object_storage import ObjectStorage

ATTEMPTS = 20  # at the index, each after others have published


def publish(bundle: Bundle, place: str, *, progress: Callable[[str], object] = str) -> str:
    """Publish a bundle to a folder or URI under its own name and version; return where it is.

    `progress` gets a line per file. Raises ConflictError if that version is there, or is being published,
    UsageError if nothing can be written, UnavailableError if the storage fails, and BundleError.
    """
    root = place_of(place)
    for file in bundle.sums:
        check_file_type(file, bundle.path / SUMS_FILE)
    if bundle.contract.name == INDEX:
        raise BundleError(f"a policy named {INDEX} cannot be published: the index of versions has that name")
    if is_uri(root):
        _publish_to_storage(bundle, object_storage(root, TIMEOUT_S), progress)
    else:
        _publish_to_folder(bundle, Path(root))
    return f"{root}/{_name_of(bundle)}"


def next_version(place: str, name: str) -> str:
    """Return the integer after the newest version at a folder or URI; one that was begun is not free.

    Raises UsageError and UnavailableError.
    """
    root = place_of(place)
    storage = object_storage(root, TIMEOUT_S) if is_uri(root) else FolderStorage(Path(root))
    entries = {each.partition("/")[0] for each in storage.names(name)}
    versions = [version_key(text)[0] for text in entries if re.fullmatch(VERSION_PATTERN, text)]
    return str(max(versions, default=0) + 1)


def _name_of(bundle: Bundle) -> str:
    return f"{bundle.contract.name}/{bundle.contract.version}"


def _files(bundle: Bundle) -> Iterator[tuple[str, bytes]]:
    """Yield the name and content of each file, the one with the hashes first. Raises BundleError."""
    for name, digest in {SUMS_FILE: bundle.digest, **bundle.sums}.items():
        content = (bundle.path / name).read_bytes()
        if hashlib.sha256(content).hexdigest() != digest:
            raise BundleError(f"{bundle.path / name} changed while it was published")
        yield name, content


def _publish_to_storage(bundle: Bundle, storage: ObjectStorage, progress: Callable[[str], object]) -> None:
    if storage.is_read_only:
        raise UsageError(f"{storage.uri} can only be read: publish to a folder that its server shows, or to s3://")
    _with(Index.read(storage)[0], bundle, storage.uri)
    for file, content in _files(bundle):
        name = f"{_name_of(bundle)}/{file}"
        progress(f"{storage.uri}/{name}")
        if not storage.create(name, content):
            raise ConflictError(
                f"{storage.uri}/{name} holds another file than {bundle.path / file}: the version is being published by "
                "another command, or was left unfinished; publish as another version (--version next)"
            )
    for attempt in range(ATTEMPTS):
        index, tag = Index.read(storage)
        if attempt and _published(index, bundle) == bundle.digest:
            return  # ours was written, and replaced by another publisher's at once
        if storage.create(INDEX, _with(index, bundle, storage.uri), tag):
            return
        time.sleep(0.05 * attempt)
    raise UnavailableError(f"{storage.uri}/{INDEX}: others keep publishing; run the same command again")


def _with(index: Index | None, bundle: Bundle, place: object) -> bytes:
    """Return the content of an index with one more line. Raises ConflictError if the version has one."""
    if there := _published(index, bundle):
        which = "this very bundle" if there == bundle.digest else "another bundle"
        raise ConflictError(
            f"{place}/{_name_of(bundle)} is there already ({which}): versions are never overwritten; publish as "
            "another (--version next)"
        )
    policies = {} if index is None else dict(index.policies)
    name, version = bundle.contract.name, bundle.contract.version
    policies[name] = {**policies.get(name, {}), version: bundle.digest}
    return Index(policies=policies).model_dump_json(indent=1).encode() + b"\n"


def _published(index: Index | None, bundle: Bundle) -> str | None:
    """Return the hash under which a bundle's version is published."""
    policies = {} if index is None else index.policies
    return policies.get(bundle.contract.name, {}).get(bundle.contract.version)


def _publish_to_folder(bundle: Bundle, root: Path) -> None:
    """Publish into a folder, which takes its name when it is complete; `rlservo serve` reads it as any other."""
    target = root / _name_of(bundle)
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        content = _with(Index.read(FolderStorage(root))[0], bundle, root)
        with tempfile.TemporaryDirectory(prefix=".publishing-", dir=target.parent) as name:
            folder = Path(name) / target.name
            folder.mkdir()
            for file, copy in _files(bundle):
                (folder / file).write_bytes(copy)
            try:
                if not target.exists() or digest_of(target) != bundle.digest:  # else: it lacks only its line
                    folder.rename(target)
            except OSError:
                raise ConflictError(
                    f"{target} is there already and holds another bundle: versions are never overwritten; publish as "
                    "another one (--version next)"
                ) from None
            (Path(name) / INDEX).write_bytes(content)
            (Path(name) / INDEX).replace(root / INDEX)
    finally:
        os.close(descriptor)
