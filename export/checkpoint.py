"""Restore a policy from an RLlib checkpoint, and run it as RLlib itself would. The one file that imports ray.rllib.

Restoring starts nothing: no `ray.init`, no environment, no worker. The module and both connector pipelines come from
their own folders in the checkpoint; `connectors.py` reads off them what they do. `Checkpoint.reference` is the truth
every export is compared with: RLlib's own pipelines around RLlib's own forward pass.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from ray.rllib.connectors.connector_pipeline_v2 import ConnectorPipelineV2
from ray.rllib.connectors.env_to_module.env_to_module_pipeline import EnvToModulePipeline
from ray.rllib.connectors.module_to_env.module_to_env_pipeline import ModuleToEnvPipeline
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, QNetAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from torch import Tensor, nn

from rlservo.export.connectors import check_spaces, read_observation_steps, read_transform
from rlservo.export.errors import CheckpointError, UnsupportedError
from rlservo.export.heads import replace_heads
from rlservo.export.location import CTOR_FILE, STATE_STEMS, CheckpointFiles
from rlservo.export.recipe import AnyDiscrete, DistributionKind, Mode, Recipe
from rlservo.export.unpickle import explain, first_line, unpickle

DISTRIBUTIONS: dict[str, DistributionKind] = {
    "TorchDiagGaussian": "diag_gaussian",
    "TorchSquashedGaussian": "squashed_gaussian",
    "TorchCategorical": "categorical",
}
QF_PREDS = "qf_preds"  # DQN's key for the Q-values, in ray/rllib/algorithms/dqn/default_dqn_rl_module.py


class Network(nn.Module):
    """RLlib's inference forward pass as a module that can be traced: network input to named tensors."""

    def __init__(self, module: Any, names: tuple[str, ...]) -> None:
        super().__init__()
        self.module = module
        self.names = names

    def forward(self, obs: Tensor) -> tuple[Tensor, ...]:
        """Return one tensor `[batch, ...]` for each of `names`, given the network's input `[batch, ...]`."""
        return tuple(_output(self.module, name, {Columns.OBS: obs}) for name in self.names)


def _output(module: Any, name: str, batch: dict[str, Any]) -> Tensor:
    if name == "value":
        value: Tensor = module.compute_values(batch)
    elif name == "q_values":
        value = module.compute_q_values(batch)[QF_PREDS]
    else:
        value = module._forward_inference(batch)[Columns.ACTION_DIST_INPUTS]
    return value


