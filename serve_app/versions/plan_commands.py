"""Commands that change a plan: load, unload, alias, rollback, canary, shadow; by a server or on a repository itself.

A command returns the policies after it, and leaves the plan as it is. No command touches a file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError
from typing_extensions import Self

from rlservo.bundle.contract import first_fault, version_key
from rlservo.errors import (
    ConflictError,
    RequestError,
    UnknownVersionError,
)
from rlservo.policy.acting_policy import PRODUCTION
from rlservo.serve_app.repository.repository import Listing
from rlservo.serve_app.versions.deployment_plan import (
    Alias,
    Canary,
    Plan,
    PolicyConfig,
    PolicyPlan,
    Reference,
    ServedConfig,
    Version,
)

LONGEST_HISTORY = 16  # earlier versions of an alias that a rollback can go back through

Policies = dict[str, PolicyPlan]


class Command(BaseModel):
    """One command on one policy."""

    model_config = ConfigDict(extra="forbid")
    verb: ClassVar[str]
    summary: ClassVar[str]
    nothing: ClassVar[str] = ""  # the word for a command without values
    _notes: list[str] = PrivateAttr(default_factory=list)

    @property
    def notes(self) -> list[str]:
        """What differs without harm between the versions that it gives to the same clients."""
        return self._notes

    def line(self, name: str) -> str:
        """Return the command as `rlservo policy` takes it, for the plan and the logs."""
        values = "=".join(str(value or "") for field, value in self if field != "expected")
        return f"{self.verb} {name} {values if values.strip('=') else self.nothing}".strip()

    def change(self, plan: Plan, name: str) -> Policies:
        """Return the policies after it. Raises UnknownPolicyError, UnknownVersionError, ConflictError, RequestError."""
        return {**plan.policies, name: self.changed(name, plan.policy(name))}

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        """Return the policy after it, as `change` does."""
        raise NotImplementedError


class Load(Command):
    """Add a version, or replace its bundle by the current one; clients keep the version that they get.

    The first version of a policy that is not served becomes its `production`: it changes no reply but a 404.
    """

    verb = "load"
    summary = "Load a version, prove it, and keep it ready: not in use until an alias points to it"
    version: Version | None = Field(default=None, description="The repository's newest by default.")
    _digest: str = PrivateAttr("")

    @classmethod
    def of(cls, version: str, digest: str) -> Self:
        """Return the command for a bundle that the repository holds; without one it cannot change a plan."""
        command = cls(version=version)
        command._digest = digest
        return command

    def change(self, plan: Plan, name: str) -> Policies:
        return {**plan.policies, name: self.changed(name, plan.policies.get(name) or PolicyPlan())}

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        return _changed(name, policy, versions={**policy.versions, str(self.version): self._digest})


class Poll(Load):
    """Add a newer version that a server has found by itself."""

    verb = "poll"


class Evaluate(Command):
    """Accept a bundle with more evaluations in its contract instead of the one before; the network is the same.

    Aliases, canary and shadow stay, and a rollback finds it too. No server takes this command: `rlservo verify` gives
    it where it has written the contract.
    """

    verb = "verify"
    version: Version
    _digests: tuple[str, str] = PrivateAttr(("", ""))

    @classmethod
    def of(cls, version: str, before: str, after: str) -> Self:
        """Return the command for the hashes of a bundle before and after its evaluation."""
        command = cls(version=version)
        command._digests = (before, after)
        return command

    def change(self, plan: Plan, name: str) -> Policies:
        policy, (before, after) = plan.policies.get(name), self._digests
        if policy is None:
            return plan.policies

        def accepted(digests: Mapping[str, str]) -> dict[str, str]:
            return {v: after if (v, each) == (self.version, before) else each for v, each in digests.items()}

        changes = {"versions": accepted(policy.versions), "unloaded": accepted(policy.unloaded)}
        return {**plan.policies, name: policy.model_copy(update=changes)}


class Unload(Command):
    verb = "unload"
    summary = "Unload a version, or the policy"
    version: Version | None = Field(default=None, description="The whole policy by default.")

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        version = self.version
        if version is None:  # its history stays: a rollback after it is loaded again still knows what was in use
            return _changed(name, policy, versions={}, aliases={}, canary=None, shadow=None)
        _require(name, policy, version)
        if len(policy.versions) == 1:
            raise ConflictError(f"version {version} is the last of policy '{name}': unload the policy itself")
        return _changed(name, policy, versions={v: each for v, each in policy.versions.items() if v != version})


class SetAlias(Command):
    """Point an alias to a loaded version, or remove it; `production` can only be moved.

    `expected` protects another operator's change. The same command twice succeeds twice.
    """

    verb = "alias"
    summary = "Point an alias to a loaded version"
    alias: Alias = Field(description="`production` is the default version; it can be moved, not removed.")
    version: Version | None = Field(description="A loaded version; null removes the alias.")
    expected: Version | None = Field(
        None, description="Version that the alias points to now; if it points elsewhere, nothing changes."
    )

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        alias, version = self.alias, policy.aliases.get(self.alias)
        if version != self.version and self.expected not in (None, version):
            now = f"points to {version}" if version is not None else "is gone"
            raise ConflictError(
                f"the alias '{alias}' of policy '{name}' {now}, but was expected to point to {self.expected}: "
                "someone moved it"
            )
        if self.version is not None:
            return _changed(name, policy, aliases={**policy.aliases, alias: self.version})
        if alias not in policy.aliases:
            raise ConflictError(f"policy '{name}' has no alias '{alias}': it has {_listed(policy.aliases)}")
        if alias == PRODUCTION:
            raise ConflictError(
                f"the alias '{PRODUCTION}' of policy '{name}' is the version that clients get by default: point it "
                "elsewhere, or unload the policy"
            )
        return _changed(name, policy, aliases={a: v for a, v in policy.aliases.items() if a != alias})


class Rollback(Command):
    """Point an alias back to its previous version, the same bundle, which is loaded again if necessary."""

    verb = "rollback"
    summary = "Point an alias back to its previous version"
    alias: Alias = Field(PRODUCTION, description="The alias; `production` by default.")

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        alias = self.alias
        *earlier, version = policy.history.get(alias, ()) or ("",)
        if not version:
            raise ConflictError(f"the alias '{alias}' of policy '{name}' has no previous version to roll back to")
        versions = {version: policy.unloaded.get(version, ""), **policy.versions}
        changed = _changed(name, policy, versions=versions, aliases={**policy.aliases, alias: version})
        return changed.model_copy(update={"history": {**changed.history, alias: tuple(earlier)}})


class SetCanary(Command):
    verb = "canary"
    nothing = "off"
    summary = "Give another version a share of the sessions"
    version: Reference | None = Field(description="A loaded version or an alias; null ends the canary.")
    share: float | None = Field(None, gt=0, le=1, description="Share of the sessions.")

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        if self.version is None:
            return _changed(name, policy, canary=None)
        if self.share is None:
            raise RequestError(f"the canary of policy '{name}' needs a share above 0 and at most 1")
        return _changed(name, policy, canary=Canary(version=self.version, share=self.share))


class SetShadow(Command):
    verb = "shadow"
    nothing = "off"
    summary = "Compute and compare another version's actions, without using them"
    version: Reference | None = Field(description="A loaded version or an alias; null ends the shadow.")

    def changed(self, name: str, policy: PolicyPlan) -> PolicyPlan:
        return _changed(name, policy, shadow=self.version)


COMMANDS: dict[str, type[Command]] = {
    kind.verb: kind for kind in (Load, Unload, SetAlias, Rollback, SetCanary, SetShadow)
}


class Changed(BaseModel):
    """State of a policy after a command."""

    generation: int = Field(description="Number of the plan that contains the change.")
    policy: str
    default: str | None = Field(description="The default version; null when the policy is no longer served.")
    versions: list[str]
    aliases: dict[str, str]
    canary: Canary | None
    shadow: str | None
    notes: list[str] = Field(
        [], description="Harmless differences between the version that clients get now and the previous one."
    )

    @classmethod
    def of(cls, plan: Plan, name: str, notes: Sequence[str] = ()) -> Changed:
        """Return a policy's state in a plan."""
        policy = plan.policies.get(name) or PolicyPlan()
        state = {field: getattr(policy, field) for field in ("default", "aliases", "canary", "shadow")}
        return cls(generation=plan.generation, policy=name, versions=list(policy.versions), notes=list(notes), **state)


