"""Disturbances of a rollout, written as `latency=3,noise=real`: parsed, and applied to an environment.

| kind | size | what it does |
|---|---|---|
| latency | control cycles | an action takes effect later |
| observation_latency | control cycles | an observation is older |
| late | control cycles | each observation arrives up to this much later |
| drop | share | observations that never arrive: the last one is repeated |
| noise | real, 2*real, or a number in each element's unit | normal noise on each element |
| bias | the same | a constant error of each element, drawn once an episode |
| noise.NAME, bias.NAME | a number in the element's unit | the same, of one element |
| stuck | any, or an element's name | an element keeps its first value |
| payload | kg | a load the arm does not know of |
| model | share | masses, inertias, gains, friction, velocities differ by up to this |
| base | m | distance of the robot from its believed position |
| target | outside | a target out of reach |
| start | corner | the robot starts in a corner |

Sizes of cycles, kilograms and metres, and the share of dropped observations, may be ranges (`latency=0..3`), drawn once
an episode. The wrapper is `DomainRandomization`, whose docstring says what is drawn when.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rlservo.errors import UsageError

if TYPE_CHECKING:
    import gymnasium as gym

WRAPPER = "rlservo.envs.randomization:DomainRandomization"

LARGEST_DELAY = 1000  # control cycles
LARGEST_PAYLOAD = 20.0  # [kg]
LARGEST_MODEL_ERROR = 0.5
LARGEST_OFFSET = 1.0  # [m]


@dataclass(frozen=True)
class Disturbance:
    """Kinds and sizes, as written and as arguments of `DomainRandomization`."""

    label: str
    arguments: dict[str, Any]


class DisturbanceError(UsageError):
    """The environment cannot be disturbed in this way."""


def parse_disturbance(text: str) -> Disturbance:
    """Parse `kind=size,kind=size`. Raises UsageError for an unknown kind or an impossible size."""
    arguments: dict[str, Any] = {}
    for part in text.split(","):
        kind, equals, size = (piece.strip() for piece in part.partition("="))
        base, dot, element = kind.partition(".")
        if not equals or not size or (base if dot else kind) not in _KINDS or (dot and base not in _BY_ELEMENT):
            raise UsageError(f"disturbance {part.strip()!r}: expected KIND=SIZE with one of {', '.join(_KINDS)}")
        argument, parse = _KINDS[base]
        if dot:
            errors = arguments.setdefault(argument, {})
            if not isinstance(errors, dict) or element in errors:
                raise UsageError(f"disturbance {text!r}: {base} is given twice")
            errors[element] = _number(kind, size, math.inf)
            continue
        if argument in arguments:
            other = " (target and start go one at a time)" if argument == "extreme" else ""
            raise UsageError(f"disturbance {text!r}: {kind} is given twice{other}")
        arguments[argument] = parse(kind, size)
    return Disturbance(text, arguments)


def disturb_env(env: gym.Env[Any, Any], disturbance: Disturbance) -> gym.Env[Any, Any]:
    """Return the environment with the disturbance. Raises DisturbanceError, naming the missing method."""
    from gymnasium.envs.registration import load_env_creator

    # By name, as in Gymnasium's registry: driving a third-party environment needs no simulator of ours.
    wrap: Callable[..., Any] = load_env_creator(WRAPPER)
    try:
        wrapped: gym.Env[Any, Any] = wrap(env, **disturbance.arguments)
    except ValueError as error:
        raise DisturbanceError(f"disturbance {disturbance.label!r}: {error}") from error
    return wrapped


def _number(kind: str, text: str, largest: float, *, below: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    is_within = 0.0 <= value < largest if below else 0.0 <= value <= largest
    if not (math.isfinite(value) and is_within):
        bound = "or more" if largest == math.inf else f"to {'less than ' if below else ''}{largest:g}"
        raise UsageError(f"disturbance '{kind}={text}': expected a number, 0 {bound}")
    return value


def _range(kind: str, text: str, largest: float, *, below: bool = False) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    first = _number(kind, low, largest, below=below)
    last = _number(kind, high, largest, below=below) if dots else first
    if last < first:
        raise UsageError(f"disturbance '{kind}={text}': expected LOW..HIGH with LOW not above HIGH")
    return first, last


def _cycles(kind: str, text: str) -> tuple[int, int]:
    low, high = _range(kind, text, LARGEST_DELAY)
    if low != int(low) or high != int(high):
        raise UsageError(f"disturbance '{kind}={text}': expected whole control cycles")
    return int(low), int(high)


def _late(kind: str, text: str) -> tuple[int, int]:
    low, high = _cycles(kind, text)
    return (low, high) if ".." in text else (0, high)


def _share(kind: str, text: str) -> tuple[float, float]:
    return _range(kind, text, 1.0, below=True)


def _errors(kind: str, text: str) -> float | str:
    factor, star, word = text.rpartition("*")
    if word == "real":
        if star:
            _number(kind, factor, math.inf)
        return text
    try:
        return _number(kind, text, math.inf)
    except UsageError as error:
        raise UsageError(f"disturbance '{kind}={text}': expected real, 2*real or a number, 0 or more") from error


def _word(meaning: dict[str, str]) -> Callable[[str, str], str]:
    def parse(kind: str, text: str) -> str:
        if text not in meaning:
            raise UsageError(f"disturbance '{kind}={text}': expected {kind}={' or '.join(meaning)}")
        return meaning[text]

    return parse


_KINDS: dict[str, tuple[str, Callable[[str, str], Any]]] = {
    "latency": ("action_latency", _cycles),
    "observation_latency": ("observation_latency", _cycles),
    "late": ("late_observations", _late),
    "drop": ("dropped_observations", _share),
    "noise": ("observation_noise", _errors),
    "bias": ("observation_bias", _errors),
    "stuck": ("stuck_sensor", lambda _kind, text: text),
    "payload": ("payload", lambda kind, text: _range(kind, text, LARGEST_PAYLOAD)),
    "model": ("model_error", lambda kind, text: _number(kind, text, LARGEST_MODEL_ERROR)),
    "base": ("base_offset", lambda kind, text: _range(kind, text, LARGEST_OFFSET)),
    "target": ("extreme", _word({"outside": "target"})),
    "start": ("extreme", _word({"corner": "start"})),
}
_BY_ELEMENT = ("noise", "bias")
