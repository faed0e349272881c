"""Policies that a server holds: names, versions, aliases, and the one call of every protocol, `act`.

A store does not change: what should be served otherwise is another store, and whoever began with one ends with it.
"""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlservo.export.contract.bundle import DEFAULT_LIMITS, BundleLimits, find_bundles, read_contract
from rlservo.export.contract.contract import version_key
from rlservo.export.contract.errors import (
    BundleError,
    RequestError,
    RlservoError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.export.contract.spaces import DictSpec, SpaceSpec, TupleSpec, leaf_specs
from rlservo.serve_app.interface import Observation
from rlservo.serve_app.runtime.options import DEFAULT_OPTIONS, PolicyOptions
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions.micro_batching import Batcher
from rlservo.serve_app.versions.plan import PRODUCTION, PolicyPlan


@dataclass(frozen=True, slots=True)
class EpisodeNote:
    """What a reply says of its episode."""

    state: Mapping[str, Any] | None = None  # for the client to carry, as `carried_state.py` has it
    session_id: str | int | None = None
    step: int | None = None  # how many actions this session or stream has given since its episode began


@dataclass(slots=True)  # not frozen: that would cost every request half a microsecond
class Decision:
    """An action, and who decided it how fast."""

    action: Any
    """An array, or dicts and tuples of arrays where the action space is nested."""
    name: str
    version: str
    infer_ms: float  # [ms] checking the observation, the network (for all that it ran for), checking the action
    batch: int | None = None  # how many observations there were; None for one that came alone
    notices: tuple[str, ...] = ()  # what was out of bounds or limited, and used all the same
    episode: EpisodeNote | None = None
    sharers: int = 1  # requests whose observations were computed in the same run of the network


@dataclass(frozen=True, slots=True)
class _Canary:
    policy: Policy
    share: float
    needs_session: bool  # a policy with a memory cannot change in the middle of an episode


@dataclass(frozen=True, slots=True)
class Shadow:
    """A version that computes along with the default one."""

    of: str  # the default version
    version: str
    policy: Policy


class PolicyStore:
    """Several policies in several versions; a name's default is its `production` alias, without plans the newest."""

    def __init__(
        self,
        policies: Iterable[Policy],
        plans: Mapping[str, PolicyPlan] | None = None,
        *,
        changed: Iterable[str] = (),
        replaces: PolicyStore | None = None,
    ) -> None:
        """Take loaded policies, and by name which are to do what; those `changed` were served otherwise before.

        A plan may name versions that are not among the policies; an alias, canary or shadow that leads to one is left
        out. Raises UsageError when two have the same name and version, when the default version is not there (no other
        takes its place), or, without plans, when there is no policy. What goes on of a store that this one `replaces`
        is the micro-batching of the policies that both have.
        """
        self._policies: dict[str, dict[str, Policy]] = {}
        self._changed = frozenset(changed)
        for policy in policies:
            name, version = policy.contract.name, policy.contract.version
            versions = self._policies.setdefault(name, {})
            # '1' and '1.0.0' compare equal, so neither would be the newest.
            same = next((v for v in versions if version_key(v) == version_key(version)), None)
            if same is not None:
                raise UsageError(
                    f"policy '{name}' version {version} is in both {versions[same].path} and {policy.path}: "
                    "serve one of them, or export one under another name or version"
                )
            versions[version] = policy
        if not self._policies and plans is None:
            raise UsageError("no policy to serve: give at least one bundle folder")
        for name, versions in self._policies.items():
            self._policies[name] = dict(sorted(versions.items(), key=lambda item: version_key(item[0])))
        self._aliases: dict[str, dict[str, Policy]] = {}
        self._default: dict[str, Policy] = {}
        self._canary: dict[str, _Canary] = {}
        self._shadow: dict[str, Shadow] = {}
        for name, versions in self._policies.items():
            self._arrange(name, versions, (plans or {}).get(name) or _newest(versions))
        before: dict[Policy, Batcher] = {} if replaces is None else replaces._batchers
        self._batchers: dict[Policy, Batcher] = {
            policy: before.get(policy) or Batcher(policy.network(), policy.options.micro_batch)
            for versions in self._policies.values()
            for policy in versions.values()
            if _wants_batches(policy)
        }
        self.batches = bool(self._batchers)
        """Whether some policy computes together what comes at the same time."""

    @classmethod
    def load(
        cls,
        paths: Iterable[str | Path],
        *,
        threads: int = 1,
        options: Mapping[str, PolicyOptions] | None = None,
    ) -> PolicyStore:
        """Load every bundle at or below `paths` (bundles, policy folders, repositories).

        `options` are by policy name; '*' is for those not named.

        Hashes, graphs and golden vectors are checked. A server with some of its policies would be found out by a
        robot, so one bad bundle refuses the start: raises BundleError that lists every bad one, or UsageError.
        """
        folders: dict[Path, Path] = {}  # resolved -> as given: the same folder given twice is loaded once
        failures: list[RlservoError] = []
        for path in paths:
            try:
                folders.update({folder.resolve(): folder for folder in find_bundles(path)})
            except BundleError as error:
                failures.append(error)
        policies: list[Policy] = []
        for folder in folders.values():
            try:
                policies.append(load_policy(folder, threads=threads, options=options))
            except BundleError as error:
                failures.append(error)
        if len(failures) == 1:
            raise failures[0]
        if failures:
            sentences = "; ".join(error.message for error in failures)
            raise BundleError(f"{len(failures)} bundles cannot be served: {sentences}")
        return cls(policies)

    @property
    def names(self) -> tuple[str, ...]:
        """The policies' names, sorted."""
        return tuple(sorted(self._policies))

    def versions(self, name: str) -> tuple[str, ...]:
        """The versions of a policy, oldest first. Raises UnknownPolicyError."""
        return tuple(self._versions(name))

    def default(self, name: str) -> str:
        """The version of whoever asks for none. Raises UnknownPolicyError."""
        return self.get(name).contract.version

    def get(self, name: str, version: str | None = None) -> Policy:
        """Return a policy by version or alias; None is its default.

        Raises UnknownPolicyError or UnknownVersionError.
        """
        if version is None:
            default = self._default.get(name)
            if default is not None:
                return default
        versions = self._versions(name)
        policy = versions.get(version or "") or self._aliases[name].get(version or "")
        if policy is None:
            aliases = self._aliases[name]
            also = f", aliases are {', '.join(aliases)}" if aliases else ""
            raise UnknownVersionError(
                f"policy '{name}' has no version '{str(version)[:32]}': loaded are {', '.join(versions)}{also}",
                {"policy": name, "versions": list(versions), "aliases": list(aliases)},
            )
        return policy

    def find(self, name: str, identity: str) -> Policy | None:
        """Return the policy of a name that a memory belongs to (`Policy.identity`), if it is loaded."""
        return next((each for each in self._policies.get(name, {}).values() if each.identity == identity), None)

    def is_certain(self, name: str, version: str | None) -> bool:
        """Whether a memory that does not say whose it is can only be of the policy that this request gets.

        So it is where the version itself is named (an alias may lead elsewhere by now), and where there is and was
        only one.
        """
        versions = self._versions(name)
        return version in versions or (len(versions) == 1 and name not in self._changed)

    def version_of(self, name: str, reference: str) -> str:
        """Return the version that a version or an alias means, '' where there is none."""
        try:
            return self.get(name, reference).contract.version
        except UnknownPolicyError:
            return ""

    def choose(self, name: str, version: str | None, label: str | None) -> Policy:
        """Return the policy that a request gets: as `get`, but where a canary runs, a share of the labels get that.

        All requests of a label get the same one, on every replica, for as long as the share does not change; a larger
        share keeps those it had. Raises what `get` raises.
        """
        if version is None and self._canary:
            canary = self._canary.get(name)
            if canary is not None and _draw(name, label, canary.needs_session) < canary.share:
                return canary.policy
        return self.get(name, version)

    def shadow(self, name: str) -> Shadow | None:
        """Return the version that computes along, if there is one."""
        return self._shadow.get(name)

    def batcher_of(self, policy: Policy) -> Batcher | None:
        """Return what gathers the single observations for a policy; None where each is computed by itself."""
        return self._batchers.get(policy)

    def act(
        self,
        name: str,
        version: str | None,
        obs: Observation,
        *,
        explore: bool = False,
        seed: int | None = None,
        label: str | None = None,
    ) -> Decision:
        """Decide for `obs`: an action for one observation, a batch for a batch.

        Raises UnknownPolicyError, UnknownVersionError and what `Policy.act` raises.
        """
        return _act(self._stateless(name, version, label), obs, explore, seed)

    async def act_together(
        self,
        name: str,
        version: str | None,
        obs: Observation,
        *,
        label: str | None = None,
        check: Callable[[], None] | None = None,
    ) -> Decision:
        """Decide as `act` does without exploring; with what else is there in one run where the policy's options say so.

        `check` is asked again right before the network runs. Raises what it and `act` raise.
        """
        policy = self._stateless(name, version, label)
        batcher = self._batchers.get(policy)
        if batcher is None:
            return _act(policy, obs)
        policy.notices.clear()
        started = time.perf_counter()
        feed, batch = policy.read(obs)
        notices = take_notices(policy)
        read_ms = (time.perf_counter() - started) * 1e3
        single = len(next(iter(feed.values()))) == 1  # also a batch of one: the Open Inference Protocol has no other
        computed = await batcher.compute(feed, check) if single else batcher.compute_now(feed)
        started = time.perf_counter()
        action = policy.action(computed.outputs, batch=batch)
        infer_ms = read_ms + computed.milliseconds + (time.perf_counter() - started) * 1e3
        space = policy.contract.action_space
        version = policy.contract.version
        sharers = computed.requests
        return Decision(action, name, version, infer_ms, batch_of(action, space), notices, sharers=sharers)

    def close(self) -> None:
        """Close every policy; what is waiting to be computed with others is computed."""
        self._batchers = {}
        for versions in self._policies.values():
            for policy in versions.values():
                policy.close()

    def _arrange(self, name: str, versions: Mapping[str, Policy], plan: PolicyPlan) -> None:
        default = versions.get(plan.default or "")
        if default is None:
            raise UsageError(f"policy '{name}' is to be served as version {plan.default}, which is not loaded")
        self._default[name] = default
        self._aliases[name] = {alias: versions[v] for alias, v in sorted(plan.aliases.items()) if v in versions}
        canary = plan.canary and versions.get(plan.version_of(plan.canary.version) or "")
        if canary and plan.canary:
            self._canary[name] = _Canary(canary, plan.canary.share, canary.episodic)
        shadow = versions.get((plan.shadow and plan.version_of(plan.shadow)) or "")
        if shadow is not None and shadow is not default:
            self._shadow[name] = Shadow(default.contract.version, shadow.contract.version, shadow.twin())

    def _stateless(self, name: str, version: str | None, label: str | None) -> Policy:
        policy = self.choose(name, version, label)
        if policy.episodic:  # its memory belongs to one episode, and a server has many callers
            raise RequestError(f"policy '{name}' {NEEDS_STATE if policy.contract.state else NEEDS_LAST}", NEEDS)
        return policy

    def _versions(self, name: str) -> Mapping[str, Policy]:
        versions = self._policies.get(name)
        if versions is None:
            raise UnknownPolicyError(
                f"no policy '{name[:64]}' is loaded: this server has {', '.join(self.names) or 'none'}",
                {"policies": list(self.names)},
            )
        return versions


def _wants_batches(policy: Policy) -> bool:
    """Return whether single observations are computed together: the options say so, and nothing else goes in."""
    contract = policy.contract
    observed = leaf_specs(contract.observation_space, "obs")
    return policy.options.micro_batch > 1 and not policy.episodic and len(contract.inputs) == len(observed)


def _newest(versions: Mapping[str, Policy]) -> PolicyPlan:
    return PolicyPlan(versions=dict.fromkeys(versions, ""), aliases={PRODUCTION: list(versions)[-1]})


def _act(policy: Policy, obs: Observation, explore: bool = False, seed: int | None = None) -> Decision:
    if policy.notices:
        policy.notices.clear()
    started = time.perf_counter()
    action = policy.act(obs, explore=explore, seed=seed)
    infer_ms = (time.perf_counter() - started) * 1e3
    contract = policy.contract
    notices = take_notices(policy) if policy.notices else ()
    batch = batch_of(action, contract.action_space)
    return Decision(action, contract.name, contract.version, infer_ms, batch, notices)


def _draw(name: str, label: str | None, needs_session: bool) -> float:
    """Return a number in [0, 1): the label's own, or without one a random one."""
    if label is None:
        return 1.0 if needs_session else random.random()
    digest = hashlib.blake2b(f"{name}/{label}".encode("utf-8", "surrogatepass"), digest_size=8).digest()
    return (int.from_bytes(digest, "big") >> 11) * 2.0**-53


CARRY = "send 'state' ({} begins an episode, then what the last reply gave)"
SESSION = (
    "begin a session ('session_id' with 'reset'; in the Open Inference Protocol 'sequence_id' with 'sequence_start')"
)
NEEDS_STATE = f"remembers its episode: {CARRY.replace('an episode', 'one')}, or the inputs 'state_in.*', or {SESSION}"
NEEDS_LAST = (
    f"has a limit on the step from one action to the next: {CARRY}, or 'last_action' (in the Open Inference Protocol "
    f"an input, or 'sequence_start' for the first), or {SESSION}"
)
NEEDS: dict[str, Any] = {"send": "state"}
"""Details of both refusals: a client that did not know that it has to carry something learns it from them."""


def batch_of(action: Any, space: SpaceSpec) -> int | None:
    """Return how many actions a batch holds; None for a single one. The first leaf tells."""
    while isinstance(space, DictSpec | TupleSpec):
        key: Any = next(iter(space.spaces)) if isinstance(space, DictSpec) else 0
        action, space = action[key], space.spaces[key]
    return len(action) if action.ndim > len(space.shape) else None


def take_notices(policy: Policy) -> tuple[str, ...]:
    """Return what the policy noticed since it was last asked."""
    taken = tuple(policy.notices)
    policy.notices.clear()
    return taken


def load_policy(
    folder: Path,
    *,
    threads: int = 1,
    options: Mapping[str, PolicyOptions] | None = None,
    limits: BundleLimits = DEFAULT_LIMITS,
) -> Policy:
    """Load and prove a bundle; `options` are by policy name, '*' is for those not named. Raises BundleError."""
    if not options:
        return Policy.load(folder, threads=threads, limits=limits)
    name = read_contract(folder, limits).name
    chosen = options.get(name, options.get("*", DEFAULT_OPTIONS))
    policy = Policy.load(folder, threads=threads, options=chosen, limits=limits)
    if _wants_batches(policy):
        policy.check_rows()
    return policy
