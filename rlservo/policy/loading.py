"""Checks of a bundle before it may act: contract, graph, golden vectors."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.bundle import CONTRACT_FILE, CONTRACT_KEY, GOLDEN_FILE, ONNX_FILE, Bundle
from rlservo.bundle.contract import REWARD, VALUE, Contract, TensorSpec, parse_contract
from rlservo.bundle.scores import split_scores
from rlservo.bundle.spaces import BoxSpec, DiscreteSpec, LeafSpec, MultiDiscreteSpec, leaf_specs
from rlservo.errors import BundleError, BundleTamperedError, GoldenMismatchError, first_line, quoted
from rlservo.policy.exploration import distribution_size
from rlservo.policy.ort_session import open_ort_session

if TYPE_CHECKING:
    import onnxruntime


logger = logging.getLogger(__name__)

GOLDEN_RTOL = (
    1e-4  # machines differ in the last bits of exp and in the order of sums; a wrong graph differs in the first bits
)
GOLDEN_ATOL = 1e-5  # the same for actions near zero
MAX_ELEMENTS = 1 << 24  # of an observation or action: a one-line contract could otherwise demand all memory
# onnxruntime's names of the types a policy's tensors have.
ONNX_TYPES = {
    "tensor(float)": "float32", "tensor(double)": "float64", "tensor(float16)": "float16", "tensor(bool)": "bool",
    **{f"tensor({name})": name for size in (8, 16, 32, 64) for name in (f"int{size}", f"uint{size}")},
}  # fmt: skip

LARGEST_MADE = 32 << 20
"""[bytes] Largest graph that is rebuilt without its value head; acting waits meanwhile, 0.6 ms per megabyte."""

MAX_GOLDEN_SAMPLES = 4096
"""An export writes 64. All are computed at once, in memory for each layer of the network."""

PROOF_S = 10.0
"""[s] Time limit for the golden vectors: a network computes thousands in a second, but a graph can have loops."""

MOST_S = 1.0
"""[s] Computing time for one observation; no operator is loaded whose time depends on its numbers."""
NUMBERS = (1.0, 1e7, 1e-40)  # processors are slow at numbers as small as the last

Run = Callable[..., Any]
"""Signature of onnxruntime's `run`: output names, inputs by name and optional run options, to arrays."""


