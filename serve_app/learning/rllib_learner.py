"""RLlib's learner of a checkpoint, without its algorithm: no environment, no runner, no Ray that is started.

An update takes whole episodes as the acting version's network saw them. The observation filter belongs to acting: its
statistics grow with the updates, and act from the next saved version on.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.connectors.env_to_module import EnvToModulePipeline
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME

from rlservo.export.checkpoints.facts import read_facts
from rlservo.export.checkpoints.location import CTOR_FILE, CheckpointFiles, locate_checkpoint
from rlservo.export.checkpoints.unpickle import unpickle
from rlservo.export.contract.errors import CheckpointError, RlservoError, UnsupportedError, UsageError, first_line
from rlservo.serve_app.learning.rllib_episodes import through_connectors

ALGORITHMS = ("PPO",)
LEARNER_GROUP = "learner_group"


class OnlineLearner:
    """The learner after the updates so far."""

    def __init__(self, start: Path, *, batch_size: int | None = None) -> None:
        """Restore the checkpoint `start`; `batch_size` is the steps of an update, else the checkpoint's own.

        Raises CheckpointError, UnsupportedError and UsageError.
        """
        self._files = _files_of(start)
        self._config = _config_of(self._files)
        self.batch_size = batch_size or self._config.total_train_batch_size
        pipeline = self._pipeline(self._files.root)
        spaces = (pipeline.observation_space, pipeline.input_action_space)
        named: Any = {INPUT_ENV_SPACES: spaces, INPUT_ENV_SINGLE_SPACES: spaces, DEFAULT_MODULE_ID: spaces}
        try:
            self._group = self._config.build_learner_group(spaces=named)
        except Exception as error:  # the configuration may name anyone's code
            raise CheckpointError(f"{start}: its learner cannot be built: {first_line(error)}") from error
        self._first_steps = read_facts(self._files.root, lambda _sentence: None).env_steps or 0
        self._acting: dict[Path, EnvToModulePipeline] = {}
        self._env_to_module = pipeline
        self.restore(self._files.root)

    def restore(self, checkpoint: Path) -> None:
        """Continue from another checkpoint of this learner. Raises CheckpointError."""
        try:
            self._group.restore_from_path(str(checkpoint.absolute() / LEARNER_GROUP))
        except Exception as error:  # a damaged file raises almost anything
            raise CheckpointError(f"{checkpoint} cannot be restored: {first_line(error)}") from error
        self._env_to_module = self._pipeline(checkpoint)

    def seen(self, episodes: Sequence[SingleAgentEpisode], acting: Path) -> list[SingleAgentEpisode]:
        """Return episodes as the network of the checkpoint `acting` saw them; its filter stays as it is."""
        if acting not in self._acting:
            self._acting[acting] = self._pipeline(acting)
        return through_connectors(episodes, self._acting[acting])

    def forget(self, acting: Path) -> None:
        """Forget the connectors of a version that is too old to learn from."""
        self._acting.pop(acting, None)

    def update(
        self, raw: Sequence[SingleAgentEpisode], seen: Sequence[SingleAgentEpisode], steps: int
    ) -> dict[str, float]:
        """Learn once from episodes as networks `seen` them; `raw` ones feed the filter. Return losses by name.

        `steps` are the environment steps learned from before. Raises RlservoError with the cause.
        """
        config = cast(Any, self._config)
        try:
            results = self._group.update(
                episodes=list(seen),
                timesteps={NUM_ENV_STEPS_SAMPLED_LIFETIME: self._first_steps + steps},
                num_epochs=config.num_epochs,
                minibatch_size=config.minibatch_size,
                shuffle_batch_per_epoch=config.shuffle_batch_per_epoch,
            )
        except Exception as error:  # the user's own learner or connectors among it
            raise RlservoError(f"learning failed: {first_line(error)}") from error
        through_connectors(raw, self._env_to_module, learn=True)
        found = results[0][DEFAULT_MODULE_ID]
        return {name: float(np.asarray(found[name].peek())) for name in found if "loss" in name}

    def save(self, folder: Path) -> None:
        """Write a checkpoint of the whole algorithm: RLlib trains on from it, and `rlservo export` takes it.

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
            f"{checkpoint}: expected a checkpoint of RLlib's new API stack, of one agent, with its connectors"
        )
    if not (files.root / CTOR_FILE).is_file():
        raise UsageError(
            f"{checkpoint} was pruned, or is a module alone: learning continues from a whole checkpoint, with its "
            "configuration and its optimizer"
        )
    return files


def _config_of(files: CheckpointFiles) -> AlgorithmConfig:
    opened = unpickle(files.root / CTOR_FILE)
    algorithm = opened["class"]
    if algorithm.__name__ not in ALGORITHMS:
        raise UnsupportedError(
            f"{files.root} is of {algorithm.__name__}: online learning supports {', '.join(ALGORITHMS)}; "
            "examples/learn_from_recordings.py learns offline"
        )
    args, kwargs = opened["ctor_args_and_kwargs"]
    given = kwargs.get("config", args[0] if args else {})
    config = given if isinstance(given, AlgorithmConfig) else algorithm.get_default_config().from_state(given)
    config = config.copy(copy_frozen=False)
    config.learners(num_learners=0, num_gpus_per_learner=0)
    return cast(AlgorithmConfig, config)
