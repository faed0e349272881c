"""What should be served: versions, aliases, canary and shadow of each policy, and the changes an operator may make.

`ServedConfig` is what a person writes (Serve's `user_config`); a `Plan` is what came of it and of every change since:
whole, numbered, the same for every replica. A version in a plan carries the hash of the bundle that was accepted, so
that no replica serves another one under its name. It knows nothing of files, ray or HTTP.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from rlservo.export.bundle import NAME_PATTERN, VERSION_PATTERN, version_key
from rlservo.export.errors import ConflictError, UnknownPolicyError, UnknownVersionError, UsageError

PRODUCTION = "production"
ALIAS_PATTERN = r"^[a-z][a-z0-9_-]{0,31}$"
LONGEST_HISTORY = 16  # earlier versions of an alias that a rollback can go back through

Digests = Mapping[str, str]
DigestOf = Callable[[str, str], str]
"""(name, version) to the bundle's hash; raises UnknownPolicyError or UnknownVersionError."""


def _as_text(value: Any) -> Any:
    """YAML reads an unquoted version 3 as a number."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Version = Annotated[str, BeforeValidator(_as_text), Field(pattern=VERSION_PATTERN)]
Alias = Annotated[str, Field(pattern=ALIAS_PATTERN)]
Reference = Annotated[str, BeforeValidator(_as_text), Field(pattern=f"{VERSION_PATTERN}|{ALIAS_PATTERN}")]
"""A version, or an alias that leads to one: whatever moves the alias moves this, too."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Canary(_Model):
    """A share of what does not ask for a version goes to another one, all of a session to the same."""

    version: Reference
    share: float = Field(gt=0, le=1)
    """Of the sessions; of the requests, where they name no session."""


class PolicyConfig(_Model):
    """What a configuration says of one policy."""

    versions: tuple[Version, ...] | None = None
    """To be loaded; all that the repository holds when left out."""

    aliases: dict[Alias, Version] = {}
    """Names that clients may use in a version's place. `production` is the default version."""

    canary: Canary | None = None

    shadow: Reference | None = None
    """A version that computes, too, and whose action is only compared."""


class ServedConfig(_Model):
    """The `user_config` of the deployment."""

    policies: dict[Name, PolicyConfig] = {}

    unlisted: Literal["load", "ignore"] = "load"
    """What becomes of the repository's policies that `policies` does not name."""

    @property
    def wants_all(self) -> bool:
        """Whether something is meant by not being named, so that nothing of the repository may be missing."""
        return self.unlisted == "load" or any(policy.versions is None for policy in self.policies.values())

    @classmethod
    def read(cls, document: Any) -> Self:
        """Check a configuration as it was given. Raises UsageError."""
        try:
            return cls.model_validate(document or {})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "the document"
            raise UsageError(
                f"the policies' configuration is not usable: {where}: {first['msg']} (given: {first['input']!r:.80})"
            ) from None


class PolicyPlan(_Model):
    """One policy of a plan."""

    versions: dict[Version, str]
    """The version's bundle, as the SHA-256 of its SHA256SUMS."""

    aliases: dict[Alias, Version] = {}
    history: dict[Alias, tuple[Version, ...]] = {}
    """Where an alias led before, the last one last."""

    canary: Canary | None = None
    shadow: Reference | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        keys = [version_key(version) for version in self.versions]
        if len(set(keys)) != len(keys):
            raise ValueError("two versions compare equal, as '1' and '1.0.0' do: keep one of them")
        return self

    @property
    def default(self) -> str | None:
        """The version of whoever asks for none."""
        if PRODUCTION in self.aliases:
            return self.aliases[PRODUCTION]
        return max(self.versions, key=version_key, default=None)

    def version_of(self, reference: str) -> str | None:
        """Return the version that a version or an alias means, None where there is none."""
        version = self.aliases.get(reference, reference)
        return version if version in self.versions else None


class FailedVersion(_Model):
    """A bundle that cannot be served."""

    name: str
    version: str
    reason: str


class Refusal(_Model):
    """A change that was not taken: what ran before it goes on."""

    change: str
    reason: str
    at: str
    versions: tuple[FailedVersion, ...] = ()


