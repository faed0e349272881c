"""Values that an object and its code keep between two calls: what changes in them is a memory.

They are looked for in attributes and containers, and in what the code of a user's own classes reads beside its
arguments: class attributes, closures, defaults, and globals of its own modules.
"""

from __future__ import annotations

import contextlib
import contextvars
import dis
import functools
import itertools
import random
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from types import CodeType, FunctionType, GeneratorType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

FRAMEWORKS = frozenset({
    "torch", "ray", "stable_baselines3", "sb3_contrib", "rsl_rl", "skrl", "leapp", "tensordict", "gymnasium", "numpy",
    "rlservo",
})  # fmt: skip
"""Packages whose own code keeps nothing that an action depends on, and changes none by what it reads of a tensor."""
INSTALLED = ("site-packages", "dist-packages")
DEPTH = 12
"""Levels of objects in objects that are searched."""
HOLDERS = ("_modules", "_buffers", "_parameters")
"""Dictionaries in which a module keeps its parts, and whose names nobody writes."""
GLOBAL = ("_GLOBAL", "_NAME")
"""Ends of the instructions for globals."""
GENERATORS: dict[type, Callable[[Any], Any]] = {
    random.Random: lambda one: one.getstate(),
    np.random.Generator: lambda one: repr(one.bit_generator.state),
    np.random.RandomState: lambda one: repr(one.get_state(legacy=False)),
    torch.Generator: lambda one: one.get_state().numpy().tobytes(),
    itertools.count: repr,
    contextvars.ContextVar: lambda one: repr(one.get(None)),
}


def kept_values(value: Any, name: str = "", seen: set[int] | None = None) -> Iterator[tuple[str, Any]]:
    """Yield every value in an object, in the objects in it and in its class's own code, by its dotted name."""
    seen = set() if seen is None else seen
    if isinstance(value, bool | int | float | complex | str | bytes | np.generic | None):
        yield name, repr(value)
        return
    if id(value) in seen or name.count(".") > DEPTH:
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        yield from _of_attributes(value, name, seen)
        if not value.is_sparse:
            yield name, (value.shape, value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    elif isinstance(value, np.ndarray):
        yield name, (value.shape, value.tobytes() if value.dtype != object else len(value))
    elif kind := next((kind for kind in GENERATORS if isinstance(value, kind)), None):
        yield name, GENERATORS[kind](value)
    elif isinstance(value, MethodType):
        yield from kept_values(value.__self__, name, seen)
    elif isinstance(value, FunctionType):
        if _is_own(value):
            yield from _of_function(value, name, seen)
    elif isinstance(value, functools.partial):
        for part in (value.func, value.args, value.keywords):
            yield from kept_values(part, name, seen)
    elif isinstance(value, GeneratorType):
        if value.gi_frame is not None:  # it has not ended
            yield f"{name}.gi_frame", value.gi_frame.f_lasti
            yield from kept_values(value.gi_frame.f_locals, name, seen)
    elif isinstance(value, Iterator) and type(value).__module__ in ("builtins", "itertools"):
        with contextlib.suppress(TypeError):  # without a copy
            yield from kept_values(value.__reduce__(), name, seen)
    elif hasattr(value, "cache_info"):  # of functools.lru_cache
        yield f"{name}.currsize", value.cache_info().currsize
        yield from kept_values(value.__wrapped__, name, seen)
    elif isinstance(value, Mapping | Sequence | Set):
        yield name, len(value)
        yield from _of_attributes(value, name, seen)
        items = value.items() if isinstance(value, Mapping) else enumerate(value if isinstance(value, Sequence) else ())
        for key, item in items:
            yield from kept_values(item, f"{name}.{key}", seen)
    elif isinstance(value, type):
        yield from _of_class(value, name, seen)
    elif not isinstance(value, ModuleType | torch.jit.ScriptModule):
        for base in reversed(type(value).__mro__):
            yield from _of_class(base, name, seen)  # an attribute of the object itself comes later, and counts
        yield from _of_attributes(value, name, seen)


def _of_attributes(value: Any, name: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    """Yield what is in an object's own attributes, and in the slots of a user's classes."""
    for key, item in list(getattr(value, "__dict__", {}).items()):
        if key in functools.WRAPPER_ASSIGNMENTS:  # texts, which a copy of torch's own hooks loses
            continue
        yield from kept_values(item, name if key in HOLDERS else f"{name}.{key}", seen)
    for base in type(value).__mro__:
        slots = vars(base).get("__slots__", ()) if _is_own(base) else ()
        for key in (slots,) if isinstance(slots, str) else slots:
            if hasattr(value, key):
                yield from kept_values(getattr(value, key), f"{name}.{key}", seen)


def _is_own(code: Any) -> bool:
    """Return whether a class or function is neither of a framework nor of Python."""
    return not _is_of(str(getattr(code, "__module__", "")).partition(".")[0])


def _is_of(package: str) -> bool:
    return package in FRAMEWORKS or (package in sys.stdlib_module_names and package != "__main__")


def _of_class(kind: type, name: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    if not _is_own(kind):
        return
    for key, item in list(vars(kind).items()):
        if isinstance(item, staticmethod | classmethod):
            item = item.__func__
        if isinstance(item, property):
            item = item.fget
        if isinstance(item, FunctionType) or not (key.startswith("__") and key.endswith("__")):
            yield from kept_values(item, f"{name}.{key}", seen)


def _of_function(function: FunctionType, name: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    for key, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            inside = cell.cell_contents
        except ValueError:  # not filled yet
            continue
        yield from kept_values(inside, f"{name}.{key}", seen)
    for part in (function.__defaults__, function.__kwdefaults__, vars(function)):
        yield from kept_values(part, name, seen)
    used = set(_names(function.__code__))
    names, stored = {name for _, name in used}, {name for does, name in used if does == "STORE_ATTR"}
    for key in sorted({name for does, name in used if does.endswith(GLOBAL)} & function.__globals__.keys()):
        item, place = function.__globals__[key], f"{function.__module__}.{key}"
        is_anothers = isinstance(item, ModuleType | FunctionType | type) and _is_anothers(item, function)
        if not isinstance(item, ModuleType):
            if not is_anothers:
                yield from kept_values(item, place, seen)
            continue
        for attribute in sorted((stored if is_anothers else names) & vars(item).keys()):
            yield from kept_values(vars(item)[attribute], f"{place}.{attribute}", seen)


def _is_anothers(item: Any, function: FunctionType) -> bool:
    """Return whether what a function uses by name is of another installed package, a framework's or Python's."""
    module = item.__name__ if isinstance(item, ModuleType) else str(item.__module__)
    top = module.partition(".")[0]
    file = getattr(sys.modules.get(top), "__file__", None) or ""
    is_installed = any(part in INSTALLED for part in Path(file).parts)
    return top != str(function.__module__).partition(".")[0] and (is_installed or _is_of(top))


def _names(code: CodeType) -> Iterator[tuple[str, str]]:
    """Yield (instruction, name) of the globals and attributes that a function and those in it use."""
    for step in dis.get_instructions(code):
        if step.opcode in dis.hasname:
            yield step.opname, step.argval
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def changed(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return the shortest name of what changed between two calls; '' if nothing did."""
    names = (name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    return min(names, key=lambda name: (len(name), name), default="")
