"""The demo's pictures of a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.deploy.demo import picture
from rlservo.drive import video
from rlservo.drive.control_loop import rollout
from rlservo.drive.make_environment import make_env
from rlservo.policy.policy import Policy

MIR100 = "rlservo/NoObstacleNavigationMir100Sim-v0"


def test_only_the_first_middle_and_last_picture_of_an_episode_are_drawn(
    shipped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawing costs more than all else of a step; here each picture is the number of actions before it."""
    with Policy.load(shipped / "mir100") as policy:
        (episode,) = rollout(policy, MIR100, episodes=1, seed=10_000).episodes
        actions: list[Any] = []
        act = policy.act
        monkeypatch.setattr(policy, "act", lambda obs, **options: actions.append(act(obs, **options)) or actions[-1])
        monkeypatch.setattr(picture, "make_env", lambda env_id, kwargs, render: make_env(env_id, kwargs, render=False))
        monkeypatch.setattr(video, "rgb_frame", lambda env: np.array(len(actions)))
        notes: list[object] = []
        frames = picture.film(policy, MIR100, seed=10_000, steps=episode.steps, note=notes.append)
    assert [int(frame) for frame in frames] == [0, episode.steps // 2, episode.steps] and episode.steps > 3
    assert notes == []
