"""Policy bundle: the interface between the exporter and everything that runs a policy.

A bundle is a folder `<name>/<version>/` holding

    policy.onnx     the whole policy as one graph: raw observation in, environment-ready action out
    policy.ts       the same graph as TorchScript
    contract.json   what goes in, what comes out, what is baked in, how it was proven (`Contract` below)
    golden.npz      recorded inputs and outputs, replayed at every load
    SHA256SUMS      a hash of each of the files above (`sha256sum -c SHA256SUMS` checks them too)

This module reads and writes those files. It needs numpy and pydantic, and never unpickles. A bundle may come from
anyone who can write into a folder: only regular files are read, sizes are bounded before anything is read, and only
bytes whose hash was checked are used.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import VERSION_PATTERN, Contract, contract_json, parse_contract, version_key
from rlservo.bundle.production import production_of
from rlservo.bundle.regular_files import FileTooLargeError, NotReadableError, blocks, open_regular
from rlservo.bundle.spaces import DictSpec, TupleSpec
from rlservo.errors import BundleError, BundleTamperedError

ONNX_FILE = "policy.onnx"
TORCHSCRIPT_FILE = "policy.ts"
CONTRACT_FILE = "contract.json"
GOLDEN_FILE = "golden.npz"
SUMS_FILE = "SHA256SUMS"
NEWEST = "newest"
"""The version with the highest number, instead of the one in production."""
CONTRACT_KEY = "rlservo.contract"
"""Key of the contract in the graph's own metadata."""
MAX_SUMS_BYTES = 1 << 16
MAX_FILES = 16  # the four, and what a user may have added
DESCRIPTORS = Path("/proc/self/fd")  # Linux: a file that this process has open, whether it has a name or not
BAD_ARCHIVE = (OSError, ValueError, EOFError, RuntimeError, KeyError, MemoryError, zlib.error, zipfile.BadZipFile)
"""Exceptions of zipfile and numpy for broken archives."""
DictSpec.model_rebuild()
TupleSpec.model_rebuild()


@dataclass(frozen=True)
class BundleLimits:
    """Size limits of a bundle's files; larger ones are refused before they are read. A server sets its own."""

    max_policy_bytes: int | None = None
    """Limit of each file except the two below; None for no limit."""

    max_golden_bytes: int = 256 << 20
    """Limit of golden.npz, packed and unpacked."""

    max_contract_bytes: int = 16 << 20

    def of(self, name: str) -> tuple[int | None, str]:
        """Return (bytes, name of the limit) for a file of a bundle."""
        if name == CONTRACT_FILE:
            return self.max_contract_bytes, "max_contract_bytes"
        if name == GOLDEN_FILE:
            return self.max_golden_bytes, "max_golden_bytes"
        return self.max_policy_bytes, "max_policy_bytes"


DEFAULT_LIMITS = BundleLimits()


@dataclass(frozen=True)
class Bundle:
    """A bundle folder whose hashes have been checked, and its contract."""

    path: Path
    contract: Contract
    sums: Mapping[str, str]
    """The SHA-256 of each file, as recorded."""
    digest: str
    """Identity of this bundle: the hash of its hashes."""
    limits: BundleLimits = DEFAULT_LIMITS

    @property
    def onnx(self) -> Path:
        return self.path / ONNX_FILE

    @property
    def torchscript(self) -> Path:
        return self.path / TORCHSCRIPT_FILE

    def golden(self) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
        """Return the golden (inputs, outputs) by tensor name; all share the leading batch axis.

        Raises BundleError, and BundleTamperedError if the file is no longer the one that was checked.
        """
        inputs: dict[str, NDArray[Any]] = {}
        outputs: dict[str, NDArray[Any]] = {}
        file = self.path / GOLDEN_FILE
        content = io.BytesIO(b"".join(_verified(file, self.sums[GOLDEN_FILE], self.limits)))
        try:
            _check_unpacked(file, content, self.limits.max_golden_bytes)
            with np.load(content, allow_pickle=False) as archive:
                for key in archive.files:
                    side, _, name = key.partition("/")
                    (inputs if side == "input" else outputs)[name] = archive[key]
        except BAD_ARCHIVE as error:
            raise BundleError(f"{file} cannot be read: {error}") from error
        return inputs, outputs

    @contextmanager
    def verified_copy(self, name: str) -> Iterator[Path]:
        """Give the path of a private copy of a file: the very bytes whose hash was compared.

        On Linux it is in no folder and gone with this process. Raises BundleError, BundleTamperedError.
        """
        recorded = self.digest if name == SUMS_FILE else self.sums[name]
        with _private_file() as (copy, path):
            try:
                for block in _verified(self.path / name, recorded, self.limits):
                    copy.write(block)
                copy.flush()
            except OSError as error:  # from writing: a BundleError is not an OSError
                raise BundleError(
                    f"{self.path / name} cannot be copied to {tempfile.gettempdir()}: {error.strerror}"
                ) from error
            yield path


