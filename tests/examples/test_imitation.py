"""Beginning with a solution: a network is fitted to inverse kinematics, from only the elements that decide them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from shared.imitation import Imitation, fit_to_solution

from rlservo.errors import UsageError

SETTINGS: dict[str, Any] = {
    "env": "rlservo.envs:rlservo/EndEffectorPositioningPandaSim-v0",
    "env_config": {"rs_state_to_info": False},
    "seed": 0,
}
TARGET = [17, 18, 19]  # of the observation


class Network(torch.nn.Module):
    """A mean by one hidden layer and a free standard deviation, as RLlib's module gives them."""

    def __init__(self, observations: int, actions: int, *, is_free: bool = True) -> None:
        super().__init__()
        self.first, self.last = torch.nn.Linear(observations, 32), torch.nn.Linear(32, actions)
        if is_free:
            self.log_std = torch.nn.Parameter(torch.zeros(actions))

    def forward_train(self, batch: dict[str, Any]) -> dict[str, Any]:
        mean = self.last(self.first(batch["obs"]).tanh())
        return {"action_dist_inputs": torch.cat([mean, torch.zeros_like(mean)], dim=-1)}


def imitation(updates: int) -> Imitation:
    return Imitation(of=[], episodes=100, updates=updates, rate=0.01, std=0.2)


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


def test_a_network_learns_the_solution_from_the_elements_that_are_seen() -> None:
    short, long = (Network(29, 6) for _ in range(2))
    before = long.first.weight.detach().clone()
    assert fit_to_solution(short, imitation(1), SETTINGS, TARGET) > 5 * fit_to_solution(
        long, imitation(400), SETTINGS, TARGET
    )
    moved = (long.first.weight - before).abs().sum(dim=0) > 0
    assert moved.nonzero().flatten().tolist() == TARGET
    assert torch.allclose(long.log_std.exp(), torch.full((6,), 0.2))


def test_what_cannot_be_imitated_is_refused_in_a_sentence() -> None:
    with pytest.raises(UsageError, match=r"set model.free_log_std=true"):
        fit_to_solution(Network(29, 6, is_free=False), imitation(1), SETTINGS, TARGET)
    other = SETTINGS | {"env": "CartPole-v1", "env_config": {}}
    with pytest.raises(UsageError, match=r"imitate is set, and .*CartPole.* has no solution"):
        fit_to_solution(Network(4, 2), imitation(1), other, [0])
