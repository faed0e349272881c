"""`AdminClient`: the commands of `/v1/admin` as methods, for `rlservo policy`."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rlservo.client.formats.addresses import is_loopback
from rlservo.client.formats.admin_key_file import key_file, read_key
from rlservo.client.http_transport import Transport
from rlservo.errors import RlservoError, UnauthenticatedError, UnavailableError, UsageError
from rlservo.policy.acting_policy import Closeable

KEY_VARIABLE = "RLSERVO_ADMIN_KEY"
LOOK_TIMEOUT_S = 10.0  # for requests that load nothing
TIMEOUT_S = 90.0  # every replica loads and proves a version before the server answers


class AdminClient(Closeable):
    """Changes a server's plan. Every method raises the server's error."""

    def __init__(self, url: str, *, api_key: str, timeout_s: float = TIMEOUT_S) -> None:
        """Take the connection's settings; nothing is sent before the first call."""
        # Not retried: a change whose answer was lost would be made twice.
        self._transport = _Transport(url, timeout_s=timeout_s, retries=0, api_key=api_key)

    @classmethod
    def of_operator(cls, url: str, file: Path | None) -> AdminClient:
        """Return a client with the key that `find_key` finds, whose errors say where that is. Raises what it raises."""
        client = cls(url, api_key=find_key(url, file))
        client._transport.key_place = str(file or f"{KEY_VARIABLE}, or in the file that 'rlservo serve' wrote here")
        return client

    def listing(self) -> dict[str, Any]:
        """Return the answering process's listing, as `GET /v1/policies`."""
        listing: dict[str, Any] = self._transport.get("v1", "policies", timeout_s=LOOK_TIMEOUT_S)
        return listing

    def contract(self, name: str) -> dict[str, Any]:
        """Return the contract of a policy's default version."""
        contract: dict[str, Any] = self._transport.get("v1", "policies", name, timeout_s=LOOK_TIMEOUT_S)
        return contract

    def metrics(self) -> str:
        """Return the metrics in Prometheus' format."""
        return self._transport.get_bytes("metrics", timeout_s=LOOK_TIMEOUT_S).decode("utf-8", "replace")

    def recordings(self) -> dict[str, int]:
        """Return the server's recordings: the files' names, and the present size of each in bytes."""
        files: dict[str, int] = self._transport.get("v1", "admin", "recordings", timeout_s=LOOK_TIMEOUT_S)
        return files

    def recording(self, name: str, begin: int) -> bytes:
        """Return up to some MiB of a recording from byte `begin` on; nothing at its end."""
        return self._transport.get_bytes("v1", "admin", "recordings", name, str(begin))

    def plans(self) -> dict[str, int]:
        """Return the number of the plan that each process follows, by name: all workers, or one replica."""
        found = re.findall(r'^rlservo_plan_generation\{replica="([^"]*)"\} (\d+)', self.metrics(), re.MULTILINE)
        return {process: int(number) for process, number in found}

    def load(self, name: str, version: str | None = None) -> dict[str, Any]:
        """Load and prove a version; None means the repository's newest."""
        return self.command(name, "load", {"version": version})

    def unload(self, name: str, version: str | None = None) -> dict[str, Any]:
        """Unload a version, or with None the whole policy."""
        return self.command(name, "unload", {"version": version})

    def alias(self, name: str, alias: str, version: str | None, *, expected: str | None = None) -> dict[str, Any]:
        """Point an alias to a loaded version, or with None remove it; refused if it no longer points to `expected`."""
        return self.command(name, "alias", {"alias": alias, "version": version, "expected": expected})

    def rollback(self, name: str, alias: str) -> dict[str, Any]:
        """Move an alias back to its previous version."""
        return self.command(name, "rollback", {"alias": alias})

    def canary(self, name: str, version: str | None, share: float | None = None) -> dict[str, Any]:
        """Send a share of the sessions to a version, or with None end the canary."""
        return self.command(name, "canary", {"version": version, "share": share})

    def shadow(self, name: str, version: str | None) -> dict[str, Any]:
        """Run a version as shadow, or with None end the shadow."""
        return self.command(name, "shadow", {"version": version})

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()

    def command(self, name: str, command: str, document: dict[str, Any]) -> dict[str, Any]:
        """Send a command (`load`, `unload`, `alias`, `rollback`, `canary`, `shadow`); return the new listing."""
        reply: dict[str, Any] = self._transport.post("v1", "admin", "policies", name, command, document=document)
        return reply


class _Transport(Transport):
    """A transport that says where a key came from which the server does not know."""

    key_place = ""

    def _call(self, method: str, path: tuple[str, ...], body: bytes | None, timeout_s: float | None) -> bytes:
        try:
            return super()._call(method, path, body, timeout_s)
        except UnauthenticatedError:
            if not self.key_place:
                raise
            raise UnauthenticatedError(
                f"{self.url} does not know the key in {self.key_place}: expected one of that server's keys"
            ) from None


def find_key(url: str, file: Path | None) -> str:
    """Return the admin key: from the file, from RLSERVO_ADMIN_KEY, or of this user's server on that port.

    Raises UsageError if there is none, and UnavailableError if no server answers there either.
    """
    if file is not None:
        return read_key(file)
    key = os.environ.get(KEY_VARIABLE)
    if key:
        return key
    parts = urlsplit(url)
    local = key_file(parts.port or 80)
    if is_loopback(parts.hostname or "") and local.exists():
        return read_key(local)
    _check_answers(url)
    raise UsageError(
        f"administration needs an admin key: name its file with --key-file or set {KEY_VARIABLE} "
        "('rlservo serve' writes one and prints its path; 'rlservo key LABEL --admin' makes one for other servers)"
    )


def _check_answers(url: str) -> None:
    """Raise UnavailableError if no server answers there: without one, a missing key is not the fault."""
    transport = Transport(url, timeout_s=LOOK_TIMEOUT_S, retries=0)
    try:
        transport.get_bytes("v2", "health", "live")
    except UnavailableError as error:
        raise UnavailableError(f"{error.message}: start it with `rlservo serve`, or name another with --url") from None
    except RlservoError:  # something answers there
        return
    finally:
        transport.close()
