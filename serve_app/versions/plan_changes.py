"""Changes of a plan: by a configuration, or by an operator (load, unload, alias, rollback, canary, shadow).

Each function returns the policies after the change, and leaves the plan as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from rlservo.export.contract.contract import version_key
from rlservo.export.contract.errors import (
    ConflictError,
    RequestError,
    RlservoError,
    UnknownPolicyError,
    UnknownVersionError,
)
from rlservo.serve_app.versions.serving_plan import PRODUCTION, Canary, Plan, PolicyConfig, PolicyPlan, ServedConfig

LONGEST_HISTORY = 16  # earlier versions of an alias that a rollback can go back through

Digests = Mapping[str, str]


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


def agrees(plan: Plan, config: ServedConfig) -> bool:
    """Return whether a plan is what a configuration means, given the versions that the plan knows."""
    known = {name: each.versions for name, each in plan.policies.items() if each.versions}
    try:
        return plan_of(config, known, plan) == plan.policies
    except RlservoError:
        return False


def differences(before: Mapping[str, PolicyPlan], after: Mapping[str, PolicyPlan]) -> dict[tuple[str, str, str], Any]:
    """Return what is served otherwise after than before, by policy, field and version or alias."""
    changed: dict[tuple[str, str, str], Any] = {}
    for name in before.keys() | after.keys():
        was, now = (policies.get(name) or PolicyPlan(versions={}) for policies in (before, after))
        for field, old, new in (("versions", was.versions, now.versions), ("aliases", was.aliases, now.aliases)):
            changed |= {(name, field, key): new.get(key) for key in old | new if old.get(key) != new.get(key)}
        for field in ("canary", "shadow"):
            if getattr(was, field) != getattr(now, field):
                changed[name, field, ""] = getattr(now, field)
    return changed


def load(plan: Plan, name: str, version: str, digest: str) -> dict[str, PolicyPlan]:
    """Add a version, or take its bundle as it is now; what clients get stays as it is.

    The first version of a policy that is not served becomes its `production`: it changes no reply but a 404. Raises
    ConflictError if the folder holds another bundle than the one in use under this version.
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


def set_alias(
    plan: Plan, name: str, alias: str, version: str | None, *, expected: str | None = None
) -> dict[str, PolicyPlan]:
    """Let an alias lead to a loaded version, or with None remove it; `production` can only be moved.

    `expected` is where it leads as far as the caller knows: who has not seen another's move does not undo it. The same
    command twice is not a contradiction.
    """
    policy = plan.policy(name)
    aliases = dict(policy.aliases)
    if expected is not None and aliases.get(alias) not in (expected, version):
        raise _not_as_expected(policy, name, alias, expected)
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
        raise _not_as_expected(policy, name, alias, expected)
    earlier = policy.history.get(alias, ())
    if not earlier:
        raise ConflictError(f"the alias '{alias}' of policy '{name}' has no previous version to roll back to")
    version = earlier[-1]
    versions = {version: policy.unloaded.get(version, ""), **policy.versions}
    changed = _with(plan, name, policy, versions=versions, aliases={**policy.aliases, alias: version})
    history = {**changed[name].history, alias: earlier[:-1]}
    return {**changed, name: changed[name].model_copy(update={"history": history})}


def _not_as_expected(policy: PolicyPlan, name: str, alias: str, expected: str) -> ConflictError:
    leads = f"leads to {policy.aliases[alias]}" if alias in policy.aliases else "is gone"
    return ConflictError(
        f"the alias '{alias}' of policy '{name}' {leads} and was expected at {expected}: moved already"
    )


def set_canary(plan: Plan, name: str, version: str | None, share: float | None = None) -> dict[str, PolicyPlan]:
    """Send a share of the sessions to another version, or with None or no share end that. Raises RequestError."""
    if version is not None and share is None:
        raise RequestError(f"the canary of policy '{name}' needs a share above 0 and at most 1")
    canary = None if version is None or not share else Canary(version=version, share=share)
    return _with(plan, name, plan.policy(name), canary=canary)


def set_shadow(plan: Plan, name: str, version: str | None) -> dict[str, PolicyPlan]:
    """Let another version compute along, or with None end that."""
    return _with(plan, name, plan.policy(name), shadow=version)


def _with(plan: Plan, name: str, policy: PolicyPlan, **changes: Any) -> dict[str, PolicyPlan]:
    return {**plan.policies, name: _checked(name, policy, **changes)}


def _checked(name: str, was: PolicyPlan, **changes: Any) -> PolicyPlan:
    """Return the policy with these changes: sorted, in use as commanded, with the way back from what it was."""
    values: dict[str, Any] = {field: getattr(was, field) for field in PolicyPlan.model_fields} | changes
    versions: dict[str, str] = dict(sorted(values["versions"].items(), key=lambda item: version_key(item[0])))
    aliases: dict[str, str] = dict(values["aliases"])
    if versions and PRODUCTION not in aliases:
        aliases[PRODUCTION] = list(versions)[-1]
    history = _moved(was, aliases)
    known = sorted({**was.unloaded, **was.versions}.items(), key=lambda item: version_key(item[0]))
    unloaded = {version: digest for version, digest in known if version not in versions}
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
            f"policy '{name}' has no {what} '{reference[:32]}': expected one of {_listed(policy.versions)}; "
            f"aliases: {_listed(policy.aliases)}"
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