class Plan(_Model):
    """What every replica is to serve."""

    generation: int
    config: str
    """The hash of the configuration that this was made from, refused ones included; a changed one is seen by it."""

    policies: dict[Name, PolicyPlan]
    changed_at: str
    changed_by: str
    refused: Refusal | None = None
    """The last change, if it was refused."""

    def policy(self, name: str) -> PolicyPlan:
        """Return a policy. Raises UnknownPolicyError."""
        plan = self.policies.get(name)
        if plan is None:
            known = ", ".join(sorted(self.policies)) or "none"
            raise UnknownPolicyError(f"no policy '{name[:64]}' is loaded: this server has {known}")
        return plan

    def after(self, policies: Mapping[str, PolicyPlan], by: str) -> Plan:
        """Return the next plan, with these policies."""
        return self.model_copy(
            update={
                "generation": self.generation + 1,
                "policies": dict(policies),
                "changed_at": now(),
                "changed_by": by,
                "refused": None,
            }
        )

    def refusing(self, refusal: Refusal, *, config: str | None = None) -> Plan:
        """Return the next plan: what was served before, and why a change of it was refused."""
        changes: dict[str, Any] = {"generation": self.generation + 1, "refused": refusal}
        return self.model_copy(update=changes if config is None else {**changes, "config": config})


def now() -> str:
    """Return the time as plans and statuses write it: UTC, ISO 8601."""
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")


