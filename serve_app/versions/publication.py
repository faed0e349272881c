"""Publication of a bundle as a version that never changes: its files first, its manifest last.

SHA256SUMS is written before the other files and claims the version's number: of two publishers with different bundles
one is refused before it has written anything else. Objects are only created, never overwritten, and read back before
the manifest is written. A storage that knows no conditional writes leaves a moment in which two publishers may both
think that a number is free: each reads claim and manifest again at the end, and says so when they are not its own.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from rlservo.export.contract.bundle import SUMS_FILE, Bundle, load_bundle, sha256
from rlservo.export.contract.contract import VERSION_PATTERN, version_key
from rlservo.export.contract.errors import BundleError, ConflictError, UnavailableError, UsageError
from rlservo.serve_app.versions.manifest import (
    MAX_MANIFEST_BYTES,
    SUFFIX,
    Manifest,
    PublishedFile,
    check_file_type,
)
from rlservo.serve_app.versions.object_storage import ObjectStorage, announced, is_uri, place_of
from rlservo.serve_app.versions.plan import now


def publish(bundle: Bundle, place: str, *, timeout_s: float = 15.0, progress: Callable[[str], object] = str) -> str:
    """Publish a bundle to a folder or URI under its own name and version; return where its manifest is.

    `progress` gets a line per file. Raises ConflictError where that version is there, or is being published,
    UsageError where nothing can be written, UnavailableError where the storage fails, and BundleError.
    """
    root = place_of(place)
    manifest = _manifest_of(bundle)
    if is_uri(root):
        _publish_to_storage(bundle, manifest, ObjectStorage(root, timeout_s=timeout_s), progress)
    else:
        _publish_to_folder(bundle, manifest, Path(root))
    return f"{root}/{_name_of(manifest)}"


def next_version(place: str, name: str, *, timeout_s: float = 15.0) -> str:
    """Return the integer after the newest version at a folder or URI; one that was begun is not free.

    Raises UsageError and UnavailableError.
    """
    root = place_of(place)
    if is_uri(root):
        entries = list(ObjectStorage(root, timeout_s=timeout_s).entries(name))
    else:
        folder = Path(root) / name
        entries = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    versions = [text for text in (each.removesuffix(SUFFIX) for each in entries) if re.fullmatch(VERSION_PATTERN, text)]
    return str(max((version_key(version)[0] for version in versions), default=0) + 1)


def _manifest_of(bundle: Bundle) -> Manifest:
    files = {}
    for name in (SUMS_FILE, *bundle.sums):
        check_file_type(name, str(bundle.path / SUMS_FILE))
        file = bundle.path / name
        files[name] = PublishedFile(size=file.stat().st_size, sha256=bundle.sums.get(name) or sha256(file))
    if files[SUMS_FILE].sha256 != bundle.digest:
        raise BundleError(f"{bundle.path} changed while it was read")
    contract = bundle.contract
    name, version = contract.name, contract.version
    try:
        manifest = Manifest(format=1, name=name, version=version, published_at=now(), files=files)
    except ValidationError:
        strange = ", ".join(sorted(files))
        raise BundleError(f"{bundle.path} has files whose names cannot be published, of {strange[:300]}") from None
    return Manifest.parse(manifest.encode(), f"{name}/{version}{SUFFIX}")  # what nobody would fetch is not published


def _name_of(manifest: Manifest) -> str:
    return f"{manifest.name}/{manifest.version}{SUFFIX}"


def _publish_to_storage(
    bundle: Bundle, manifest: Manifest, storage: ObjectStorage, progress: Callable[[str], object]
) -> None:
    if storage.is_read_only:
        raise UsageError(f"{storage.uri} can only be read: publish to a folder that its server shows, or to s3://")
    place = f"{storage.uri}/{_name_of(manifest)}"
    folder = f"{manifest.name}/{manifest.version}"
    with announced(lambda: f"the publication of {place}"):
        _refuse_published(_read_manifest(storage, manifest), manifest, place)
        for name in manifest.files:
            progress(f"{storage.uri}/{folder}/{name}")
            content = (bundle.path / name).read_bytes()
            written = f"{folder}/{name}"
            if not content:  # storages refuse to read a range of nothing, and whoever fetches does not ask for it
                storage.create(written, content)
                continue
            there = _is_there(storage, written, content)
            if there is None:
                storage.create(written, content)
                there = _is_there(storage, written, content)
            if there is None:
                raise UnavailableError(f"{storage.uri}/{written} is not there after it was written")
            if not there:
                raise ConflictError(
                    f"{storage.uri}/{written} holds another file than {bundle.path / name}, and there is no "
                    "manifest: the version is being published by somebody else, or was left unfinished; publish as "
                    "another version (--version next)"
                )
        storage.create(_name_of(manifest), manifest.encode())
        _check_own(_read_manifest(storage, manifest), manifest, place)
        if not _is_there(storage, f"{folder}/{SUMS_FILE}", (bundle.path / SUMS_FILE).read_bytes()):
            raise ConflictError(
                f"{place} was published by somebody else at the same moment: publish as another version"
            )


def _is_there(storage: ObjectStorage, name: str, content: bytes) -> bool | None:
    """Whether an object has this content; None: there is none."""
    try:
        return storage.read(name, len(content) + 1) == content
    except FileNotFoundError:
        return None


def _read_manifest(storage: ObjectStorage, manifest: Manifest) -> Manifest | None:
    name = _name_of(manifest)
    try:
        return Manifest.parse(storage.read(name, MAX_MANIFEST_BYTES + 1), f"{storage.uri}/{name}")
    except FileNotFoundError:
        return None


def _refuse_published(there: Manifest | None, manifest: Manifest, place: str) -> None:
    if there is not None:
        same = "this very bundle" if there.digest == manifest.digest else "another bundle"
        raise ConflictError(
            f"{place} is there already ({same}): versions are never overwritten; publish as another (--version next)"
        )


def _check_own(there: Manifest | None, manifest: Manifest, place: str) -> None:
    if there is None:
        raise UnavailableError(f"{place} is not there after it was written")
    if there != manifest:
        raise ConflictError(f"{place} was published by somebody else at the same moment: publish as another version")


def _publish_to_folder(bundle: Bundle, manifest: Manifest, root: Path) -> None:
    """Publish where a whole folder takes its name at once; `rlservo serve` reads it as any other folder."""
    parent = root / manifest.name
    parent.mkdir(parents=True, exist_ok=True)
    target, beside = parent / manifest.version, parent / f"{manifest.version}{SUFFIX}"
    if beside.exists():
        _refuse_published(Manifest.parse(beside.read_bytes(), str(beside)), manifest, str(beside))
    with tempfile.TemporaryDirectory(prefix=".publishing-", dir=parent) as name:
        folder = Path(name) / manifest.version
        folder.mkdir()
        for file in manifest.files:
            shutil.copyfile(bundle.path / file, folder / file)
        if load_bundle(folder).digest != manifest.digest:
            raise BundleError(f"{bundle.path} changed while it was copied")
        try:
            if not target.exists() or load_bundle(target).digest != manifest.digest:  # else: left without a manifest
                folder.rename(target)
        except OSError:
            raise ConflictError(
                f"{target} is there already and holds another bundle: versions are never overwritten; publish as "
                "another one (--version next)"
            ) from None
        written = Path(name) / "manifest"
        written.write_bytes(manifest.encode())
        try:
            os.link(written, beside)  # unlike a rename it fails where there is one
        except FileExistsError:
            _check_own(Manifest.parse(beside.read_bytes(), str(beside)), manifest, str(beside))
