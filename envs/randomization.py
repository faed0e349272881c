"""Domain randomisation: latency, noise, payload and model errors, drawn for each episode.

A wrapper for every Gymnasium environment: delays and losses work with any, noise needs a vector of numbers, the rest an
environment of this package or one with the methods in `disturbances.py`.
"""

from __future__ import annotations

import copy
import inspect
import math
import pkgutil
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.environment_id import plain_id
from rlservo.robots.disturbable import (
    MAX_MODEL_ERROR,
    CarriesPayload,
    Extreme,
    HasBaseOffset,
    HasExtremes,
    HasModelError,
    HasRobotModels,
    HasSensorErrors,
)

Range = tuple[float, float]
Array = NDArray[np.float32]
Vector = NDArray[np.float64]
ByElement = float | Sequence[float] | Mapping[str, float] | str

RANDOMIZED = "rlservo/Randomized-v0"
REAL = "real"
# Random streams of their own, so that asking for one disturbance changes no other's draws; only append.
STREAMS = ("model", "base", "extreme", "bias", "stuck", "drop", "late", "robot")
EXTREMES: tuple[Extreme, ...] = ("target", "start")


class DomainRandomization(gym.Wrapper[Any, Any, Any, Any]):
    """Delay and drop messages, disturb observations, and let the robot differ from its model.

    | argument | what is drawn | drawn at | unit |
    |---|---|---|---|
    | `action_latency` | how late an action takes effect, uniformly in a range | reset | control cycles |
    | `observation_latency` | how old an observation is, uniformly in a range | reset | control cycles |
    | `late_observations` | how much later each observation arrives, uniformly in a range | step | control cycles |
    | `dropped_observations` | the share of observations that never arrive, uniformly in a range | reset | 1 |
    | `observation_noise` | normal noise of this standard deviation | step | the element's |
    | `observation_bias` | a constant error, uniform between minus and plus this | reset | the element's |
    | `stuck_sensor` | an element that keeps its first value: its name, or "any" for one that is drawn | reset | |
    | `payload` | a point mass at the tool that the arm does not know of, uniformly in a range | reset | kg |
    | `model_error` | by how much masses, inertias, gains, friction and velocities may differ: 0.05 is 5% | reset | 1 |
    | `base_offset` | how far from its believed place the robot stands, in any direction, in a range | reset | m |
    | `robot_models` | which robot it is, of these models (named twice: twice as often) | reset | |
    | `extreme` | "target": a target out of reach; "start": the robot in a corner | reset | |

    `observation_noise` and `observation_bias` are one number for all elements, one each, a mapping by element name, or
    "real" for what the environment's `sensor_errors` states of real sensors, each element in its own unit ("2*real"
    for twice as much). The figures and their sources are in `ur/sensor_errors.py`, `mir100/sensor_errors.py`
    and the `draw_model_error` of the two simulations. Only UR arms carry a payload. An arm whose base stands elsewhere
    gets wrong positions of targets and objects; a mobile robot whose localisation is off, of the target.

    Until the first delayed action takes effect the robot repeats the first action of the episode. Until there is an old
    observation the first one is given. While observations are late or lost, the newest that has arrived is given again.
    Noisy observations are clipped to the space. Rewards and endings are judged on what really happened.

    `reset(seed=...)` seeds the environment and this wrapper; the same seed and actions give the same episode, and one
    disturbance more does not change what the others draw. The drawn values are in `info["randomization"]` from `reset`.
    Without arguments the wrapper changes nothing. Options given to `reset` take precedence over those of `extreme`.

    Raises ValueError for a range that is empty or negative, errors that do not fit the observation, and what the
    environment cannot do.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        action_latency: tuple[int, int] = (0, 0),
        observation_latency: tuple[int, int] = (0, 0),
        late_observations: tuple[int, int] = (0, 0),
        dropped_observations: Range = (0.0, 0.0),
        observation_noise: ByElement = 0.0,
        observation_bias: ByElement = 0.0,
        stuck_sensor: str | None = None,
        payload: Range = (0.0, 0.0),
        model_error: float = 0.0,
        base_offset: Range = (0.0, 0.0),
        robot_models: Sequence[str] = (),
        extreme: Extreme | None = None,
    ) -> None:
        super().__init__(env)
        self._action_latency = _cycles("action_latency", action_latency)
        self._observation_latency = _cycles("observation_latency", observation_latency)
        self._late = _cycles("late_observations", late_observations)
        self._dropped = _range("dropped_observations", dropped_observations)
        if self._dropped[1] >= 1.0:
            raise ValueError(f"dropped_observations is {tuple(dropped_observations)}: expected shares below 1")
        self._noise = self._by_element("observation_noise", observation_noise)
        self._bias = self._by_element("observation_bias", observation_bias)
        self._stuck_sensor = stuck_sensor
        self._stuck_candidates = [] if stuck_sensor is None else self._stuck_indices(stuck_sensor)
        self._payload = _range("payload", payload)
        self._base_offset = _range("base_offset", base_offset)
        if not 0.0 <= model_error <= MAX_MODEL_ERROR:
            raise ValueError(f"model_error is {model_error:g}: expected 0 to {MAX_MODEL_ERROR:g}")
        self._model_error = model_error
        if extreme is not None and extreme not in EXTREMES:
            raise ValueError(f"extreme is {extreme!r}: expected {' or '.join(EXTREMES)}")
        self._extreme: Extreme | None = extreme
        if isinstance(robot_models, str):
            raise ValueError(f"robot_models is {robot_models!r}: expected a list of names")
        self._robot_models = tuple(robot_models)
        self._check_environment()
        for model in self._robot_models or (None,):
            if model is not None:
                self._set_robot_model(model)
            if isinstance(self._robot, HasModelError):  # another wrapper may have changed it
                self._robot.draw_model_error(0.0, np.random.default_rng())
        if isinstance(env.unwrapped, HasBaseOffset):
            env.unwrapped.set_base_offset((0.0, 0.0))

        self._rng = np.random.default_rng()
        self._streams = {kind: np.random.default_rng() for kind in STREAMS}
        self._actions: deque[Any] = deque()
        self._observations: deque[Any] = deque()
        self._in_flight: list[tuple[int, Any]] = []  # (the step at which it arrives, the observation), oldest first
        self._last_seen: Any = None
        self._delay = 0
        self._steps = 0
        self._drop_share = 0.0
        self._constant_error: Vector | None = None
        self._stuck: tuple[int, float] | None = None  # an element's index and the value it keeps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the episode's values, and start it."""
        if seed is not None:
            # Not the environment's own stream: its episodes stay what they are without this wrapper.
            self._rng = np.random.default_rng([seed, 1])
            self._streams = {kind: np.random.default_rng([seed, 2 + i]) for i, kind in enumerate(STREAMS)}
        draws: dict[str, Any] = {}
        if self._robot_models:
            draws["robot_model"] = str(self._streams["robot"].choice(self._robot_models))
            self._set_robot_model(draws["robot_model"])
        self._delay = int(self._rng.integers(*self._action_latency, endpoint=True))
        age = int(self._rng.integers(*self._observation_latency, endpoint=True))
        mass = float(self._rng.uniform(*self._payload))
        if isinstance(self._robot, CarriesPayload):
            self._robot.set_payload(mass)
        draws |= {"action_latency": self._delay, "observation_latency": age, "payload": mass}
        draws |= self._draw_model()
        if self._extreme is not None:
            assert isinstance(self.env.unwrapped, HasExtremes)
            extreme = self.env.unwrapped.extreme_options(self._extreme, self._streams["extreme"])
            options = {**extreme, **(options or {})}
            draws["extreme"] = self._extreme
        observation, info = self.env.reset(seed=seed, options=options)
        draws |= self._draw_sensors()
        self._steps = 0
        self._actions = deque()
        self._observations = deque([self._kept(observation)] * (age + 1), maxlen=age + 1)
        first = self._sensed(observation)
        if self._stuck_candidates:
            index = int(self._streams["stuck"].choice(self._stuck_candidates))
            self._stuck = (index, float(first[index]))
            names = self._element_names()
            draws["stuck_sensor"] = names[index] if names else index
        self._in_flight, self._last_seen = [], first
        return first, {**info, "randomization": draws}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Give the environment the action of some cycles ago, and return the newest observation that has arrived."""
        if self._delay:
            action = copy.deepcopy(action)  # the caller may write into it before it takes effect
        if not self._actions:
            self._actions.extend([action] * self._delay)
        self._actions.append(action)
        observation, reward, terminated, truncated, info = self.env.step(self._actions.popleft())
        self._steps += 1
        self._observations.append(self._kept(observation))
        return self._arrived(self._sensed(self._observations[0])), reward, terminated, truncated, info

    # -- once an episode

    def _set_robot_model(self, model: str) -> None:
        assert isinstance(self.env.unwrapped, HasRobotModels)
        self.env.unwrapped.set_robot_model(model)

    def _draw_model(self) -> dict[str, Any]:
        draws: dict[str, Any] = {}
        if self._model_error > 0.0:
            assert isinstance(self._robot, HasModelError)
            draws["model_error"] = self._robot.draw_model_error(self._model_error, self._streams["model"])
        if self._base_offset[1] > 0.0:
            env = self.env.unwrapped
            assert isinstance(env, HasBaseOffset)
            distance = float(self._streams["base"].uniform(*self._base_offset))
            direction = float(self._streams["base"].uniform(-math.pi, math.pi))
            offset = (distance * math.cos(direction), distance * math.sin(direction))
            env.set_base_offset(offset)
            draws["base_offset"] = list(offset)
        return draws

    def _draw_sensors(self) -> dict[str, Any]:
        draws: dict[str, Any] = {}
        self._constant_error, self._stuck, self._drop_share = None, None, 0.0
        if self._bias is not None:
            self._constant_error = self._bias * self._streams["bias"].uniform(-1.0, 1.0, self._bias.shape)
            draws["observation_bias"] = self._constant_error.tolist()
        if self._dropped[1] > 0.0:
            self._drop_share = draws["dropped_observations"] = float(self._streams["drop"].uniform(*self._dropped))
        return draws

    # -- each step

    def _sensed(self, observation: Any) -> Any:
        """Return the observation with the sensors' errors."""
        if self._noise is None and self._constant_error is None and self._stuck is None:
            return observation
        sensed: Vector = np.asarray(observation, dtype=np.float64)
        if self._noise is not None:
            sensed = sensed + self._noise * self._rng.standard_normal(observation.shape)
        if self._constant_error is not None:
            sensed = sensed + self._constant_error
        space = self.observation_space
        assert isinstance(space, gym.spaces.Box)
        clipped = np.clip(sensed, space.low, space.high).astype(observation.dtype)
        if self._stuck is not None:
            index, value = self._stuck
            clipped[index] = value
        return clipped

    def _arrived(self, observation: Any) -> Any:
        """Send the observation and return the newest that has arrived by now."""
        if self._late[1] == 0 and self._dropped[1] == 0.0:
            return observation
        is_lost = float(self._streams["drop"].uniform()) < self._drop_share
        arrives = self._steps + int(self._streams["late"].integers(*self._late, endpoint=True))
        if not is_lost:
            self._in_flight.append((arrives, observation))
        for number in reversed(range(len(self._in_flight))):
            if self._in_flight[number][0] <= self._steps:
                self._last_seen = self._in_flight[number][1]
                del self._in_flight[: number + 1]  # those sent before it are obsolete
                break
        return self._last_seen

    def _kept(self, observation: Any) -> Any:
        """Return an observation that the environment cannot overwrite, if it is needed later."""
        is_kept = self._observation_latency[1] or self._late[1] or self._dropped[1]
        return copy.deepcopy(observation) if is_kept else observation

    # -- what the environment offers

    @property
    def _robot(self) -> Any:
        return getattr(self.env.unwrapped, "robot", None)

    def _check_environment(self) -> None:
        env = self.env.unwrapped
        name = type(env).__name__
        if self._payload[1] > 0.0 and not isinstance(self._robot, CarriesPayload):
            raise ValueError(f"payload is {self._payload}: {name} has no simulation that carries one")
        if self._model_error > 0.0 and not isinstance(self._robot, HasModelError):
            raise ValueError(f"model_error is {self._model_error:g}: {name} has no simulation with draw_model_error")
        if self._base_offset[1] > 0.0 and not isinstance(env, HasBaseOffset):
            raise ValueError(f"base_offset is {self._base_offset}: {name} has no set_base_offset")
        if self._robot_models and not isinstance(env, HasRobotModels):
            raise ValueError(f"robot_models is {self._robot_models}: {name} has no set_robot_model")
        if self._extreme is not None and not isinstance(env, HasExtremes):
            raise ValueError(f"extreme is {self._extreme!r}: {name} has no extreme_options")

    def _element_names(self) -> list[str]:
        describe = getattr(self.env.unwrapped, "describe", None)
        return [element["name"] for element in describe()["observation"]] if describe else []

    def _element_count(self, name: str, value: object) -> int:
        space = self.observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"{name} is {value!r}: the observation space is {space}, expected a one-dimensional Box")
        return space.shape[0]

    def _by_element(self, name: str, value: ByElement) -> Vector | None:
        """Return one number for each element; None where all are zero."""
        if isinstance(value, (int, float)) and value == 0.0:
            return None
        size = self._element_count(name, value)
        if isinstance(value, str):
            errors = self._by_name(name, self._real_errors(name, value))
        elif isinstance(value, Mapping):
            errors = self._by_name(name, value)
        else:
            errors = np.asarray(value, dtype=np.float64)
            errors = np.full(size, float(errors)) if errors.ndim == 0 else errors
        if errors.shape != (size,):
            raise ValueError(f"{name} has shape {errors.shape}, expected one number or {size}")
        if not (np.isfinite(errors).all() and (errors >= 0.0).all()):
            what = "standard deviation" if name == "observation_noise" else "size"
            raise ValueError(f"{name} has a negative or infinite {what}")
        return errors if errors.any() else None

    def _by_name(self, name: str, value: Mapping[str, float]) -> Vector:
        names = self._element_names()
        unknown = [element for element in value if element not in names]
        if unknown:
            raise ValueError(f"{name} names {', '.join(unknown)}: expected some of {', '.join(names) or 'no names'}")
        return np.array([value.get(element, 0.0) for element in names], dtype=np.float64)

    def _real_errors(self, name: str, value: str) -> dict[str, float]:
        factor, star, word = value.rpartition("*")
        try:
            scale = float(factor) if star else 1.0
        except ValueError:
            scale = -1.0
        if word != REAL or not (math.isfinite(scale) and scale >= 0.0):
            raise ValueError(f"{name} is {value!r}: expected numbers, {REAL!r} or a multiple such as '2*{REAL}'")
        env = self.env.unwrapped
        if not isinstance(env, HasSensorErrors):
            raise ValueError(
                f"{name} is {value!r}: {type(env).__name__} does not state its sensors' errors (sensor_errors)"
            )
        errors = env.sensor_errors()
        attribute = "noise" if name == "observation_noise" else "bias"
        return {element: scale * float(getattr(error, attribute)) for element, error in errors.items()}

    def _stuck_indices(self, sensor: str) -> list[int]:
        count, names = self._element_count("stuck_sensor", sensor), self._element_names()
        if sensor == "any":
            return list(range(count))
        if sensor not in names:
            raise ValueError(f"stuck_sensor is {sensor!r}: expected any or one of {', '.join(names) or 'no names'}")
        return [names.index(sensor)]


