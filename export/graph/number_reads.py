"""Places where a network reads numbers of the observation in Python, of which a traced graph keeps an example's."""

from __future__ import annotations

import ast
import contextlib
import functools
import logging
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from rlservo.errors import UnsupportedError, first_line
from rlservo.export.graph import policy_graph
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.why_not_exportable import raised_at
from rlservo.export.recipe.kept_values import FRAMEWORKS, INSTALLED

READS = frozenset({
    "__bool__", "__int__", "__float__", "__complex__", "__index__", "__contains__", "__array__", "__format__",
    "__repr__", "__dlpack__", "_to_dlpack", "to_dlpack", "numpy", "item", "tolist", "equal", "allclose", "is_nonzero",
    "storage", "untyped_storage", "data_ptr", "new_tensor", "tensor", "apply_", "map_", "map2_",
})  # fmt: skip
"""Functions and methods that take a tensor's numbers out of torch."""
SELECTS = frozenset({
    "nonzero", "argwhere", "masked_select", "unique", "_unique2", "unique_consecutive", "bincount",
    "_pack_padded_sequence", "zeros", "ones", "empty", "arange",
})  # fmt: skip
"""Those whose results have as many numbers as the observation's say."""
SELECTS_ALONE = ("where", "one_hot")
"""The same, if they are given one tensor and nothing else."""
REPEATS, TAKE_NUMBERS = "repeat_interleave", frozenset({"roll", "nan_to_num", "nan_to_num_", "logit", "logit_"})
"""Those that the observation may tell how often, how far or what, where tracing keeps the size or the number."""
SIZES = frozenset({"__len__", "__iter__", "unbind", "numel", "nelement", "size", "sym_size"})
"""Those that take a tensor's size out of torch."""
SHAPE = Tensor.shape.__get__  # type: ignore[attr-defined]
OPERATORS = (type(torch.ops.aten.item), type(torch.ops.aten.item.default))
"""Kinds of functions that torch.ops holds."""
READ_FOR_THE_CALLER = (
    ("numpy",), ("tree",), ("gymnasium",), ("ray", "rllib", "utils"), ("torch", "_tensor.py"),
    ("torch", "overrides.py"), ("torch", "_ops.py"), ("torch", "serialization.py"),
)  # fmt: skip
"""Installed packages and files whose functions may be given a tensor, and return what its numbers are."""
RECOVERS_FROM = frozenset({
    "", "BaseException", "Exception", "ArithmeticError", "AssertionError", "IndexError", "LinAlgError", "LookupError",
    "RuntimeError", "ValueError",
})  # fmt: skip
"""Exceptions that an operator of torch raises for some numbers; ``: any."""


def number_reads(graph: PolicyGraph, tensors: Sequence[Tensor]) -> tuple[list[str], list[str]]:
    """Return the places in the user's own code that read the observation's numbers in Python, and where it recovers.

    Assertions do not count as the former. The latter are operators on such numbers in a `try` that goes on.
    """
    reads: set[str] = set()
    tries: set[str] = set()

    def report(is_read: bool) -> None:
        stack = ((frame.f_code.co_filename, line) for frame, line in traceback.walk_stack(None))
        inside = takewhile(lambda place: place[0] != policy_graph.__file__, stack)
        own = [place for place in inside if not _reads_for_its_caller(place[0])]
        # The frameworks' reads are checks, such as those of torch's distributions.
        for place in own[:1] if is_read else ():
            if not _is_of_a_framework(place[0]) and not _decides_nothing(*place):
                reads.add("{}:{}".format(*place))
        tries.update("{}:{}".format(*place) for place in own if not _is_installed(place[0]) and _recovers(*place))

    given = [tensor.clone() for tensor in tensors]
    try:
        with torch.no_grad(), _in_all_threads(_Follower(given, report)):
            graph(*given)
    except Exception as error:  # torch's higher order operators do not take a mode
        raise UnsupportedError(
            "the network does not run under a TorchFunctionMode, with which the export looks for numbers that are "
            f"read in Python: {first_line(error)}{raised_at(error)}"
        ) from error
    return sorted(reads), sorted(tries)


class _Follower(TorchFunctionMode):
    """Calls `report` for each use of a tensor that was computed from the observation: True if it reads its numbers.

    Such a tensor is known by its memory: a buffer that was filled with the observation, and a view of it, are others'
    objects. The size of some depends on numbers of the observation too: to read it is to read those.
    """

    def __init__(self, tensors: Sequence[Tensor], report: Callable[[bool], None]) -> None:
        super().__init__()
        self._report = report
        self._kept: list[Tensor] = []  # kept alive, so that no other tensor gets their memory
        self._memory: set[int] = set()
        self._sized: set[int] = set()
        for tensor in tensors:
            self._follow(tensor)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None) -> Any:
        options = kwargs or {}
        given = self._followed((args, options))
        if not given:
            return func(*args, **options)
        name = getattr(func, "__name__", "").partition(".")[0]
        is_sized = any(id(one) in self._sized for one in given)
        is_told = bool(self._followed((args[1:], options)))
        is_read = name in READS or (is_sized and (name in SIZES or func == SHAPE)) or (name in TAKE_NUMBERS and is_told)
        is_read |= name == "as_tensor" and not isinstance(args[0], Tensor)
        is_read |= name in ("__getitem__", "__setitem__") and bool(self._followed(_slices(args[1])))
        result = func(*args, **options)
        self._report(is_read or (isinstance(func, OPERATORS) and isinstance(result, int | float) and name not in SIZES))
        for one in _tensors((result, options.get("out"), args[0] if _writes(func) else None)):
            self._follow(one)
        selects = name in SELECTS or (name == "__getitem__" and _is_mask(args[1])) or (name == REPEATS and is_told)
        if is_sized or selects or (name in SELECTS_ALONE and [*args[1:], *options.values()] in ([], [-1])):
            self._sized.update(id(one) for one in _tensors(result) if one.dim())
        return result

    def _followed(self, value: Any) -> list[Tensor]:
        return [one for one in _tensors(value) if not self._memory.isdisjoint(_memory(one))]

    def _follow(self, tensor: Tensor) -> None:
        self._kept.append(tensor)
        self._memory.update(_memory(tensor))


