"""Rewards on the way to a target, for a policy that was trained to see those of its actions; no ROS."""

from __future__ import annotations

import threading
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from rlservo.deploy.ros2 import node as ros2_node


class Seeing:
    """A policy that must be given rewards, and keeps them."""

    contract = SimpleNamespace(has_reward=True)

    def __init__(self) -> None:
        self.rewards: list[float] = []

    def reset(self) -> None:
        self.rewards.clear()

    def act(self, obs: Any, *, reward: float) -> Any:
        self.rewards.append(reward)
        return obs


class Track:
    """A robot that arrives in its third step."""

    def __init__(self) -> None:
        self.unwrapped = SimpleNamespace(
            reset_options=lambda start: {"start": start},
            robot=SimpleNamespace(hold=lambda: None, is_called_off=lambda: False, stopped_by=None),
        )
        self.steps = 0

    def reset(self, *, options: Any) -> Any:
        assert options["target_pose"] == [1.0, 2.0, 0.0]
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        info = {"robot": {"state": "run"}, "is_success": True, "final_status": "success"}
        return action, 0.5 * self.steps, self.steps == 3, False, info


def test_policy_gets_the_reward_of_its_last_action() -> None:
    policy, entered = Seeing(), []
    node: Any = SimpleNamespace(
        policy=policy, stop=threading.Event(), wanted=ros2_node.Wanted.RUN, counts=Counter(),
        enter=lambda state, why="": entered.append(state),
    )  # fmt: skip
    target: Any = SimpleNamespace(number=1, begun=0, done=0, pose=SimpleNamespace(x=1.0, y=2.0, z=0.0))
    ros2_node._drive_to(node, Track(), "target_pose", target)
    assert policy.rewards == [0.0, 0.5, 1.0]
    assert entered == ["starting", "running", "running", "arrived"]
    assert node.counts["decisions"] == 3 and target.done == 1
