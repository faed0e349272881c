"""Run one exported policy in this process: an observation in, an action ready for `env.step` out.

This is the file where an observation becomes an action, in `Policy.act`. It needs numpy and onnxruntime; it knows
nothing of the web, ray, torch or gymnasium. The server is a thin edge over it (`store.py`, `http.py`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from rlservo.export.bundle import (
    CONTRACT_FILE,
    GOLDEN_FILE,
    Bundle,
    Contract,
    DiscreteSpec,
    iter_elements,
    load_bundle,
)
from rlservo.export.errors import ActionError, BundleError, GoldenMismatchError, RequestError, UsageError
from rlservo.serve_app.acting import Observation
from rlservo.serve_app.exploring import distribution_size, sample_action
from rlservo.serve_app.observation import ObservationReader

if TYPE_CHECKING:
    import onnxruntime

logger = logging.getLogger(__name__)

GOLDEN_RTOL = (
    1e-4  # machines differ in the last bits of exp and in the order of sums; a wrong graph differs in the first
)
GOLDEN_ATOL = 1e-5  # the same for actions near zero
OVERSHOOT = 1e-5  # relative to the bound: what float32 rounding in unsquash may leave outside the space; clipped
SMALL_ACTION = 32  # elements up to which a Python loop checks bounds faster than numpy does

_Run = Callable[[list[str], dict[str, NDArray[Any]]], Any]


class Policy:
    """An exported policy, loaded and proven on this machine.

    ```python
    policy = Policy.load("policies/ur5")
    action = policy.act(obs)
    ```
    """

    def __init__(self, bundle: Bundle, session: onnxruntime.InferenceSession) -> None:
        """Wrap a session whose graph fits `bundle.contract`; use `Policy.load`."""
        contract = bundle.contract
        self._bundle = bundle
        self._contract = contract
        self._run: _Run = session.run
        self._reader = ObservationReader(contract.name, contract.observation_space)
        self._input = contract.inputs[0].name
        self._action_only = ["action"]
        self._dist_only = ["action_dist_inputs"]
        self._rng = np.random.default_rng()
        space = contract.action_space
        self._space = space
        self._shape = space.shape
        self._dtype = np.dtype(space.dtype)
        if isinstance(space, DiscreteSpec):
            low, high = np.array(space.start, np.float64), np.array(space.start + space.n - 1, np.float64)
        else:
            low, high = space.bounds()
        if self._dtype.kind == "f":  # the largest finite number stands for unbounded: infinity is then outside as well
            largest = float(np.finfo(self._dtype).max)
            low, high = np.maximum(low, -largest), np.minimum(high, largest)
        self._low, self._high = low, high
        self._small_bounds: list[tuple[float, float]] = []
        if space.size <= SMALL_ACTION:
            self._small_bounds = list(zip(low.ravel().tolist(), high.ravel().tolist(), strict=True))

    @classmethod
    def load(cls, path: str | Path, *, threads: int = 1, check_golden: bool = True) -> Self:
        """Load the bundle at `path` (a bundle, a policy folder or a repository with one policy).

        Checks hashes, the graph against the contract and, unless `check_golden` is off, that this machine reproduces
        the golden vectors. `threads` is onnxruntime's intra-op thread count; one is fastest for networks of this size.

        Raises BundleError, BundleTamperedError or GoldenMismatchError.
        """
        if threads < 1:
            raise UsageError(f"threads must be 1 or more, got {threads}")
        bundle = load_bundle(path)
        _check_contract(bundle)
        session = _open_session(bundle, threads)
        _check_graph(bundle, session)
        if check_golden:
            check_golden_vectors(bundle, session.run)
        return cls(bundle, session)

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def path(self) -> Path:
        """The bundle folder this policy was loaded from."""
        return self._bundle.path

    def act(self, obs: Observation, *, explore: bool = False, seed: int | None = None) -> NDArray[Any]:
        """Return the action for `obs`: one for one observation, a batch for a batch (see `ActingPolicy.act`).

        Raises ObservationError when `obs` does not fit the contract, RequestError when the policy cannot explore, and
        ActionError when what came out is not finite or not in the action space.
        """
        array, batch = self._reader.read(obs)
        action = self._sample(array, seed) if explore else self._run(self._action_only, {self._input: array})[0]
        self._check_action(action)
        return action if batch else action[0, ...]

    def reset(self) -> None:
        """Start an episode. The policies this version runs have no state to reset."""

    def close(self) -> None:
        """Drop the session; `act` raises UsageError from now on."""
        self._run = _refuse_closed

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _sample(self, array: NDArray[Any], seed: int | None) -> NDArray[Any]:
        distribution = self._contract.distribution
        if distribution is None:
            raise RequestError(
                f"policy '{self._contract.name}' has no action distribution and cannot explore: leave 'explore' out"
            )
        if seed is not None and seed < 0:
            raise RequestError(f"seed must be a non-negative integer, got {seed}")
        rng = self._rng if seed is None else np.random.default_rng(seed)
        inputs = self._run(self._dist_only, {self._input: array})[0]
        if not np.isfinite(inputs).all():
            raise ActionError(
                f"policy '{self._contract.name}' gave a non-finite action distribution for this observation"
            )
        return sample_action(inputs, distribution, self._space, rng).astype(self._dtype)

    def _check_action(self, action: NDArray[Any]) -> None:
        """Let only finite actions of the action space pass; rounding overshoot is clipped in place."""
        if self._small_bounds and len(action) == 1:
            for value, (low, high) in zip(action.ravel().tolist(), self._small_bounds, strict=True):
                if not low <= value <= high:  # so written, it holds for not-a-number too
                    break
            else:
                return
        elif ((action >= self._low) & (action <= self._high)).all():
            return
        self._clip_or_refuse(action)

    def _clip_or_refuse(self, action: NDArray[Any]) -> None:
        slack = OVERSHOOT * np.maximum(1.0, np.minimum(np.abs(self._low), np.abs(self._high)))
        bad = ~((action >= self._low - slack) & (action <= self._high + slack))
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            flat = int(np.ravel_multi_index(index[1:], self._shape)) if self._shape else 0
            label = dict(iter_elements(self._space))[flat] if self._shape else "0"
            low, high = self._low[index[1:]], self._high[index[1:]]
            value = action[index]
            why = f"not in [{low:g}, {high:g}]" if np.isfinite(value) else "not a finite number"
            raise ActionError(
                f"policy '{self._contract.name}' computed an action that must not reach a robot: "
                f"element {label} is {value}, {why}",
                {"policy": self._contract.name, "index": list(index), "value": str(value)},
            )
        np.clip(action, self._low.astype(self._dtype), self._high.astype(self._dtype), out=action)


def _refuse_closed(_names: list[str], _feed: Mapping[str, Any]) -> NoReturn:
    raise UsageError("the policy has been closed: load it again to act")


# Loading: what must hold before a graph may act.


def _check_contract(bundle: Bundle) -> None:
    """Refuse what this runtime cannot run faithfully, and contracts that contradict themselves."""
    contract = bundle.contract
    if contract.state:
        states = ", ".join(state.name for state in contract.state)
        raise BundleError(f"{bundle.path}: the policy is recurrent (state {states}); this version runs stateless ones")
    if [tensor.name for tensor in contract.inputs] != ["obs"]:
        names = ", ".join(tensor.name for tensor in contract.inputs) or "none"
        raise BundleError(f"{bundle.path}: this version runs policies with the one input 'obs', got {names}")
    if "action" not in {tensor.name for tensor in contract.outputs}:
        raise BundleError(f"{bundle.path}: {CONTRACT_FILE} lists no output 'action'")
    for which, space in (("observation_space", contract.observation_space), ("action_space", contract.action_space)):
        try:
            kind: str = np.dtype(space.dtype).kind
        except TypeError:
            kind = "?"
        if kind not in "fiub":
            raise BundleError(f"{bundle.path}: {which} has dtype '{space.dtype}': expected a number type")
        if space.elements and len(space.elements) != space.size:
            raise BundleError(f"{bundle.path}: {which} names {len(space.elements)} elements of {space.size}")
        if not isinstance(space, DiscreteSpec):
            for side in (space.low, space.high):
                if isinstance(side, tuple) and len(side) != space.size:
                    raise BundleError(f"{bundle.path}: {which} has {len(side)} bounds for {space.size} elements")
    expected = contract.distribution and distribution_size(contract.distribution, contract.action_space)
    dist = {tensor.name: tensor for tensor in contract.outputs}.get("action_dist_inputs")
    if expected is not None and (dist is None or dist.shape[1:] != (expected,)):
        got = "none" if dist is None else str(dist.shape)
        raise BundleError(
            f"{bundle.path}: a {contract.distribution.kind if contract.distribution else ''} policy needs the output "
            f"'action_dist_inputs' of shape (-1, {expected}), got {got}"
        )


def _open_session(bundle: Bundle, threads: int) -> onnxruntime.InferenceSession:
    # onnxruntime 1.31's Linux wheels report use to Microsoft from the moment they are imported unless this is set
    # (its Privacy.md). What runs a robot calls nobody; whoever wants it may set the variable to 0.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4  # what goes wrong arrives as an exception; onnxruntime would print it as well
    # A second thread spinning for work burns a core that a robot's control loop wants.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        # From bytes, not from the path: a graph cannot make onnxruntime read other files that way.
        return onnxruntime.InferenceSession(bundle.onnx.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions share no base but Exception
        raise BundleError(f"{bundle.onnx} is not a graph onnxruntime can run: {_first_line(error)}") from error


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
            f"{bundle.path}: the graph does not run on its golden vectors: {_first_line(error)}"
        ) from error
    rtol = max(bundle.contract.parity.rtol, GOLDEN_RTOL)
    atol = max(bundle.contract.parity.atol, GOLDEN_ATOL)
    for name in names:
        _compare(bundle, name, computed, recorded, rtol, atol)
    logger.debug("%s: %d golden vectors reproduced", bundle.path, len(recorded["action"]))


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
    scores = next((recorded[key] for key in ("action_dist_inputs", "q_values") if key in recorded), None)
    space = bundle.contract.action_space
    if name != "action" or scores is None or not isinstance(space, DiscreteSpec) or scores.shape[1:] != (space.n,):
        return np.zeros(expected.shape, np.bool_)
    rows = np.arange(len(expected))
    here, there = computed[name] - space.start, expected - space.start
    valid = (here >= 0) & (here < space.n) & (there >= 0) & (there < space.n)
    a, b = scores[rows, np.where(valid, here, 0)], scores[rows, np.where(valid, there, 0)]
    tied: NDArray[np.bool_] = valid & (np.abs(a - b) <= rtol * np.abs(b) + atol)
    return tied


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:300]
