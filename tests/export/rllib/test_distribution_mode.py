"""Rules from a distribution's parameters to its deterministic action."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from ray.rllib.core.distribution.torch.torch_distribution import TorchDeterministic, TorchDiagGaussian

from rlservo.export.rllib.distribution_mode import find_mode

ARM = Box(-np.inf, np.inf, (2,), np.float32)


class Limited(TorchDiagGaussian):
    """Its deterministic action is the mean up to a limit that few numbers reach."""

    def to_deterministic(self) -> TorchDeterministic:
        return TorchDeterministic(loc=self.loc.clamp(-30.0, 30.0))


@pytest.mark.parametrize(("kind", "mode"), [(TorchDiagGaussian, "mean"), (Limited, "given")])
def test_a_users_own_distribution_is_not_taken_for_a_known_rule(kind: Any, mode: str) -> None:
    def act(inputs: torch.Tensor) -> Any:
        return kind.from_logits(inputs).to_deterministic().sample()

    assert find_mode(act, (kind,), ARM, torch.zeros(2, 4)) == mode
