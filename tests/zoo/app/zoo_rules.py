"""A user's own action rules: distributions that act in none of RLlib's ways, and a network that branches."""

from __future__ import annotations

from typing import Any

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import TorchDeterministic, TorchDistribution
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.models.torch.torch_action_dist import TorchCategorical, TorchDiagGaussian
from torch import nn


class BetaDistribution(TorchDistribution):
    """A Beta on [-1, 1]; its deterministic action is its mean."""

    def __init__(self, alpha: Any, beta: Any) -> None:
        self.alpha, self.beta = alpha, beta
        super().__init__()
        self._dist = torch.distributions.Beta(alpha, beta)

    def _get_torch_distribution(self, *args: Any, **kwargs: Any) -> Any:
        return None

    def sample(self, *, sample_shape: Any = ()) -> Any:
        return 2.0 * self._dist.sample(torch.Size(sample_shape)) - 1.0

    def rsample(self, *, sample_shape: Any = ()) -> Any:
        return 2.0 * self._dist.rsample(torch.Size(sample_shape)) - 1.0

    def logp(self, value: Any, **kwargs: Any) -> Any:
        return self._dist.log_prob(((value + 1.0) / 2.0).clamp(1e-4, 1.0 - 1e-4)).sum(-1)

    def entropy(self) -> Any:
        return self._dist.entropy().sum(-1)

    def kl(self, other: Any, **kwargs: Any) -> Any:
        return torch.distributions.kl_divergence(self._dist, other._dist).sum(-1)

    @staticmethod
    def required_input_dim(space: Any, **kwargs: Any) -> int:
        return 2 * int(space.shape[0])

    @classmethod
    def from_logits(cls, logits: Any, **kwargs: Any) -> Any:
        alpha, beta = nn.functional.softplus(logits).chunk(2, dim=-1)
        return cls(alpha + 1.0, beta + 1.0)

    def to_deterministic(self) -> Any:
        return TorchDeterministic(loc=2.0 * self.alpha / (self.alpha + self.beta) - 1.0)


class BetaModule(TorchRLModule, ValueFunctionAPI):
    """A network with a distribution of the user's own."""

    def setup(self) -> None:
        self.trunk = nn.Sequential(nn.Linear(self.observation_space.shape[0], 8), nn.SiLU(), nn.LayerNorm(8))
        self.policy, self.values = nn.Linear(8, 2 * self.action_space.shape[0]), nn.Linear(8, 1)
        self.action_dist_cls = BetaDistribution

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.policy(self.trunk(batch[Columns.OBS]))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(self.trunk(batch[Columns.OBS])).squeeze(-1)


class BranchingModule(TorchRLModule, ValueFunctionAPI):
    """Asks the whole batch which of two layers to use."""

    def setup(self) -> None:
        size = self.observation_space.shape[0]
        self.one, self.other = (nn.Linear(size, self.action_space.n) for _ in range(2))
        self.values = nn.Linear(size, 1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        obs = batch[Columns.OBS]
        return {Columns.ACTION_DIST_INPUTS: self.one(obs) if float(obs.mean()) > 0.0 else self.other(obs)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.values(batch[Columns.OBS]).squeeze(-1)


class OldTanhGaussian(TorchDiagGaussian):
    """On the old stack, registered by name: acts by 0.7 tanh of the mean."""

    def deterministic_sample(self) -> Any:
        self.last_sample = 0.7 * torch.tanh(self.dist.mean)
        return self.last_sample


class OldTempered(TorchCategorical):
    """On the old stack: RLlib's categorical with a temperature, which divides the scores in place."""

    def __init__(self, inputs: Any, model: Any = None) -> None:
        super().__init__(inputs, model, temperature=3.0)
