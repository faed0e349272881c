"""Run one exported policy in this process: an observation in, an action ready for `env.step` out.

This is the file where an observation becomes an action, in `Policy.act`. It needs numpy and onnxruntime; it knows
nothing of the web, ray, torch or gymnasium. The server is a thin edge over it (`policy_store.py`, `json_act.py`).
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from rlservo.export.contract.bundle import (
    CONTRACT_FILE,
    CONTRACT_KEY,
    DEFAULT_LIMITS,
    GOLDEN_FILE,
    ONNX_FILE,
    REWARD,
    BoxSpec,
    Bundle,
    BundleLimits,
    Contract,
    DiscreteSpec,
    Distribution,
    LeafSpec,
    MultiDiscreteSpec,
    embedded_contract,
    leaf_specs,
    load_bundle,
)
from rlservo.export.contract.errors import (
    ActionError,
    BundleError,
    BundleTamperedError,
    GoldenMismatchError,
    RequestError,
    UsageError,
    first_line,
)
from rlservo.export.contract.nested import StructureReader, action_leaves, build_action
from rlservo.export.contract.onnx_session import open_session
from rlservo.export.contract.scores import split_scores
from rlservo.serve_app.interface import Observation
from rlservo.serve_app.runtime.action_guard import ActionGuard
from rlservo.serve_app.runtime.drift import Drift
from rlservo.serve_app.runtime.exploration import distribution_size, sample_leaves
from rlservo.serve_app.runtime.observations import ObservationReader
from rlservo.serve_app.runtime.options import DEFAULT_OPTIONS, PolicyOptions
from rlservo.serve_app.runtime.recurrent_state import Memory, State
from rlservo.serve_app.runtime.step_limit import StepLimit

if TYPE_CHECKING:
    import onnxruntime

logger = logging.getLogger(__name__)

GOLDEN_RTOL = (
    1e-4  # machines differ in the last bits of exp and in the order of sums; a wrong graph differs in the first
)
GOLDEN_ATOL = 1e-5  # the same for actions near zero
SHOWN_HASH = 12  # hexadecimal digits: enough to tell the graphs apart that ever bear one name and version
MAX_ELEMENTS = 1 << 24  # of an observation or action: a contract of one line could ask for all the memory there is
NOTICE_EVERY_S = 60.0  # an observation out of bounds comes a hundred times a second, and is worth a line a minute

# onnxruntime's names of the types a policy's tensors have.
ONNX_TYPES = {
    "tensor(float)": "float32", "tensor(double)": "float64", "tensor(float16)": "float16", "tensor(bool)": "bool",
    **{f"tensor({name})": name for size in (8, 16, 32, 64) for name in (f"int{size}", f"uint{size}")},
}  # fmt: skip

_Run = Callable[[list[str], dict[str, NDArray[Any]]], Any]
Network = Callable[[dict[str, NDArray[Any]]], dict[str, NDArray[Any]]]
"""Computes tensors `[batch, ...]` by name from tensors by name."""


@dataclass(frozen=True, slots=True)
class Step:
    """What one step of an episode came to."""

    action: Any
    """In the action space's own form, a batch with its axis on every leaf."""
    leaves: dict[str, NDArray[Any]]
    """The action by tensor name, `[batch, *shape]`."""
    state: State
    """What the next step needs, `[batch, *shape]`; empty for a stateless policy."""
    batch: int | None
    """How many observations there were; None for one that came alone."""
    fed: Mapping[str, NDArray[Any]]
    """What the network was given, by tensor name."""

    @property
    def rows(self) -> int:
        """How many episodes it was a step of."""
        return self.batch or 1


