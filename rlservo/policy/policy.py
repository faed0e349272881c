"""Exported policy in this process: from an observation to an action ready for `env.step`.

`Policy.act` turns an observation into an action.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from rlservo.bundle.bundle import DEFAULT_LIMITS, ONNX_FILE, Bundle, BundleLimits, load_bundle
from rlservo.bundle.contract import VALUE, Contract, Distribution
from rlservo.bundle.nested import action_leaves, build_action
from rlservo.bundle.spaces import leaf_specs
from rlservo.errors import ActionError, RequestError, UsageError
from rlservo.policy.acting_policy import Closeable, Observation
from rlservo.policy.action_check import ActionCheck
from rlservo.policy.action_step_limit import StepLimit
from rlservo.policy.drift import Drift
from rlservo.policy.exploration import Draw, draw_action
from rlservo.policy.loading import (
    Run,
    acting_outputs,
    check_contract,
    check_copy,
    check_golden_vectors,
    check_graph,
    check_time,
    leaves_value_out,
    open_graph,
)
from rlservo.policy.observation_parser import ObservationParser, Observed
from rlservo.policy.options import DEFAULT_OPTIONS, PolicyOptions
from rlservo.policy.recurrent_state import State, StateTensors

if TYPE_CHECKING:
    import onnxruntime

logger = logging.getLogger(__name__)
SHOWN_HASH = 12  # hexadecimal digits: enough to distinguish the graphs of one name and version
NOTICE_EVERY_S = 60.0  # observations out of bounds may come a hundred times a second; a line a minute is enough
Network = Callable[[dict[str, NDArray[Any]]], dict[str, NDArray[Any]]]
"""Computes tensors `[batch, ...]` by name from tensors by name."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Decision of a policy in an episode driven by another policy (`Policy.follow`)."""

    leaves: dict[str, NDArray[Any]]
    """The deterministic action by tensor name, `[batch, *shape]`."""
    inputs: NDArray[Any] | None
    """`action_dist_inputs`, if the policy has a distribution."""
    state: State
    """For the next step."""


@dataclass(slots=True)  # not frozen, which would cost every request half a microsecond
class Step:
    """One step of an episode: the action, the next state, and the network's inputs."""

    action: Any
    """In the action space's own form, with a batch axis on every leaf for a batch."""
    leaves: dict[str, NDArray[Any]]
    """The action by tensor name, `[batch, *shape]`."""
    state: State
    """State for the next step, `[batch, *shape]`; empty for a stateless policy."""
    batch: int | None
    """Number of observations; None for a single one."""
    inputs: Mapping[str, NDArray[Any]]
    """Inputs of the network, by tensor name."""
    notices: tuple[str, ...] = ()
    """Warnings about values out of bounds or beyond a limit that were used anyway."""
    last_action: dict[str, NDArray[Any]] | None = None
    """The caller's last action by tensor name, the base of a limit on the step; None if not given."""

    @property
    def rows(self) -> int:
        """Number of episodes."""
        return self.batch or 1

    @property
    def own_state(self) -> State:
        """The state in the observation's own form: without a batch axis for a single observation."""
        return self.state if self.batch is not None else {name: leaf[0, ...] for name, leaf in self.state.items()}


