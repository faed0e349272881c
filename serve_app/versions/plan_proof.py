"""Proof that a changed plan can be served: what is new loads, canary and shadow fit the default version."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import BundleError, RefusedError, RlservoError
from rlservo.serve_app.versions.plan import PolicyPlan
from rlservo.serve_app.versions.repository import Key, raise_all
from rlservo.serve_app.versions.version_loader import VersionLoader


async def prove(loader: VersionLoader, policies: Mapping[str, PolicyPlan], before: Mapping[str, PolicyPlan]) -> None:
    """Load what is new or newly relied on in `policies`. Raises RefusedError with all that cannot be served."""
    failures: list[tuple[Key, RlservoError]] = []
    for name, policy in policies.items():
        was = before.get(name)
        if policy == was:
            continue
        relied_on = {policy.default, *policy.aliases.values()}
        known = {} if was is None else was.versions
        for version, digest in policy.versions.items():
            if known.get(version) != digest or version in relied_on:
                try:
                    await loader.load(name, version, digest)
                except RlservoError as error:
                    failures.append(((name, version), error))
        if not failures:
            await _check_companions(loader, name, policy)
    if failures:
        details = {"versions": [{"name": n, "version": v, "reason": e.message} for (n, v), e in failures]}
        try:
            raise_all([BundleError(error.message) for _, error in failures])
        except BundleError as error:
            raise RefusedError(error.message, details) from None


async def _check_companions(loader: VersionLoader, name: str, policy: PolicyPlan) -> None:
    """Refuse a canary or shadow that reads or gives something else than the default version."""
    references = {"canary": policy.canary and policy.canary.version, "shadow": policy.shadow}
    for role, reference in references.items():
        version = policy.version_of(reference) if reference else None
        if version is None or policy.default is None:
            continue
        theirs = (await loader.load(name, version, policy.versions[version])).policy.contract
        ours = (await loader.load(name, policy.default, policy.versions[policy.default])).policy.contract
        if _interface(theirs) != _interface(ours):
            raise RefusedError(
                f"policy '{name}' version {version} cannot be the {role} of version {policy.default}: its "
                "observations or actions are of other names, types or shapes"
            )
        if role == "canary" and theirs.state != ours.state:
            raise RefusedError(
                f"policy '{name}' version {version} cannot be the canary of version {policy.default}: what it "
                "remembers of an episode is something else"
            )
        if role == "shadow" and theirs.state:
            raise RefusedError(
                f"policy '{name}' version {version} remembers its episode: a shadow computes on single observations"
            )


def _interface(contract: Contract) -> tuple[Any, ...]:
    """Return what a caller must know of a policy: what goes in and what comes out."""
    inputs = tuple(tensor for tensor in contract.inputs if not tensor.name.startswith("state_in."))
    actions = tuple(tensor for tensor in contract.outputs if tensor.name.split(".")[0] == "action")
    return inputs, actions