def make_randomized(
    *,
    env_id: str,
    action_latency: tuple[int, int] = (0, 0),
    observation_latency: tuple[int, int] = (0, 0),
    late_observations: tuple[int, int] = (0, 0),
    dropped_observations: Range = (0.0, 0.0),
    observation_noise: ByElement = 0.0,
    observation_bias: ByElement = 0.0,
    stuck_sensor: str | None = None,
    payload: Range = (0.0, 0.0),
    model_error: float = 0.0,
    base_offset: Range = (0.0, 0.0),
    robot_models: Sequence[str] = (),
    extreme: Extreme | None = None,
    **arguments: Any,
) -> DomainRandomization:
    """Make `env_id` with `arguments` and wrap it: `rlservo/Randomized-v0`, for programs that make environments by id.

    Raises what `gymnasium.make` and `DomainRandomization` raise.
    """
    env: gym.Env[Any, Any] = gym.make(env_id, disable_env_checker=True, **arguments)
    return DomainRandomization(
        env,
        action_latency=action_latency,
        observation_latency=observation_latency,
        late_observations=late_observations,
        dropped_observations=dropped_observations,
        observation_noise=observation_noise,
        observation_bias=observation_bias,
        stuck_sensor=stuck_sensor,
        payload=payload,
        model_error=model_error,
        base_offset=base_offset,
        robot_models=robot_models,
        extreme=extreme,
    )


def wrapped_env(env_id: str, env_config: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return id and arguments of an environment without the disturbances that `rlservo/Randomized-v0` adds to it."""
    if env_id != RANDOMIZED or "env_id" not in env_config:
        return env_id, dict(env_config)
    own = inspect.signature(make_randomized).parameters
    return env_config["env_id"], {name: value for name, value in env_config.items() if name not in own}


def _describe(**env_config: Any) -> Any:
    """Name the elements of the wrapped environment."""
    entry_point = gym.spec(plain_id(env_config["env_id"])).entry_point
    made_by = pkgutil.resolve_name(entry_point) if isinstance(entry_point, str) else entry_point
    describe = getattr(made_by, "describe", None)
    return describe(**wrapped_env(RANDOMIZED, env_config)[1]) if describe else {}


make_randomized.describe = _describe  # type: ignore[attr-defined]  # `rlservo export` looks here for names and units


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
