"""Operators of robots' connectors and networks, each alone through ONNX and TorchScript, against torch itself."""

from __future__ import annotations

import itertools
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor, nn

from rlservo.errors import UnsupportedError
from rlservo.export.graph.onnx_file import run_onnx, write_onnx
from rlservo.export.graph.operators import EXACT, exact_operators
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.torchscript_file import run_torchscript, write_torchscript
from rlservo.export.recipe.recipe import Recipe, UserStep
from rlservo.policy.integer_division import with_floating_divisors

TURN = 2 * math.pi
SPECIAL = [
    0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 0.3, 1.5, 2.5, -2.5, 3.5, math.pi, -math.pi, math.pi / 2, -math.pi / 2, 6.28, -7.0,
    100.25, 1e-20, -1e-20, 1e-38, 1e-42, -1e-42, 1e5, 1e10, -1e10, 1e30, -1e30, 3e38, -3e38,
]  # fmt: skip
"""Zeros, signs, halves, quarter turns, denormal numbers, the largest ones."""
INFINITE = [math.inf, -math.inf]

Function = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Operator:
    """A function of observations `[batch, 6]`, and how far its export may be off."""

    function: Function
    ulps: float = 0.0
    """In float32's units in the last place; 0 is bit by bit, the signs of zeros too."""
    atol: float = 0.0
    """Absolute, for a result near zero that is the difference of larger numbers."""
    degree: int = 0
    """Sums of products of so many elements round with their largest term, of which this gives the size."""
    zeros: bool = True
    """Whether the two zeros are distinguished."""
    infinite: bool = True
    """Whether infinity, which no observation is, but a division inside a connector may give, is tried as well."""
    limit: float = math.inf
    """Larger numbers are cut to this, where torch itself leaves float32."""


def of_two(function: Callable[[Tensor, Tensor], Tensor]) -> Function:
    return lambda obs: function(obs[:, 0], obs[:, 1]).unsqueeze(1)


def of_each(function: Function) -> Function:
    return lambda obs: function(obs[:, :2])


def of_integers(function: Function) -> Function:
    return lambda obs: function(torch.clamp(obs[:, :2], -100, 100).long())


def exact(function: Function, **how: Any) -> Operator:
    return Operator(function, **how)


def rounded(function: Function, ulps: float = 4.0, atol: float = 0.0, **how: Any) -> Operator:
    return Operator(function, ulps, atol, **{"zeros": False, **how})


def summed(function: Function, degree: int = 1, **how: Any) -> Operator:
    return Operator(function, 8.0, degree=degree, zeros=False, infinite=False, **{"limit": 1e15, **how})


def constant(obs: Tensor, *numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=obs.dtype)


def integer_divisions(n: Tensor, by: Tensor) -> tuple[Tensor, ...]:
    return n // by, n % by, torch.div(n, by, rounding_mode="trunc"), torch.remainder(n, by), n.floor_divide(by)


def quaternion_product(obs: Tensor) -> Tensor:
    w, x, y, z = torch.unbind(obs[:, :4], 1)
    a, b, c, d = torch.unbind(torch.roll(obs[:, :4], 1, 1), 1)
    return torch.stack((
        w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ), 1)  # fmt: skip


def quaternion_rotation(obs: Tensor) -> Tensor:
    v, q = obs[:, 3:6], obs[:, :4] / torch.linalg.vector_norm(obs[:, :4], dim=1, keepdim=True).clamp(min=1e-6)
    t = 2.0 * torch.linalg.cross(q[:, 1:], v, dim=-1)
    return v + q[:, :1] * t + torch.linalg.cross(q[:, 1:], t, dim=-1)


def in_place(obs: Tensor) -> Tensor:
    obs = obs.clone()
    obs[:, 0] = torch.copysign(obs[:, 0], obs[:, 1])
    obs[:, 1] %= TURN
    return obs.remainder_(3.0)


