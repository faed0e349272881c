"""Torch operators whose ONNX form is missing or wrong, as compositions of exact ones.

torch's exporters leave out `hypot`, `searchsorted` and `copysign`, divide by zero in `atan2`, lose the remainder of
large angles in `%`, and write double-precision `atan` for a kernel that onnxruntime does not have. While
`exact_operators` is entered, torch's Python functions, methods and operators of these names compute what torch itself
computes (ATen/native, torch 2.13) in steps that survive both exporters. TorchScript needs none of it: it runs torch.

Operators that themselves round agree to rounding: `hypot`, `atan2` and the logarithms to a few units in the last place,
functions without a double-precision kernel to single precision. The rest agree bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode


class exact_operators(TorchFunctionMode):  # entered like a function: `with exact_operators():`
    """While it is entered, the operators of EXACT compute by their exportable compositions."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Return `func`'s result; torch disables the mode meanwhile, so a composition may use its own operator."""
        name = str(getattr(func, "__name__", "")).removeprefix("linalg_").removeprefix("special_")
        in_place = name.endswith("_") and not name.endswith("__")
        name = name.removesuffix("_") if in_place else name
        composition = EXACT.get(name)
        named = {SYNONYMS.get(key, key): value for key, value in (kwargs or {}).items()}
        operands = (*args, *(named.pop(key) for key in OPERANDS if key in named))
        if composition is None or "out" in named or not _is_real(operands, integers=name in OF_INTEGERS_TOO):
            return func(*args, **(kwargs or {}))
        result = composition(*operands, **named)
        return operands[0].copy_(result) if in_place else result


SYNONYMS = {"axis": "dim", "keepdims": "keepdim"}
OPERANDS = (
    "sorted_sequence", "input", "x", "x1", "other", "x2", "y", "values", "boundaries", "indices", "tensor1", "tensor2",
)  # fmt: skip
"""Torch's keywords for tensors, in the order of its signatures."""


def _is_real(args: tuple[Any, ...], *, integers: bool) -> bool:
    """Return whether tensors of real numbers are among the arguments, floating-point ones unless integers will do."""
    tensors = [arg for arg in args if isinstance(arg, Tensor)]
    if any(tensor.is_complex() for tensor in tensors):
        return False
    return bool(tensors) and (integers or any(tensor.is_floating_point() for tensor in tensors))


def _is_negative(x: Tensor) -> Tensor:
    """Return a mask of the elements whose sign bit is set, zeros included."""
    if not x.is_floating_point():
        return x < 0
    return (x < 0) | ((x == 0) & (torch.reciprocal(x) < 0))


def _sign(x: Tensor, like: Tensor) -> Tensor:
    """Return -1 or 1, to multiply with: onnxruntime's Where makes a chosen -0.0 a 0.0."""
    one = torch.ones_like(like)
    return torch.where(_is_negative(x), -one, one)


def _tensor(x: Any, like: Tensor) -> Tensor:
    return x if isinstance(x, Tensor) else torch.full_like(like, x, dtype=torch.result_type(like, x))


# Angles, lengths, signs


def _hypot(a: Tensor, b: Tensor) -> Tensor:
    a, b = torch.abs(a), torch.abs(b)
    long, short = torch.maximum(a, b), torch.minimum(a, b)
    ratio = short / long  # squared as they are, lengths overflow from 1e19 on and vanish below 1e-23
    length = long * torch.sqrt(1.0 + ratio * ratio)
    return torch.where((long == 0) | torch.isinf(long), long, length)


def _atan2(y: Tensor, x: Tensor) -> Tensor:
    angle = _atan(torch.abs(y) / torch.abs(x))  # of infinity, where x is 0: a right angle
    angle = torch.where((y == 0) & (x == 0), torch.zeros_like(angle), angle)
    angle = torch.where(torch.isinf(y) & torch.isinf(x), torch.full_like(angle, math.pi / 4), angle)
    angle = torch.where(_is_negative(x), math.pi - angle, angle)
    return angle * _sign(y, angle)


def _copysign(x: Tensor, sign: Any) -> Tensor:
    size = torch.abs(x)
    if not isinstance(sign, Tensor):
        return -size if math.copysign(1.0, sign) < 0 else size
    return size * _sign(sign, size)


def _heaviside(x: Tensor, at_zero: Tensor) -> Tensor:
    return torch.where(x == 0, at_zero, (x > 0).to(x.dtype))