class Policy:
    """An exported policy, loaded and proven on this machine.

    ```python
    policy = Policy.load("policies/ur5")
    action = policy.act(obs)
    ```
    """

    def __init__(
        self,
        bundle: Bundle,
        session: onnxruntime.InferenceSession,
        options: PolicyOptions = DEFAULT_OPTIONS,
        *,
        graph_hash: str = "",
    ) -> None:
        """Wrap a session whose graph fits `bundle.contract`; use `Policy.load`."""
        contract = bundle.contract
        self._bundle = bundle
        self._graph_hash = graph_hash
        self.identity = f"{contract.name}/{contract.version}#{graph_hash[:SHOWN_HASH]}"
        """What a memory of this policy's belongs to: name, version and graph, the same wherever it is loaded."""
        self._contract = contract
        self._session: onnxruntime.InferenceSession | None = session
        self._run: _Run = session.run
        self._rng = np.random.default_rng()
        self.options = options
        self.notices: deque[str] = deque(maxlen=16)
        """What was out of bounds or beyond a limit and used all the same, for who answers to a client."""
        self._unlogged = 0
        self._logged_at = -NOTICE_EVERY_S
        self._reader = StructureReader(
            contract.name, contract.observation_space, options=options, notice=self._take_notice
        )
        self._observed = list(leaf_specs(contract.observation_space, "obs"))
        actions = leaf_specs(contract.action_space, "action")
        self._guards = {name: ActionGuard(contract.name, name, leaf) for name, leaf in actions.items()}
        self._memory = Memory(contract)
        self._limit = StepLimit(contract.name, actions, options)
        self._state: State | None = None
        self._last: dict[str, NDArray[Any]] | None = None
        self.limited = bool(self._limit)
        self.episodic = bool(contract.state) or self.limited
        """Whether an action depends on what came before: on a state, or by a limit on the last action."""
        # Most policies read one array and give one: those few microseconds are what a control loop asks for.
        observations = leaf_specs(contract.observation_space, "obs")
        flat = "obs" in observations and "action" in actions  # not a Dict or Tuple, which may have a single leaf
        self._simple = flat and len(contract.inputs) == 1 and not self.episodic
        self._leaf_reader = ObservationReader(
            contract.name, next(iter(observations.values())), options=options, notice=self._take_notice
        )
        self.drift = Drift.of(contract)
        if self.drift is not None:
            self._leaf_reader.watch = self.drift.see
            self._reader.watch("obs", self.drift.see)
        self._guard = next(iter(self._guards.values()))
        self._input = contract.inputs[0].name
        self._action_only = ["action"]
        self._dist_only = ["action_dist_inputs"]

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        threads: int = 1,
        check_golden: bool = True,
        options: PolicyOptions = DEFAULT_OPTIONS,
        limits: BundleLimits = DEFAULT_LIMITS,
    ) -> Self:
        """Load the bundle at `path` (a bundle, a policy folder or a repository with one policy).

        Checks hashes, the graph against the contract and, unless `check_golden` is off, that this machine reproduces
        the golden vectors. `threads` is onnxruntime's intra-op thread count; one is fastest for networks of this size.

        `options` say how strict it is at its edges, `limits` how large the bundle's files may be.

        Raises BundleError, BundleTamperedError or GoldenMismatchError, and UsageError where the options do not fit.
        """
        if threads < 1:
            raise UsageError(f"threads must be 1 or more, got {threads}")
        bundle = load_bundle(path, limits)
        _check_contract(bundle)
        session = _open(bundle, threads)
        _check_graph(bundle, session)
        _check_copy(bundle, session)
        if check_golden:
            check_golden_vectors(bundle, session.run)
        return cls(bundle, session, options, graph_hash=bundle.sums[ONNX_FILE])

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def path(self) -> Path:
        """The bundle folder this policy was loaded from."""
        return self._bundle.path

    @property
    def digest(self) -> str:
        """What tells the loaded bundle from every other of its name and version."""
        return self._bundle.digest

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the action for `obs`: one for one observation, a batch for a batch (see `ActingPolicy.act`).

        A nested observation is given, and a nested action returned, in the space's own form. A recurrent policy goes
        on from the `act` before, `reset()` begins an episode; a batch is so many episodes side by side, row i going on
        from row i. `reward` is what the last action brought, for a policy that was trained to see it.

        Raises ObservationError when `obs` does not fit the contract, RequestError when the policy cannot explore, lacks
        the reward, or remembers another number of episodes, and ActionError when what came out is not finite or not in
        the action space.
        """
        if not self._simple:
            return self._act_on(obs, explore, seed, reward)
        array, batch = self._leaf_reader.read(obs)
        if explore:
            self._check_explores()
            action = self._sample(self._run(self._dist_only, {self._input: array})[0], seed)["action"]
        else:
            action = self._run(self._action_only, {self._input: array})[0]
        self._guard.check(action)
        return action if batch else action[0, ...]

    def act_from(
        self,
        obs: Observation,
        state: Mapping[str, ArrayLike] | None,
        *,
        explore: bool = False,
        seed: int | None = None,
        reward: ArrayLike | None = None,
    ) -> tuple[Any, State]:
        """Return (action, next state) and remember nothing: for a server, whose callers carry their own state.

        `state` is what this method returned for the step before, by state name, with a batch axis where `obs` has one;
        None begins an episode. Raises RequestError when it does not fit the contract, and what `act` raises.
        """
        step = self.step(obs, state=state, explore=explore, seed=seed, reward=reward)
        if step.batch is not None:
            return step.action, step.state
        return step.action, {name: leaf[0, ...] for name, leaf in step.state.items()}

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
        """Decide one step of an episode and remember nothing.

        `before` and `last` are an earlier step's `state` and `leaves`; `state` and `last_action` the same as a caller
        sends them, which is checked. None of a pair begins an episode. Raises RequestError when they do not fit, and
        what `act` raises.
        """
        feed, batch = self._reader.read(obs)
        rows = len(next(iter(feed.values())))
        known = next((len(leaf) for leaf in (*(before or {}).values(), *(last or {}).values())), rows)
        if known != rows:
            raise RequestError(
                f"policy '{self._contract.name}' remembers {known} episode{'s' if known > 1 else ''} and got {rows} "
                f"observation{'s' if rows > 1 else ''}: reset to begin others"
            )
        if state is not None:
            before = self._memory.read(state, rows, batch=batch)
        if last_action is not None:
            given = action_leaves(self._contract.action_space, last_action, "action")
            last = self._limit.read(given, rows, batch=batch)
        action, after = self._decide(feed, rows, before, explore, seed, reward)
        if self._limit and last is not None:
            action, limited = self._limit.apply(action, last)
            for sentence in limited:
                self._take_notice(sentence)
            for name, guard in self._guards.items():
                guard.check(action[name])
        space = self._contract.action_space
        own = action if batch else {name: leaf[0, ...] for name, leaf in action.items()}
        return Step(build_action(space, own), action, after, rows if batch else None, feed)

    def read(self, obs: Observation) -> tuple[dict[str, NDArray[Any]], bool]:
        """Return what the network would be given, and whether that is a batch. Raises ObservationError."""
        return self._reader.read(obs)

    def action(self, computed: Mapping[str, NDArray[Any]], *, batch: bool) -> Any:
        """Return the action that the network's outputs are (`read`, `network`), checked. Raises ActionError."""
        for name, guard in self._guards.items():
            guard.check(computed[name])
        own = {name: computed[name] if batch else computed[name][0, ...] for name in self._guards}
        return build_action(self._contract.action_space, own)

    def network(self) -> Network:
        """Return the network: from what `read` gives to the action's tensors by name, unchecked (`action` checks).

        It is onnxruntime's own `run`: what has been given to it is computed even when the policy is closed meanwhile.
        """
        return _named(self._open_session().run, list(self._guards))

    def check_rows(self) -> None:
        """Raise BundleError where the network computes several observations otherwise than each by itself."""
        check_rows(self._bundle, self._open_session().run)

    def fingerprint(self, fed: Mapping[str, NDArray[Any]]) -> bytes:
        """Return what tells the observation of a feed (`read`, `Step.fed`) from others."""
        digest = hashlib.blake2b(digest_size=16)
        for name in self._observed:
            digest.update(fed[name].tobytes())
        return digest.digest()

    def twin(self) -> Policy:
        """Return another policy over the same graph, for another thread: its memory, notices and drift are its own."""
        return Policy(self._bundle, self._open_session(), self.options, graph_hash=self._graph_hash)

    def reset(self) -> None:
        """Start an episode: a recurrent policy forgets. Nothing to do for a stateless one."""
        self._state = self._last = None

    def close(self) -> None:
        """Drop the session; `act` raises UsageError from now on."""
        self._run, self._session = _refuse_closed, None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open_session(self) -> onnxruntime.InferenceSession:
        if self._session is None:
            _refuse_closed([], {})
        return self._session

    def _act_on(self, obs: Observation, explore: bool, seed: int | None, reward: ArrayLike | None) -> Any:
        step = self.step(obs, before=self._state, last=self._last, explore=explore, seed=seed, reward=reward)
        self._state = step.state or None
        self._last = step.leaves if self._limit else None
        return step.action

    def _take_notice(self, sentence: str) -> None:
        self.notices.append(sentence)
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
        feed.update(self._memory.feed(before, rows, reward))
        names = (["action_dist_inputs"] if explore else list(self._guards)) + self._memory.outputs
        if explore:
            self._check_explores()
        computed = dict(zip(names, self._run(names, feed), strict=True))
        action = self._sample(computed["action_dist_inputs"], seed) if explore else computed
        for name, guard in self._guards.items():
            guard.check(action[name])
        after = self._memory.keep(computed, action if explore else None)
        return {name: action[name] for name in self._guards}, after

    def _check_explores(self) -> Distribution:
        distribution = self._contract.distribution
        if distribution is None:
            raise RequestError(
                f"policy '{self._contract.name}' has no action distribution and cannot explore: leave 'explore' out"
            )
        return distribution

    def _sample(self, inputs: NDArray[Any], seed: int | None) -> dict[str, NDArray[Any]]:
        if seed is not None and seed < 0:
            raise RequestError(f"seed must be a non-negative integer, got {seed}")
        rng = self._rng if seed is None else np.random.default_rng(seed)
        # Minus infinity is how a policy says 'not allowed'; where it is a mean, the guard refuses the action.
        if np.isnan(inputs).any() or np.isposinf(inputs).any():
            raise ActionError(
                f"policy '{self._contract.name}' gave a non-finite action distribution for this observation"
            )
        return sample_leaves(inputs, self._check_explores(), self._contract.action_space, rng)


