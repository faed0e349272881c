"""Bundles on disk: find them by name and version, tell them apart by their hashes.

A name or version that a request brings is only ever compared with what the folders hold; no path is made of it.
Everything here blocks (hashing, onnxruntime, golden vectors), and may do so for ever where a file system hangs:
`version_loader.py` calls it through `BlockingCalls`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from rlservo.export.contract.bundle import DEFAULT_LIMITS, BundleLimits, digest_of, find_bundles, read_contract
from rlservo.export.contract.contract import version_key
from rlservo.export.contract.errors import (
    BundleError,
    RlservoError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.serve_app.versions.plan import ServedConfig

Key = tuple[str, str]  # (name, version)


class Repository:
    """The folders of bundles that a server was given."""

    def __init__(self, paths: Iterable[str | Path], limits: BundleLimits = DEFAULT_LIMITS) -> None:
        self._paths = [Path(path) for path in paths]
        self._limits = limits
        if not self._paths:
            raise UsageError("no policy to serve: give at least one bundle folder")

    def scan(self) -> tuple[dict[Key, Path], dict[Path, RlservoError]]:
        """Return the bundles by name and version, and what cannot be served, by folder.

        Two bundles of the same policy in the same version are among the latter: nobody could say which one is meant.
        A copy of a bundle is the bundle.
        """
        found: dict[Key, Path] = {}
        errors: dict[Path, RlservoError] = {}
        folders: dict[Path, Path] = {}  # resolved -> as given: the same folder given twice counts once
        for path in self._paths:
            try:
                folders.update({folder.resolve(): folder for folder in find_bundles(path)})
            except BundleError as error:
                errors[path] = error
        twice: set[Key] = set()
        for folder in folders.values():
            try:
                contract = read_contract(folder, self._limits)
                key = (contract.name, contract.version)
                copied = key in found and digest_of(folder) == digest_of(found[key])
            except BundleError as error:
                errors[folder] = error
                continue
            if key in found and not copied:
                twice.add(key)
                errors[folder] = UsageError(
                    f"policy '{key[0]}' version {key[1]} is in both {found[key]} and {folder}: "
                    "serve one of them, or export one under another name or version"
                )
            elif not copied:
                found[key] = folder
        return {key: folder for key, folder in found.items() if key not in twice}, errors

    def available(self, config: ServedConfig) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version.

        Where the configuration means all that is there, all of it has to be good: raises BundleError or UsageError.
        """
        found, errors = self.scan()
        if config.wants_all:
            raise_all(list(errors.values()))
        hashes: dict[str, dict[str, str]] = {}
        for (name, version), folder in sorted(found.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            hashes.setdefault(name, {})[version] = digest_of(folder)
        return hashes

    def find(self, name: str, version: str | None) -> tuple[str, Path]:
        """Return (version, folder) of a bundle; None is the newest one.

        Raises UnknownPolicyError or UnknownVersionError, or what is wrong with the folder of that name and version.
        """
        found, errors = self.scan()
        versions = sorted((v for n, v in found if n == name), key=version_key)
        wanted = version if version is not None else (versions[-1] if versions else None)
        if wanted is not None and (name, wanted) in found:
            return wanted, found[name, wanted]
        # A folder of that name and version that cannot be served says more than that there is none.
        for folder, error in errors.items():
            if folder.parent.name == name and version in (folder.name, None):
                raise error
        if not versions:
            known = ", ".join(sorted({n for n, _ in found})) or "none"
            raise UnknownPolicyError(f"the repository has no policy '{name[:64]}': it has {known}")
        raise UnknownVersionError(
            f"the repository has no version '{str(version)[:32]}' of policy '{name}': it has {', '.join(versions)}"
        )

    def find_digest(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle, as `find`."""
        found, folder = self.find(name, version)
        return found, digest_of(folder)


def raise_all(errors: Sequence[RlservoError]) -> None:
    """Raise the error, or one that lists all of them."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        sentences = "; ".join(error.message for error in errors)
        raise BundleError(f"{len(errors)} bundles cannot be served: {sentences}")
