"""The ghost: another version that drives a robot of its own from the same start to the same target."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.deploy.cockpit.stage import Scene, Stage
from rlservo.policy.acting_policy import ActingPolicy, Closeable


class Ghost(Closeable):
    """A policy and a stage of its own; `close` closes both."""

    def __init__(self, policy: ActingPolicy, like: Stage) -> None:
        """Build the same robot again. Raises UsageError if the policy does not fit it; then the caller keeps it."""
        self.stage = Stage(like.env_id, like.arguments, policy.contract)
        self._policy, self.contract = policy, policy.contract
        self._obs: Any = None
        self._is_over = False
        scene = self.stage.scene()
        self.scenes: tuple[Scene, Scene] = scene, scene
        """Before and after the last control cycle."""

    def begin(self, like: Stage) -> None:
        """Begin an episode at the robot's pose, with the same target."""
        self._obs, self._is_over = self.stage.begin_like(like), False
        self._policy.reset()
        scene = self.stage.scene()
        self.scenes = scene, scene

    def step(self, obs: Any, action: Any) -> NDArray[Any]:
        """Let a control cycle pass; return how the policy's action differs from `action` for the robot's observation.

        Raises the errors of `act`.
        """
        # Two rows, two episodes side by side: one follows the robot's observations, one the ghost's own.
        follows, own = self._policy.act(np.stack([obs, self._obs]))
        self.contract = self._policy.contract
        if not self._is_over:
            self._obs, _, terminated, truncated, _ = self.stage.step(own)
            self._is_over = terminated or truncated
        self.scenes = self.scenes[1], self.stage.scene()
        difference: NDArray[Any] = np.atleast_1d(np.asarray(follows) - np.asarray(action))
        return difference

    def close(self) -> None:
        self._policy.close()
        self.stage.close()