def check_contract(bundle: Bundle) -> None:
    """Refuse contracts that this runtime cannot run faithfully, or that contradict themselves."""
    contract = bundle.contract
    observations = leaf_specs(contract.observation_space, "obs")
    actions = leaf_specs(contract.action_space, "action")
    known = {*observations, REWARD, *(f"state_in.{state.name}" for state in contract.state)}
    listed = [tensor.name for tensor in contract.inputs]
    if missing := [name for name in observations if name not in listed]:
        raise BundleError(f"{bundle.path}: {CONTRACT_FILE} lists no input {quoted(missing)}")
    if strange := [name for name in listed if name not in known]:
        raise BundleError(f"{bundle.path}: the input {quoted(strange)} is neither an observation nor a state")
    outputs = {tensor.name: tensor for tensor in contract.outputs}
    if missing := [name for name in actions if name not in outputs]:
        raise BundleError(f"{bundle.path}: {CONTRACT_FILE} lists no output {quoted(missing)}")
    tensors_of = {"inputs": observations, "outputs": actions}
    for side, listed_tensors in (("inputs", contract.inputs), ("outputs", contract.outputs)):
        for tensor in listed_tensors:
            space = tensors_of[side].get(tensor.name)
            # RLlib gives an action of a Box of shape () as an array of one element, and so do its exports.
            shapes = [(-1, *space.shape)] + [(-1, 1)] * (side == "outputs" and not space.shape) if space else []
            if space is not None and (tensor.dtype != space.dtype or tensor.shape not in shapes):
                raise BundleError(
                    f"{bundle.path}: the space of '{tensor.name}' is {space.dtype} of shape {space.shape}, but the "
                    f"tensor is {tensor.dtype} of shape {tensor.shape}"
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
        raise BundleError(f"{where} has dtype '{space.dtype}': expected a numeric type")
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


def leaves_value_out(bundle: Bundle) -> bool:
    """Return whether the acting graph leaves out its value head: if it has one, and is not large."""
    has_value = any(tensor.name == VALUE for tensor in bundle.contract.outputs)
    return has_value and bundle.onnx.stat().st_size <= LARGEST_MADE


def open_graph(bundle: Bundle, threads: int, *, acts_only: bool = False) -> onnxruntime.InferenceSession:
    """Open the network; `acts_only`: see `leaves_value_out`. Raises BundleError, BundleTamperedError."""
    with bundle.verified_copy(ONNX_FILE) as file:
        try:
            if acts_only and leaves_value_out(bundle):
                from rlservo.policy.acting_graph import without_value

                file.write_bytes(without_value(file.read_bytes()))
            else:
                _check_divisions(bundle, file)
                _check_sizes(bundle, file)
            return open_ort_session(file, threads)
        except BundleError:
            raise
        except Exception as error:  # onnxruntime's own exceptions share no base but Exception
            sentence = first_line(error).replace(str(file), bundle.onnx.name)
            raise BundleError(f"{bundle.onnx} is not a graph that onnxruntime can run: {sentence}") from error


def _check_divisions(bundle: Bundle, file: Path) -> None:
    """Raise BundleError if an integer division of the graph could end the process.

    Acting waits while the graph is parsed, 1 ms per megabyte.
    """
    from rlservo.policy.integer_division import CHECKS_ZERO, with_floating_divisors

    model = file.read_bytes()
    probe = with_floating_divisors(model)
    if probe is None:
        return
    open_ort_session(file)  # otherwise it is not this that is wrong with it
    try:
        file.write_bytes(probe)
        open_ort_session(file)
    except Exception as error:
        trap, how = "be -1, which ends the process for the smallest integer", "divide by an absolute value"
        if not CHECKS_ZERO:
            trap, how = "be 0 or -1, which ends the process", "install onnxruntime 1.25 or newer (Python 3.11)"
        raise BundleError(
            f"{bundle.onnx} divides integers by a number that may {trap}: {how}, or export the policy again"
        ) from error
    finally:
        file.write_bytes(model)


def _check_sizes(bundle: Bundle, file: Path) -> None:
    """Raise BundleError if an observation could decide how long the graph computes.

    Acting waits while the graph is parsed, 1 ms per megabyte.
    """
    from rlservo.policy.data_dependence import deciding_by_data

    if deciding := deciding_by_data(file.read_bytes()):
        raise BundleError(
            f"{bundle.onnx}: the size, repetitions or branch of {deciding[0]} depend on the observation, so a request "
            "could stop all others: use fixed sizes, and 'where' or 'clamp' instead of masks and branches"
        )


def check_graph(bundle: Bundle, ort_session: onnxruntime.InferenceSession) -> None:
    """Compare the graph's inputs and outputs with the contract's."""
    contract = bundle.contract
    for side, listed, actual in (
        ("inputs", contract.inputs, ort_session.get_inputs()),
        ("outputs", contract.outputs, ort_session.get_outputs()),
    ):
        found = {node.name: node for node in actual}
        if set(found) != {tensor.name for tensor in listed}:
            raise BundleError(
                f"{bundle.onnx}: the graph's {side} are {', '.join(sorted(found))}, but {CONTRACT_FILE} lists "
                f"{', '.join(sorted(tensor.name for tensor in listed))}"
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
                    f"{bundle.onnx}: '{tensor.name}' has shape (batch, {', '.join(map(str, inner))}) in the graph, but "
                    f"{tensor.shape} in {CONTRACT_FILE}"
                )


def check_copy(bundle: Bundle, ort_session: onnxruntime.InferenceSession) -> None:
    """Compare the contract with the copy inside the graph: an edited one may have valid hashes."""
    text = ort_session.get_modelmeta().custom_metadata_map.get(CONTRACT_KEY)
    if text is None:
        return  # a graph of another tool; the visible parts of the contract have been compared
    exported = parse_contract(text, f"{bundle.onnx}: the contract inside the graph is malformed")
    now = bundle.contract.model_copy(update={"evaluations": exported.evaluations})  # `rlservo verify` adds to them
    if now != exported:
        changed = [name for name in Contract.model_fields if getattr(now, name) != getattr(exported, name)]
        raise BundleTamperedError(
            f"{bundle.path / CONTRACT_FILE} has been edited since the export: its {quoted(changed)} "
            f"{'is' if len(changed) == 1 else 'are'} not what {bundle.onnx.name} was proven with",
            {"fields": changed},
        )


def acting_outputs(contract: Contract) -> list[str]:
    """Return the graph's outputs except `value`."""
    return [tensor.name for tensor in contract.outputs if tensor.name != VALUE]


def check_golden_vectors(bundle: Bundle, run: Run, names: Sequence[str]) -> None:
    """Replay golden.npz and compare the outputs of these names with the recorded ones.

    Floats agree within `max(contract parity rtol, GOLDEN_RTOL)` relative and `max(parity atol, GOLDEN_ATOL)` absolute;
    integers agree exactly, unless the choice was a tie within that tolerance. Raises GoldenMismatchError.
    """
    inputs, recorded = bundle.golden()
    missing = ({tensor.name for tensor in bundle.contract.inputs} - set(inputs)) | (set(names) - set(recorded))
    if missing or any(array.ndim == 0 or len(array) == 0 for array in (*inputs.values(), *recorded.values())):
        raise BundleError(f"{bundle.path / GOLDEN_FILE} holds no samples of {', '.join(sorted(missing)) or 'a tensor'}")
    samples = max(len(array) for array in (*inputs.values(), *recorded.values()))
    if samples > MAX_GOLDEN_SAMPLES:
        raise BundleError(f"{bundle.path / GOLDEN_FILE} holds {samples:,} samples: at most {MAX_GOLDEN_SAMPLES:,}")
    feed = {tensor.name: inputs[tensor.name] for tensor in bundle.contract.inputs}
    try:
        computed = dict(zip(names, _run_in_time(bundle, run, names, feed), strict=True))
    except BundleError:
        raise
    except Exception as error:  # onnxruntime's own exceptions share no base but Exception
        raise BundleError(
            f"{bundle.path}: the graph does not run on its golden vectors: {first_line(error)}"
        ) from error
    rtol = max(bundle.contract.parity.rtol, GOLDEN_RTOL)
    atol = max(bundle.contract.parity.atol, GOLDEN_ATOL)
    for name in names:
        _compare(bundle, name, computed, recorded, rtol, atol)
    logger.debug("%s: %d golden vectors reproduced", bundle.path, len(next(iter(recorded.values()))))


def check_time(bundle: Bundle, run: Run, names: Sequence[str]) -> None:
    """Raise BundleError if the graph computes for longer than MOST_S for an observation that its spaces allow."""
    contract, before = bundle.contract, b""
    spaces = leaf_specs(contract.observation_space, "obs")
    for number in NUMBERS:
        feed = {tensor.name: _filled(tensor, spaces.get(tensor.name), number) for tensor in contract.inputs}
        content = b"".join(array.tobytes() for array in feed.values())
        if content == before:
            continue
        before, began = content, time.thread_time()
        with contextlib.suppress(Exception):  # a graph may refuse numbers, and BundleError comes from the time below
            _run_in_time(bundle, run, names, feed)
        taken_s = time.thread_time() - began
        if taken_s > MOST_S:
            raise BundleError(
                f"{bundle.onnx} computed for {taken_s:.1f} s on an observation of {number:.0e}, and may take at most "
                f"{MOST_S:g} s, so that no request stops the others: make the network smaller"
            )


def _filled(tensor: TensorSpec, space: LeafSpec | None, number: float) -> NDArray[Any]:
    """Return a batch of one, of the number as far as the space and the type allow it."""
    dtype = np.dtype(tensor.dtype)
    values = np.full((1, *tensor.shape[1:]), number)
    if space is not None:
        values = np.clip(values, *space.bounds())
    if dtype.kind in "iu":
        values = np.clip(values, np.iinfo(dtype).min, np.iinfo(dtype).max)
    with np.errstate(over="ignore"):  # 1e7 is infinity in half precision
        return values.astype(dtype)


def _run_in_time(bundle: Bundle, run: Run, names: Sequence[str], feed: dict[str, NDArray[Any]]) -> Sequence[Any]:
    """Compute, or raise BundleError after PROOF_S: onnxruntime stops before the next operator or loop iteration."""
    import onnxruntime

    options = onnxruntime.RunOptions()
    options.log_severity_level = 4  # errors arrive as exceptions
    end = threading.Timer(PROOF_S, setattr, (options, "terminate", True))
    end.daemon = True
    end.start()
    try:
        return run(names, feed, options)  # type: ignore[no-any-return]
    except Exception:
        if not options.terminate:
            raise
        raise BundleError(f"{bundle.path}: the graph did not finish its golden vectors within {PROOF_S:g} s") from None
    finally:
        end.cancel()


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
            f"{bundle.path}: '{name}' has shape {got.shape} on this machine, but {expected.shape} in {GOLDEN_FILE}"
        )
    a, b = got.astype(np.float64), expected.astype(np.float64)
    with np.errstate(invalid="ignore"):  # a choice that a mask forbids scores -inf
        difference = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
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
    """Return where another discrete choice is equally good: its score ties with the recorded one within tolerance."""
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