@dataclass(frozen=True)
class Checkpoint:
    """A restored policy: the recipe around its network, the network for tracing, and RLlib's own way to act."""

    recipe: Recipe
    network: Network
    module_class: str
    _module: Any
    _env_to_module: ConnectorPipelineV2
    _module_to_env: ConnectorPipelineV2

    def reference(self, obs: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return what RLlib computes for a batch of raw observations `[batch, *obs_shape]`, by output name.

        `action` is what RLlib would pass to `env.step`: exploration off, filter frozen. This repeats the steps of
        `SingleAgentEnvRunner._sample` (ray 2.60).
        """
        episodes: list[Any] = []
        for one in obs:
            episode = SingleAgentEpisode(
                observation_space=self.recipe.observation_space, action_space=self.recipe.action_space
            )
            episode.add_env_reset(observation=one)
            episodes.append(episode)
        shared: dict[str, Any] = {}
        with torch.no_grad():
            batch = self._env_to_module(
                rl_module=self._module, batch={}, episodes=episodes, explore=False, shared_data=shared
            )
            outputs = {name: _output(self._module, name, dict(batch)).numpy() for name in self.network.names}
            to_env = self._module.forward_inference(batch)
            to_env = self._module_to_env(
                rl_module=self._module, batch=to_env, episodes=episodes, explore=False, shared_data=shared
            )
        action = np.asarray(to_env.get(Columns.ACTIONS_FOR_ENV, to_env[Columns.ACTIONS]))
        return {"action": action, **outputs}


def load_checkpoint(files: CheckpointFiles, notify: Callable[[str], None], *, value: bool = True) -> Checkpoint:
    """Restore one policy; `value` False leaves the value head out.

    Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
    """
    for folder in (files.module, files.env_to_module, files.module_to_env):
        unpickle(folder / CTOR_FILE)  # RLlib's own loader hides a missing class behind an unrelated error
    module: Any = _restore(RLModule, files.module)
    env_to_module: Any = _restore(EnvToModulePipeline, files.env_to_module)
    module_to_env: Any = _restore(ModuleToEnvPipeline, files.module_to_env)

    name = type(module).__name__
    if not isinstance(module, TorchRLModule):
        raise UnsupportedError(f"module {name} is not a torch RLModule: only torch modules are exported")
    if module.is_stateful():
        raise UnsupportedError(
            f"module {name} is recurrent (LSTM or similar), which is not exported yet: its state would have to become "
            "an input and an output of the graph"
        )
    module.eval().requires_grad_(False)
    no_value = _check_weights(files, module)
    observation_space = env_to_module.input_observation_space
    action_space: Any = module_to_env.input_action_space or module.action_space
    check_spaces(observation_space, action_space)
    steps = read_observation_steps(env_to_module, files)
    distribution, mode = _action_rule(module, action_space)
    transform = read_transform(module_to_env, action_space)
    recipe = Recipe(observation_space, action_space, steps, mode, transform, distribution)
    if recipe.filter is not None and recipe.filter.count == 0:
        notify("the observation filter has seen nothing yet: RLlib divides by 1e-6 and clips, and so does the export")
    if isinstance(recipe.action_space, Discrete) and recipe.action_space.start != 0:
        notify(
            f"the action space starts at {recipe.action_space.start}, but RLlib sends 0..{recipe.action_space.n - 1} "
            "to env.step: the export does the same"
        )
    names = _output_names(module, recipe)
    if value and isinstance(module, ValueFunctionAPI):
        if no_value:
            notify(f"the checkpoint holds no value head ({no_value}): the export has no output 'value'")
        else:
            names = (*names, "value")
    traced = copy.deepcopy(module)
    replace_heads(traced)
    full_name = f"{type(module).__module__}.{name}"
    return Checkpoint(recipe, Network(traced, names), full_name, module, env_to_module, module_to_env)


def _restore(kind: Any, folder: Path) -> Any:
    deprecation = logging.getLogger("ray._common.deprecation")
    deprecation.addFilter(_not_rllibs_own)
    try:
        return kind.from_checkpoint(str(folder))
    except Exception as error:  # whatever RLlib, torch or the user's own constructor raises
        raise CheckpointError(f"{folder} cannot be restored: {explain(error)}") from error
    finally:
        deprecation.removeFilter(_not_rllibs_own)


def _not_rllibs_own(record: logging.LogRecord) -> bool:
    """Drop the warning about RLModuleConfig, which RLlib's own constructor raises against itself (ray 2.60)."""
    return "RLModuleConfig object" not in record.getMessage()


def _check_weights(files: CheckpointFiles, module: Any) -> str:
    """Return '' when every weight was in the checkpoint, or why the value head has none.

    RLlib ignores weights that are missing and leaves them random. Raises CheckpointError where an action needs them,
    and where a weight is not a finite number.
    """
    for key, weights in module.state_dict().items():
        if not torch.isfinite(weights).all():
            raise CheckpointError(f"{files.module}: the weights '{key}' are not all finite: training diverged")
    if module.inference_only:
        return "it was saved for inference only"
    state_file = files.module / f"{STATE_STEMS['module']}.pkl"
    if type(module).get_state is not TorchRLModule.get_state or not state_file.is_file():
        return ""  # a custom layout, which only the module itself can judge, or msgpack
    missing = set(module.state_dict()) - set(unpickle(state_file))
    unneeded = module.get_non_inference_attributes() if isinstance(module, InferenceOnlyAPI) else []
    if needed := sorted(key for key in missing if not any(key.startswith(f"{prefix}.") for prefix in unneeded)):
        raise CheckpointError(f"{state_file} lacks weights that {type(module).__name__} needs: {', '.join(needed[:3])}")
    return f"{len(missing)} weights are missing" if missing else ""


def _action_rule(module: Any, action_space: Box | AnyDiscrete) -> tuple[DistributionKind | None, Mode]:
    """Return the distribution's kind and how its mode is computed, found out by asking the class."""
    if _is_value_based(module):
        return None, "argmax"
    kind = module.get_inference_action_dist_cls()
    name = getattr(kind, "__name__", str(kind))
    if name not in DISTRIBUTIONS:
        raise UnsupportedError(
            f"the action distribution {name} is not exported yet: known are {', '.join(DISTRIBUTIONS)}"
        )
    if isinstance(action_space, Discrete):
        return DISTRIBUTIONS[name], "argmax"
    # RLlib 2.60 sends SAC's bare mean where other versions send its tanh: the class in the checkpoint decides.
    probe = torch.linspace(-2.0, 2.0, 2 * int(np.prod(action_space.shape))).reshape(1, -1)
    mode, mean = kind.from_logits(probe).to_deterministic().sample(), probe.chunk(2, dim=-1)[0]
    if torch.equal(mode, mean):
        return DISTRIBUTIONS[name], "mean"
    if torch.allclose(mode, torch.tanh(mean), atol=1e-6):
        return DISTRIBUTIONS[name], "tanh_mean"
    raise UnsupportedError(
        f"the deterministic action of {name} is neither its mean nor the mean's tanh: not exported yet"
    )


def _is_value_based(module: Any) -> bool:
    """Return whether actions are picked by Q-value (DQN); SAC's module has those, too, but gives a distribution."""
    return isinstance(module, QNetAPI) and Columns.ACTION_DIST_INPUTS not in _forward_once(module)


def _output_names(module: Any, recipe: Recipe) -> tuple[str, ...]:
    if recipe.distribution is None:
        return ("q_values",)
    given = _forward_once(module)
    if Columns.ACTIONS in given or Columns.ACTION_DIST_INPUTS not in given:
        raise UnsupportedError(
            f"module {type(module).__name__} computes its actions itself (its inference forward gives "
            f"{', '.join(sorted(given))}): only modules that give '{Columns.ACTION_DIST_INPUTS}' are exported"
        )
    return ("action_dist_inputs",)


def _forward_once(module: Any) -> dict[str, Any]:
    """Return the inference forward's output for two observations of zeros."""
    zeros = torch.zeros((2, *module.observation_space.shape))
    try:
        with torch.no_grad():
            given: dict[str, Any] = module.forward_inference({Columns.OBS: zeros})
    except Exception as error:  # the user's own forward may raise anything
        raise UnsupportedError(
            f"module {type(module).__name__} does not run on a plain batch of observations: {first_line(error)}"
        ) from error
    return given