def _memory(tensor: Tensor) -> set[int]:
    """Return what a tensor shares with its views: the address of its numbers; and its own, as it may have none."""
    try:
        return {id(tensor), tensor.untyped_storage().data_ptr() or id(tensor)}
    except (RuntimeError, NotImplementedError):  # a kind of tensor without a storage
        return {id(tensor)}


def _writes(func: Any) -> bool:
    """Return whether a function of torch writes into its first argument."""
    name = getattr(func, "__name__", "")
    return name in ("__setitem__", "__set__") or (name.endswith("_") and not name.endswith("__"))


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors among arguments or results."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, slice):
        yield from _tensors((value.start, value.stop, value.step))
    elif isinstance(value, list | tuple | dict):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tensors(item)


def _slices(index: Any) -> list[slice]:
    return [one for one in (index if isinstance(index, tuple) else (index,)) if isinstance(one, slice)]


def _is_mask(index: Any) -> bool:
    return any(one.dtype == torch.bool for one in _tensors(index))


@contextlib.contextmanager
def _in_all_threads(mode: TorchFunctionMode) -> Iterator[None]:
    """Enter a mode, which is its thread's own, also in the threads and the tasks of pools that begin meanwhile."""
    start, submit = threading.Thread.start, ThreadPoolExecutor.submit

    def followed(call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **options: Any) -> Any:
            with mode:
                return call(*args, **options)

        return run

    def start_followed(self: threading.Thread) -> None:
        self.run = followed(self.run)  # type: ignore[method-assign]
        start(self)

    def submit_followed(pool: ThreadPoolExecutor, call: Callable[..., Any], /, *args: Any, **options: Any) -> Any:
        threading.Thread.start = start  # type: ignore[method-assign]  # a pool's own thread goes on after the check
        try:
            return submit(pool, followed(call), *args, **options)
        finally:
            threading.Thread.start = start_followed  # type: ignore[method-assign]

    threading.Thread.start = start_followed  # type: ignore[method-assign]
    ThreadPoolExecutor.submit = submit_followed  # type: ignore[method-assign,assignment]
    try:
        with mode:
            yield
    finally:
        threading.Thread.start = start  # type: ignore[method-assign]
        ThreadPoolExecutor.submit = submit  # type: ignore[method-assign]


def _reads_for_its_caller(file: str) -> bool:
    """Return whether a file only reads what it is given: functions of an installed package, or this file."""
    inside = _installed(file)
    return file == __file__ or any(inside[: len(names)] == names for names in READ_FOR_THE_CALLER)


def _is_of_a_framework(file: str) -> bool:
    """Return whether a file is of an installed package that trains policies, or of what that stands on."""
    return not FRAMEWORKS.isdisjoint(_installed(file)[:1])


def _is_installed(file: str) -> bool:
    """Return whether a file is of an installed package or of Python's own library."""
    return bool(_installed(file)) or Path(file).is_relative_to(Path(logging.__file__).parents[1])


def _installed(file: str) -> tuple[str, ...]:
    """Return the parts of a file's path below the folder of installed packages; () if it is not in one."""
    parts = Path(file).parts
    places = [index for index, part in enumerate(parts) if part in INSTALLED]
    return parts[places[-1] + 1 :] if places else ()


def _decides_nothing(file: str, line: int) -> bool:
    """Return whether a line is part of an assertion or a `print`, or is of Python's own logging: no number changes."""
    return file == logging.__file__ or any(
        isinstance(node, ast.Assert) or _is_print(node)
        for node in _statements(file)
        if node.lineno <= line <= (node.end_lineno or 0)
    )


def _recovers(file: str, line: int) -> bool:
    """Return whether a line is in a `try` that goes on otherwise after an exception of torch's operators."""
    return any(
        isinstance(node, ast.Try)
        and node.body[0].lineno <= line <= (node.body[-1].end_lineno or 0)
        and any(_names(handler.type) & RECOVERS_FROM for handler in node.handlers if not _raises(handler))
        for node in _statements(file)
    )


def _raises(handler: ast.ExceptHandler) -> bool:
    return isinstance(handler.body[-1], ast.Raise)


def _names(kind: ast.expr | None) -> set[str]:
    """Return the names of the exceptions that an `except` is for; an empty one if it is for all."""
    kinds = kind.elts if isinstance(kind, ast.Tuple) else [kind]
    return {ast.unparse(one).rpartition(".")[2] if one else "" for one in kinds}


@functools.cache
def _statements(file: str) -> list[ast.stmt]:
    """Return every statement of a file; none if it cannot be read."""
    try:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return []
    return [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]


def _is_print(node: ast.stmt) -> bool:
    match node:
        case ast.Expr(value=ast.Call(func=ast.Name(id="print"))):
            return True
    return False