def _named(run: _Run, names: list[str]) -> Network:
    return lambda feed: dict(zip(names, run(names, feed), strict=True))


def _refuse_closed(_names: list[str], _feed: Mapping[str, Any]) -> NoReturn:
    raise UsageError("the policy has been closed: load it again to act")


# Loading: what must hold before a graph may act.


def _check_contract(bundle: Bundle) -> None:
    """Refuse what this runtime cannot run faithfully, and contracts that contradict themselves."""
    contract = bundle.contract
    observations = leaf_specs(contract.observation_space, "obs")
    actions = leaf_specs(contract.action_space, "action")
    known = {*observations, REWARD, *(f"state_in.{state.name}" for state in contract.state)}
    listed = [tensor.name for tensor in contract.inputs]
    if missing := [name for name in observations if name not in listed]:
        raise BundleError(f"{bundle.path}: {CONTRACT_FILE} lists no input {_quoted(missing)}")
    if strange := [name for name in listed if name not in known]:
        raise BundleError(f"{bundle.path}: the input {_quoted(strange)} is neither an observation nor a state")
    outputs = {tensor.name: tensor for tensor in contract.outputs}
    if missing := [name for name in actions if name not in outputs]:
        raise BundleError(f"{bundle.path}: {CONTRACT_FILE} lists no output {_quoted(missing)}")
    tensors_of = {"inputs": observations, "outputs": actions}
    for side, listed_tensors in (("inputs", contract.inputs), ("outputs", contract.outputs)):
        for tensor in listed_tensors:
            space = tensors_of[side].get(tensor.name)
            # RLlib sends the action of a Box of shape () as an array of one, and so do its exports.
            shapes = [(-1, *space.shape)] + [(-1, 1)] * (side == "outputs" and not space.shape) if space else []
            if space is not None and (tensor.dtype != space.dtype or tensor.shape not in shapes):
                raise BundleError(
                    f"{bundle.path}: the space of '{tensor.name}' is {space.dtype} of shape {space.shape}, the tensor "
                    f"{tensor.dtype} of shape {tensor.shape}"
                )
    for state in contract.state:
        shape = (-1, *state.shape)
        for name, tensors in (
            (f"state_in.{state.name}", contract.inputs),
            (f"state_out.{state.name}", contract.outputs),
        ):
            wanted = (name, state.dtype, shape)
            if not any((tensor.name, tensor.dtype, tensor.shape) == wanted for tensor in tensors):
                raise BundleError(f"{bundle.path}: {CONTRACT_FILE} lists no '{name}' of shape {shape} ({state.dtype})")
    for name, space in {**observations, **actions}.items():
        _check_leaf(bundle, name, space)
    expected = contract.distribution and distribution_size(contract.distribution, contract.action_space)
    dist = outputs.get("action_dist_inputs")
    if expected is not None and (dist is None or dist.shape[1:] != (expected,)):
        got = "none" if dist is None else str(dist.shape)
        raise BundleError(
            f"{bundle.path}: a {contract.distribution.kind if contract.distribution else ''} policy needs the output "
            f"'action_dist_inputs' of shape (-1, {expected}), got {got}"
        )