def parse(command: str, document: dict[str, Any]) -> Command:
    """Return a command from its fields. Raises RequestError."""
    try:
        return COMMANDS[command].model_validate(document)
    except ValidationError as error:
        raise RequestError(f"{command}: {first_fault(error, shows_input=True)}") from None


def first_policies(config: ServedConfig, listing: Listing) -> Policies:
    """Return the policies of a configuration, given the repository's bundles; none may be broken if it means all.

    Raises what `Listing.find` and `Listing.available` raise, and ConflictError.
    """
    means_all = config.unlisted == "load" or any(policy.versions is None for policy in config.policies.values())
    available = listing.available(needs_all=means_all)
    unlisted = available if config.unlisted == "load" else ()
    policies = {}
    for name, wanted in sorted(({name: PolicyConfig() for name in unlisted} | config.policies).items()):
        if wanted.versions is not None:
            versions = dict(listing.find(name, version) for version in wanted.versions)
        elif not (versions := available.get(name, {})):
            listing.find(name, None)  # which raises
        policies[name] = _changed(
            name, PolicyPlan(), versions=versions,
            aliases=wanted.aliases, canary=wanted.canary, shadow=wanted.shadow,
        )  # fmt: skip
    return policies


def agrees(plan: Plan, config: ServedConfig) -> bool:
    """Return whether a plan serves what a configuration names."""
    for name, wanted in config.policies.items():
        policy = plan.policies.get(name, PolicyPlan())
        if wanted.versions is not None and set(wanted.versions) != set(policy.versions):
            return False
        if not wanted.aliases.items() <= policy.aliases.items():
            return False
        if (wanted.canary, wanted.shadow) != (policy.canary, policy.shadow):
            return False
    served = {name for name, policy in plan.policies.items() if policy.versions}
    return config.unlisted == "load" or served <= config.policies.keys()


