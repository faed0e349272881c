"""Release of a version to a server: prove, publish and load it, then move an alias or promote it by a canary."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from rlservo.bundle.bundle import ONNX_FILE, Bundle, load_bundle
from rlservo.client.admin_client import AdminClient
from rlservo.client.promotion import INTERRUPTED, PROMOTED, ROLLED_BACK, Promotion, Terms
from rlservo.client.promotion_log import PromotionLog
from rlservo.deploy.learning.episode_filter import KnownVersion, Reward, named_reward
from rlservo.deploy.learning.run_folder import RunFolder
from rlservo.errors import (
    ConflictError,
    DeadlineError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from rlservo.export.export_checkpoint import export_checkpoint, silent
from rlservo.policy.acting_policy import PRODUCTION
from rlservo.recording.policy_format import PolicyFormat
from rlservo.serve_app.repository.publication import next_version, publish

RETRY_S = 2.0
EVERY_S = 5.0  # between two checks of a canary
ATTEMPTS = 5  # to get a version number, each after another publisher has taken one

Result = TypeVar("Result")


@dataclass(frozen=True)
class Target:
    """Destination of versions."""

    policy: str
    repository: str
    """A folder or URI, one of the server's repositories."""
    alias: str
    canary: Terms | None = None
    """If given, versions go to production by promotions on these terms, and no alias is moved."""


class Release:
    """Releases versions of one run to its server."""

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
        """`connect` makes a client of the server with the current admin key; `progress` takes the current activity."""
        self._target, self._run, self._connect = target, run, connect
        self._reward = ""
        self._app_dir, self._progress, self._sleep = app_dir, progress, sleep

    def named_reward(self, modules: Collection[str]) -> Reward | None:
        """Return the reward function that the served policy's contract names, for this run's contracts too.

        None if it names none. Raises UsageError if it cannot be loaded, or is not of these modules.
        """
        with suppress(UnknownPolicyError):  # not served before its first version
            self._reward = self._ask(lambda client: str(client.contract(self._target.policy).get("reward", "")))
        return named_reward(self._reward, modules) if self._reward else None

    def publish(self, save: Callable[[Path], None]) -> KnownVersion:
        """Save a checkpoint under the next version number, prove it and publish it.

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
                untrained_filter=True, reward=self._reward, notify=silent,
            )  # fmt: skip
            bundle = load_bundle(result.path)
            try:
                self._until_reached(partial(publish, bundle, place))
            except ConflictError:  # another publisher took this number
                continue
            return _known(bundle)
        raise UsageError(f"{place}/{name}: other publishers keep taking the next version: run the command again")

    def check_unclaimed(self) -> None:
        """Raise ConflictError if a new run's alias already points to a version, as another learner may move it."""
        name, alias = self._target.policy, self._target.alias
        there = None if self._target.canary else self._aliases().get(alias)
        if there is not None:
            raise ConflictError(
                f"alias '{alias}' of policy '{name}' already points to version {there}: is another learner moving it? "
                f"Give this run its own --alias, or remove a stale alias with 'rlservo policy alias {name} {alias}='"
            )

    def serve(self, version: str, before: str | None) -> str | None:
        """Load a version on the server and serve it to robots; if already done, this changes nothing.

        `before` is the version to which this run last moved the alias, None at first. Returns why the server refused
        the version or rolled its canary back, None if robots get it. Raises ConflictError if someone else changes the
        alias.
        """
        try:
            self._ask(lambda client: client.load(self._target.policy, version))
        except RefusedError as error:
            return error.message
        if self._target.canary is not None:
            return self._promote(version, self._target.canary)
        self._move(version, before)
        return None

    def unload(self, version: str) -> None:
        """Unload a version that robots no longer need, unless something still points to it."""
        try:
            with self._connect() as client:
                client.unload(self._target.policy, version)
        except RlservoError as error:
            self._progress(f"version {version} stays loaded: {error.message}")

    def _aliases(self) -> dict[str, str]:
        policies = self._ask(lambda client: client.listing()["policies"])
        return next((dict(one["aliases"]) for one in policies if one["name"] == self._target.policy), {})

    def _move(self, version: str, before: str | None) -> None:
        name, alias = self._target.policy, self._target.alias
        there = self._aliases().get(alias)
        if there == version:
            return
        if there not in (None, before):
            raise ConflictError(
                f"alias '{alias}' of policy '{name}' points to version {there}, but this run had moved it to {before}: "
                "is another learner moving it? Give each run its own --alias"
            )
        self._ask(lambda client: client.alias(name, alias, version, expected=there))

    def _promote(self, version: str, terms: Terms) -> str | None:
        """Put a version into production as `rlservo policy promote` does, resuming from its log."""
        log = self._run.path / "promotions" / f"{version}.jsonl"
        if self._aliases().get(PRODUCTION) == version:
            return None
        terms = replace(terms, version=version)
        log.parent.mkdir(exist_ok=True)
        with PromotionLog.open(log) as opened:
            try:
                outcome = Promotion(
                    lambda _url: self._connect(), terms, opened, every_s=EVERY_S, say=self._progress
                ).run()
            except UsageError as error:  # for example another learner's canary
                raise ConflictError(f"version {version} was not promoted: {error.message}") from None
        if outcome.outcome == INTERRUPTED:
            raise KeyboardInterrupt
        if outcome.outcome not in (PROMOTED, ROLLED_BACK):
            raise ConflictError(f"version {version} was not promoted: {outcome.why}")
        return outcome.why if outcome.outcome == ROLLED_BACK else None

    def _ask(self, question: Callable[[AdminClient], Result]) -> Result:
        """Return the server's answer, however long that takes."""

        def ask() -> Result:
            with self._connect() as client:
                return question(client)

        return self._until_reached(ask)

    def _until_reached(self, change: Callable[[], Result]) -> Result:
        """Return the result of `change`, which is retried until the server or the storage is reachable."""
        while True:
            try:
                return change()
            except (UnavailableError, DeadlineError) as error:
                self._progress(f"waiting to release the version: {error.message}")
            self._sleep(RETRY_S)


def _known(bundle: Bundle) -> KnownVersion:
    contract_hash = PolicyFormat(bundle.contract).contract_hash
    return KnownVersion(bundle.contract.version, bundle.sums[ONNX_FILE], contract_hash)