def _check_leaf(bundle: Bundle, name: str, space: LeafSpec) -> None:
    where = f"{bundle.path}: the space of '{name}'"
    try:
        kind: str = np.dtype(space.dtype).kind
    except TypeError:
        kind = "?"
    if kind not in "fiub":
        raise BundleError(f"{where} has dtype '{space.dtype}': expected a number type")
    if space.size > MAX_ELEMENTS:
        raise BundleError(f"{where} has {space.size:,} elements: at most {MAX_ELEMENTS:,}")
    if space.elements and len(space.elements) != space.size:
        raise BundleError(f"{where} names {len(space.elements)} elements of {space.size}")
    if isinstance(space, BoxSpec):
        sides: tuple[Any, ...] = (space.low, space.high)
    else:
        sides = (space.nvec, space.start) if isinstance(space, MultiDiscreteSpec) else ()
    for side in sides:
        if isinstance(side, tuple) and len(side) != space.size:
            raise BundleError(f"{where} has {len(side)} bounds for {space.size} elements")


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _open(bundle: Bundle, threads: int) -> onnxruntime.InferenceSession:
    with bundle.verified_copy(ONNX_FILE) as file:
        try:
            return open_session(file, threads)
        except Exception as error:  # onnxruntime's own exceptions share no base but Exception
            sentence = first_line(error).replace(str(file), bundle.onnx.name)
            raise BundleError(f"{bundle.onnx} is not a graph onnxruntime can run: {sentence}") from error


