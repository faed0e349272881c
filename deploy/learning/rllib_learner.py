"""RLlib's learner of a checkpoint without its algorithm: no environment, no runner, no running Ray.

An update takes whole episodes as the acting version's network saw them. The observation filter belongs to acting: its
statistics grow with the updates, and take effect in the next saved version.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.impala.impala_learner import IMPALALearner
from ray.rllib.connectors.env_to_module import EnvToModulePipeline
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.learner.learner import Learner
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME, NUM_ENV_STEPS_TRAINED_LIFETIME

from rlservo.deploy.learning.rllib_episodes import through_connectors
from rlservo.deploy.learning.rllib_replay import ReplayBuffer
from rlservo.errors import CheckpointError, RlservoError, UnsupportedError, UsageError, first_line
from rlservo.export.checkpoints.facts import read_facts
from rlservo.export.checkpoints.location import CTOR_FILE, CheckpointFiles, locate_checkpoint
from rlservo.export.checkpoints.unpickle import unpickle

ALGORITHMS = {"PPO": 1, "APPO": 3, "SAC": 10}
"""Default age of the oldest version that each learns from, in versions behind the newest: PPO clips the ratio to it,
APPO corrects with V-trace, SAC replays."""
LEARNER_GROUP = "learner_group"
MOST_ACTING = 16  # versions whose connectors are kept


class OnlineLearner:
    """A checkpoint's learner with its updates so far."""

    def __init__(self, start: Path, *, batch_size: int | None = None) -> None:
        """Restore the checkpoint `start`; `batch_size` is the number of steps per update; the checkpoint's by default.

        Raises CheckpointError, UnsupportedError and UsageError.
        """
        self._files = _files_of(start)
        algorithm, self._config = _config_of(self._files)
        self.max_age = ALGORITHMS[algorithm]
        """Default number of versions that may have followed the one that acted."""
        self._replay = ReplayBuffer(self._config) if algorithm == "SAC" else None
        self._epochs = _epochs(self._config)
        self.batch_size = batch_size or self._config.total_train_batch_size
        pipeline = self._pipeline(self._files.root)
        spaces = (pipeline.observation_space, pipeline.input_action_space)
        named: Any = {INPUT_ENV_SPACES: spaces, INPUT_ENV_SINGLE_SPACES: spaces, DEFAULT_MODULE_ID: spaces}
        try:
            self._group = self._config.build_learner_group(spaces=named)
        except Exception as error:  # the configuration may name third-party code
            raise CheckpointError(f"{start}: its learner cannot be built: {first_line(error)}") from error
        self._first_steps = read_facts(self._files.root, lambda _sentence: None).env_steps or 0
        self._acting = lru_cache(MOST_ACTING)(self._pipeline)
        self._env_to_module = pipeline
        self.restore(self._files.root)

    @property
    def replays(self) -> bool:
        """Whether episodes are learned from repeatedly."""
        return self._replay is not None

    @property
    def steps_wanted(self) -> int:
        """Number of steps of new episodes that the next update needs."""
        return max(self.batch_size, self._replay.missing if self._replay else 0)

    def remember(self, seen: Sequence[SingleAgentEpisode]) -> None:
        """Take back the episodes that were learned from before a restart."""
        if self._replay is not None:
            self._replay.add(seen)

    def restore(self, checkpoint: Path, forget: int = 0) -> None:
        """Continue from another checkpoint of this learner, without its newest `forget` episodes.

        Raises CheckpointError.
        """
        if self._replay is not None and forget:
            self._replay.forget(forget)
        try:
            self._group.restore_from_path(str(checkpoint.absolute() / LEARNER_GROUP))
        except Exception as error:  # a damaged file can raise any exception
            raise CheckpointError(f"{checkpoint} cannot be restored: {first_line(error)}") from error
        self._env_to_module = self._pipeline(checkpoint)

    def seen(self, episodes: Sequence[SingleAgentEpisode], acting: Path) -> list[SingleAgentEpisode]:
        """Return episodes as the network of the checkpoint `acting` saw them; its filter is not changed."""
        return through_connectors(episodes, self._acting(acting))

    def update(
        self, raw: Sequence[SingleAgentEpisode], seen: Sequence[SingleAgentEpisode], steps: int
    ) -> dict[str, float]:
        """Learn once from the episodes `seen` by networks; `raw` ones update the filter. Return losses by name.

        `steps` are the environment steps learned from before. Raises RlservoError with the cause.
        """
        new, replay = sum(map(len, seen)), self._replay
        if replay is not None:
            replay.add(seen)
        count = 1 if replay is None else replay.updates(new)
        found: Any = {}
        for number in range(count):
            at = self._first_steps + steps + new * number // count
            try:
                found = self._learn(list(seen) if replay is None else replay.draw(), at)
            except Exception as error:  # including the user's own learner or connectors
                raise RlservoError(f"learning failed: {first_line(error)}") from error
        through_connectors(raw, self._env_to_module, learn=True)
        return {name: float(np.asarray(found[name].peek())) for name in found if "loss" in name}

    def _learn(self, episodes: Any, at: int) -> Any:
        """Let RLlib's learner take a step at `at` environment steps; return its results."""
        config = cast(Any, self._config)

        def step(learner: Learner, *_: Any) -> Any:
            # APPO's own `update` passes a batch to a thread, which calls this method, and does not wait for it.
            update = Learner.update if isinstance(learner, IMPALALearner) else type(learner).update
            return update(
                learner,
                episodes=episodes,
                timesteps={NUM_ENV_STEPS_SAMPLED_LIFETIME: at, NUM_ENV_STEPS_TRAINED_LIFETIME: at},
                num_epochs=self._epochs,
                minibatch_size=config.minibatch_size,
                shuffle_batch_per_epoch=config.shuffle_batch_per_epoch,
            )

        (result,) = self._group.foreach_learner(step)
        found: Any = result.get()
        return found[DEFAULT_MODULE_ID]

    def save(self, folder: Path) -> None:
        """Write a checkpoint of the whole algorithm: RLlib can resume from it, and `rlservo export` accepts it.

        Its counters of iterations and environment steps are the first checkpoint's.
        """
        start = self._files
        for entry in start.root.iterdir():
            if entry.is_file():
                folder.mkdir(parents=True, exist_ok=True)
                shutil.copy2(entry, folder / entry.name)
        self._group.save_to_path(str(folder.absolute() / LEARNER_GROUP))
        runner = start.runner.relative_to(start.root)
        if runner.parts:
            shutil.copytree(start.runner, folder / runner)
        else:
            shutil.copytree(start.module_to_env, folder / start.module_to_env.name)
        place = folder.absolute() / start.env_to_module.relative_to(start.root)
        shutil.rmtree(place, ignore_errors=True)
        self._env_to_module.save_to_path(str(place), state=self._env_to_module.get_state())

    def _pipeline(self, checkpoint: Path) -> EnvToModulePipeline:
        place = checkpoint.absolute() / self._files.env_to_module.relative_to(self._files.root)
        try:
            return EnvToModulePipeline.from_checkpoint(str(place))
        except Exception as error:
            raise CheckpointError(f"{place} cannot be restored: {first_line(error)}") from error


