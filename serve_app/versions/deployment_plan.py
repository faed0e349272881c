"""Plan of what a server serves: versions, aliases, canary and shadow of each policy.

A person writes a `ServedConfig` (Serve's `user_config`) for a repository that has no plan yet. A `Plan` is the result
of it and of every command since: whole, numbered, the same for every process. A version in a plan carries the hash of
the bundle that was accepted, so that no process serves another one under its name.

Every policy of a plan has the alias `production`, the version for clients that name none. If no one has set it, it is
written down when the policy is first served. So a version that is loaded later is never in use by itself, and a
rollback always knows the previous version.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from typing_extensions import Self

from rlservo.bundle.contract import NAME_PATTERN, VERSION_PATTERN, first_fault
from rlservo.errors import UnknownPolicyError, UsageError
from rlservo.policy.acting_policy import PRODUCTION

ALIAS_PATTERN = r"^[a-z][a-z0-9_-]{0,31}$"


def _as_text(value: Any) -> Any:
    """YAML reads an unquoted version 3 as a number."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Version = Annotated[str, BeforeValidator(_as_text), Field(pattern=VERSION_PATTERN)]
Alias = Annotated[str, Field(pattern=ALIAS_PATTERN)]
Loadable = tuple[str, str, str]  # (name, version, hash of the bundle)
Reference = Annotated[str, BeforeValidator(_as_text), Field(pattern=f"{VERSION_PATTERN}|{ALIAS_PATTERN}")]
"""A version, or an alias that leads to one: moving the alias also moves this."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Canary(_Model):
    """A share of the sessions that name no version goes to another one, each session always to the same."""

    version: Reference
    share: float = Field(gt=0, le=1)
    """Of the sessions; of the requests, if they name no session."""


class PolicyConfig(_Model):
    """Configuration of one policy."""

    versions: tuple[Version, ...] | None = None
    """To be loaded; all that the repository holds when left out."""

    aliases: dict[Alias, Version] = {}
    """Names that clients may use in a version's place. `production` is the default version; left out, it stays where it
    is, and at the start leads to the newest."""

    canary: Canary | None = None

    shadow: Reference | None = None
    """A version that is also computed, and whose action is only compared."""


class ServedConfig(_Model):
    """The `user_config` of the deployment."""

    policies: dict[Name, PolicyConfig] = {}

    unlisted: Literal["load", "ignore"] = "load"
    """Treatment of the repository's policies that `policies` does not name."""

    @classmethod
    def parse(cls, document: Any) -> Self:
        """Check a configuration as it was given. Raises UsageError."""
        try:
            return cls.model_validate(document or {})
        except ValidationError as error:
            fault = first_fault(error, shows_input=True)
            raise UsageError(f"the policies' configuration is not usable: {fault}") from None


class PolicyPlan(_Model):
    """One policy of a plan."""

    versions: dict[Version, str] = {}
    """Each version's bundle, as the SHA-256 of its SHA256SUMS. Empty if the policy was unloaded: its history is kept
    for when it is loaded again."""

    aliases: dict[Alias, Version] = {}
    history: dict[Alias, tuple[Version, ...]] = {}
    """Previous versions of an alias, the latest last."""

    unloaded: dict[Version, str] = {}
    """Bundles of versions that were loaded before: a rollback returns to the same ones, and polling skips them."""

    canary: Canary | None = None
    shadow: Reference | None = None

    @property
    def default(self) -> str | None:
        """The version for clients that name none; None if nothing is loaded."""
        return self.aliases.get(PRODUCTION)

    @property
    def uses(self) -> dict[str, str]:
        """Version or alias by its use, in words, such as "the alias 'production'"."""
        uses = {f"the alias '{alias}'": version for alias, version in self.aliases.items()}
        if self.canary is not None:
            uses["the canary"] = self.canary.version
        if self.shadow is not None:
            uses["the shadow"] = self.shadow
        return uses

    def loadables(self, name: str) -> list[Loadable]:
        """Return the bundles of the versions, given the policy's name."""
        return [(name, version, digest) for version, digest in self.versions.items()]

    def version_of(self, reference: str) -> str | None:
        """Return the version that a version or an alias means, None if there is none."""
        version = self.aliases.get(reference, reference)
        return version if version in self.versions else None


class Plan(_Model):
    """Policies and versions that every process serves."""

    generation: int
    """Its number: 1 is a repository's first."""

    policies: dict[Name, PolicyPlan]
    changed_at: str = ""
    changed_by: str = "configuration"

    def policy(self, name: str) -> PolicyPlan:
        """Return a policy. Raises UnknownPolicyError."""
        plan = self.policies.get(name)
        if plan is None or not plan.versions:
            known = ", ".join(sorted(name for name, each in self.policies.items() if each.versions)) or "none"
            raise UnknownPolicyError(f"no policy '{name[:64]}' is loaded: this server has {known}")
        return plan

    def after(self, policies: Mapping[str, PolicyPlan], by: str) -> Plan:
        """Return the next plan, with these policies."""
        now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        return Plan(generation=self.generation + 1, policies=dict(policies), changed_at=now, changed_by=by)