def _check_graph(bundle: Bundle, session: onnxruntime.InferenceSession) -> None:
    """Compare the graph's inputs and outputs with the contract's."""
    contract = bundle.contract
    for side, listed, actual in (
        ("inputs", contract.inputs, session.get_inputs()),
        ("outputs", contract.outputs, session.get_outputs()),
    ):
        found = {node.name: node for node in actual}
        if set(found) != {tensor.name for tensor in listed}:
            raise BundleError(
                f"{bundle.onnx}: the graph's {side} are {', '.join(sorted(found))}, "
                f"{CONTRACT_FILE} lists {', '.join(sorted(tensor.name for tensor in listed))}"
            )
        for tensor in listed:
            actual_type = ONNX_TYPES.get(found[tensor.name].type, found[tensor.name].type)
            if actual_type != tensor.dtype:
                raise BundleError(
                    f"{bundle.onnx}: '{tensor.name}' is {actual_type} in the graph, {tensor.dtype} in {CONTRACT_FILE}"
                )
            inner = tuple(found[tensor.name].shape[1:])
            # A symbolic axis (a string) fits any size; the golden vectors check the rest.
            fits = len(inner) == len(tensor.shape) - 1 and all(
                not isinstance(a, int) or a == b for a, b in zip(inner, tensor.shape[1:], strict=True)
            )
            if not fits:
                raise BundleError(
                    f"{bundle.onnx}: '{tensor.name}' has shape (batch, {', '.join(map(str, inner))}) in the graph and "
                    f"{tensor.shape} in {CONTRACT_FILE}"
                )


