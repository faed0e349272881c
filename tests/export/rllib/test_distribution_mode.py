"""Rules from a network's numbers to its deterministic action."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from ray.rllib.algorithms.dqn.dqn_catalog import DQNCatalog
from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import TorchDeterministic, TorchDiagGaussian
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.rllib.distribution_mode import find_mode
from rlservo.policy.policy import Policy

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


class StopsForOutliers(DefaultDQNTorchRLModule):
    """Chooses otherwise than by its Q-values, for numbers that no sample has."""

    def _forward_inference(self, batch: dict[str, Any], **more: Any) -> dict[str, Any]:
        outputs: dict[str, Any] = super()._forward_inference(batch, **more)
        is_far = (batch[Columns.OBS].abs() > 1e9).any(-1)
        return {**outputs, Columns.ACTIONS: torch.where(is_far, 0, outputs[Columns.ACTIONS])}


@pytest.mark.filterwarnings("ignore:.*RLModule.*:DeprecationWarning")
def test_an_own_choice_among_q_values_is_in_the_graph(tmp_path: Path, notices: list[str]) -> None:
    torch.manual_seed(0)
    settings = asdict(DefaultModelConfig(fcnet_hiddens=[8]))
    module: Any = StopsForOutliers(
        observation_space=Box(-np.inf, np.inf, (3,), np.float32),
        action_space=Discrete(3),
        model_config={**settings, "double_q": True, "dueling": True, "epsilon": [(0, 0.1)], "num_atoms": 1},
        catalog_class=DQNCatalog,
    )
    module.save_to_path(str(tmp_path / "module"))
    result = export_checkpoint(tmp_path / "module", tmp_path / "out", name="x", notify=notices.append)
    obs = np.float32([[-1e10, 2, -1e10], [-1e10, 1e10, 0], [-1e8, 1e8, 0]])
    with torch.no_grad():
        wanted = module.eval().forward_inference({Columns.OBS: torch.from_numpy(obs)})[Columns.ACTIONS]
    assert wanted[-1] != 0
    with Policy.load(result.path) as policy:
        np.testing.assert_array_equal(policy.act(obs), wanted.numpy())
