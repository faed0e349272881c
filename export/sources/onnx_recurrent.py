"""ONNX's LSTM and GRU as torch operations (onnx/docs/Operators.md): x `[time, batch, in]`, states `[1, batch, n]`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from rlservo.errors import UnsupportedError

State = tuple[Tensor, ...]
Cell = Callable[[Tensor, State], State]


def lstm(
    a: Mapping[str, Any],
    x: Tensor,
    w: Tensor,
    r: Tensor,
    b: Tensor | None = None,
    lengths: Any = None,
    h: Tensor | None = None,
    c: Tensor | None = None,
    peepholes: Tensor | None = None,
) -> State:
    """Return every step's h, the last h and the last c. The weights' rows are in the order i, o, f, c."""
    if peepholes is not None:
        raise UnsupportedError("an LSTM with peepholes is not exported")

    def cell(direction: int) -> Cell:
        bias_x, bias_h = _biases(b, direction)

        def step(x: Tensor, state: State) -> State:
            h, c = state
            gates = functional.linear(x, w[direction], bias_x) + functional.linear(h, r[direction], bias_h)
            i, o, f, g = gates.chunk(4, -1)
            c = f.sigmoid() * c + i.sigmoid() * g.tanh()
            return o.sigmoid() * c.tanh(), c

        return step

    return _run(a, x, cell, (h, c), lengths)


def gru(
    a: Mapping[str, Any],
    x: Tensor,
    w: Tensor,
    r: Tensor,
    b: Tensor | None = None,
    lengths: Any = None,
    h: Tensor | None = None,
) -> State:
    """Return every step's h and the last h. The weights' rows are in the order z, r, h."""
    after = bool(a.get("linear_before_reset"))

    def cell(direction: int) -> Cell:
        bias_x, bias_h = _biases(b, direction)

        def step(x: Tensor, state: State) -> State:
            (h,) = state
            size = h.shape[-1]
            z_x, r_x, n_x = functional.linear(x, w[direction], bias_x).chunk(3, -1)
            z_h, r_h, n_h = functional.linear(h, r[direction], bias_h).chunk(3, -1)
            z, reset = (z_x + z_h).sigmoid(), (r_x + r_h).sigmoid()
            if not after:
                bias = None if bias_h is None else bias_h[2 * size :]
                n_h = functional.linear(reset * h, r[direction][2 * size :], bias)
            n = (n_x + (reset * n_h if after else n_h)).tanh()
            return (n + z * (h - n),)

        return step

    return _run(a, x, cell, (h,), lengths)


def _biases(b: Tensor | None, direction: int) -> tuple[Tensor | None, Tensor | None]:
    if b is None:
        return None, None
    first, second = b[direction].chunk(2)
    return first, second


def _run(
    a: Mapping[str, Any], x: Tensor, cell: Callable[[int], Cell], initial: tuple[Tensor | None, ...], lengths: Any
) -> State:
    """Return the outputs `[time, directions, batch, n]`, then the last of each state `[directions, batch, n]`."""
    if lengths is not None or a.keys() & {"activations", "clip"} or a.get("layout") or a.get("input_forget"):
        raise UnsupportedError("an LSTM or GRU with lengths, a layout or activations of its own is not exported")
    names = {b"forward": (False,), b"reverse": (True,), b"bidirectional": (False, True)}
    sequences, last = [], []
    for direction, backwards in enumerate(names[a.get("direction", b"forward")]):
        zeros = x.new_zeros((x.shape[1], a["hidden_size"]))
        state: State = tuple(zeros if each is None else each[direction] for each in initial)
        step, steps = cell(direction), []
        for time in reversed(range(x.shape[0])) if backwards else range(x.shape[0]):
            state = step(x[time], state)
            steps.append(state[0])
        sequences.append(torch.stack(steps[::-1] if backwards else steps))
        last.append(state)
    return torch.stack(sequences, 1), *(torch.stack(each) for each in zip(*last, strict=True))
