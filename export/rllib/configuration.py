"""The algorithm's configuration, and the connector pipelines that RLlib itself builds from it when it restores.

RLlib's `Algorithm.setup` builds the pipelines by the configuration's own functions, and `restore_from_path` then sets
the saved state (ray 2.60). The parity gate's reference does the same. The recipe instead reads the list of classes and
arguments that RLlib saves beside the state, in a folder that `CheckpointFiles.runner` finds by name.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from ray.rllib.connectors.common.numpy_to_tensor import NumpyToTensor
from ray.rllib.connectors.env_to_module.mean_std_filter import MeanStdFilter
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES

from rlservo.errors import CheckpointError, UnsupportedError, first_line
from rlservo.export.checkpoints.facts import read_config
from rlservo.export.checkpoints.location import (
    CTOR_FILE,
    ENV_TO_MODULE,
    EVALUATION_RUNNER,
    MODULE_TO_ENV,
    TRAINING_RUNNER,
    CheckpointFiles,
)
from rlservo.export.checkpoints.unpickle import explain, unpickle_present
from rlservo.export.rllib import private_names

HOOKS = (
    "on_algorithm_init", "on_checkpoint_loaded", "on_environment_created", "on_env_runners_recreated",
    "on_episode_created", "on_episode_start", "on_episode_step", "on_episode_end", "on_sample_end",
)  # fmt: skip
"""Callbacks that RLlib gives the module or the connectors that act."""


def read_algorithm_config(files: CheckpointFiles) -> Any | None:
    """Return the checkpoint's `AlgorithmConfig`; None if it holds none.

    Code that cannot be imported is left out, and raises when a connector needs it. Raises CheckpointError if the
    configuration itself cannot be read.
    """
    file = files.root / CTOR_FILE
    if files.alone or not file.is_file():
        return None
    opened = unpickle_present(file)
    given = opened.get("ctor_args_and_kwargs") if isinstance(opened, dict) else None
    if not (saved := dict(read_config(given))):
        return None
    # Here and not at the top: it imports every algorithm, which a pruned copy does without.
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

    kind = saved.setdefault("class", AlgorithmConfig)
    try:
        return AlgorithmConfig.from_state(saved)
    except Exception as error:  # a class of the user's own
        raise CheckpointError(f"{file}: the configuration {kind.__name__} cannot be made: {explain(error)}") from error


def check_own_code(files: CheckpointFiles, config: Any, notify: Callable[[str], None]) -> None:
    """Name the user's own code that RLlib runs beside module and connectors, which no comparison includes.

    Raises UnsupportedError for an env runner of the user's own, whose steps are the policy's.
    """
    if (runner := config.env_runner_cls) is not None and not _is_known(runner):
        raise UnsupportedError(
            f"{files.root}: its env runner is {runner.__module__}.{runner.__name__}, and only the steps of RLlib's "
            "own env runners are exported: put your own steps into connectors, or into the module"
        )
    classes = config.callbacks_class if isinstance(config.callbacks_class, list) else [config.callbacks_class]
    own = [kind.__name__ for kind in [*classes, config.algo_class] if isinstance(kind, type) and not _is_known(kind)]
    own += [hook for hook in HOOKS if getattr(config, f"callbacks_{hook}", None)]
    if own:
        notify(f"what {', '.join(own)} of your own may change in the module or the connectors is NOT compared")


def _is_known(kind: type) -> bool:
    return kind.__module__.partition(".")[0] in ("ray", "rlservo")


def folder_of_connectors(files: CheckpointFiles, config: Any) -> Path:
    """Return the folder from which RLlib itself would restore the connectors of training.

    It is the one found by name if RLlib restores none (recorded data). Raises CheckpointError if RLlib's folder is
    missing: other pipelines that exist are not the policy's.
    """
    from ray.rllib.algorithms.algorithm import Algorithm

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


def build_pipelines(files: CheckpointFiles, config: Any, spaces: tuple[Any, Any]) -> tuple[Any, Any]:
    """Return both pipelines as the configuration makes them, without any state.

    `spaces` are the environment's own, of observations and actions. Raises CheckpointError if they cannot be built.
    """
    # With an environment on the spot RLlib gives it to the functions, else only its spaces.
    on_the_spot = config.num_env_runners == 0 or config.create_env_on_local_worker
    env = _SpacesOnly(spaces, config.num_envs_per_env_runner) if on_the_spot else None
    reads = [] if env is None else env.reads
    named = {INPUT_ENV_SPACES: spaces, INPUT_ENV_SINGLE_SPACES: spaces}
    try:
        built = (
            config.build_env_to_module_connector(env=env, spaces=named, device=torch.device("cpu")),
            config.build_module_to_env_connector(env=env, spaces=named),
        )
        if reads:  # the function went on without
            raise _NoEnvironmentError(reads[0])
        return built
    except Exception as error:  # the user's own functions may raise anything
        reason = first_line(error) if isinstance(error, _NoEnvironmentError) else explain(error)
        raise CheckpointError(
            f"{files.root}: the connector pipelines cannot be built from its configuration, as RLlib itself would: "
            f"{reason}"
        ) from error


def restore_pipelines(files: CheckpointFiles, config: Any, folder: Path, spaces: tuple[Any, Any]) -> tuple[Any, Any]:
    """Return both pipelines as RLlib restores them from `folder`."""
    if folder.name == EVALUATION_RUNNER:
        config = config.get_evaluation_config_object()
    pipelines = build_pipelines(files, config, spaces)
    for pipeline, name in zip(pipelines, (ENV_TO_MODULE, MODULE_TO_ENV), strict=True):
        try:
            pipeline.restore_from_path(str(folder / name))
        except Exception as error:  # the user's own set_state may raise anything
            raise CheckpointError(f"{folder / name} cannot be restored: {explain(error)}") from error
    return pipelines


def build_actor(config: Any, module: Any, module_id: str | None, env_to_module: Any) -> Any | None:
    """Return the module as RLlib's env runners build it from the configuration (`make_module`), without weights.

    `module` is the one that was saved, `module_id` its id if there are several. None for a module that was added in
    training, of which the configuration knows nothing.
    """
    observations = env_to_module.observation_space
    if module_id is None:
        single = {DEFAULT_MODULE_ID: (observations, env_to_module.input_action_space)}
        return config.get_rl_module_spec(spaces=single, inference_only=True).build()
    spaces = dict.fromkeys(config.policies, (module.observation_space, module.action_space))  # some serve no agent
    spaces |= {one: (space, env_to_module.action_space[one]) for one, space in observations.spaces.items()}
    specs = config.get_multi_rl_module_spec(spaces=spaces, inference_only=True).rl_module_specs
    return specs[module_id].build() if module_id in specs else None


def freeze(pipeline: Any) -> None:
    """Stop a pipeline's observation filters from learning from what they are shown, and keep it on the CPU."""
    for piece in pipeline.connectors:
        if isinstance(piece, MeanStdFilter):
            private_names.replace(piece, "_update_stats", False)
        if isinstance(piece, NumpyToTensor):
            private_names.replace(piece, "_device", None)


class _NoEnvironmentError(AttributeError): ...


class _SpacesOnly(VectorEnv[Any, Any, Any]):
    """An environment's spaces, for functions that take the environment."""

    def __init__(self, spaces: tuple[Any, Any], num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(space, num_envs) for space in spaces)
        self.reads: list[str] = []

    def __getattr__(self, name: str) -> Any:
        self.reads.append(
            f"the function reads the environment's '{name}', and an export starts no environment: take what it needs "
            "from its argument 'spaces', or from a constant"
        )
        raise _NoEnvironmentError(self.reads[-1])
