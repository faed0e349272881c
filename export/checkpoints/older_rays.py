"""Pickles of older Rays and other Pythons, converted to those of the Ray that restores them (2.60).

Names that have moved, values whose class is gone, filters' statistics. The new API stack's own differences, which take
RLlib to translate, are in `rllib/new_stack/older_components.py`.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Mapping
from typing import Any

from rlservo.errors import UnsupportedError

OLD_WEIGHTS = "module_state.pt"
"""The weights' file up to Ray 2.40. It is also a pickle."""
_ALGORITHMS = "ray.rllib.algorithms"
MOVED = {
    ("ray.rllib.core.learner.learner", "TorchCompileWhatToCompile"): (
        f"{_ALGORITHMS}.algorithm_config", "TorchCompileWhatToCompile",
    ),
    (f"{_ALGORITHMS}.dqn.dqn_rainbow_catalog", "DQNRainbowCatalog"): (f"{_ALGORITHMS}.dqn.dqn_catalog", "DQNCatalog"),
    (f"{_ALGORITHMS}.dqn.torch.dqn_rainbow_torch_rl_module", "DQNRainbowTorchRLModule"): (
        f"{_ALGORITHMS}.dqn.torch.default_dqn_torch_rl_module", "DefaultDQNTorchRLModule",
    ),
    **{
        (f"{_ALGORITHMS}.{name.lower()}.torch.{name.lower()}_torch_rl_module", f"{name}TorchRLModule"): (
            f"{_ALGORITHMS}.{name.lower()}.torch.default_{name.lower()}_torch_rl_module", f"Default{name}TorchRLModule",
        )
        for name in ("APPO", "BC", "CQL", "PPO", "SAC")
    },
}  # fmt: skip
"""New places of names of older Rays (ray 2.60)."""


class Gone:
    """Stand-in for a value whose class, one of Ray's or gym's, no longer exists; it holds the value's attributes."""

    def __init__(self, *_args: Any, **_kwargs: Any) -> None:
        """Accept any arguments."""

    def __setstate__(self, state: Any) -> None:
        """Accept any arguments."""
        if isinstance(state, dict):
            self.__dict__.update(state)


def find_class(find: Callable[[str, str], Any], module: str, name: str, *, missing_ok: bool) -> Any:
    """Return the object that a pickle names; `find` looks it up at its present place.

    With `missing_ok` a `Gone` replaces classes that Ray and gym no longer have. Raises ImportError or AttributeError.
    """
    if module.endswith("cloudpickle.cloudpickle") and name == "_builtin_type":
        return _builtin_type
    if module.startswith("numpy.core."):  # of numpy 1
        module = f"numpy._core.{module.removeprefix('numpy.core.')}"
    module, name = MOVED.get((module, name), (module, name))
    try:
        return find(module, name)
    except (ImportError, AttributeError):
        if not missing_ok or module.partition(".")[0] not in ("ray", "gym"):
            raise
        return type(name, (Gone,), {"__module__": module})


def _builtin_type(name: str) -> Any:
    """Return cloudpickle's constructor of functions that it pickled by value."""
    return _code if name == "CodeType" else getattr(types, name)


def _code(*parts: Any) -> types.CodeType:
    """Return a function's code, or code that raises if another Python's was pickled: few of them are ever called."""
    try:
        return types.CodeType(*parts)
    except (TypeError, ValueError):
        return _unreadable.__code__.replace(co_freevars=parts[-2])


def _unreadable(*_args: Any, **_kwargs: Any) -> Any:
    raise TypeError("it was pickled by value, by another Python: put it into a module, or export with that Python")


def with_current_statistics(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return a filter's state with current names: up to Ray 2.47 the sum of squares was called std_array.

    Raises UnsupportedError for statistics in another form.
    """
    lists = {key: [_statistics(one) for one in saved[key]] for key in ("running_stats", "buffer") if key in saved}
    return {**saved, **lists}


def _statistics(saved: Mapping[str, Any]) -> Mapping[str, Any]:
    if "sum_sq_diff_array" in saved:
        return saved
    if "std_array" not in saved:
        raise UnsupportedError(
            "the observation filter's statistics are in an unknown form: expected 'sum_sq_diff_array' ('std_array' in "
            f"an older Ray) among {', '.join(saved)}"
        )
    mean, squares = saved["mean_array"], saved["std_array"]
    # A delta counts what a filter has seen since the last merge: nothing here, so these are not used.
    deltas = {"num_pushes_delta": 0, "mean_delta_array": mean, "sum_sq_diff_delta_array": squares}
    return {"num_pushes": saved["num_pushes"], "mean_array": mean, "sum_sq_diff_array": squares, **deltas}