def load_bundle(path: str | Path, limits: BundleLimits = DEFAULT_LIMITS, *, version: str | None = None) -> Bundle:
    """Read and check one bundle.

    `path` may be the bundle folder itself, a policy folder `<name>/` or a repository that holds exactly one policy:
    then it is the version in production by the folder's plan, the newest without a plan, or `version` (a number, or
    `newest`).

    Raises BundleError when there is no bundle, a file is missing or the contract is malformed, and
    BundleTamperedError when a file differs from its recorded hash.
    """
    folder = resolve_bundle(path, version)
    digest, sums = read_sums(folder)
    for name in (ONNX_FILE, TORCHSCRIPT_FILE, CONTRACT_FILE, GOLDEN_FILE):
        if name not in sums:
            raise BundleError(f"{folder / SUMS_FILE} does not list {name}: the bundle is incomplete")
    if len(sums) > MAX_FILES:  # each may be as large as a policy, and all of them are hashed
        raise BundleError(f"{folder / SUMS_FILE} lists {len(sums)} files: at most {MAX_FILES}")
    contract = b""
    for name, recorded in sums.items():
        content = _verified(folder / name, recorded, limits)
        if name == CONTRACT_FILE:
            contract = b"".join(content)
        else:
            for _ in content:
                pass
    return Bundle(folder, _parse_contract(folder / CONTRACT_FILE, contract), sums, digest, limits)


def resolve_bundle(path: str | Path, version: str | None = None) -> Path:
    """Return the bundle folder of `path`, as `load_bundle` chooses it. Raises BundleError."""
    folders = find_bundles(path)  # versions of one policy come in ascending order
    policies = sorted({folder.parent for folder in folders})
    if len(policies) > 1:
        names = ", ".join(str(policy.relative_to(path)) for policy in policies)
        raise BundleError(f"{path} holds {len(policies)} policies ({names}): name one of their folders")
    if folders == [Path(path)]:
        if version not in (None, NEWEST) and version != (its := read_contract(folders[0]).version):
            raise BundleError(f"{path} is version {its}, not {version}")
        return folders[0]
    by_version = {folder.name: folder for folder in folders}
    plan = None
    if (
        len(folders) > 1
        and version is None
        and (production := production_of(policies[0], _policy_name(folders))) is not None
    ):
        version, plan = production
    if version in (None, NEWEST):
        return folders[-1]
    if version not in by_version:
        there = f"expected {NEWEST} or one of {', '.join(by_version)}"
        if plan is not None:
            raise BundleError(
                f"{plan} has version {version} of '{policies[0].name}' in production, which does not exist: {there}"
            )
        raise BundleError(f"{path} has no version {version}: {there}")
    return by_version[version]


def _policy_name(folders: Sequence[Path]) -> str:
    """Return the name that the newest readable contract gives a policy; it may differ from its folder's."""
    for folder in reversed(folders):
        with suppress(BundleError):
            return read_contract(folder).name
    return folders[0].parent.name


def find_bundles(path: str | Path) -> list[Path]:
    """Return every bundle folder at or below `path` (a bundle, a policy folder or a repository), oldest version first.

    Raises BundleError when there is none.
    """
    root = Path(path)
    if not root.exists():
        raise BundleError(f"{root} does not exist: expected a policy bundle (a folder with {CONTRACT_FILE})")
    if not root.is_dir():
        raise BundleError(f"{root} is a file: expected a policy bundle (a folder with {CONTRACT_FILE})")
    if _looks_like_bundle(root):
        return [root]
    versions = _versions(root)
    if not versions:
        versions = [v for policy in sorted(root.iterdir()) if policy.is_dir() for v in _versions(policy)]
    if not versions:
        raise BundleError(
            f"{root} holds no policy bundle: expected {CONTRACT_FILE} in it, in <version>/ or in <name>/<version>/"
        )
    return versions


def _looks_like_bundle(folder: Path) -> bool:
    return (folder / CONTRACT_FILE).exists() or (folder / SUMS_FILE).exists()


def _versions(policy: Path) -> list[Path]:
    folders = [
        f for f in policy.iterdir() if f.is_dir() and re.fullmatch(VERSION_PATTERN, f.name) and _looks_like_bundle(f)
    ]
    return sorted(folders, key=lambda f: version_key(f.name))


def read_contract(folder: Path, limits: BundleLimits = DEFAULT_LIMITS) -> Contract:
    """Parse `contract.json`; an error names the wrong field in one sentence."""
    file = folder / CONTRACT_FILE
    return _parse_contract(file, b"".join(_blocks(file, *limits.of(CONTRACT_FILE))))


def _parse_contract(file: Path, content: bytes) -> Contract:
    try:
        return parse_contract(content.decode("utf-8"), str(file))
    except UnicodeDecodeError as error:
        raise BundleError(f"{file} cannot be read: {error}") from error