def _check_copy(bundle: Bundle, session: onnxruntime.InferenceSession) -> None:
    """Compare the contract with the copy inside the graph: an edited one may have valid hashes."""
    text = session.get_modelmeta().custom_metadata_map.get(CONTRACT_KEY)
    if text is None:
        return  # a graph that another tool wrote; what of the contract can be seen in it has been compared
    exported = embedded_contract(text, bundle.onnx)
    now = bundle.contract.model_copy(update={"evaluations": exported.evaluations})  # `rlservo verify` adds to them
    if now != exported:
        changed = [name for name in Contract.model_fields if getattr(now, name) != getattr(exported, name)]
        raise BundleTamperedError(
            f"{bundle.path / CONTRACT_FILE} has been edited since the export: its {_quoted(changed)} "
            f"{'is' if len(changed) == 1 else 'are'} not what {bundle.onnx.name} was proven with",
            {"fields": changed},
        )


def check_golden_vectors(bundle: Bundle, run: _Run) -> None:
    """Replay golden.npz and compare every output with the recorded one.

    Floats agree within `max(contract parity rtol, GOLDEN_RTOL)` relative and `max(parity atol, GOLDEN_ATOL)` absolute;
    integers exactly, unless the choice was a tie within that tolerance. Raises GoldenMismatchError.
    """
    inputs, recorded = bundle.golden()
    names = [tensor.name for tensor in bundle.contract.outputs]
    missing = ({tensor.name for tensor in bundle.contract.inputs} - set(inputs)) | (set(names) - set(recorded))
    if missing or any(array.ndim == 0 or len(array) == 0 for array in (*inputs.values(), *recorded.values())):
        raise BundleError(f"{bundle.path / GOLDEN_FILE} holds no samples of {', '.join(sorted(missing)) or 'a tensor'}")
    feed = {tensor.name: inputs[tensor.name] for tensor in bundle.contract.inputs}
    try:
        computed = dict(zip(names, run(names, feed), strict=True))
    except Exception as error:  # onnxruntime's own exceptions share no base but Exception
        raise BundleError(
            f"{bundle.path}: the graph does not run on its golden vectors: {first_line(error)}"
        ) from error
    rtol = max(bundle.contract.parity.rtol, GOLDEN_RTOL)
    atol = max(bundle.contract.parity.atol, GOLDEN_ATOL)
    for name in names:
        _compare(bundle, name, computed, recorded, rtol, atol)
    logger.debug("%s: %d golden vectors reproduced", bundle.path, len(next(iter(recorded.values()))))


