"""Judgement of a mutant without the exporter: the largest change of an action over observations of its own drawing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from numpy.typing import NDArray

SAMPLES = 20_000
IMAGE = 512
"""Elements of an observation from which on there are fewer samples."""
IMAGE_SAMPLES = 3_000
ROWS, STATEFUL_ROWS = 1_000, 200
NEW_EPISODE = 0.03
UNBOUNDED = 1e6
UNSURE = 0.002
"""Share of the range by which last bits of the observation may move an action that is judged."""
TIE = 1e-4
"""Change of the scores, in parts of the largest, below which another choice is one between equals."""
Arrays = dict[str, NDArray[Any]]


def run_model(model: onnx.ModelProto) -> Any:
    """Return a function from inputs by name to outputs by name."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    names = [each.name for each in session.get_outputs()]
    wanted = [each.name for each in session.get_inputs()]

    def run(inputs: Mapping[str, NDArray[Any]]) -> Arrays:
        values: Sequence[Any] = session.run(names, {name: inputs[name] for name in wanted})
        return dict(zip(names, values, strict=True))

    return run


class Judge:
    """The original graph's actions on 20,000 observations, in sequences if it has a state."""

    def __init__(
        self, model: onnx.ModelProto, state: Arrays, observation_space: Any, action_space: Any, seen: Any
    ) -> None:
        """`state` is what an episode starts with; `seen` is (mean, standard deviation) of a leaf's observations."""
        self._actions = dict(leaves(action_space, "action"))
        rng = np.random.default_rng(4711)
        sizes = [int(np.prod(space.shape or ())) for _, space in leaves(observation_space, "obs")]
        self.samples = SAMPLES if sum(sizes) <= IMAGE else IMAGE_SAMPLES
        rows = STATEFUL_ROWS if state else ROWS
        self._steps = [
            _draw(dict(leaves(observation_space, "obs")), seen, rows, rng, first=step == 0)
            for step in range(self.samples // rows)
        ]
        self._wanted = list(_play(run_model(model), state, self._steps))
        nudged = [(_nudge(inputs, rng), restart, kinds) for inputs, restart, kinds in self._steps]
        moved = _play(run_model(model), state, nudged)
        self._range = {name: self._range_of(name, space) for name, space in self._actions.items()}
        self._unsure = [
            np.any([self._apart(name, a, b) > UNSURE for name in self._actions], axis=0)
            for a, b in zip(self._wanted, moved, strict=True)
        ]
        self.unsure = int(np.sum(self._unsure))

    def largest_change(self, model: onnx.ModelProto, state: Arrays) -> tuple[float, dict[str, Any]]:
        """Return the largest change of an action, as a share of its range, and where; infinite if it does not run."""
        largest, where = 0.0, {}
        try:
            for step, found in enumerate(_play(run_model(model), state, self._steps)):
                for name in self._actions:
                    apart = np.where(self._unsure[step], 0.0, self._apart(name, self._wanted[step], found))
                    row = int(apart.argmax())
                    if apart[row] > largest:
                        inputs = {
                            key: values[row].ravel()[:12].tolist() for key, values in self._steps[step][0].items()
                        }
                        was, now = (side[name][row].tolist() for side in (self._wanted[step], found))
                        largest = float(apart[row])
                        where = {"step": step, "output": name, "was": was, "is": now, "observation": inputs}
        except Exception as error:  # onnxruntime's own, and shapes that do not fit
            return np.inf, {"error": str(error)[:200]}
        return largest, where

    def _apart(self, name: str, wanted: Arrays, found: Arrays) -> NDArray[np.float64]:
        """Return each row's largest difference as a share of the action's range; another choice is 1."""
        a, b = (side[name].reshape(len(side[name]), -1) for side in (wanted, found))
        if a.shape != b.shape:
            return np.full(len(a), np.inf)
        if not isinstance(self._actions[name], Box):
            return np.where((a != b).any(axis=1) & ~_tied(wanted, found, self._actions), 1.0, 0.0)
        a, b = a.astype(np.float64), b.astype(np.float64)
        with np.errstate(invalid="ignore"):
            same = (a == b) | (np.isnan(a) & np.isnan(b))
            moved = np.where(same, 0.0, np.abs(a - b) / self._range[name])
        return np.asarray(np.nan_to_num(moved, nan=np.inf).max(axis=1))

    def _range_of(self, name: str, space: Any) -> NDArray[np.float64]:
        """Return the range of each number: the space's, or the middle 98% of what likely observations give."""
        if not isinstance(space, Box):
            return np.ones(1)
        low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
        likely = np.concatenate([
            wanted[name].reshape(len(kinds), -1)[kinds == 0]
            for wanted, (_, _, kinds) in zip(self._wanted, self._steps, strict=True)
        ]).astype(np.float64)  # fmt: skip
        first, last = np.nanpercentile(likely, [1, 99], axis=0)
        with np.errstate(invalid="ignore"):
            given = np.where(np.abs(high - low) < UNBOUNDED, high - low, last - first)
        return np.maximum(given, 1e-9)


def leaves(space: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield a space's leaves by tensor name; keys in sorted order."""
    if isinstance(space, Dict | Tuple):
        inside = sorted(space.spaces.items()) if isinstance(space, Dict) else enumerate(space.spaces)
        for key, part in inside:
            yield from leaves(part, f"{name}.{key}")
    else:
        yield name, space


def _tied(wanted: Arrays, found: Arrays, actions: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Return rows whose scores have not moved: their choice was one between equals."""
    scores = [n for n in wanted if n not in actions and n != "value" and not n.startswith("state_out.")]
    rows = len(next(iter(wanted.values())))
    tied = np.full(rows, bool(scores))
    for name in scores:
        a, b = (side[name].reshape(rows, -1).astype(np.float64) for side in (wanted, found))
        a, b = (np.where(np.abs(side) < 1e30, side, 0.0) for side in (a, b))
        tied &= np.abs(a - b).max(axis=1) <= TIE * np.maximum(np.abs(a).max(axis=1), 1.0)
    return tied


def _play(run: Any, initial: Arrays, steps: Sequence[Any]) -> Iterator[Arrays]:
    """Yield a graph's outputs, each row fed with its own state."""
    state: Arrays = {}
    for inputs, restart, _ in steps:
        rows = len(restart)
        for name, first in initial.items():
            begun = np.repeat(first[None], rows, axis=0)
            keep = ~restart.reshape(rows, *[1] * first.ndim)
            state[name] = np.where(keep, state[name], begun).astype(first.dtype) if name in state else begun
        outputs = run({**inputs, **{f"state_in.{name}": values for name, values in state.items()}})
        state = {name: outputs[f"state_out.{name}"] for name in initial}
        yield outputs


def _nudge(inputs: Arrays, rng: np.random.Generator) -> Arrays:
    """Return inputs moved by the last bit of their own type."""
    return {
        name: np.nextafter(values, np.where(rng.random(values.shape) < 0.5, np.inf, -np.inf).astype(values.dtype))
        if values.dtype.kind == "f" else values
        for name, values in inputs.items()
    }  # fmt: skip


# Observations: likely ones (kind 0), of every size, at corners, and likely ones with one number anywhere.


def _draw(spaces: Mapping[str, Any], seen: Any, rows: int, rng: np.random.Generator, *, first: bool) -> Any:
    kinds = rng.choice(4, rows, p=[0.4, 0.2, 0.15, 0.25])
    inputs = {}
    for name, space in spaces.items():
        mean, spread = seen(name, space)
        inputs[name] = _leaf(space, mean, spread, kinds, rng)
    restart = rng.random(rows) < NEW_EPISODE
    restart[:] |= first
    inputs["reward"] = np.where(restart, 0.0, rng.normal(size=rows)).astype(np.float32)
    return inputs, restart, kinds


def _leaf(space: Any, mean: Any, spread: Any, kinds: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    rows = len(kinds)
    if isinstance(space, Discrete):
        return rng.integers(space.start, space.start + space.n, rows)
    if isinstance(space, MultiDiscrete):
        start = np.broadcast_to(space.start, space.shape)
        return rng.integers(start, start + space.nvec, (rows, *space.shape)).astype(space.dtype)
    if isinstance(space, MultiBinary):
        return rng.integers(0, 2, (rows, *space.shape)).astype(space.dtype)
    shape, flat = (rows, *space.shape), (rows, *[1] * len(space.shape))
    low, high = (np.clip(side.astype(np.float64), -UNBOUNDED, UNBOUNDED) for side in (space.low, space.high))
    bounded = (np.abs(low) < UNBOUNDED) & (np.abs(high) < UNBOUNDED)
    around = mean + spread * rng.normal(size=shape)
    likely = np.where(bounded, rng.uniform(np.where(bounded, low, 0), np.where(bounded, high, 1), shape), around)
    if space.dtype.kind in "iu":
        likely = np.floor(rng.uniform(np.maximum(low, -1000), np.minimum(high, 1000) + 1, shape))
    sized = mean + spread * 10.0 ** rng.uniform(-2, 3, flat) * rng.normal(size=shape)
    corner = np.where(rng.random(shape) < 0.5, np.where(bounded, low, around), np.where(bounded, high, -around))
    anywhere = np.where(bounded, rng.uniform(np.where(bounded, low, 0), np.where(bounded, high, 1), shape), sized)
    one = np.where(
        rng.integers(likely[0].size, size=flat) == np.arange(likely[0].size).reshape(space.shape), anywhere, likely
    )
    drawn = np.select([kinds.reshape(flat) == kind for kind in range(4)], [likely, sized, corner, one])
    return np.asarray(np.clip(drawn, space.low, space.high), space.dtype)
