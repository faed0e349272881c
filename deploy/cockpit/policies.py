"""Policies to choose from, on a server or in bundles on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rlservo.bundle.bundle import find_bundles, read_contract
from rlservo.bundle.production import PRODUCTION, production_of
from rlservo.client.http_transport import Transport
from rlservo.client.policy_client import PolicyClient
from rlservo.drive.fallback import WithFallback
from rlservo.errors import BundleError, UnavailableError, UnknownPolicyError
from rlservo.policy.acting_policy import ActingPolicy, Closeable
from rlservo.policy.compiled_policy import open_policy

TIMEOUT_S = 2.0  # of a look at what the server has
WAIT = "wait"  # instead of a fallback: time stands still until the server answers
FALLBACKS = (WAIT, "hold", "zero", "stop")


@dataclass(frozen=True)
class ServerLink:
    """Transport and limits of requests to a server."""

    deadline_ms: float = 1000.0
    fallback: str = WAIT


@dataclass(frozen=True)
class Choice:
    """A policy, and a version or an alias of it."""

    name: str
    version: str


class PolicySource(Closeable, Protocol):
    """Source of policies."""

    is_remote: bool

    def versions(self) -> dict[str, list[str]]:
        """Return each policy's aliases, then its versions from the newest on. May raise UnavailableError."""
        ...

    def open(self, choice: Choice, link: ServerLink) -> ActingPolicy:
        """Return the policy to act with. Raises UnknownPolicyError, BundleError or UnavailableError."""
        ...


class ServedPolicies(PolicySource):
    """The policies of an rlservo server."""

    is_remote = True

    def __init__(self, url: str, *, api_key: str | None = None) -> None:
        self._api_key = api_key
        self._transport = Transport(url, timeout_s=TIMEOUT_S, retries=0, api_key=api_key)
        self.url = self._transport.url

    def versions(self) -> dict[str, list[str]]:
        listing = self._transport.get("v1", "policies")
        try:
            return {
                str(each["name"]): [*sorted(map(str, each["aliases"])), *reversed(list(map(str, each["versions"])))]
                for each in listing["policies"]
            }
        except (KeyError, TypeError) as error:
            raise UnavailableError(
                f"{self.url} sent a list of policies that cannot be read: is it another version of rlservo?"
            ) from error

    def open(self, choice: Choice, link: ServerLink) -> ActingPolicy:
        client = PolicyClient(
            self.url,
            choice.name,
            version=choice.version,
            retries=0,
            api_key=self._api_key,
            deadline_ms=link.deadline_ms,
        )
        try:
            _ = client.contract  # resolves the version, or fails now
            if link.fallback in ("hold", "zero", "stop"):
                return WithFallback(client, link.fallback)
        except BaseException:
            client.close()
            raise
        return client

    def close(self) -> None:
        self._transport.close()


class BundledPolicies(PolicySource):
    """The bundles at or below a folder, in process."""

    is_remote = False

    def __init__(self, folder: Path) -> None:
        """Raise BundleError if there is none."""
        self._folders: dict[Choice, Path] = {}
        self._production: dict[str, str | BundleError] = {}
        """The production version by policy, or why it is not known."""
        bundles = find_bundles(folder)
        for bundle in bundles:
            name, version = (contract := read_contract(bundle)).name, contract.version
            self._folders[Choice(name, version)] = bundle
            if name not in self._production and sum(each.parent == bundle.parent for each in bundles) > 1:
                try:
                    if (production := production_of(bundle.parent, name)) is not None:
                        self._production[name] = production.version
                except BundleError as error:
                    self._production[name] = error

    def versions(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for choice in reversed(self._folders):
            found.setdefault(choice.name, []).append(choice.version)
        for name, versions in found.items():
            if name in self._production:
                versions.insert(0, PRODUCTION)
        return dict(sorted(found.items()))

    def open(self, choice: Choice, link: ServerLink) -> ActingPolicy:  # noqa: ARG002
        if choice.version == PRODUCTION:
            production = self._production.get(choice.name, PRODUCTION)
            if isinstance(production, BundleError):
                raise production
            choice = Choice(choice.name, production)
        if choice not in self._folders:
            there = ", ".join(f"{each.name}/{each.version}" for each in self._folders)
            raise UnknownPolicyError(f"there is no bundle {choice.name}/{choice.version}: expected one of {there}")
        return open_policy(self._folders[choice])

    def close(self) -> None:
        """Nothing to close."""
