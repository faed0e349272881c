"""The success rate of a training, from RLlib's own episodes and metrics."""

from __future__ import annotations

from typing import Any

import pytest
import shared.training_run as training_run
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics.metrics_logger import MetricsLogger


@pytest.mark.slow
@pytest.mark.parametrize(
    ("infos", "by_hand"),
    [
        ([{}, {}, {}, {"final_status": "success"}, {}], 1 / 5),
        ([{"is_success": True}, {"is_success": False}], 1 / 2),
        ([{"success": 0.0}] * 4, 0.0),
        ([{}] * 4, None),
    ],
)
def test_rate_of_a_training_is_the_one_counted_by_hand(infos: list[dict[str, Any]], by_hand: float | None) -> None:
    log, metrics = training_run.SuccessLog(), MetricsLogger()
    for info in infos:
        episode = SingleAgentEpisode()
        episode.add_env_reset(observation=0, infos={})
        episode.add_env_step(observation=1, action=0, reward=1.0, infos=info, truncated=True)
        log(episode=episode, metrics_logger=metrics)
    found = metrics.peek().get("success_rate")
    assert found == (None if by_hand is None else pytest.approx(by_hand))
