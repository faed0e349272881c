"""The user's own code in the checkpoints of older Ray releases."""

from __future__ import annotations

from typing import Any


def mean_std_filter(env: Any = None, spaces: Any = None, device: Any = None) -> Any:
    from ray.rllib.connectors.env_to_module.mean_std_filter import MeanStdFilter  # not in every Ray

    return MeanStdFilter()
