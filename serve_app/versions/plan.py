"""Plan of what a server serves: versions, aliases, canary and shadow of each policy, and its changes.

`ServedConfig` is what a person writes (Serve's `user_config`); a `Plan` is what came of it and of every change since:
whole, numbered, the same for every replica. A version in a plan carries the hash of the bundle that was accepted, so
that no replica serves another one under its name.

Every policy of a plan has the alias `production`, which is what clients get that ask for no version; where nobody said
so it is written down when the policy is first served. So a version that is loaded later is never in use by itself, and
a rollback always knows what was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from rlservo.export.contract.contract import NAME_PATTERN, VERSION_PATTERN, version_key
from rlservo.export.contract.errors import ConflictError, UnknownPolicyError, UnknownVersionError, UsageError

PRODUCTION = "production"
ALIAS_PATTERN = r"^[a-z][a-z0-9_-]{0,31}$"
LONGEST_HISTORY = 16  # earlier versions of an alias that a rollback can go back through

Digests = Mapping[str, str]


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
    """Names that clients may use in a version's place. `production` is the default version; left out, it stays where it
    is, and at the start leads to the newest."""

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
    """The version's bundle, as the SHA-256 of its SHA256SUMS. None at all: the policy was unloaded, and its
    history is kept for when it is loaded again."""

    aliases: dict[Alias, Version] = {}
    history: dict[Alias, tuple[Version, ...]] = {}
    """Where an alias led before, the last one last."""

    unloaded: dict[Version, str] = {}
    """The bundles of the history's versions that are not loaded: a rollback leads back to the same ones."""

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
        """The version of whoever asks for none; None where nothing is loaded."""
        return self.aliases.get(PRODUCTION)

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
        if plan is None or not plan.versions:
            known = ", ".join(sorted(name for name, each in self.policies.items() if each.versions)) or "none"
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

    An alias that moves remembers where it led in `before`. Where `production` is not said it stays where it led, unless
    that version is no longer to be served.
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
        was = (before.policies.get(name) if before is not None else None) or PolicyPlan(versions={})
        stays = {PRODUCTION: was.default} if was.default in versions else {}
        policies[name] = _checked(
            name,
            was,
            versions=versions,
            aliases={**stays, **wanted.aliases},
            canary=wanted.canary,
            shadow=wanted.shadow,
        )
    if before is not None:  # what is no longer served is as good as unloaded: its history stays
        for name in before.policies.keys() - policies.keys():
            policies[name] = _unloaded(name, before.policies[name])
    return policies


# The changes an operator may make. Each returns the policies after it, and leaves the plan as it is.


def load(plan: Plan, name: str, version: str, digest: str) -> dict[str, PolicyPlan]:
    """Add a version, or take its bundle as it is now; what clients get stays as it is.

    The first version of a policy that is not served becomes its `production`: it changes no reply but a 404. Raises
    ConflictError where the folder holds another bundle than the one in use under this version.
    """
    policy = plan.policies.get(name) or PolicyPlan(versions={})
    uses = _uses(policy, version)
    if uses and policy.versions[version] != digest:
        raise ConflictError(
            f"policy '{name}' version {version} is in use by {' and '.join(uses)}, and its folder holds another bundle "
            "by now: export changes under a new version, or point that elsewhere first"
        )
    return _with(plan, name, policy, versions={**policy.versions, version: digest})


def unload(plan: Plan, name: str, version: str | None) -> dict[str, PolicyPlan]:
    """Drop a version, or with None the whole policy. Raises ConflictError while something leads to the version."""
    policy = plan.policy(name)
    if version is None:  # its history stays: a rollback after it is loaded again still knows what was in use
        return {**plan.policies, name: _unloaded(name, policy)}
    _require(name, policy, version)
    if len(policy.versions) == 1:
        raise ConflictError(f"version {version} is the last of policy '{name}': unload the policy itself")
    uses = _uses(policy, version)
    if uses:
        raise ConflictError(
            f"policy '{name}' version {version} is in use by {' and '.join(uses)}: point that elsewhere first"
        )
    return _with(plan, name, policy, versions={v: digest for v, digest in policy.versions.items() if v != version})


