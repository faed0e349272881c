"""Policies to choose from, on a server or in bundles on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rlservo.export.contract.bundle import find_bundles, read_contract
from rlservo.export.contract.errors import UnavailableError, UnknownPolicyError
from rlservo.serve_app.client.http_transport import Transport
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.interface import ActingPolicy, Closeable
from rlservo.serve_app.rollout.fallback import WithFallback
from rlservo.serve_app.runtime.compiled_policy import open_policy

TIMEOUT_S = 2.0  # of a look at what the server has
WAIT = "wait"  # instead of a fallback: time stands still until the server answers
FALLBACKS = (WAIT, "hold", "zero", "stop")


@dataclass(frozen=True)
class Link:
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

    def open(self, choice: Choice, link: Link) -> ActingPolicy:
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

    def open(self, choice: Choice, link: Link) -> ActingPolicy:
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
        for bundle in find_bundles(folder):
            contract = read_contract(bundle)
            self._folders[Choice(contract.name, contract.version)] = bundle

    def versions(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for choice in reversed(self._folders):
            found.setdefault(choice.name, []).append(choice.version)
        return dict(sorted(found.items()))

    def open(self, choice: Choice, link: Link) -> ActingPolicy:  # noqa: ARG002
        if choice not in self._folders:
            there = ", ".join(f"{each.name}/{each.version}" for each in self._folders)
            raise UnknownPolicyError(f"there is no bundle {choice.name}/{choice.version}: expected one of {there}")
        return open_policy(self._folders[choice])

    def close(self) -> None:
        """Nothing to close."""