def hyperbolic(obs: Tensor) -> Tensor:
    """All at once: only torch's slow exporter knows them."""
    x = torch.clamp(obs[:, :2], -0.9, 0.9)
    above = 1.0 + torch.abs(x)
    found = [torch.sinh(x), torch.cosh(x), torch.asinh(x), torch.arcsinh(x), torch.acosh(above), torch.arccosh(above)]
    return torch.cat([*found, torch.atanh(x), torch.arctanh(x), torch.atan2(x, above), torch.hypot(x, above)], 1)


OPERATORS: dict[str, Operator] = {
    # Angles and lengths
    "hypot": rounded(of_two(torch.hypot), 2, zeros=True),
    "atan2": rounded(of_two(torch.atan2), 3, zeros=True),
    "arctan2": rounded(of_two(torch.arctan2), 3, zeros=True),
    "polar": rounded(lambda o: torch.stack((torch.hypot(o[:, 0], o[:, 1]), o[:, 1].atan2(o[:, 0])), 1), 3),
    "wrap_remainder": exact(of_each(lambda x: (x + math.pi) % TURN - math.pi)),
    "wrap_round": exact(of_each(lambda x: x - TURN * torch.round(x / TURN))),
    "wrap_atan2": rounded(of_each(lambda x: torch.atan2(torch.sin(x), torch.cos(x))), 4, atol=5e-7),
    "unwrap": exact(
        lambda o: o[:, :1] + torch.cumsum((torch.diff(o, dim=1) + math.pi) % TURN - math.pi, 1), zeros=False
    ),
    "deg2rad": exact(of_each(torch.deg2rad)),
    "rad2deg": exact(of_each(torch.rad2deg)),
    "norm": rounded(lambda o: torch.norm(o[:, :2], dim=1, keepdim=True), limit=1e15),
    "linalg_norm": rounded(lambda o: torch.linalg.norm(o[:, :3], dim=1, keepdim=True), limit=1e15),
    "vector_norm": rounded(lambda o: torch.linalg.vector_norm(o[:, :3], dim=1, keepdim=True), limit=1e15),
    "vector_norm_1": rounded(lambda o: torch.linalg.vector_norm(o[:, :3], 1, 1, True), limit=1e15),
    "vector_norm_inf": exact(lambda o: torch.linalg.vector_norm(o[:, :3], math.inf, 1, True)),
    "normalize": rounded(lambda o: F.normalize(o[:, :3], dim=1), atol=1e-7, infinite=False, limit=1e15),
    "pairwise_distance": rounded(lambda o: F.pairwise_distance(o[:, :3], o[:, 3:], keepdim=True), limit=1e15),
    "cdist": rounded(
        lambda o: torch.cdist(o[:, :4].reshape(-1, 2, 2), constant(o, 1.0, 2.0).reshape(1, 1, 2)).flatten(1)
    ),
    "cross": summed(lambda o: torch.cross(o[:, :3], o[:, 3:], dim=1), 2),
    "linalg_cross": summed(lambda o: torch.linalg.cross(o[:, :3], o[:, 3:]), 2),
    "quaternion_product": summed(quaternion_product, 2),
    "quaternion_rotation": summed(quaternion_rotation, 1),
    # Trigonometry
    "sin": rounded(of_each(torch.sin), atol=1e-7),
    "cos": rounded(of_each(torch.cos), atol=1e-7),
    "tan": rounded(of_each(lambda x: torch.tan(torch.clamp(x, -1.5, 1.5)))),
    "atan": rounded(of_each(torch.atan)),
    "arctan": rounded(of_each(torch.arctan)),
    "asin": rounded(of_each(torch.asin)),
    "arcsin": rounded(of_each(torch.arcsin)),
    "acos": rounded(of_each(torch.acos), 5),
    "arccos": rounded(of_each(torch.arccos), 5),
    "hyperbolic": rounded(hyperbolic, 6),
    # Division and rounding
    "remainder": exact(of_two(torch.remainder)),
    "remainder_of_turn": exact(of_each(lambda x: torch.remainder(x, TURN))),
    "modulo": exact(of_two(lambda a, b: a % b)),
    "modulo_negative": exact(of_each(lambda x: x % -1.5)),
    "modulo_of_number": exact(of_each(lambda x: 7.0 % x)),
    "modulo_in_place": exact(in_place),
    "fmod": exact(of_two(torch.fmod)),
    "fmod_number": exact(of_each(lambda x: torch.fmod(x, 1.5))),
    "floor_divide": exact(of_two(torch.floor_divide)),
    "floordiv": exact(of_each(lambda x: x // 0.3)),
    "number_floordiv": exact(of_each(lambda x: 1.0 // x)),
    "div": exact(of_two(torch.div)),
    "divide": exact(of_two(torch.divide)),
    "div_floor": exact(of_two(lambda a, b: torch.div(a, b, rounding_mode="floor"))),
    "div_trunc": exact(of_two(lambda a, b: torch.div(a, b, rounding_mode="trunc"))),
    "keywords": rounded(
        of_two(lambda a, b: torch.hypot(a, other=b) + torch.fmod(torch.atan2(input=a, other=b), 0.5)),
        4,
        atol=5e-7,
        infinite=False,
    ),
    "keywords_along_axis": exact(
        lambda o: torch.searchsorted(sorted_sequence=torch.cumsum(o.abs(), axis=1), input=o[:, :2].contiguous()),
        infinite=False,
    ),
    "integers_floordiv": exact(of_integers(lambda n: n // 7)),
    "integers_floor_divide": exact(of_integers(lambda n: torch.floor_divide(n, n.abs() + 3))),
    "integers_div_trunc": exact(of_integers(lambda n: torch.div(n, 7, rounding_mode="trunc"))),
    "integers_modulo": exact(of_integers(lambda n: n % 7)),
    "integers_by_negative": exact(of_integers(lambda n: torch.cat((n // -7, n % -7, n // -1, n % -1), 1))),
    "integers_by_integers": exact(
        of_integers(lambda n: torch.cat((*integer_divisions(n, n.abs() + 3), *integer_divisions(n, -3 - n.abs())), 1))
    ),
    "integer_by_integers": exact(of_integers(lambda n: torch.cat((100 // (n.abs() + 3), 100 % (-3 - n.abs())), 1))),
    "integers_by_number": exact(of_integers(lambda n: torch.cat((n % 2.5, n // 2.5, torch.div(n, 0.5)), 1))),
    "round": exact(of_each(torch.round)),
    "round_decimals": exact(of_each(lambda x: torch.round(x, decimals=2)), limit=1e30),
    "round_tens": exact(of_each(lambda x: torch.round(x, decimals=-1))),
    "floor": exact(of_each(torch.floor)),
    "ceil": exact(of_each(torch.ceil)),
    "trunc": exact(of_each(torch.trunc)),
    "fix": exact(of_each(torch.fix)),
    "frac": exact(of_each(torch.frac)),
    # Signs and choices
    "sign": exact(of_each(torch.sign)),
    "sgn": exact(of_each(torch.sgn)),
    "signbit": exact(of_each(torch.signbit)),
    "copysign": exact(of_two(torch.copysign)),
    "copysign_number": exact(of_each(lambda x: torch.copysign(x, -1.0))),
    "positive": exact(of_each(torch.positive)),
    "abs": exact(of_each(torch.abs)),
    "neg": exact(of_each(torch.neg)),
    "heaviside": exact(of_two(torch.heaviside), zeros=False),
    "clamp": exact(of_each(lambda x: torch.clamp(x, -0.5, 1.0))),
    "clamp_tensors": exact(lambda o: torch.clamp(o[:, :2], constant(o, -1.0, 0.0), constant(o, 1.0, 0.5)), zeros=False),
    "where": exact(of_two(lambda a, b: torch.where(a > b, a, b)), zeros=False),
    "nan_to_num": exact(of_two(lambda a, b: torch.nan_to_num(a / b, 0.0, 1.0, -1.0))),
    "minimum": exact(of_two(torch.minimum), zeros=False),
    "maximum": exact(of_two(torch.maximum), zeros=False),
    "fmin": exact(of_two(lambda a, b: torch.fmin(a / b, b)), zeros=False),
    "fmax": exact(of_two(lambda a, b: torch.fmax(a / b, b)), zeros=False),
    "isclose": exact(of_two(torch.isclose)),
    "eq": exact(of_two(torch.eq)),
    "lt": exact(of_two(torch.lt)),
    "isfinite": exact(of_two(lambda a, b: torch.isfinite(a / b))),
    "isnan": exact(of_two(lambda a, b: torch.isnan(a / b))),
    "logical_xor": exact(of_two(lambda a, b: (a > 0) ^ (b > 0))),
    "masked_fill": exact(lambda o: o.masked_fill(o > 0.5, 7.0), zeros=False),
    # Order
    "sort": exact(lambda o: torch.sort(o, dim=1).values, zeros=False),
    "sort_descending": exact(lambda o: torch.sort(o, dim=1, descending=True).values, zeros=False),
    "sort_stable": exact(lambda o: torch.sort(o, dim=1, stable=True).indices),
    "argsort": exact(lambda o: torch.argsort(o, dim=1, stable=True)),
    "topk": exact(lambda o: torch.topk(o, 2, dim=1).values, zeros=False),
    "kthvalue": exact(lambda o: torch.kthvalue(o, 2, dim=1).values.unsqueeze(1), zeros=False),
    "median": exact(lambda o: torch.median(o, 1, keepdim=True).values, zeros=False),
    "amax": exact(lambda o: torch.amax(o, 1, keepdim=True), zeros=False),
    "argmax": exact(lambda o: torch.argmax(o, 1, True)),
    "searchsorted": exact(lambda o: torch.searchsorted(constant(o, -1.0, 0.0, 0.5, 1.0), o[:, :2].contiguous())),
    "searchsorted_right": exact(
        lambda o: torch.searchsorted(constant(o, -1.0, 0.0, 0.5, 1.0), o[:, :2].contiguous(), right=True)
    ),
    "searchsorted_rows": exact(lambda o: torch.searchsorted(torch.sort(o[:, :4], 1)[0], o[:, 4:].contiguous())),
    "bucketize": exact(of_each(lambda x: torch.bucketize(x.contiguous(), constant(x, -1.0, 0.0, 0.5), right=True))),
    # Along an axis
    "cumsum": exact(lambda o: torch.cumsum(o, 1), zeros=False, infinite=False),
    "cumprod": exact(lambda o: torch.cumprod(o, 1), zeros=False),
    "diff": exact(lambda o: torch.diff(o, dim=1)),
    "diff_twice": exact(lambda o: torch.diff(o, n=2, prepend=o[:, :1])),
    "sum": summed(lambda o: o.sum(1, keepdim=True)),
    "mean": summed(lambda o: o.mean(1, keepdim=True)),
    "nanmean": summed(lambda o: torch.nanmean(torch.where(o > 0.5, math.nan, o), 1, True)),
    "nanmean_of_all": summed(lambda o: torch.nanmean(o, dim=1).unsqueeze(1)),
    "prod": rounded(lambda o: o.prod(1, keepdim=True)),
    "std": summed(lambda o: torch.std(o, 1, keepdim=True), limit=1e30),
    "var": summed(lambda o: torch.var(o, 1, keepdim=True), 2),
    "var_biased": summed(lambda o: torch.var(o, 1, correction=0, keepdim=True), 2),
    "logsumexp": rounded(lambda o: torch.logsumexp(o, 1, True), atol=1e-6, infinite=False),
    "count_nonzero": exact(lambda o: torch.count_nonzero(o, 1).unsqueeze(1)),
    "matmul": summed(lambda o: o @ torch.arange(12.0, dtype=o.dtype).reshape(6, 2), limit=1e30),
    "einsum": summed(lambda o: torch.einsum("bi,ij->bj", o, torch.arange(12.0, dtype=o.dtype).reshape(6, 2))),
    "vecdot": summed(lambda o: torch.linalg.vecdot(o[:, :3], o[:, 3:]).unsqueeze(1), 2),
    "det": summed(lambda o: torch.linalg.det(o[:, :4].reshape(-1, 2, 2)).unsqueeze(1), 2),
    "addcdiv": rounded(
        lambda o: torch.addcdiv(o[:, :2], o[:, 2:4], o[:, 4:] + 10.0), infinite=False, limit=1e15, degree=1
    ),
    "lerp": rounded(of_two(lambda a, b: torch.lerp(a, b, 0.25))),
    # Places
    "stack": exact(lambda o: torch.stack((o[:, 0], o[:, 1]), 1)),
    "split": exact(lambda o: torch.split(o, [2, 4], 1)[1]),
    "chunk": exact(lambda o: torch.chunk(o, 3, 1)[1]),
    "roll": exact(lambda o: torch.roll(o, 1, 1)),
    "flip": exact(lambda o: torch.flip(o, [1])),
    "fliplr": exact(torch.fliplr),
    "flipud": exact(lambda o: torch.flipud(o.T).T),
    "gather": exact(lambda o: torch.gather(o, 1, torch.argmax(o, 1, True))),
    "take_along_dim": exact(lambda o: torch.take_along_dim(o, torch.argmin(o, 1, True), 1)),
    "index_select": exact(lambda o: torch.index_select(o, 1, torch.tensor([2, 0]))),
    "one_hot": exact(lambda o: F.one_hot((o[:, 0] > 0).long() + (o[:, 1] > 0).long(), 3)),
    "repeat_interleave": exact(lambda o: torch.repeat_interleave(o, 2, 1)),
    # Exponentials, logarithms, activations
    "exp": rounded(of_each(torch.exp)),
    "exp2": rounded(of_each(torch.exp2)),
    "expm1": rounded(of_each(torch.expm1)),
    "log": rounded(of_each(torch.log)),
    "log1p": rounded(of_each(torch.log1p)),
    "log10": rounded(of_each(torch.log10)),
    "special_expm1": rounded(of_each(torch.special.expm1)),
    "logaddexp": rounded(of_two(torch.logaddexp), 8),
    "xlogy": rounded(of_two(torch.xlogy)),
    "softplus": rounded(of_each(F.softplus)),
    "softplus_beta": rounded(of_each(lambda x: F.softplus(x, 2.0, 5.0))),
    "erf": rounded(of_each(torch.erf)),
    "logit": rounded(of_each(torch.logit)),
    "sigmoid": rounded(of_each(torch.sigmoid), atol=1e-7),
    "tanh": rounded(of_each(torch.tanh), atol=1e-6),
    "softmax": rounded(lambda o: torch.softmax(o, 1), 8, atol=1e-7, infinite=False),
    "elu": rounded(of_each(F.elu), atol=1e-7),
    "celu": rounded(of_each(F.celu), atol=1e-7),
    "selu": rounded(of_each(F.selu), atol=2e-7),
    "softsign": rounded(of_each(F.softsign), infinite=False, limit=1e30),
    "gelu": rounded(of_each(F.gelu), atol=1e-6, infinite=False),
    "mish": rounded(of_each(F.mish), 8, atol=1e-7, infinite=False),
    "hardsigmoid": rounded(of_each(F.hardsigmoid), atol=1e-7),
    "hardswish": rounded(of_each(F.hardswish), atol=1e-6, infinite=False, limit=1e15),
    "pow": rounded(of_each(lambda x: x**2)),
    "sqrt": rounded(of_each(torch.sqrt)),
    "rsqrt": rounded(of_each(torch.rsqrt)),
}
SINGLE_ONLY = {"wrap_atan2", "tan", "hyperbolic"}
"""Cases in which a double's last bits decide (acosh near 1), and the graph has only single precision's."""


class Untouched(nn.Module):
    """A network that gives its input as the action."""

    names: tuple[str, ...] = ()

    def forward(self, obs: Tensor) -> tuple[Tensor, ...]:
        return (obs.float(),)


def graph_of(function: Function, dtype: Any) -> PolicyGraph:
    observations, actions = Box(-np.inf, np.inf, (6,), dtype), Box(-np.inf, np.inf, (2,), np.float32)
    steps = (UserStep("operators.Tried", function),)
    return PolicyGraph(Recipe(observations, actions, steps, "given", "none", None), Untouched())


def observations(operator: Operator, dtype: Any) -> NDArray[Any]:
    """Every pair of the special numbers in the first two elements, any of them in the rest, and some usual rows."""
    numbers = SPECIAL + (INFINITE if operator.infinite else [])
    pairs = np.array(list(itertools.product(numbers, numbers)))
    rng = np.random.default_rng(0)
    rows = np.concatenate([np.hstack([pairs, rng.choice(numbers, (len(pairs), 4))]), rng.uniform(-4, 4, (200, 6))])
    return np.clip(rows, -operator.limit, operator.limit).astype(dtype)


def assert_close(operator: Operator, obs: NDArray[Any], got: NDArray[Any], expected: NDArray[Any]) -> None:
    assert got.dtype == expected.dtype == np.float32 and got.shape == expected.shape
    if operator.ulps == 0.0:
        np.testing.assert_array_equal(got, expected)
    else:
        with np.errstate(invalid="ignore", over="ignore"):
            spacing = np.spacing(np.maximum(np.abs(expected), np.abs(got)).astype(np.float32)).astype(np.float64)
            allowed = operator.ulps * np.nan_to_num(spacing, nan=0.0) + operator.atol
            if operator.degree:
                largest = np.abs(obs).max(axis=1, keepdims=True).astype(np.float64)
                allowed = np.maximum(allowed, operator.ulps * np.finfo(np.float32).eps * 12 * largest**operator.degree)
            off = np.abs(got.astype(np.float64) - expected)
        same = (got == expected) | (np.isnan(got) & np.isnan(expected))
        wrong = np.argwhere(~(same | (off <= allowed)))
        assert not len(wrong), (obs[wrong[0][0]], got[tuple(wrong[0])], expected[tuple(wrong[0])], len(wrong))
    if operator.zeros:
        numbers = ~np.isnan(expected)
        np.testing.assert_array_equal(np.signbit(got[numbers]), np.signbit(expected[numbers]))


@pytest.mark.parametrize(
    ("name", "dtype"),
    [(name, dtype) for name in OPERATORS for dtype in (np.float32, np.float64)
     if dtype == np.float32 or name not in SINGLE_ONLY],
)  # fmt: skip
def test_an_operator_gives_torchs_own_numbers_in_both_formats(name: str, dtype: Any, tmp_path: Path) -> None:
    operator = OPERATORS[name]
    graph, obs = graph_of(operator.function, dtype), observations(operator, dtype)
    with np.errstate(over="ignore"):
        expected = operator.function(torch.from_numpy(obs.copy())).float().numpy()
    example = {"obs": obs[-2:]}
    write_onnx(graph, example, tmp_path / "policy.onnx")
    assert_close(operator, obs, run_onnx(tmp_path / "policy.onnx")({"obs": obs})["action"], expected)
    write_torchscript(graph, example, tmp_path / "policy.ts")
    run = run_torchscript(tmp_path / "policy.ts", graph.input_names, graph.output_names)
    np.testing.assert_array_equal(run({"obs": obs})["action"], expected)


SMALLEST = """import sys
from pathlib import Path
import numpy as np
from rlservo.export.graph.onnx_file import run_onnx
obs = np.array([[-(2.0**63), -1, 0, 0, 0, 0], [7, -2, 0, 0, 0, 0]], np.float32)
print(run_onnx(Path(sys.argv[1]))({"obs": obs})["action"].tolist())
"""


def test_the_smallest_integer_by_minus_one_does_not_end_the_process(tmp_path: Path) -> None:
    def divided(obs: Tensor) -> Tensor:
        return torch.stack(integer_divisions(obs[:, 0].long(), obs[:, 1].long()), 1)

    example = {"obs": np.array([[9, 4, 0, 0, 0, 0], [9, -4, 0, 0, 0, 0]], np.float32)}
    write_onnx(graph_of(divided, np.float32), example, tmp_path / "policy.onnx")
    done = subprocess.run([sys.executable, "-c", SMALLEST, tmp_path / "policy.onnx"], capture_output=True, text=True)
    assert done.returncode == 0, done
    assert json.loads(done.stdout) == [[-(2.0**63), 0, -(2.0**63), 0, -(2.0**63)], [-4, -1, -3, -1, -4]]
    assert with_floating_divisors((tmp_path / "policy.onnx").read_bytes()) is None


def test_every_composition_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: set[str] = set()

    def watched(name: str, composition: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **named: Any) -> Any:
            tried.add(name)
            return composition(*args, **named)

        return run

    for name, composition in list(EXACT.items()):
        monkeypatch.setitem(EXACT, name, watched(name, composition))
    for operator in OPERATORS.values():
        with exact_operators():
            operator.function(torch.from_numpy(observations(operator, np.float32)[:4]))
    assert set(EXACT) - tried == set()


class Misfit:
    """A user's connector, as the exporter calls it."""

    def torch_forward(self, obs: Tensor) -> Tensor:
        return torch.cummax(obs, 1).values


def solved(obs: Tensor) -> Tensor:
    return torch.linalg.inv(obs[:, :4].reshape(-1, 2, 2)).flatten(1)


@pytest.mark.parametrize(
    ("function", "named", "instead"),
    [
        (Misfit().torch_forward, r"torch\.cummax in Misfit\.torch_forward", "torch.maximum"),
        (lambda o: Misfit().torch_forward(torch.sinh(o)), r"torch\.cummax in Misfit\.torch_forward", "torch.maximum"),
        (solved, r"torch\.linalg\.inv in solved", "by its elements"),
        (of_two(torch.nextafter), r"torch\.nextafter in <lambda>", "torch.where"),
    ],
)
def test_an_operator_without_a_form_is_named_with_its_place(
    function: Function, named: str, instead: str, tmp_path: Path
) -> None:
    with pytest.raises(UnsupportedError) as caught:
        obs = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 6)).astype(np.float32)
        write_onnx(graph_of(function, np.float32), {"obs": obs}, tmp_path / "policy.onnx")
    message = caught.value.message
    assert re.search(rf"the operator {named} \({re.escape(__file__)}:\d+\) has no ONNX form", message), message
    assert instead in message
    assert "\n" not in message and "\x1b" not in message and "step" not in message


def test_what_cannot_be_traced_says_where(tmp_path: Path) -> None:
    def reads_a_word(obs: Tensor) -> Tensor:
        return obs * float("fast")

    graph, example = graph_of(reads_a_word, np.float32), {"obs": np.ones((2, 6), np.float32)}
    for write in (write_torchscript, write_onnx):
        with pytest.raises(UnsupportedError, match=r"'fast' in reads_a_word \(.*test_operators\.py:\d+\)$"):
            write(graph, example, tmp_path / "policy")