class Policy(Closeable):
    """An exported policy, loaded and proven on this machine.

    ```python
    policy = Policy.load("policies/ur5")
    action = policy.act(obs)
    ```
    """

    def __init__(
        self,
        bundle: Bundle,
        ort_session: onnxruntime.InferenceSession,
        options: PolicyOptions = DEFAULT_OPTIONS,
        *,
        graph_hash: str = "",
    ) -> None:
        """Wrap an onnxruntime session whose graph fits `bundle.contract`; use `Policy.load` instead."""
        contract = bundle.contract
        self._bundle = bundle
        self._graph_hash = graph_hash
        self.identity = f"{contract.name}/{contract.version}#{graph_hash[:SHOWN_HASH]}"
        """Name, version and graph, the same on every machine: a recurrent state belongs to one policy."""
        self._contract = contract
        self._ort_session: onnxruntime.InferenceSession | None = ort_session
        self._run: Run = ort_session.run
        self._run_whole: Run | None = None  # with the value head, once it is requested
        self._rng: np.random.Generator | None = None  # numpy.random takes 2 MB, needed only by policies that explore
        self.options = options
        self.draw: Draw | None = None
        """Draw of the last exploratory action, for a recording; None before the first."""
        self.last_notices: tuple[str, ...] = ()
        """Warnings of the last `act`, for a recording."""
        self.loaded_at = datetime.now(timezone.utc)
        self._unlogged = 0
        self._logged_at = -NOTICE_EVERY_S
        self.drift = Drift.of(contract)
        self._observations = ObservationParser(
            contract.name, contract.observation_space, options=options, drift=self.drift
        )
        actions = leaf_specs(contract.action_space, "action")
        self._action_checks = {name: ActionCheck(contract.name, name, leaf) for name, leaf in actions.items()}
        self._state_tensors = StateTensors(contract)
        self._step_limit = StepLimit(contract.name, actions, options)
        self._state: State | None = None
        self._last: dict[str, NDArray[Any]] | None = None
        self.has_step_limit = bool(self._step_limit)
        self.is_stateful = bool(contract.state) or self.has_step_limit
        """Whether an action depends on earlier steps: through a state, or a limit on the step from the last action."""
        self.sees_reward = self._state_tensors.has_reward
        """Whether it was trained to see the reward of its last action."""
        # Most policies read one array and give one: this saves a control loop a few microseconds.
        leaves = self._observations.leaves
        flat = "obs" in leaves and "action" in actions  # excludes a Dict or Tuple with a single leaf
        self._simple = flat and len(contract.inputs) == 1 and not self.is_stateful
        self._leaf = next(iter(leaves.values()))
        self._action_check = next(iter(self._action_checks.values()))
        self._input = contract.inputs[0].name
        self._action_only = ["action"]

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        version: str | None = None,
        threads: int = 1,
        check_golden: bool = True,
        options: PolicyOptions = DEFAULT_OPTIONS,
        limits: BundleLimits = DEFAULT_LIMITS,
    ) -> Self:
        """Load the bundle at `path` (a bundle, a policy folder or a repository with one policy).

        Of several versions it is the one in production by the folder's plan, the newest without a plan, or `version`:
        a number, or `newest`.

        Checks hashes, the graph against the contract and, unless `check_golden` is off, that this machine reproduces
        the golden vectors. `threads` is onnxruntime's intra-op thread count; one is fastest for networks of this size.

        `options` are its runtime options, `limits` bound the size of the bundle's files.

        Raises BundleError, BundleTamperedError or GoldenMismatchError, and UsageError if the options do not fit.
        """
        if threads < 1:
            raise UsageError(f"threads must be 1 or more, got {threads}")
        bundle = load_bundle(path, limits, version=version)
        check_contract(bundle)
        ort_session = open_graph(bundle, threads)
        check_graph(bundle, ort_session)
        check_copy(bundle, ort_session)
        outputs = [tensor.name for tensor in bundle.contract.outputs]
        if check_golden:
            check_golden_vectors(bundle, ort_session.run, outputs)
        check_time(bundle, ort_session.run, outputs)
        if leaves_value_out(bundle):
            del ort_session  # otherwise both would be in memory
            ort_session = open_graph(bundle, threads, acts_only=True)
            if check_golden:
                check_golden_vectors(bundle, ort_session.run, acting_outputs(bundle.contract))
        return cls(bundle, ort_session, options, graph_hash=bundle.sums[ONNX_FILE])

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def path(self) -> Path:
        """The bundle folder this policy was loaded from."""
        return self._bundle.path

    @property
    def graph_hash(self) -> str:
        """SHA-256 of the graph file, in hexadecimal digits."""
        return self._graph_hash

    @property
    def digest(self) -> str:
        """Identity of the loaded bundle among those with its name and version."""
        return self._bundle.digest

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the action for `obs`: one for one observation, a batch for a batch (see `ActingPolicy.act`).

        A nested observation is given, and a nested action returned, in the space's own form. A recurrent policy
        continues from the previous `act`, `reset()` begins an episode; in a batch each row is an episode of its own.
        `reward` is the reward of the last action, for a policy that was trained to see it.

        Raises ObservationError when `obs` does not fit the contract, RequestError when the policy cannot explore, lacks
        the reward, or remembers another number of episodes, and ActionError when the result is not finite or not in the
        action space.
        """
        if self._simple and not explore:
            computed, _, batch, self.last_notices = self._compute(obs)
            return computed if batch else computed[0, ...]
        step = self.step(obs, before=self._state, last=self._last, explore=explore, seed=seed, reward=reward)
        self._state = step.state or None
        self._last = step.leaves if self._step_limit else None
        self.last_notices = step.notices
        return step.action

    def step(
        self,
        obs: Observation,
        *,
        before: State | None = None,
        state: Mapping[str, ArrayLike] | None = None,
        last: Mapping[str, NDArray[Any]] | None = None,
        last_action: Any = None,
        explore: bool = False,
        seed: int | None = None,
        reward: ArrayLike | None = None,
    ) -> Step:
        """Decide one step of an episode without remembering anything.

        `before` and `last` are an earlier step's `state` and `leaves`; `state` and `last_action` are the same from a
        caller, and are checked. If both of a pair are None, an episode begins. Raises RequestError when they do not
        fit, and what `act` raises.
        """
        if self._simple and not explore and before is None and state is None and last is None and last_action is None:
            computed, feed, batch, notices = self._compute(obs)
            leaves = {"action": computed}
            if batch:
                return Step(computed, leaves, {}, len(computed), feed, notices)
            return Step(computed[0, ...], leaves, {}, None, feed, notices)
        feed, batch, notices = self.parse(obs)
        rows = len(next(iter(feed.values())))
        known = next((len(leaf) for leaf in (*(before or {}).values(), *(last or {}).values())), rows)
        if known != rows:
            raise RequestError(
                f"policy '{self._contract.name}' remembers {known} episode{'s' if known > 1 else ''} and got {rows} "
                f"observation{'s' if rows > 1 else ''}: call reset() to begin new ones"
            )
        if state is not None:
            before = self._state_tensors.parse(state, rows, batch=batch)
        given: dict[str, NDArray[Any]] | None = None
        if last_action is not None:
            parts = action_leaves(self._contract.action_space, last_action, "action")
            last = given = self._step_limit.parse_last_action(parts, rows, batch=batch)
        action, after = self._decide(feed, rows, before, explore, seed, reward)
        if self._step_limit and last is not None:
            action, limit_notices = self._step_limit.apply(action, last)
            self._log(limit_notices)
            notices += limit_notices
            for name, check in self._action_checks.items():
                check.check(action[name])
        space = self._contract.action_space
        own = action if batch else {name: leaf[0, ...] for name, leaf in action.items()}
        return Step(build_action(space, own), action, after, rows if batch else None, feed, notices, given)

    def follow(
        self,
        obs: Observation,
        gave: Mapping[str, NDArray[Any]],
        *,
        before: State | None = None,
        last: Mapping[str, NDArray[Any]] | None = None,
        reward: ArrayLike | None = None,
    ) -> Answer:
        """Return the policy's action at a step where the recorded policy gave `gave`; nothing is remembered.

        `gave` and `last` are leaves `[batch, *shape]`: the policy sees `gave` as its own action, and limits count from
        `last`, the robot's previous command. Raises what `step` raises.
        """
        feed, _, _ = self._observations.parse(obs)
        rows = len(next(iter(feed.values())))
        feed.update(self._state_tensors.inputs(before, rows, reward))
        explores = self._contract.distribution is not None
        names = list(self._action_checks) + (["action_dist_inputs"] if explores else []) + self._state_tensors.outputs
        computed = dict(zip(names, self._run(names, feed), strict=True))
        action = {name: computed[name] for name in self._action_checks}
        for name, check in self._action_checks.items():
            check.check(action[name])
        if self._step_limit and last is not None:
            action, _ = self._step_limit.apply(action, last)
        inputs = computed["action_dist_inputs"] if explores else None
        return Answer(action, inputs, self._state_tensors.next_state(computed, gave))

    def value(self, obs: Observation) -> NDArray[Any] | None:
        """Return the critic's value of each observation `[batch]`; None if the graph has none, or is recurrent.

        The first call opens the whole graph, of which acting may need only a part. Raises the errors of `parse` and
        `load`.
        """
        if self.is_stateful or all(tensor.name != VALUE for tensor in self._contract.outputs):
            return None
        if self._run_whole is None:
            run = open_graph(self._bundle, 1).run
            self._open()  # unless it has been closed
            self._run_whole = run
        feed, _, _ = self._observations.parse(obs)
        if {tensor.name for tensor in self._contract.inputs} != set(feed):
            return None  # it also sees rewards
        value: Any = self._run_whole([VALUE], feed)[0]
        return value  # type: ignore[no-any-return]

    def parse(self, obs: Observation) -> Observed:
        """Return an observation as the network's tensors. Raises ObservationError."""
        observed = self._observations.parse(obs)
        if observed.notices:
            self._log(observed.notices)
        return observed

    def build_action(self, computed: Mapping[str, NDArray[Any]], *, batch: bool) -> Any:
        """Return the checked action of the network's outputs (`parse`, `network`). Raises ActionError."""
        for name, check in self._action_checks.items():
            check.check(computed[name])
        own = {name: computed[name] if batch else computed[name][0, ...] for name in self._action_checks}
        return build_action(self._contract.action_space, own)

    def network(self) -> Network:
        """Return the network: from `parse`'s result to the action's tensors by name (`build_action` checks them).

        It is onnxruntime's own `run`: a computation in progress ends normally even if the policy is closed.
        """
        run: Callable[..., Sequence[Any]] = self._open().run  # an action is dense: no sparse tensors, no maps
        names = list(self._action_checks)
        return lambda feed: dict(zip(names, run(names, feed), strict=True))

    def fingerprint(self, inputs: Mapping[str, NDArray[Any]]) -> bytes:
        """Return a hash of the observation in the network's inputs (`parse`, `Step.inputs`)."""
        digest = hashlib.blake2b(digest_size=16)
        for name in self._observations.leaves:
            digest.update(inputs[name].tobytes())
        return digest.digest()

    def clone(self) -> Policy:
        """Return another policy over the same graph, for another thread, with its own recurrent state and drift."""
        return Policy(self._bundle, self._open(), self.options, graph_hash=self._graph_hash)

    def reset(self) -> None:
        """Start an episode: clear the state of a recurrent policy. Does nothing for a stateless one."""
        self._state = self._last = None

    def close(self) -> None:
        """Release the graph; later calls of `act` raise UsageError."""
        self._run = self._run_whole = _refuse_closed
        self._ort_session = None

    def _open(self) -> onnxruntime.InferenceSession:
        if self._ort_session is None:
            _refuse_closed([], {})
        return self._ort_session

    def _compute(self, obs: Observation) -> tuple[NDArray[Any], dict[str, NDArray[Any]], bool, tuple[str, ...]]:
        """Return (action `[batch, ...]`, feed, whether `obs` is a batch, notices) of a simple policy."""
        array, batch, notice = self._leaf.parse(obs)
        feed = {self._input: array}
        action = self._run(self._action_only, feed)[0]
        self._action_check.check(action)
        notices: tuple[str, ...] = ()
        if notice:
            notices = (notice,)
            self._log(notices)
        return action, feed, batch, notices

    def _log(self, notices: tuple[str, ...]) -> None:
        """Log a notice once in `NOTICE_EVERY_S`, with its count."""
        for sentence in notices:
            self._unlogged += 1
            now = time.monotonic()
            if now - self._logged_at >= NOTICE_EVERY_S:
                logger.warning("policy '%s': %s (%d times)", self._contract.name, sentence, self._unlogged)
                self._unlogged, self._logged_at = 0, now

    def _decide(
        self,
        feed: dict[str, NDArray[Any]],
        rows: int,
        before: State | None,
        explore: bool,
        seed: int | None,
        reward: ArrayLike | None,
    ) -> tuple[dict[str, NDArray[Any]], State]:
        """Return (action leaves `[batch, ...]`, next state) for checked observations."""
        feed.update(self._state_tensors.inputs(before, rows, reward))
        names = (["action_dist_inputs"] if explore else list(self._action_checks)) + self._state_tensors.outputs
        if explore:
            self._check_explores()
        computed = dict(zip(names, self._run(names, feed), strict=True))
        action = self._sample(computed["action_dist_inputs"], seed) if explore else computed
        for name, check in self._action_checks.items():
            check.check(action[name])
        after = self._state_tensors.next_state(computed, action if explore else None)
        return {name: action[name] for name in self._action_checks}, after

    def _check_explores(self) -> Distribution:
        distribution = self._contract.distribution
        if distribution is None:
            raise RequestError(
                f"policy '{self._contract.name}' has no action distribution and cannot explore: leave 'explore' out"
            )
        if not self.options.explore:
            raise RequestError(f"policy '{self._contract.name}' must not explore on this server: leave 'explore' out")
        return distribution

    def _sample(self, inputs: NDArray[Any], seed: int | None) -> dict[str, NDArray[Any]]:
        if seed is not None and seed < 0:
            raise RequestError(f"seed must be a non-negative integer, got {seed}")
        if seed is None:
            rng = self._rng = self._rng or np.random.default_rng()
        else:
            rng = np.random.default_rng(seed)
        # Minus infinity in a score means 'not allowed'; if it is a mean, the action is refused.
        if np.isnan(inputs).any() or np.isposinf(inputs).any():
            raise ActionError(
                f"policy '{self._contract.name}' gave a non-finite action distribution for this observation"
            )
        self.draw = draw_action(inputs, self._check_explores(), self._contract.action_space, rng)
        return self.draw.action


def _refuse_closed(_names: Sequence[str], _feed: Mapping[str, Any]) -> NoReturn:
    raise UsageError("the policy has been closed: load it again to act")
