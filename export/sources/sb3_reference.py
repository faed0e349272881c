"""Stable-Baselines3's own way to act: the loaded model's `predict` behind its own VecEnv wrappers.

Nothing here reads the recipe's steps: the framework's own checks decide where VecNormalize and VecFrameStack fit, and
its own `load` whether images are transposed and whether the spaces are the model's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
    is_vecenv_wrapped,
)

from rlservo.errors import CheckpointError, first_line
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.trees import Tree


class GivenObservations(VecEnv):
    """Environments that give the observations they are handed; an episode ends where the next one begins."""

    def __init__(self, rows: int, observation_space: Any, action_space: Any) -> None:
        super().__init__(rows, observation_space, action_space)
        self._obs: Tree = None
        self._begins = np.ones(rows, np.bool_)

    def hand(self, obs: Tree, begins: NDArray[np.bool_]) -> None:
        """Keep what the next reset or step gives."""
        self._obs, self._begins = obs, begins

    def reset(self) -> Any:
        return self._obs

    def step_async(self, actions: NDArray[Any]) -> None: ...

    def step_wait(self) -> Any:
        infos: list[dict[str, Any]] = [
            {"terminal_observation": _row(self._obs, row)} if begins else {} for row, begins in enumerate(self._begins)
        ]
        return self._obs, np.zeros(self.num_envs, np.float32), self._begins, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:  # noqa: ARG002  # it has none
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:  # noqa: ARG002
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002  # in none
        return [False] * self.num_envs


def _row(obs: Tree, row: int) -> Tree:
    return {key: value[row] for key, value in obs.items()} if isinstance(obs, dict) else obs[row]


@dataclass(frozen=True)
class Wrappers:
    """The wrappers that a model was trained behind, innermost first."""

    names: tuple[str, ...]
    statistics: Path | None
    frames: int

    def around(self, env: VecEnv) -> VecEnv:
        """Return the environment in the wrappers. Raises as they do if it does not fit."""
        for name in self.names:
            if name == "VecFrameStack":
                env = VecFrameStack(env, self.frames)
            elif name == "VecNormalize":
                normalized: Any = VecNormalize.load(str(self.statistics), env)
                normalized.training = False
                if not isinstance(normalized.observation_space, Space):  # saved with Gym, by Stable-Baselines3 1
                    normalized.observation_space = env.observation_space
                    normalized.action_space = env.action_space
                env = normalized
            else:
                env = VecTransposeImage(env)
        return env


def load_acting(
    file: Path,
    load: Callable[[VecEnv], Any],
    frame: Any,
    action_space: Any,
    statistics: Path | None,
    frames: int,
) -> tuple[Any, Wrappers]:
    """Return the model loaded with an environment of observations `frame` in its wrappers, and the wrappers.

    Raises CheckpointError if no order of the wrappers fits, with Stable-Baselines3's own reason.
    """
    named = [*(["VecNormalize"] if statistics else []), *(["VecFrameStack"] if frames > 1 else [])]
    reasons: list[str] = []
    for names in dict.fromkeys((tuple(named), tuple(reversed(named)))):
        wrappers = Wrappers(names, statistics, frames)
        try:
            env = wrappers.around(GivenObservations(1, frame, action_space))
        except Exception as error:  # its checks are assertions, and more
            reasons.append(f"{' below '.join(names)}: {first_line(error)}")
            continue
        model = load(env)
        if is_vecenv_wrapped(model.get_env(), VecTransposeImage):
            wrappers = Wrappers((*names, "VecTransposeImage"), statistics, frames)
        return model, wrappers
    raise CheckpointError(f"{file}: Stable-Baselines3's own wrappers do not fit the model ({'; '.join(reasons)})")


class PredictLoop:
    """`predict(deterministic=True)` on what the wrapped environment gives, step after step."""

    def __init__(
        self,
        model: Any,
        wrappers: Wrappers,
        frame: Any,
        read: Callable[[Inputs], tuple[Tree, NDArray[Any] | None]],
        score: Callable[[NDArray[Any] | None], NDArray[Any]],
        names: Sequence[str],
        recurrent: Sequence[str],
    ) -> None:
        """`read` gives observations and action masks, `score` the named numbers of the last prediction."""
        self._model, self._wrappers, self._frame = model, wrappers, frame
        self._read, self._score = read, score
        self._names, self._recurrent = names, recurrent
        self._given: GivenObservations | None = None
        self._env: VecEnv | None = None
        self._state: Any = None

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return what the model predicts for one step of every row, by output name."""
        model, space = self._model, self._model.action_space
        frame, mask = self._read(inputs)
        obs = self._observe(frame, restart)
        how: dict[str, Any] = {} if mask is None else {"action_masks": mask}
        if self._recurrent:
            how |= {"state": self._state, "episode_start": restart}
        actions, self._state = model.predict(obs, deterministic=True, **how)
        outputs = {"action": actions if isinstance(space, Box) else actions.astype(np.int64)}
        for name in self._names:
            if name != "value":
                outputs[name] = self._score(mask)
                continue
            with torch.no_grad():
                values = model.policy.predict_values(model.policy.obs_to_tensor(obs)[0])
            outputs[name] = values.squeeze(-1).numpy()
        for name, values in zip(self._recurrent, self._state or (), strict=False):
            outputs[f"state_out.{name}"] = np.swapaxes(values, 0, 1)
        return outputs

    def _observe(self, frame: Tree, restart: NDArray[np.bool_]) -> Tree:
        """Return the model's observation of the frames; rows in `restart` begin an episode."""
        if self._env is None or self._given is None:
            self._given = GivenObservations(len(restart), self._frame, self._model.action_space)
            self._env = self._wrappers.around(self._given)
            self._given.hand(frame, restart)
            return self._env.reset()
        self._given.hand(frame, restart)
        return self._env.step(np.zeros(len(restart)))[0]
