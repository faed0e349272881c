"""Imitation at the start of a training: the policy is fitted to a solution that its environment knows.

For `train_shipped.py`. An environment with `solution() -> action` (such as inverse kinematics) gives an action that
ends at the target, whatever the arm does meanwhile. The policy's mean is fitted to it by least squares, from only the
elements that decide it. Reinforcement learning then begins with a policy that reaches most targets, and improves it
with all elements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from rlservo import errors

BATCH = 512
LAST_RATE = 0.01  # share of the first learning rate, which falls along a cosine


@dataclass(frozen=True)
class Imitation:
    """Settings `imitate` of a training.yaml."""

    of: Sequence[str]  # the observed elements that decide the solution
    episodes: int  # one observation each
    updates: int
    rate: float  # the optimiser's, at first
    std: float  # of the actions that reinforcement learning begins with


def fit_to_solution(module: Any, imitation: Imitation, settings: dict[str, Any], seen: list[int]) -> float:
    """Fit a PPO module's means to the environment's solution and return the root mean square error of the last batch.

    `seen` are the columns of `imitation.of`; the weights of the others are 0 and stay 0. Raises UsageError for an
    environment without a solution, and for a network whose standard deviation is an output.
    """
    spread = [parameter for name, parameter in module.named_parameters() if name.endswith("log_std")]
    if not spread:
        raise errors.UsageError("imitate.std sets a standard deviation that is no output: set model.free_log_std=true")
    observations, actions = _solved(imitation.episodes, settings, seen)
    generator = torch.Generator().manual_seed(settings["seed"])
    optimiser = torch.optim.Adam(module.parameters(), lr=imitation.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, imitation.updates, eta_min=LAST_RATE * imitation.rate
    )
    loss = torch.zeros(())
    for _ in range(imitation.updates):
        rows = torch.randint(len(observations), (BATCH,), generator=generator)
        outputs = module.forward_train({Columns.OBS: observations[rows]})
        means = outputs[Columns.ACTION_DIST_INPUTS].chunk(2, dim=-1)[0]
        loss = (means - actions[rows]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        for parameter in spread:
            parameter.fill_(math.log(imitation.std))
    return math.sqrt(float(loss.detach()))


def _solved(episodes: int, settings: dict[str, Any], seen: list[int]) -> tuple[Tensor, Tensor]:
    """Return first observations (n, elements), 0 but for the columns `seen`, and solutions (n, actions)."""
    env: Any = gymnasium.make(settings["env"], disable_env_checker=True, **settings.get("env_config", {}))
    if not hasattr(env.unwrapped, "solution"):
        raise errors.UsageError(f"imitate is set, and {env.unwrapped} has no solution")
    observations = np.zeros((episodes, env.observation_space.shape[0]), np.float32)
    actions = np.zeros((episodes, env.action_space.shape[0]), np.float32)
    for row in range(episodes):
        observation, _ = env.reset(seed=None if row else settings["seed"])
        observations[row, seen] = observation[seen]
        actions[row] = env.unwrapped.solution()
    env.close()
    return torch.from_numpy(observations), torch.from_numpy(actions)
