"""Loaded policies of a server by name, version and alias.

A store never changes: a new plan makes a new store, and a request finishes with the store it began with.
"""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import NDArray

from rlservo.bundle.contract import version_key
from rlservo.errors import UnknownPolicyError, UnknownVersionError, UsageError
from rlservo.policy.acting_policy import Observation
from rlservo.policy.policy import Policy, Step
from rlservo.serve_app.versions.computing import Computing
from rlservo.serve_app.versions.deployment_plan import PolicyPlan


class EpisodeStep(NamedTuple):
    """A step of an episode in a recording, from 0."""

    episode: str
    step: int


@dataclass(slots=True)  # not frozen: that would cost every request half a microsecond
class Decision:
    """An action, and the policy, version and time that it took."""

    action: Any
    """An array, or dicts and tuples of arrays where the action space is nested."""
    policy: Policy
    inputs: Mapping[str, Any]
    """Inputs of the network, by tensor name `[batch, *shape]`."""
    name: str
    version: str
    infer_ms: float  # [ms] checking the observation, the network, checking the action
    batch: int | None = None  # how many observations there were; None for one that came alone
    notices: tuple[str, ...] = ()  # what was out of bounds or limited, and used all the same
    state: Mapping[str, Any] | None = None  # for the client to carry, as `carried_state.py` has it
    session_id: str | int | None = None
    session_step: int | None = None  # actions of this session or stream since its episode began
    recorded_step: EpisodeStep | None = None  # this one, where the client carries the state and it is recorded
    last_action: Mapping[str, NDArray[Any]] | None = None  # which the client gave, by tensor name `[batch, *shape]`
    is_repeat: bool = False  # the answer to a session's last request once more


@dataclass(frozen=True, slots=True)
class _Served:
    """One policy's loaded versions, and their uses."""

    plan: PolicyPlan
    versions: Mapping[str, Policy]  # oldest first
    default: Policy
    canary: Policy | None
    canary_share: float
    shadow: Policy | None


