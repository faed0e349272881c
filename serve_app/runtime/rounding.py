"""Slack that float32 rounding needs at the bounds of a space."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

RELATIVE_SLACK = 1e-5  # of the bound, or of 1 where that is larger


def rounding_slack(low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.float64]:
    """Return by how much a value in [low, high] may lie outside after rounding to float32."""
    slack: NDArray[np.float64] = RELATIVE_SLACK * np.maximum(1.0, np.minimum(np.abs(low), np.abs(high)))
    return slack