def differences(before: Policies, after: Policies, name: str) -> dict[str, Any]:
    """Return what is served differently of a policy after than before, by version, alias and use."""

    def served(policies: Policies) -> dict[str, Any]:
        policy = policies.get(name, PolicyPlan())
        versions = {f"version {version}": digest for version, digest in policy.versions.items()}
        return {**versions, **policy.uses, "the canary": policy.canary}

    was, now = served(before), served(after)
    return {key: now.get(key) for key in was.keys() | now.keys() if was.get(key) != now.get(key)}


def _changed(name: str, was: PolicyPlan, **changes: Any) -> PolicyPlan:
    """Return a policy with these changes: versions sorted, each use with its loaded bundle, the way back kept."""
    versions = _sorted(changes.get("versions", was.versions))
    if len({version_key(version) for version in versions}) != len(versions):
        raise ConflictError(f"policy '{name}': two versions compare equal, as '1' and '1.0.0' do: keep one of them")
    aliases: dict[str, str] = dict(changes.get("aliases", was.aliases))
    if versions and PRODUCTION not in aliases:
        aliases[PRODUCTION] = list(versions)[-1]
    unloaded = {v: digest for v, digest in _sorted({**was.unloaded, **was.versions}).items() if v not in versions}
    changes |= {"versions": versions, "aliases": aliases, "history": _moved(was, aliases), "unloaded": unloaded}
    policy = was.model_copy(update=changes)
    lost: dict[str, list[str]] = {}  # uses by the version that they had
    for use, reference in policy.uses.items():
        had = was.version_of(reference)
        if had is None:
            _require(name, policy, reference)
        elif policy.version_of(reference) is None or versions[had] != was.versions[had]:
            lost.setdefault(had, []).append(use)
    for version, uses in lost.items():
        raise ConflictError(
            f"policy '{name}' version {version} is in use by {' and '.join(uses)}: end that or point it elsewhere "
            "first, and export changes of a bundle under a new version"
        )
    return policy


def _moved(policy: PolicyPlan, aliases: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the history after the aliases have moved."""
    history = dict(policy.history)
    for alias, version in policy.aliases.items():
        if aliases.get(alias) != version:
            history[alias] = (*history.get(alias, ()), version)[-LONGEST_HISTORY:]
    for alias, version in aliases.items():  # the same version again is not its own way back
        if history.get(alias, ())[-1:] == (version,):
            history[alias] = history[alias][:-1]
    return history


def _require(name: str, policy: PolicyPlan, reference: str) -> None:
    if policy.version_of(reference) is None:
        what = "version" if reference[:1].isdigit() else "alias"
        raise UnknownVersionError(
            f"policy '{name}' has no {what} '{reference[:32]}': expected one of {_listed(policy.versions)}; "
            f"aliases: {_listed(policy.aliases)}"
        )


def _sorted(digests: Mapping[str, str]) -> dict[str, str]:
    return dict(sorted(digests.items(), key=lambda item: version_key(item[0])))


def _listed(names: Mapping[str, Any] | list[str]) -> str:
    return ", ".join(names) or "none"