def config_hash(document: Any) -> str:
    """Return what tells a changed configuration from the same one given again."""
    text = json.dumps(document or {}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def plan_of(config: ServedConfig, available: Mapping[str, Digests], before: Plan | None) -> dict[str, PolicyPlan]:
    """Return the policies that a configuration means, given the repository's bundles (name -> version -> hash).

    An alias that moves remembers where it led in `before`.
    Raises UnknownPolicyError, UnknownVersionError, ConflictError.
    """
    chosen = dict(config.policies)
    if config.unlisted == "load":
        chosen = {name: PolicyConfig() for name in available} | chosen
    policies = {}
    for name, wanted in sorted(chosen.items()):
        digests = available.get(name)
        if digests is None:
            raise UnknownPolicyError(
                f"the repository has no policy '{name}': it has {', '.join(sorted(available)) or 'none'}"
            )
        versions = digests if wanted.versions is None else {v: _digest(name, digests, v) for v in wanted.versions}
        was = before.policies.get(name) if before is not None else None
        policies[name] = _checked(
            name,
            {
                "versions": dict(sorted(versions.items(), key=lambda item: version_key(item[0]))),
                "aliases": wanted.aliases,
                "history": {} if was is None else _moved(was, wanted.aliases),
                "canary": wanted.canary,
                "shadow": wanted.shadow,
            },
        )
    return policies


# The changes an operator may make. Each returns the policies after it, and leaves the plan as it is.


def load(plan: Plan, name: str, version: str, digest: str) -> dict[str, PolicyPlan]:
    """Add a version, or take its bundle as it is now."""
    policy = plan.policies.get(name, PolicyPlan(versions={}))
    versions = dict(sorted({**policy.versions, version: digest}.items(), key=lambda item: version_key(item[0])))
    return _with(plan, name, policy, versions=versions)


def unload(plan: Plan, name: str, version: str | None) -> dict[str, PolicyPlan]:
    """Drop a version, or with None the whole policy. Raises ConflictError while something leads to the version."""
    policy = plan.policy(name)
    if version is None:
        return {other: each for other, each in plan.policies.items() if other != name}
    _require(name, policy, version)
    uses = [f"the alias '{alias}'" for alias, target in policy.aliases.items() if target == version]
    if policy.canary is not None and policy.version_of(policy.canary.version) == version:
        uses.append("the canary")
    if policy.shadow is not None and policy.version_of(policy.shadow) == version:
        uses.append("the shadow")
    if uses:
        raise ConflictError(
            f"policy '{name}' version {version} is in use by {' and '.join(uses)}: point that elsewhere first"
        )
    if len(policy.versions) == 1:
        raise ConflictError(f"version {version} is the last of policy '{name}': unload the policy itself")
    return _with(plan, name, policy, versions={v: digest for v, digest in policy.versions.items() if v != version})


def set_alias(plan: Plan, name: str, alias: str, version: str | None) -> dict[str, PolicyPlan]:
    """Let an alias lead to a loaded version, or with None remove it."""
    policy = plan.policy(name)
    aliases = dict(policy.aliases)
    if version is None:
        if alias not in aliases:
            raise ConflictError(f"policy '{name}' has no alias '{alias}': it has {_listed(aliases)}")
        for use, reference in (("canary", policy.canary and policy.canary.version), ("shadow", policy.shadow)):
            if reference == alias:
                raise ConflictError(f"the alias '{alias}' of policy '{name}' is in use by the {use}: end that first")
        del aliases[alias]
    else:
        _require(name, policy, version)
        aliases[alias] = version
    return _with(plan, name, policy, aliases=aliases, history=_moved(policy, aliases))


def roll_back(
    plan: Plan, name: str, alias: str, digest_of: DigestOf, *, expected: str | None = None
) -> dict[str, PolicyPlan]:
    """Let an alias lead where it led before, loading that version again if need be.

    `expected` is where it leads as far as the caller knows: the same command twice goes back once.
    """
    policy = plan.policy(name)
    if expected is not None and policy.aliases.get(alias) != expected:
        leads = f"leads to {policy.aliases[alias]}" if alias in policy.aliases else "is gone"
        raise ConflictError(
            f"the alias '{alias}' of policy '{name}' {leads} and was expected at {expected}: moved already"
        )
    earlier = policy.history.get(alias, ())
    if not earlier:
        raise ConflictError(f"the alias '{alias}' of policy '{name}' has led nowhere else: there is no way back")
    version = earlier[-1]
    versions = dict(policy.versions)
    if version not in versions:
        versions[version] = digest_of(name, version)
    history = {**policy.history, alias: earlier[:-1]}
    return _with(plan, name, policy, versions=versions, aliases={**policy.aliases, alias: version}, history=history)


def set_canary(plan: Plan, name: str, canary: Canary | None) -> dict[str, PolicyPlan]:
    """Send a share of the sessions to another version, or with None end that."""
    return _with(plan, name, plan.policy(name), canary=canary)


def set_shadow(plan: Plan, name: str, shadow: str | None) -> dict[str, PolicyPlan]:
    """Let another version compute along, or with None end that."""
    return _with(plan, name, plan.policy(name), shadow=shadow)


def _with(plan: Plan, name: str, policy: PolicyPlan, **changes: Any) -> dict[str, PolicyPlan]:
    values = {field: getattr(policy, field) for field in PolicyPlan.model_fields} | changes
    return {**plan.policies, name: _checked(name, values)}


def _checked(name: str, values: Mapping[str, Any]) -> PolicyPlan:
    try:
        policy = PolicyPlan(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ConflictError(f"policy '{name}': {first['msg'].removeprefix('Value error, ')}") from None
    for version in policy.aliases.values():
        _require(name, policy, version)
    if policy.canary is not None:
        _require(name, policy, policy.canary.version)
    if policy.shadow is not None:
        _require(name, policy, policy.shadow)
    return policy


def _require(name: str, policy: PolicyPlan, reference: str) -> None:
    if policy.version_of(reference) is None:
        what = "version" if reference[:1].isdigit() else "alias"
        raise UnknownVersionError(
            f"policy '{name}' has no {what} '{reference[:32]}': loaded are {_listed(policy.versions)}, "
            f"aliases are {_listed(policy.aliases)}"
        )


def _moved(policy: PolicyPlan, aliases: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the history after the aliases have moved."""
    history = dict(policy.history)
    for alias, version in policy.aliases.items():
        if aliases.get(alias) != version:
            history[alias] = (*history.get(alias, ()), version)[-LONGEST_HISTORY:]
    return history


def _digest(name: str, digests: Digests, version: str) -> str:
    if version not in digests:
        raise UnknownVersionError(
            f"the repository has no version {version} of policy '{name}': it has {_listed(digests)}"
        )
    return digests[version]


def _listed(names: Mapping[str, Any]) -> str:
    return ", ".join(names) or "none"
