"""Environment of a cart that drives to x = 0, with an observation connector: a start for your own."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from ray.rllib.connectors.env_to_module.observation_preprocessor import SingleAgentObservationPreprocessor

RATE_HZ = 20.0  # actions per second
NEAR = 0.05  # [m]


class Reach(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Observes position [m] and velocity [m/s], takes a velocity [m/s]."""

    observation_space = gym.spaces.Box(-2.0, 2.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    @classmethod
    def describe(cls, **_env_config: Any) -> dict[str, Any]:
        """Names, units and the control rate, for the policy's contract."""
        return {
            "observation": [{"name": "position", "unit": "m"}, {"name": "velocity", "unit": "m/s"}],
            "action": [{"name": "velocity_command", "unit": "m/s"}],
            "control_rate_hz": RATE_HZ,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self._state = np.array([self.np_random.uniform(-1, 1), 0.0], np.float32)
        return self._state, {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        velocity = float(action[0])
        position = float(np.clip(self._state[0] + velocity / RATE_HZ, -2.0, 2.0))
        self._state = np.array([position, velocity], np.float32)
        is_there = abs(position) < NEAR
        return self._state, -abs(position), is_there, False, {"is_success": is_there}


class Scaled(SingleAgentObservationPreprocessor):
    """Observations times two."""

    def preprocess(self, observation: Any, episode: Any) -> Any:
        """Return one observation, for RLlib."""
        return observation * 2.0

    def torch_forward(self, obs: Any) -> Any:
        """Return tensors with a leading batch axis, for the exporter, which compares the two."""
        return obs * 2.0


def connectors(env: Any = None, spaces: Any = None, device: Any = None) -> Scaled:
    """Return the connectors before RLlib's own; a checkpoint refers to this function by its name."""
    return Scaled()


gym.register("Reach-v0", "reach:Reach", max_episode_steps=100)