def _fmin(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(torch.isnan(a), b, torch.where(torch.isnan(b), a, torch.minimum(a, b)))


def _fmax(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(torch.isnan(a), b, torch.where(torch.isnan(b), a, torch.maximum(a, b)))


def _isclose(a: Tensor, b: Tensor, rtol: float = 1e-5, atol: float = 1e-8, equal_nan: bool = False) -> Tensor:
    close = (a == b) | (torch.isfinite(b) & (torch.abs(a - b) <= atol + rtol * torch.abs(b)))
    return close | (torch.isnan(a) & torch.isnan(b)) if equal_nan else close


def _scaled_by(factor: float) -> Callable[[Tensor], Tensor]:
    return lambda x: x * factor


def _pairwise_distance(a: Tensor, b: Tensor, p: float = 2.0, eps: float = 1e-6, keepdim: bool = False) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(a - b + eps, p, -1, keepdim)
    return length


def _cdist(a: Tensor, b: Tensor, p: float = 2.0, compute_mode: Any = None) -> Tensor:  # noqa: ARG001  # speed only
    lengths: Tensor = torch.linalg.vector_norm(a.unsqueeze(-2) - b.unsqueeze(-3), p, -1)
    return lengths


# Division and rounding


def _remainder(a: Any, b: Any) -> Tensor:
    like = a if isinstance(a, Tensor) else b
    a, b = _tensor(a, like), _tensor(b, like)
    if not torch.result_type(a, b).is_floating_point:
        rest = torch.remainder(a, torch.abs(b))
        return torch.where((rest != 0) & (b < 0), rest + b, rest)
    rest = torch.fmod(a, b)
    return torch.where((rest != 0) & ((rest < 0) != (b < 0)), rest + b, rest)


def _floor_divide(a: Any, b: Any) -> Tensor:
    """As Python's `//`, whose quotient is whole even if a / b was rounded up to the next number."""
    like = a if isinstance(a, Tensor) else b
    a, b = _tensor(a, like), _tensor(b, like)
    if not torch.result_type(a, b).is_floating_point:
        return _integer_quotient(a - _remainder(a, b), b)
    rest = torch.fmod(a, b)
    quotient = (a - rest) / b
    quotient = torch.where((rest != 0) & ((rest < 0) != (b < 0)), quotient - 1.0, quotient)
    whole = torch.floor(quotient)
    whole = torch.where(quotient - whole > 0.5, whole + 1.0, whole)
    ratio = a / b
    return torch.where(b != 0, _copysign(whole, ratio), ratio)


def _integer_quotient(a: Tensor, b: Tensor) -> Tensor:
    """Divide by the divisor's size: the smallest integer by -1 ends onnxruntime's process."""
    quotient = torch.div(a, torch.abs(b), rounding_mode="trunc")
    return torch.where(b < 0, -quotient, quotient)


def _div(a: Any, b: Any, *, rounding_mode: str | None = None) -> Tensor:
    if rounding_mode == "floor":
        return _floor_divide(a, b)
    if rounding_mode == "trunc":
        is_real = torch.result_type(a, b).is_floating_point
        return _trunc(torch.div(a, b)) if is_real else _integer_quotient(a, _tensor(b, a))
    return torch.div(a, b, rounding_mode=rounding_mode)


def _trunc(x: Tensor) -> Tensor:
    return _copysign(torch.floor(torch.abs(x)), x)


def _frac(x: Tensor) -> Tensor:
    return x - _trunc(x)


def _round(x: Tensor, *, decimals: int = 0) -> Tensor:
    scale = 10.0 ** abs(decimals)
    if decimals == 0:
        return torch.round(x)
    return torch.round(x * scale) / scale if decimals > 0 else torch.round(x / scale) * scale


# Along an axis


def _cumsum(x: Tensor, dim: int, *, dtype: torch.dtype | None = None) -> Tensor:
    return torch.cumsum(x.double(), dim).to(dtype or x.dtype)  # torch also adds in double precision


def _cumprod(x: Tensor, dim: int, *, dtype: torch.dtype | None = None) -> Tensor:
    first, *rest = torch.unbind(x.double(), dim)
    products = [first]
    for factor in rest:
        products.append(products[-1] * factor)
    return torch.stack(products, dim).to(dtype or x.dtype)


def _diff(x: Tensor, n: int = 1, dim: int = -1, prepend: Any = None, append: Any = None) -> Tensor:
    x = torch.cat([part for part in (prepend, x, append) if part is not None], dim)
    for _ in range(n):
        parts = torch.unbind(x, dim)
        x = torch.stack([after - before for before, after in pairwise(parts)], dim)
    return x


def _flip_axis(dim: int) -> Callable[[Tensor], Tensor]:
    return lambda x: torch.flip(x, (dim,))


def _count_nonzero(x: Tensor, dim: Any = None) -> Tensor:
    counted = (x != 0).to(torch.int64)
    return torch.sum(counted) if dim is None else torch.sum(counted, dim)


def _nanmean(x: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: torch.dtype | None = None) -> Tensor:
    x = x if dtype is None else x.to(dtype)
    missing = torch.isnan(x)
    numbers = torch.where(missing, torch.zeros_like(x), x)
    dims = list(range(x.dim())) if dim is None else dim
    return torch.sum(numbers, dims, keepdim) / torch.sum((~missing).to(x.dtype), dims, keepdim)


def _std(x: Tensor, dim: Any = None, *args: Any, **named: Any) -> Tensor:
    return torch.std(x.double(), dim, *args, **named).to(x.dtype)  # squares leave single precision from 1e19 on


def _var(x: Tensor, dim: Any = None, *args: Any, **named: Any) -> Tensor:
    return torch.var(x.double(), dim, *args, **named).to(x.dtype)


def _searchsorted(
    boundaries: Tensor, values: Any, *, out_int32: bool = False, right: bool = False, side: str | None = None,
    sorter: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Count the boundaries below each value (`right`: or at it)."""
    if sorter is not None:
        boundaries = torch.gather(boundaries, -1, sorter)
    values = _tensor(values, boundaries[..., 0])
    rows = boundaries if boundaries.dim() == 1 else boundaries.unsqueeze(-2)
    each = values.unsqueeze(-1)
    beyond = rows > each if right or side == "right" else rows >= each
    return torch.sum(torch.logical_not(beyond).to(torch.int32 if out_int32 else torch.int64), -1)


def _bucketize(values: Any, boundaries: Tensor, *, out_int32: bool = False, right: bool = False) -> Tensor:
    return _searchsorted(boundaries, values, out_int32=out_int32, right=right)


def _sort(x: Tensor, dim: int = -1, descending: bool = False, stable: bool = True) -> Any:  # noqa: ARG001
    return torch.sort(x, dim, descending)  # onnxruntime's is stable anyway


def _argsort(x: Tensor, dim: int = -1, descending: bool = False, stable: bool = True) -> Tensor:  # noqa: ARG001
    return torch.sort(x, dim, descending)[1]


def _kthvalue(x: Tensor, k: int, dim: int = -1, keepdim: bool = False) -> Any:
    values, indices = (torch.narrow(part, dim, k - 1, 1) for part in torch.sort(x, dim))
    if not keepdim:
        values, indices = values.squeeze(dim), indices.squeeze(dim)
    return torch.return_types.kthvalue((values, indices))


def _median(x: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
    if dim is None:
        flat = x.flatten()
        return _kthvalue(flat, (len(flat.unbind()) + 1) // 2)[0]
    middle = (len(torch.unbind(x, dim)) + 1) // 2
    return torch.return_types.median(tuple(_kthvalue(x, middle, dim, keepdim)))


def _take_along_dim(x: Tensor, indices: Tensor, dim: int | None = None) -> Tensor:
    if dim is None:
        return torch.gather(x.flatten(), 0, indices.flatten())
    return torch.gather(x, dim, indices)


# Exponentials and logarithms


def _log1p(x: Tensor) -> Tensor:
    """Kahan's compensation of the error of 1 + x (HP-15C Advanced Functions Handbook, 1982)."""
    more = 1.0 + x
    exact = torch.log(more) * (x / (more - 1.0))
    return torch.where(more == math.inf, more, torch.where(more != 1.0, exact, x))


def _expm1(x: Tensor) -> Tensor:
    """Kahan's compensation, likewise."""
    power = torch.exp(x)
    less = power - 1.0
    exact = less * (x / torch.log(power))
    return torch.where((less == -1.0) | (power == math.inf), less, torch.where(power != 1.0, exact, x))


def _xlogy(x: Tensor, y: Tensor) -> Tensor:
    return torch.where((x == 0) & ~torch.isnan(y), torch.zeros_like(x), x * torch.log(y))


def _logaddexp(a: Tensor, b: Tensor) -> Tensor:
    high, low = torch.maximum(a, b), torch.minimum(a, b)
    return torch.where(torch.isinf(high) & (high == low), high, high + _log1p(torch.exp(low - high)))


def _softplus(x: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    return torch.where(x * beta > threshold, x, _log1p(torch.exp(x * beta)) / beta)


# Of single precision only

SINGLE_FUNCTIONS = ("sinh", "cosh", "asinh", "arcsinh", "acosh", "arccosh", "atanh", "arctanh", "erf", "det")
SINGLE_ACTIVATIONS = ("celu", "elu", "gelu", "hardsigmoid", "hardswish", "mish", "selu", "softsign")


def _in_single_precision(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Compute in single precision: onnxruntime has no other kernel, and the network gets no more either."""

    def composition(x: Tensor, *args: Any, **named: Any) -> Tensor:
        if x.dtype != torch.float64:
            return function(x, *args, **named)
        return function(x.float(), *args, **named).double()

    return composition


_atan = _in_single_precision(torch.atan)


def _asin(x: Tensor) -> Tensor:
    """For doubles by the arc tangent: near 1 the double's last bits decide."""
    return torch.asin(x) if x.dtype != torch.float64 else _atan2(x, torch.sqrt((1.0 - x) * (1.0 + x)))


def _acos(x: Tensor) -> Tensor:
    return torch.acos(x) if x.dtype != torch.float64 else _atan2(torch.sqrt((1.0 - x) * (1.0 + x)), x)


def _tan(x: Tensor) -> Tensor:
    return torch.tan(x) if x.dtype != torch.float64 else torch.sin(x) / torch.cos(x)


EXACT: dict[str, Callable[..., Any]] = {
    "hypot": _hypot,
    "atan2": _atan2,
    "arctan2": _atan2,
    "copysign": _copysign,
    "signbit": _is_negative,
    "sgn": torch.sign,
    "positive": lambda x: x,
    "heaviside": _heaviside,
    "fmin": _fmin,
    "fmax": _fmax,
    "isclose": _isclose,
    "deg2rad": _scaled_by(math.pi / 180),
    "rad2deg": _scaled_by(180 / math.pi),
    "pairwise_distance": _pairwise_distance,
    "cdist": _cdist,
    "remainder": _remainder,
    "__rmod__": lambda b, a: _remainder(a, b),
    "floor_divide": _floor_divide,
    "__floordiv__": _floor_divide,
    "__rfloordiv__": lambda b, a: _floor_divide(a, b),
    "div": _div,
    "divide": _div,
    "trunc": _trunc,
    "fix": _trunc,
    "frac": _frac,
    "round": _round,
    "cumsum": _cumsum,
    "cumprod": _cumprod,
    "diff": _diff,
    "fliplr": _flip_axis(1),
    "flipud": _flip_axis(0),
    "count_nonzero": _count_nonzero,
    "nanmean": _nanmean,
    "std": _std,
    "var": _var,
    "searchsorted": _searchsorted,
    "bucketize": _bucketize,
    "sort": _sort,
    "argsort": _argsort,
    "kthvalue": _kthvalue,
    "median": _median,
    "take_along_dim": _take_along_dim,
    "vecdot": lambda a, b, dim=-1: torch.sum(a * b, dim),
    "addcdiv": lambda x, a, b, value=1: x + value * (a / b),
    "exp2": lambda x: torch.pow(2.0, x),
    "xlogy": _xlogy,
    "log1p": _log1p,
    "expm1": _expm1,
    "logaddexp": _logaddexp,
    "softplus": _softplus,
    "tan": _tan,
    "asin": _asin,
    "arcsin": _asin,
    "acos": _acos,
    "arccos": _acos,
    "atan": _atan,
    "arctan": _atan,
    **{name: _in_single_precision(getattr(torch, name)) for name in SINGLE_FUNCTIONS},
    **{name: _in_single_precision(getattr(torch.nn.functional, name)) for name in SINGLE_ACTIVATIONS},
}
"""The compositions by the name of torch's function, for tensors of real numbers, with its arguments."""

OF_INTEGERS_TOO = frozenset({"floor_divide", "__floordiv__", "__rfloordiv__", "div", "divide", "remainder", "__rmod__"})
"""For integers the TorchScript-based exporter turns -1 // 7 into 0, and a divisor of -1 can end the process."""
