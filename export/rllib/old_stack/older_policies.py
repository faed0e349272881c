"""Policy states of the old API stack that an older Ray saved, converted for today's (2.60)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from ray.rllib.algorithms.registry import POLICIES, get_policy_class_name
from ray.rllib.utils.filter import RunningStat

from rlservo.errors import UnsupportedError
from rlservo.export.checkpoints.old_location import ALGORITHM_STATE, OldStackFiles
from rlservo.export.checkpoints.older_rays import with_current_statistics
from rlservo.export.checkpoints.unpickle import unpickle

MIXTURES = ("enable_rl_module_and_learner", "_enable_rl_module_api", "_enable_new_api_stack")
"""Settings that put an RLModule into an old-stack policy; up to Ray 2.8 that was PPO's default."""
_MLP_NAMES = (
    (r"encoder\.(?:actor_encoder|encoder)\.net\.mlp\.(\d+)", "_hidden_layers.{}._model.0"),
    (r"encoder\.critic_encoder\.net\.mlp\.(\d+)", "_value_branch_separate.{}._model.0"),
    (r"pi\.net\.mlp\.0", "_logits._model.0"),
    (r"vf\.net\.mlp\.0", "_value_branch._model.0"),
)
"""Weights of PPO's default RLModule without memory and images, and of the same network as an old model."""
_FILTERS = {
    "MeanStdFilter": "MeanStdObservationFilterAgentConnector",
    "ConcurrentMeanStdFilter": "ConcurrentMeanStdObservationFilterAgentConnector",
}


def update_policy_state(state: dict[str, Any], files: OldStackFiles) -> None:
    """Convert parts that older Rays saved differently. Raises UnsupportedError for those that RLlib no longer has."""
    spec = state["policy_spec"]
    spec["policy_class"] = _policy_class(spec.get("policy_class"))
    config = spec.get("config") or {}
    if any(config.get(setting) is True for setting in MIXTURES):
        _replace_module(state, config)
    if not state.get("connector_configs") and config.get("enable_connectors") is False:
        state["connector_configs"] = _connectors(config, files)
    for _, pieces in (state.get("connector_configs") or {}).values():
        for at, (name, saved) in enumerate(pieces):
            if name == "StateBufferConnector":  # the memory of episodes that were under way
                pieces[at] = (name, None)
            elif isinstance(saved, dict) and "running_stats" in saved:
                pieces[at] = (name, with_current_statistics(saved))


def _policy_class(found: Any) -> Any:
    """Return RLlib's name for a policy of its own, which older Rays pickled by value if it had none."""
    if isinstance(found, type) and found.__module__.startswith("ray."):
        found = get_policy_class_name(found) or found.__name__
    if isinstance(found, str) and found not in POLICIES:
        raise UnsupportedError(
            f"policy {found} is of an algorithm that today's RLlib no longer has: it is not exported"
        )
    return found


def _replace_module(state: dict[str, Any], config: dict[str, Any]) -> None:
    """Put the old model of the same network in place of an RLModule of RLlib's own whose weights are all known."""
    spec = config.get("rl_module_spec")
    parts = [getattr(spec, name, None) for name in ("module_class", "catalog_class")]
    if not all(str(getattr(part, "__module__", "")).startswith("ray.rllib.") for part in parts):
        return  # a class of the user's own may compute something else with weights of the same names
    renamed: dict[str, Any] = {}
    for key, values in state["weights"].items():
        part, _, kind = key.rpartition(".")
        for pattern, name in _MLP_NAMES:
            if match := re.fullmatch(pattern, part):
                layer = int(match[1]) // 2 if match.groups() else 0  # every second one is an activation
                renamed[f"{name.format(layer)}.{kind}"] = values
    if len(renamed) == len(state["weights"]):
        state["weights"] = renamed
        config.update(dict.fromkeys(MIXTURES, False), exploration_config={"type": "StochasticSampling"})


def _connectors(config: Mapping[str, Any], files: OldStackFiles) -> dict[str, Any]:
    """Return connectors equal to a worker's processing without connectors, the default up to Ray 2.3."""
    agent: list[tuple[str, Any]] = []
    if not config.get("_disable_preprocessor_api"):
        agent.append(("ObsPreprocessorConnector", None))
    if (kind := config.get("observation_filter", "NoFilter")) != "NoFilter":
        agent.append((_FILTERS[kind], _worker_filter(files)))
    agent += [("StateBufferConnector", None), ("ViewRequirementAgentConnector", None)]
    settings = {"normalize_actions": "NormalizeActionsConnector", "clip_actions": "ClipActionsConnector"}
    scaling = [(name, None) for setting, name in settings.items() if config.get(setting)]
    action = [("ConvertToNumpyConnector", None), *scaling, ("ImmutableActionsConnector", None)]
    return {"agent": ("AgentConnectorPipeline", agent), "action": ("ActionConnectorPipeline", action)}


def _worker_filter(files: OldStackFiles) -> dict[str, Any]:
    """Return the filter that a worker applied, which is in the algorithm's state, as a connector's state."""
    file = files.root / ALGORITHM_STATE
    worker = unpickle(file, missing_ok=True).get("worker", {}) if file.is_file() else {}
    saved = worker.get("filters", {}).get(files.module_id)
    if saved is None:
        raise UnsupportedError(
            f"{files.root} does not hold the observation filter's statistics: before Ray 2.4 they are in "
            f"{ALGORITHM_STATE}, next to the policies"
        )
    running = RunningStat(np.shape(saved.running_stats.mean_array))
    running.num_pushes, running.mean_array = saved.running_stats.num_pushes, saved.running_stats.mean_array
    running.sum_sq_diff_array = vars(saved.running_stats)["std_array"]
    kept = {key: getattr(saved, key) for key in ("shape", "no_preprocessor", "demean", "destd", "clip")}
    return {**kept, "running_stats": [running.to_state()], "buffer": [running.to_state()]}
