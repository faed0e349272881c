"""Folder of the connectors that RLlib itself would restore, by the algorithm's configuration and RLlib's own list.

The parity gate's reference reads its statistics from there; `CheckpointFiles.runner` finds its own by file names.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rlservo.export.checkpoints.facts import read_config
from rlservo.export.checkpoints.location import CTOR_FILE, ENV_TO_MODULE, TRAINING_RUNNER, CheckpointFiles
from rlservo.export.checkpoints.unpickle import unpickle_plain
from rlservo.export.contract.errors import CheckpointError

DECISIVE = ("_is_online", "create_local_env_runner", "num_env_runners")
"""The settings that decide which environment runners an algorithm has (ray 2.60)."""


def connectors_that_rllib_restores(files: CheckpointFiles) -> Path:
    """Return the folder of training's pipelines.

    It is the one found by name if RLlib restores none (recorded data) or the checkpoint has no configuration. Raises
    CheckpointError if RLlib's folder is missing: other pipelines that exist are not the policy's.
    """
    file = files.root / CTOR_FILE
    saved = read_config(unpickle_plain(file).get("ctor_args_and_kwargs")) if file.is_file() else {}
    if any(name not in saved for name in DECISIVE):  # a pruned copy has one folder, and so had an earlier Ray's
        return files.runner
    # Here and not at the top: they import every algorithm, which a pruned copy does without.
    from ray.rllib.algorithms.algorithm import Algorithm
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

    config: Any = AlgorithmConfig.from_state({"class": AlgorithmConfig, **{name: saved[name] for name in DECISIVE}})
    has_local_runner = config.create_local_env_runner or config.num_env_runners == 0
    built: Any = SimpleNamespace(
        config=config,
        learner_group=None,
        env_runner=True if has_local_runner else None,
        eval_env_runner=None,
        env_to_module_connector=True,
        module_to_env_connector=True,
    )
    places = {TRAINING_RUNNER: files.root / TRAINING_RUNNER, ENV_TO_MODULE: files.root}
    named = [places[name] for name, _ in Algorithm.get_checkpointable_components(built) if name in places]
    folder = named[0] if named else files.runner
    if not (folder / ENV_TO_MODULE).is_dir():
        raise CheckpointError(
            f"{files.root} is incomplete: RLlib would restore the connectors from {folder.name}/, which has none, and "
            f"those in {files.runner.name}/ are not training's"
        )
    return folder
