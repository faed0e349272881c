"""Rewards on the way to a target, for a policy that was trained to see those of its actions; no ROS."""

from __future__ import annotations

import threading
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from rlservo.deploy.ros2 import node as ros2_node
from rlservo.deploy.ros2.targets import GivenTarget


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
            simulation=SimpleNamespace(pose=np.zeros(3)),
            target_position=lambda: np.array([1.0, 2.0, 0.0]),
            robot_position=lambda: np.zeros(3),
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
        policy=policy, stop=threading.Event(), wanted=ros2_node.Wanted.RUN, counts=Counter(), state="", why=""
    )

    def enter(state: str, why: str = "") -> None:
        entered.append(state)
        node.state, node.why = state, why

    node.enter = enter
    target, ended = GivenTarget(1, (1.0, 2.0, 0.0)), []
    targets: Any = SimpleNamespace(newest=target, begun=0, tell=lambda *_: None, end=lambda *how: ended.append(how))
    ros2_node._drive_to(node, Track(), "target_pose", targets, target)
    assert policy.rewards == [0.0, 0.5, 1.0]
    assert entered == ["starting", "running", "running", "arrived"]
    assert node.counts["decisions"] == 3 and ended[0][:2] == (target, "succeed")
