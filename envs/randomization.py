"""Domain randomisation: what a real robot adds to a simulator, drawn anew for each episode.

A wrapper for every environment of this package; payload needs a simulation with `set_payload`, as the UR arms' have.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

Range = tuple[float, float]
Array = NDArray[np.float32]


@runtime_checkable
class _CarriesPayload(Protocol):
    def set_payload(self, mass: float) -> None: ...


class DomainRandomization(gym.Wrapper[Array, Array, Array, Array]):
    """Delay actions and observations, add noise to observations, and hang a load on the arm.

    | argument | what is drawn | drawn at | unit |
    |---|---|---|---|
    | `action_latency` | how late an action takes effect, uniformly in a range | reset | control cycles |
    | `observation_latency` | how old an observation is, uniformly in a range | reset | control cycles |
    | `observation_noise` | normal noise of this standard deviation | step | the element's |
    | `payload` | a point mass at the tool that the arm does not know of, uniformly in a range | reset | kg |

    `observation_noise` is one number for all elements, one each, or a mapping by element name. Only UR arms carry a
    payload.

    Until the first delayed action takes effect the robot does nothing new: the first action of the episode is what it
    repeats. Until there is an old observation the first one is given. Noisy observations are clipped to the space.
    Rewards and endings are judged on what really happened.

    `reset(seed=...)` seeds the environment and this wrapper; the same seed and actions give the same episode. What was
    drawn is in `info["randomization"]` of `reset`. With nothing asked for the wrapper changes nothing.

    Raises ValueError for a range that is empty or negative, noise that does not fit the observation, and a payload for
    a robot that carries none.
    """

    def __init__(
        self,
        env: gym.Env[Array, Array],
        *,
        action_latency: tuple[int, int] = (0, 0),
        observation_latency: tuple[int, int] = (0, 0),
        observation_noise: float | Sequence[float] | Mapping[str, float] = 0.0,
        payload: Range = (0.0, 0.0),
    ) -> None:
        super().__init__(env)
        self._action_latency = _cycles("action_latency", action_latency)
        self._observation_latency = _cycles("observation_latency", observation_latency)
        self._payload = _range("payload", payload)
        self._noise = self._standard_deviations(observation_noise)
        self._simulation = getattr(env.unwrapped, "simulation", None)
        if self._payload[1] > 0.0 and not isinstance(self._simulation, _CarriesPayload):
            raise ValueError(f"payload is {payload}: {type(env.unwrapped).__name__} has no simulation that carries one")
        self._rng = np.random.default_rng()
        self._actions: deque[Array] = deque()
        self._observations: deque[Array] = deque()
        self._delay = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Draw what is drawn once an episode, and start it."""
        if seed is not None:
            # Not the environment's own stream: its episodes stay what they are without this wrapper.
            self._rng = np.random.default_rng([seed, 1])
        self._delay = int(self._rng.integers(*self._action_latency, endpoint=True))
        age = int(self._rng.integers(*self._observation_latency, endpoint=True))
        mass = float(self._rng.uniform(*self._payload))
        if isinstance(self._simulation, _CarriesPayload):
            self._simulation.set_payload(mass)
        observation, info = self.env.reset(seed=seed, options=options)
        self._actions = deque()
        self._observations = deque([observation] * (age + 1), maxlen=age + 1)
        draws = {"action_latency": self._delay, "observation_latency": age, "payload": mass}
        return self._next_observation(), {**info, "randomization": draws}

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Give the environment the action of some cycles ago, and return what is seen by now."""
        if not self._actions:
            self._actions.extend([action] * self._delay)
        self._actions.append(action)
        observation, reward, terminated, truncated, info = self.env.step(self._actions.popleft())
        self._observations.append(observation)
        return self._next_observation(), reward, terminated, truncated, info

    def _next_observation(self) -> Array:
        observation = self._observations[0]
        if not self._noise.any():
            return observation
        noisy = observation + self._noise * self._rng.standard_normal(observation.shape)
        space = self.observation_space
        assert isinstance(space, gym.spaces.Box)
        return np.clip(noisy, space.low, space.high).astype(observation.dtype)

    def _standard_deviations(self, value: float | Sequence[float] | Mapping[str, float]) -> NDArray[np.float64]:
        space = self.observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"the observation space is {space}: expected a Box of one dimension")
        size = space.shape[0]
        if isinstance(value, Mapping):
            describe = getattr(self.env.unwrapped, "describe", None)
            names = [element["name"] for element in describe()["observation"]] if describe else []
            unknown = [name for name in value if name not in names]
            if unknown:
                raise ValueError(
                    f"observation_noise names {', '.join(unknown)}: expected some of {', '.join(names) or 'no names'}"
                )
            noise = np.array([value.get(name, 0.0) for name in names], dtype=np.float64)
        else:
            noise = np.asarray(value, dtype=np.float64)
            noise = np.full(size, float(noise)) if noise.ndim == 0 else noise
        if noise.shape != (size,):
            raise ValueError(f"observation_noise has shape {noise.shape}, expected one number or {size}")
        if not (np.isfinite(noise).all() and (noise >= 0.0).all()):
            raise ValueError("observation_noise has a negative or infinite standard deviation")
        return noise


def make_randomized(
    *,
    env_id: str,
    action_latency: tuple[int, int] = (0, 0),
    observation_latency: tuple[int, int] = (0, 0),
    observation_noise: float | Sequence[float] | Mapping[str, float] = 0.0,
    payload: Range = (0.0, 0.0),
    **arguments: Any,
) -> DomainRandomization:
    """Make `env_id` with `arguments` and wrap it: `rlservo/Randomized-v0`, for programs that make environments by id.

    Raises what `gymnasium.make` and `DomainRandomization` raise.
    """
    env: gym.Env[Array, Array] = gym.make(env_id, disable_env_checker=True, **arguments)
    return DomainRandomization(
        env,
        action_latency=action_latency,
        observation_latency=observation_latency,
        observation_noise=observation_noise,
        payload=payload,
    )


def _range(name: str, value: Range) -> Range:
    low, high = value
    if not (math.isfinite(low) and math.isfinite(high) and 0.0 <= low <= high):
        raise ValueError(f"{name} is {tuple(value)}: expected (low, high) with 0 <= low <= high")
    return float(low), float(high)


def _cycles(name: str, value: tuple[int, int]) -> tuple[int, int]:
    low, high = _range(name, value)
    if low != int(low) or high != int(high):
        raise ValueError(f"{name} is {tuple(value)}: expected whole control cycles")
    return int(low), int(high)