def check_rows(bundle: Bundle, run: _Run) -> None:
    """Refuse to compute observations together where that is something else than one by one. Raises BundleError."""
    inputs, _ = bundle.golden()
    names = [tensor.name for tensor in bundle.contract.outputs]
    rows = {tensor.name: np.resize(inputs[tensor.name], (3, *inputs[tensor.name].shape[1:]))
            for tensor in bundle.contract.inputs}  # fmt: skip
    one_by_one = [run(names, {name: array[row : row + 1] for name, array in rows.items()}) for row in range(3)]
    try:
        together = dict(zip(names, run(names, rows), strict=True))
        singly = {name: np.concatenate([each[index] for each in one_by_one]) for index, name in enumerate(names)}
        for name in names:
            _compare(bundle, name, together, singly, GOLDEN_RTOL, GOLDEN_ATOL)
    except Exception as error:  # onnxruntime's own exceptions share no base but Exception
        raise BundleError(
            f"{bundle.path}: the graph does not compute three observations as it computes each ({first_line(error)}): "
            "leave micro_batch out of the policy's options"
        ) from error


def _compare(
    bundle: Bundle,
    name: str,
    computed: Mapping[str, NDArray[Any]],
    recorded: Mapping[str, NDArray[Any]],
    rtol: float,
    atol: float,
) -> None:
    got, expected = computed[name], recorded[name]
    if got.shape != expected.shape:
        raise GoldenMismatchError(
            f"{bundle.path}: '{name}' has shape {got.shape} on this machine, {expected.shape} in {GOLDEN_FILE}"
        )
    difference = np.abs(got.astype(np.float64) - expected.astype(np.float64))
    within = difference <= (rtol * np.abs(expected) + atol if expected.dtype.kind == "f" else 0)
    if expected.dtype.kind != "f" and not within.all():
        within |= _ties(bundle, name, computed, recorded, rtol, atol)
    if within.all():
        return
    bad = int(np.count_nonzero(~within))
    worst = float(np.nanmax(difference)) if np.isfinite(difference).any() else float("nan")
    raise GoldenMismatchError(
        f"{bundle.path}: this machine does not reproduce the golden vectors: {bad} of {within.size} values of '{name}' "
        f"differ, by up to {worst:.3g} (allowed: {rtol:g} relative, {atol:g} absolute)",
        {"output": name, "differing": bad, "values": int(within.size), "max_difference": worst},
    )


def _ties(
    bundle: Bundle,
    name: str,
    computed: Mapping[str, NDArray[Any]],
    recorded: Mapping[str, NDArray[Any]],
    rtol: float,
    atol: float,
) -> NDArray[np.bool_]:
    """Return where another discrete choice is as good: its score ties with the recorded one's within tolerance."""
    expected = recorded[name]
    none = np.zeros(expected.shape, np.bool_)
    scores = next((recorded[key] for key in ("action_dist_inputs", "q_values") if key in recorded), None)
    space = leaf_specs(bundle.contract.action_space, "action").get(name)
    if scores is None or not isinstance(space, DiscreteSpec | MultiDiscreteSpec) or scores.ndim != 2:
        return none
    parts = split_scores(scores, bundle.contract.action_space)[name]
    rows = np.arange(len(expected))
    here = (computed[name] - space.bounds()[0]).reshape(len(expected), -1).astype(np.int64)
    there = (expected - space.bounds()[0]).reshape(len(expected), -1).astype(np.int64)
    tied = none.reshape(len(expected), -1)
    for column, part in enumerate(parts):
        choices = part.shape[1]
        valid = (here >= 0) & (here < choices) & (there >= 0) & (there < choices)
        a = part[rows, np.where(valid, here, 0)[:, column]]
        b = part[rows, np.where(valid, there, 0)[:, column]]
        tied[:, column] = valid[:, column] & (np.abs(a - b) <= rtol * np.abs(b) + atol)
    return tied.reshape(expected.shape)
