"""Success of episodes: one episode's, from its last `info`, and the rate over several.

An environment reports success under `is_success`, `success` or `final_status`. Some report only successes: an episode
without a report has failed if any other one of the same environment has one. Where none has, there is no rate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from rlservo.client.formats.request_names import SUCCESS
from rlservo.errors import UsageError

FAILURE = "failure"


@final  # so a type checker knows that one is never false
@dataclass(frozen=True)
class SuccessRate:
    """Successes of several episodes of an environment that reports them."""

    successes: int
    rate: float
    interval: tuple[float, float]  # 95%, Wilson


def success_of(info: Mapping[str, Any]) -> bool | None:
    """Return the success in an episode's last `info`: `is_success`, else `success`, else `final_status`, else None.

    Raises UsageError for a value that is neither true nor false: the text "False" and NaN would count as successes.
    """
    for key in ("is_success", "success"):
        if (said := info.get(key)) is not None:
            value = np.asarray(said)
            if value.dtype.kind not in "biuf" or value.size != 1 or value.item() not in (0, 1):
                raise UsageError(f"the environment's info['{key}'] is {said!r:.80}: expected true or false")
            return bool(value.item())
    status = info.get("final_status")
    return None if status is None else status == SUCCESS


def status_of(info: Mapping[str, Any]) -> str | None:
    """Return the final status that servers and recordings count: `success` exactly where `success_of` is true."""
    succeeded, status = success_of(info), info.get("final_status")
    if succeeded:
        return SUCCESS
    if status is None or status == SUCCESS:
        return None if succeeded is None else FAILURE
    return str(status)


def success_rates(*groups: Sequence[bool | None]) -> tuple[SuccessRate | None, ...]:
    """Return the rate of each group of one environment's episodes; None for all if no episode of any has a report."""
    reports = any(outcome is not None for outcomes in groups for outcome in outcomes)
    return tuple(_rate(outcomes) if reports and outcomes else None for outcomes in groups)


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the 95% score interval of a proportion (E. B. Wilson, 1927); valid at 0% and 100%, unlike +-1.96 sigma."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials is not a proportion")
    p = successes / trials
    centre = p + z * z / (2 * trials)
    half = z * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max((centre - half) / scale, 0.0), min((centre + half) / scale, 1.0)


def _rate(outcomes: Sequence[bool | None]) -> SuccessRate:
    successes = sum(outcome is True for outcome in outcomes)
    return SuccessRate(successes, successes / len(outcomes), wilson_interval(successes, len(outcomes)))