def set_alias(plan: Plan, name: str, alias: str, version: str | None) -> dict[str, PolicyPlan]:
    """Let an alias lead to a loaded version, or with None remove it; `production` can only be moved."""
    policy = plan.policy(name)
    aliases = dict(policy.aliases)
    if version is None:
        if alias not in aliases:
            raise ConflictError(f"policy '{name}' has no alias '{alias}': it has {_listed(aliases)}")
        if alias == PRODUCTION:
            raise ConflictError(
                f"the alias '{PRODUCTION}' of policy '{name}' says what clients get that ask for no version: point it "
                "elsewhere, or unload the policy"
            )
        for use, reference in (("canary", policy.canary and policy.canary.version), ("shadow", policy.shadow)):
            if reference == alias:
                raise ConflictError(f"the alias '{alias}' of policy '{name}' is in use by the {use}: end that first")
        del aliases[alias]
    else:
        _require(name, policy, version)
        aliases[alias] = version
    return _with(plan, name, policy, aliases=aliases)


def roll_back(plan: Plan, name: str, alias: str, *, expected: str | None = None) -> dict[str, PolicyPlan]:
    """Let an alias lead where it led before, to the same bundle, which is loaded again if need be.

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
    versions = {version: policy.unloaded.get(version, ""), **policy.versions}
    changed = _with(plan, name, policy, versions=versions, aliases={**policy.aliases, alias: version})
    history = {**changed[name].history, alias: earlier[:-1]}
    return {**changed, name: changed[name].model_copy(update={"history": history})}


def set_canary(plan: Plan, name: str, canary: Canary | None) -> dict[str, PolicyPlan]:
    """Send a share of the sessions to another version, or with None end that."""
    return _with(plan, name, plan.policy(name), canary=canary)


def set_shadow(plan: Plan, name: str, shadow: str | None) -> dict[str, PolicyPlan]:
    """Let another version compute along, or with None end that."""
    return _with(plan, name, plan.policy(name), shadow=shadow)


def _with(plan: Plan, name: str, policy: PolicyPlan, **changes: Any) -> dict[str, PolicyPlan]:
    return {**plan.policies, name: _checked(name, policy, **changes)}


def _checked(name: str, was: PolicyPlan, **changes: Any) -> PolicyPlan:
    """Return the policy with these changes: sorted, in use as somebody said, with the way back from what it was."""
    values: dict[str, Any] = {field: getattr(was, field) for field in PolicyPlan.model_fields} | changes
    versions: dict[str, str] = dict(sorted(values["versions"].items(), key=lambda item: version_key(item[0])))
    aliases: dict[str, str] = dict(values["aliases"])
    if versions and PRODUCTION not in aliases:
        aliases[PRODUCTION] = list(versions)[-1]
    history = _moved(was, aliases)
    known = {**was.unloaded, **was.versions}
    kept = {version for earlier in history.values() for version in earlier if version not in versions}
    unloaded = {version: known[version] for version in sorted(kept, key=version_key) if version in known}
    values |= {"versions": versions, "aliases": aliases, "history": history, "unloaded": unloaded}
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


def _unloaded(name: str, policy: PolicyPlan) -> PolicyPlan:
    return _checked(name, policy, versions={}, aliases={}, canary=None, shadow=None)


def _uses(policy: PolicyPlan, version: str) -> list[str]:
    """Return what leads to a version."""
    uses = [f"the alias '{alias}'" for alias, target in policy.aliases.items() if target == version]
    if policy.canary is not None and policy.version_of(policy.canary.version) == version:
        uses.append("the canary")
    if policy.shadow is not None and policy.version_of(policy.shadow) == version:
        uses.append("the shadow")
    return uses


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
    for alias, version in aliases.items():  # loaded again as what it was: the way back is further back
        if history.get(alias, ())[-1:] == (version,):
            history[alias] = history[alias][:-1]
    return history


def _digest(name: str, digests: Digests, version: str) -> str:
    if version not in digests:
        raise UnknownVersionError(
            f"the repository has no version {version} of policy '{name}': it has {_listed(digests)}"
        )
    return digests[version]


def _listed(names: Mapping[str, Any]) -> str:
    return ", ".join(names) or "none"