def digest_of(folder: Path) -> str:
    """Return the identity of a bundle: the hash of its hashes. Raises BundleError."""
    return read_sums(folder)[0]


def read_sums(folder: Path) -> tuple[str, dict[str, str]]:
    """Return (the hash of SHA256SUMS, what it records by file name: no path, no leading dot). Raises BundleError."""
    file = folder / SUMS_FILE
    content = b"".join(_blocks(file, MAX_SUMS_BYTES))
    try:
        lines = content.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise BundleError(f"{file} cannot be read: {error}") from error
    sums: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        match = re.fullmatch(r"([0-9a-f]{64})  ([A-Za-z0-9_-][A-Za-z0-9._-]*)", line)
        if match is None:
            raise BundleError(f"{file}, line {number}: expected '<sha256>  <file name>'")
        sums[match[2]] = match[1]
    return hashlib.sha256(content).hexdigest(), sums


def _verified(file: Path, recorded: str, limits: BundleLimits) -> Iterator[bytes]:
    """Yield a file's content; then raise BundleTamperedError if its hash is not the recorded one."""
    actual = hashlib.sha256()
    for block in _blocks(file, *limits.of(file.name)):
        actual.update(block)
        yield block
    if actual.hexdigest() != recorded:
        raise BundleTamperedError(
            f"{file} is not the file that was exported: its sha256 is {actual.hexdigest()[:12]}..., "
            f"{SUMS_FILE} records {recorded[:12]}...",
            {"file": file.name, "expected": recorded, "actual": actual.hexdigest()},
        )


def _blocks(file: Path, max_bytes: int | None, limit: str = "") -> Iterator[bytes]:
    """Yield a file's content; `limit` is the name of `max_bytes`. Raises BundleError."""
    try:
        with open_regular(file, max_bytes) as stream:
            yield from blocks(stream, max_bytes)
    except FileNotFoundError as error:
        raise BundleError(f"{file} is missing: the bundle is incomplete") from error
    except FileTooLargeError as error:
        raise BundleError(f"{file} {error}{f' ({limit})' if limit else ''}") from error
    except NotReadableError as error:
        raise BundleError(f"{file} {error}") from error
    except OSError as error:
        raise BundleError(f"{file} cannot be read: {error.strerror}") from error


def _check_unpacked(file: Path, content: io.BytesIO, max_bytes: int) -> None:
    """Refuse an archive whose arrays exceed the limit or their packed content."""
    with zipfile.ZipFile(content) as archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > max_bytes:
            raise BundleError(f"{file} unpacks to {size:,} bytes: at most {max_bytes:,} (max_golden_bytes)")
        for member in archive.infolist():
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(stream)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise BundleError(f"{file}: '{member.filename}' declares the shape {shape} and holds less")
    content.seek(0)


@contextmanager
def _private_file() -> Iterator[tuple[IO[bytes], Path]]:
    """Give an empty private file, and the path under which this process can open it."""
    if DESCRIPTORS.is_dir():
        with tempfile.TemporaryFile() as unnamed:
            yield unnamed, DESCRIPTORS / str(unnamed.fileno())
    else:
        with tempfile.TemporaryDirectory(prefix="rlservo-") as folder, (Path(folder) / "copy").open("wb") as named:
            yield named, Path(folder) / "copy"


def write_golden(folder: Path, inputs: Mapping[str, NDArray[Any]], outputs: Mapping[str, NDArray[Any]]) -> None:
    """Write golden.npz; every array's first axis is the sample."""
    arrays = {f"input/{name}": value for name, value in inputs.items()}
    arrays.update({f"output/{name}": value for name, value in outputs.items()})
    # numpy before 2.1 would save `allow_pickle` as one more array; load_bundle refuses pickled ones.
    np.savez_compressed(folder / GOLDEN_FILE, **arrays)  # type: ignore[arg-type]  # for numpy 2's keyword above


def write_contract(folder: Path, contract: Contract) -> None:
    """Write contract.json and, with it, SHA256SUMS over all four files; the other three must exist.

    Both are written next to the old ones and then take their names: a failure before that leaves the bundle as it was.
    """
    with tempfile.TemporaryDirectory(prefix=".contract-", dir=folder) as name:
        beside = Path(name)
        (beside / CONTRACT_FILE).write_text(contract_json(contract) + "\n", encoding="utf-8")
        files = [beside / CONTRACT_FILE, *(folder / other for other in (GOLDEN_FILE, ONNX_FILE, TORCHSCRIPT_FILE))]
        sums = "".join(f"{sha256(file)}  {file.name}\n" for file in files)
        (beside / SUMS_FILE).write_text(sums, encoding="ascii")
        for file in (CONTRACT_FILE, SUMS_FILE):
            (beside / file).replace(folder / file)


def sha256(file: Path) -> str:
    """Return the file's hash as 64 hexadecimal digits."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
