"""Comparison of a checkpoint's two accounts of its connectors: the configuration, and the list that RLlib saved.

RLlib records a connector's arguments by looking at the frame that called `ConnectorV2.__init__` (ray 2.60). That frame
is another's, or shows other values, if the class has no `__init__` of its own or changes an argument first, and it
knows nothing of an attribute that was set later. RLlib itself never reads the list: it restores by the configuration.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from ray.rllib.connectors.module_to_env.get_actions import GetActions

from rlservo.errors import UnsupportedError
from rlservo.export.rllib.new_stack.connectors import comes_from_rllib

SIDES = ("env-to-module", "module-to-env")
ADVICE = (
    "RLlib acts by the configuration, but saves arguments as it finds them in a stack frame: give the class an "
    "__init__ of its own that calls super().__init__() first, changes no argument and sets every attribute from one, "
    "then restore and save the checkpoint again"
)
OF_RLLIBS_OWN = (
    "the folder holds files of two checkpoints, or the attribute was set when the connector had been made: give it as "
    "an argument, then restore and save the checkpoint again"
)
DATA = (bool, int, float, complex, str, bytes, type(None), np.ndarray, np.generic, torch.Tensor, Space)


def check_same(where: str, listed: tuple[Any, Any], built: tuple[Any, Any], build: Callable[[], Any]) -> None:
    """Raise UnsupportedError unless both pairs of pipelines have the same connectors with the same attributes.

    `listed` come from RLlib's list, `built` from the configuration, which `build` makes once more: an attribute that is
    another each time, such as a time, is not compared.
    """
    for side, one, other in zip(SIDES, listed, built, strict=True):
        names = [[_name(piece) for piece in pipeline.connectors] for pipeline in (one, other)]
        if names[0] != names[1]:
            raise UnsupportedError(
                f"{where}: the {side} connectors are {', '.join(names[1])} in the algorithm's configuration, and "
                f"{', '.join(names[0])} in the list that RLlib saved: not exported, as one of them is not the policy's"
            )
    differences = dict(_differences(listed, built))
    if not differences:
        return
    changing = dict(_differences(build(), built))
    for (side, name, attribute), (saved, configured) in differences.items():
        advice = OF_RLLIBS_OWN if name.startswith("ray.") else ADVICE
        if (side, name, attribute) not in changing:
            raise UnsupportedError(
                f"{where}: the {side} connector {name} has {attribute}={reprlib.repr(configured)} in the algorithm's "
                f"configuration, and {attribute}={reprlib.repr(saved)} in the arguments that RLlib saved; {advice}"
            )


def _differences(
    listed: tuple[Any, Any], built: tuple[Any, Any]
) -> Iterator[tuple[tuple[str, str, str], tuple[Any, Any]]]:
    """Yield (side, connector, attribute) and both values of each attribute that differs."""
    own_to_rllib = vars(GetActions()).keys()  # a connector without arguments
    for side, *pipelines in zip(SIDES, listed, built, strict=True):
        for one, other in zip(*(pipeline.connectors for pipeline in pipelines), strict=True):
            for attribute in sorted((vars(one).keys() | vars(other).keys()) - own_to_rllib):
                if attribute.startswith("_") and comes_from_rllib(type(one)):
                    continue  # such as its device and its statistics
                values = (getattr(one, attribute, None), getattr(other, attribute, None))
                if not _same(*values):
                    yield (side, _name(one), attribute), values


def _same(one: Any, other: Any) -> bool:
    """Return whether two values are equal; those that are no data, such as functions, if they are of one type."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(value, other[key]) for key, value in one.items())
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(_same(*pair) for pair in zip(one, other, strict=True))
    if not (isinstance(one, DATA) and isinstance(other, DATA)):
        return type(one) is type(other) or _name(one) == _name(other)
    if isinstance(one, np.ndarray | torch.Tensor) or isinstance(other, np.ndarray | torch.Tensor):
        return np.array_equal(np.asarray(one), np.asarray(other))
    return bool(one == other) or (one != one and other != other)  # not a number


def _name(piece: Any) -> str:
    return f"{type(piece).__module__}.{type(piece).__qualname__}"