class PolicyStore:
    """Several policies in several versions, each served by its plan."""

    def __init__(
        self, policies: Iterable[Policy], plans: Mapping[str, PolicyPlan], before: PolicyStore | None = None
    ) -> None:
        """Take loaded policies, the plan of each by name, and the store that this one follows.

        A plan may name versions that are not among the policies; aliases, canary and shadow that point to one are left
        out. Raises UsageError if the default version is missing: no other takes its place.
        """
        self.plans = plans
        self._identities: dict[str, frozenset[str]] = {} if before is None else dict(before._identities)
        """Every identity that was ever served, by name."""
        loaded: dict[str, dict[str, Policy]] = {}
        for policy in sorted(policies, key=lambda each: version_key(each.contract.version)):
            name = policy.contract.name
            loaded.setdefault(name, {})[policy.contract.version] = policy
            self._identities[name] = self._identities.get(name, frozenset()) | {policy.identity}
        self._served = {name: _serve(name, versions, plans[name]) for name, versions in loaded.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """The policies' names, sorted."""
        return tuple(sorted(self._served))

    @property
    def policies(self) -> list[Policy]:
        """Every loaded version."""
        return [policy for served in self._served.values() for policy in served.versions.values()]

    def versions(self, name: str) -> tuple[str, ...]:
        """The versions of a policy, oldest first. Raises UnknownPolicyError."""
        return tuple(self._find(name).versions)

    def default(self, name: str) -> str:
        """The version for clients that name none. Raises UnknownPolicyError."""
        return self.get(name).contract.version

    def get(self, name: str, version: str | None = None) -> Policy:
        """Return a policy by version or alias; None is its default.

        Raises UnknownPolicyError or UnknownVersionError.
        """
        served = self._find(name)
        if version is None:
            return served.default
        plan = served.plan
        policy = served.versions.get(plan.version_of(version) or "")
        if policy is None:
            aliases = [alias for alias, target in sorted(plan.aliases.items()) if target in served.versions]
            also = f"; aliases: {', '.join(aliases)}" if aliases else ""
            raise UnknownVersionError(
                f"policy '{name}' has no version '{version[:32]}': expected one of {', '.join(served.versions)}{also}",
                {"policy": name, "versions": list(served.versions), "aliases": aliases},
            )
        return policy

    def find(self, name: str, identity: str) -> Policy | None:
        """Return the policy that a recurrent state belongs to (by `Policy.identity`), if it is loaded."""
        served = self._served.get(name)
        versions = () if served is None else served.versions.values()
        return next((each for each in versions if each.identity == identity), None)

    def has(self, policy: Policy) -> bool:
        """Whether this policy itself is loaded, and not another one of its name and version."""
        served = self._served.get(policy.contract.name)
        return served is not None and served.versions.get(policy.contract.version) is policy

    def remembers(self, name: str) -> bool:
        """Whether a version of this policy is stateful. Raises UnknownPolicyError."""
        return any(policy.is_stateful for policy in self._find(name).versions.values())

    def is_certain(self, name: str, version: str | None) -> bool:
        """Whether a recurrent state without an identity can only belong to the policy that this request gets.

        True if the request names the version itself (an alias may have moved), and if there is and was only one.
        """
        return version in self._find(name).versions or len(self._identities[name]) == 1

    def choose(self, name: str, version: str | None, label: str | None) -> Policy:
        """Return the policy for a request: as `get`, but a canary gets its share of the labels.

        All requests of a label get the same policy, on every replica, while the share does not change; a larger share
        keeps the labels it had. Raises what `get` raises.
        """
        if version is None:
            served = self._find(name)
            if served.canary is not None and _draw(name, label, served.canary) < served.canary_share:
                return served.canary
            return served.default
        return self.get(name, version)

    def is_drawn(self, name: str, label: str | None) -> bool:
        """Whether each request without a version draws it at random."""
        served = self._served.get(name)
        return label is None and served is not None and served.canary is not None

    def shadow(self, name: str) -> Policy | None:
        """Return the policy whose actions are compared with the default's, and not used, if there is one."""
        return self._find(name).shadow

    def close(self) -> None:
        """Close every policy."""
        for policy in self.policies:
            policy.close()

    def _find(self, name: str) -> _Served:
        served = self._served.get(name)
        if served is None:
            raise UnknownPolicyError(
                f"no policy '{name[:64]}' is loaded: this server has {', '.join(self.names) or 'none'}",
                {"policies": list(self.names)},
            )
        return served


def _serve(name: str, versions: Mapping[str, Policy], plan: PolicyPlan) -> _Served:
    default = versions.get(plan.default or "")
    if default is None:
        raise UsageError(f"policy '{name}' is to be served as version {plan.default}, which is not loaded")
    canary, share = None, 0.0
    if plan.canary is not None:
        canary, share = versions.get(plan.version_of(plan.canary.version) or ""), plan.canary.share
    shadow = versions.get(plan.version_of(plan.shadow or "") or "")
    shadow = None if shadow is None or shadow is default else shadow.clone()
    return _Served(plan, versions, default, canary, share, shadow)


def take_step(policy: Policy, obs: Observation, **given: Any) -> tuple[Decision, Step]:
    """Decide by one step of a policy, with `given` for `Policy.step` besides the observation; also return the step."""
    contract = policy.contract
    name, version = contract.name, contract.version
    started = time.perf_counter()
    try:
        with Computing(name, version):
            step = policy.step(obs, **given)
    except Exception as error:
        blame(error, version)
        raise
    infer_ms = (time.perf_counter() - started) * 1e3
    decision = Decision(step.action, policy, step.inputs, name, version, infer_ms, step.batch, step.notices)
    decision.last_action = step.last_action
    return decision, step


def blame(error: Exception, version: str) -> None:
    """Attach the version that failed to its error: with a canary, callers cannot know it."""
    error.policy_version = version  # type: ignore[attr-defined]


def blamed_version(error: Exception) -> str | None:
    """Return the version that failed with this error; None if none was called."""
    return getattr(error, "policy_version", None)


def _draw(name: str, label: str | None, canary: Policy) -> float:
    """Return a number in [0, 1]: the label's own, or without one a random one."""
    if label is None:  # a stateful policy cannot change in the middle of an episode
        return 1.0 if canary.is_stateful else random.random()
    digest = hashlib.blake2b(f"{name}/{label}".encode("utf-8", "surrogatepass"), digest_size=8).digest()
    return (int.from_bytes(digest, "big") >> 11) * 2.0**-53
