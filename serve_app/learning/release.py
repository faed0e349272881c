"""Release of a version to a server: proven, published, loaded, and named by an alias."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from rlservo.export.contract.bundle import ONNX_FILE, Bundle, load_bundle
from rlservo.export.contract.errors import ConflictError, DeadlineError, RlservoError, UnavailableError, UsageError
from rlservo.export.export_checkpoint import export_checkpoint, silent
from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.learning.admission import KnownVersion
from rlservo.serve_app.learning.run_folder import RunFolder
from rlservo.serve_app.recording.policy_format import PolicyFormat
from rlservo.serve_app.repository.publication import next_version, publish

RETRY_S = 2.0
ATTEMPTS = 5  # at a version's number, each after another publisher has taken one

Result = TypeVar("Result")


@dataclass(frozen=True)
class Target:
    """Destination of versions."""

    policy: str
    repository: str
    """A folder or URI, one of the server's."""
    alias: str


class Release:
    """Brings versions of one run to its server."""

    def __init__(
        self,
        target: Target,
        run: RunFolder,
        connect: Callable[[], AdminClient],
        *,
        app_dir: Path,
        progress: Callable[[str], object],
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """`connect` makes a client with the admin key as it is then; `progress` takes the current activity."""
        self._target, self._run, self._connect = target, run, connect
        self._app_dir, self._progress, self._sleep = app_dir, progress, sleep

    def publish(self, save: Callable[[Path], None]) -> KnownVersion:
        """Save a checkpoint under the next version's number, prove it and publish it.

        Raises ParityError and others if the gate refuses it; then nothing is published.
        """
        name, place = self._target.policy, self._target.repository
        for _ in range(ATTEMPTS):
            version = next_version(place, name)
            checkpoint = self._run.begin(name, version)
            save(checkpoint)
            self._progress(f"proving version {version}")
            result = export_checkpoint(
                checkpoint, self._run.bundles, name=name, version=version, app_dir=self._app_dir,
                untrained_filter=True, notify=silent,
            )  # fmt: skip
            bundle = load_bundle(result.path)
            try:
                self._until_reached(partial(publish, bundle, place))
            except ConflictError:  # another publisher was faster
                continue
            return _known(bundle)
        raise UsageError(f"{place}/{name}: others keep publishing versions; give the same command again")

    def serve(self, version: str, before: str | None) -> None:
        """Let the server load a version and point the alias to it; a repetition changes nothing.

        `before` is this run's last target of the alias, None at its first version. Raises ConflictError where
        someone else has moved it.
        """
        name, alias = self._target.policy, self._target.alias
        self._until_reached(lambda: self._load(name, version))
        self._until_reached(lambda: self._move(name, alias, version, before))

    def unload(self, version: str) -> None:
        """Let the server unload a version that robots no longer need, unless something still points to it."""
        try:
            with self._connect() as client:
                client.unload(self._target.policy, version)
        except RlservoError as error:
            self._progress(f"version {version} stays loaded: {error.message}")

    def _load(self, name: str, version: str) -> None:
        with self._connect() as client:
            client.load(name, version)

    def _move(self, name: str, alias: str, version: str, before: str | None) -> None:
        with self._connect() as client:
            served = next((one for one in client.listing()["policies"] if one["name"] == name), None)
            there = (served or {}).get("aliases", {}).get(alias)
            if there == version:
                return
            if there is not None and before is not None and there != before:
                raise ConflictError(
                    f"alias '{alias}' of policy '{name}' leads to version {there}, but this run had moved it to "
                    f"{before}: is another learner moving it? Give each its own --alias"
                )
            client.alias(name, alias, version, expected=there)

    def _until_reached(self, change: Callable[[], Result]) -> Result:
        """Return the result of `change`, tried until the server or the storage is reachable."""
        while True:
            try:
                return change()
            except (UnavailableError, DeadlineError) as error:
                self._progress(f"waiting until it can be released: {error.message}")
            self._sleep(RETRY_S)


def _known(bundle: Bundle) -> KnownVersion:
    contract_hash = PolicyFormat(bundle.contract).contract_hash
    return KnownVersion(bundle.contract.version, bundle.sums[ONNX_FILE], contract_hash)
