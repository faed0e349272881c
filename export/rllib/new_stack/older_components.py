"""Modules and connector pipelines of the new API stack that an older Ray saved, restored by today's (2.60)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rlservo.errors import UnsupportedError
from rlservo.export.checkpoints.location import CTOR_FILE, weights_pickle
from rlservo.export.checkpoints.older_rays import with_current_statistics
from rlservo.export.checkpoints.unpickle import unpickle
from rlservo.export.rllib import private_names

UNCHANGED = (2, 48)
"""First Ray whose checkpoints `Checkpointable.from_checkpoint` reads as today's."""
CONFIG_OBJECT = "RLModuleConfig"
"""Up to Ray 2.38 a module was made from one of these; its content is passed as arguments today."""
CONSTANT = "log_std_clip_param_const"
"""A setting that is among a module's weights since Ray 2.37 or 2.38."""
TIME_AXIS, STATES = "AddTimeDimToBatchAndZeroPad", "AddStatesFromEpisodesToBatch"


def is_older(folder: Path) -> bool:
    """Return whether an older Ray saved the module or pipeline in `folder`, as pickles."""
    if any(folder.glob("*.msgpack")):
        return False
    try:
        ray_version = str(json.loads((folder / "metadata.json").read_text(encoding="utf-8"))["ray_version"])
        return tuple(int(part) for part in ray_version.split(".")[:2]) < UNCHANGED
    except (OSError, ValueError, KeyError, TypeError):
        return weights_pickle(folder).suffix == ".pt"


def restore_older(folder: Path) -> Any:
    """Return the module or pipeline in `folder`. Raises CheckpointError, or its constructor's errors."""
    arguments, settings = _arguments(folder)
    if arguments and type(arguments[0]).__name__ == CONFIG_OBJECT:
        settings = dict(vars(arguments[0]))
        arguments = ()
        settings["model_config"] = settings.pop("model_config_dict")
    if "connectors" in settings:
        settings = {**settings, "connectors": _with_time_axis(settings["connectors"])}
    component = unpickle(folder / CTOR_FILE)["class"](*arguments, **settings)
    _set_state(component, folder)
    return component


def lists_connectors(folder: Path) -> bool:
    """Return whether a pipeline's folder lists its connectors: up to Ray 2.38 it holds the spaces."""
    if not is_older(folder):
        return True
    arguments, settings = _arguments(folder)
    return not arguments or "connectors" in settings


def saved_spaces(folder: Path) -> tuple[Any, Any]:
    """Return the observation and action space of the environment, as a pipeline's folder has them."""
    observation_space, action_space = _arguments(folder)[0]
    return observation_space, action_space


def set_saved_state(pipeline: Any, folder: Path) -> None:
    """Set the state of a pipeline that was built from a configuration.

    Raises UnsupportedError unless it consists of the connectors that have been saved.
    """
    built = {name for name, _ in pipeline.get_checkpointable_components()} - {TIME_AXIS}
    if built != (saved := {child.name for child in folder.iterdir() if child.is_dir()}):
        raise UnsupportedError(
            f"{folder} holds the connectors {', '.join(sorted(saved))}, but its configuration gives "
            f"{', '.join(sorted(built))}: this early Ray did not save their arguments"
        )
    _set_state(pipeline, folder)


def _arguments(folder: Path) -> tuple[tuple[Any, ...], dict[str, Any]]:
    arguments: tuple[tuple[Any, ...], dict[str, Any]] = unpickle(folder / CTOR_FILE)["ctor_args_and_kwargs"]
    return arguments


def _set_state(component: Any, folder: Path) -> None:
    for name, part in component.get_checkpointable_components():
        if (folder / name).is_dir():  # a connector that the older Ray did without keeps no state
            _set_state(part, folder / name)
    weights = weights_pickle(folder)
    state = unpickle(weights if weights.is_file() else folder / f"{component.STATE_FILE_NAME}.pkl")
    if type(component).__name__ == "MeanStdFilter":
        state = {agent: with_current_statistics(one) for agent, one in state.items()}
    component.set_state(state)


def _with_time_axis(connectors: list[Any]) -> list[Any]:
    """Return a pipeline's connectors; part of `AddStatesFromEpisodesToBatch` (up to Ray 2.40) is a separate one."""
    names = [kind.__name__ for kind, *_ in connectors]
    if STATES not in names or TIME_AXIS in names:
        return connectors
    added = private_names.find("ray.rllib.connectors.common", TIME_AXIS)
    return [*connectors[: names.index(STATES)], (added, (), {}), *connectors[names.index(STATES) :]]