def _files_of(checkpoint: Path) -> CheckpointFiles:
    files = locate_checkpoint(checkpoint)
    if not isinstance(files, CheckpointFiles) or not files.has_pipelines or files.is_one_of_several:
        raise UnsupportedError(
            f"{checkpoint}: expected a checkpoint of RLlib's new API stack, with one agent and its connectors"
        )
    if not (files.root / CTOR_FILE).is_file():
        raise UsageError(
            f"{checkpoint} was pruned, or is only a module: expected a whole checkpoint, with configuration and "
            "optimizer"
        )
    return files


def _epochs(config: Any) -> int:
    """Return how often a batch is learned from; for APPO including its buffer's repetitions."""
    rounds = config.circular_buffer_iterations_per_batch if getattr(config, "use_circular_buffer", False) else 1
    return int(config.num_epochs * rounds)


def _config_of(files: CheckpointFiles) -> tuple[str, AlgorithmConfig]:
    """Return the algorithm's name and configuration."""
    opened = unpickle(files.root / CTOR_FILE)
    algorithm = opened["class"]
    if algorithm.__name__ not in ALGORITHMS:
        raise UnsupportedError(
            f"{files.root} is a checkpoint of {algorithm.__name__}: online learning supports {', '.join(ALGORITHMS)}; "
            "examples/learn_from_recordings.py learns offline"
        )
    args, kwargs = opened["ctor_args_and_kwargs"]
    given = kwargs.get("config", args[0] if args else {})
    config = given if isinstance(given, AlgorithmConfig) else algorithm.get_default_config().from_state(given)
    config = config.copy(copy_frozen=False)
    config.learners(num_learners=0, num_gpus_per_learner=0)
    return algorithm.__name__, cast(AlgorithmConfig, config)
