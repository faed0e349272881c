"""Restore a policy of RLlib's new API stack, and run it as RLlib itself would.

Restoring starts nothing: no `ray.init`, no environment, no worker. The module and both connector pipelines come from
their own folders in the checkpoint; `new_connectors.py` reads off them what they do. `Checkpoint.reference` is the
truth every export is compared with: RLlib's own pipelines around RLlib's own forward pass.
"""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.connectors.env_to_module.env_to_module_pipeline import EnvToModulePipeline
from ray.rllib.connectors.module_to_env.module_to_env_pipeline import ModuleToEnvPipeline
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, QNetAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from torch import Tensor, nn

from rlservo.export.checkpoints.facts import read_config
from rlservo.export.checkpoints.location import CTOR_FILE, STATE_STEMS, CheckpointFiles
from rlservo.export.checkpoints.unpickle import explain, unpickle
from rlservo.export.contract.errors import CheckpointError, UnsupportedError, first_line
from rlservo.export.recipe.describe import surprises
from rlservo.export.recipe.recipe import DistributionKind, Mode, Recipe, StateLeaf
from rlservo.export.recipe.runners import Inputs
from rlservo.export.recipe.samples import draw_batches
from rlservo.export.recipe.trees import (
    Tree,
    build,
    build_like,
    is_nested,
    map_tree,
    named_leaves,
    space_leaves,
    tree_leaves,
)
from rlservo.export.rllib.distribution_mode import find_mode
from rlservo.export.rllib.gaussian_heads import replace_heads
from rlservo.export.rllib.new_connectors import check_spaces, read_action_steps, read_observation_steps
from rlservo.export.rllib.new_pipelines import Pipelines, find_seat, own_copy, pipelines_of

DISTRIBUTIONS: dict[str, DistributionKind] = {
    "TorchDiagGaussian": "diag_gaussian",
    "TorchSquashedGaussian": "squashed_gaussian",
    "TorchCategorical": "categorical",
    "TorchMultiCategorical": "multi_categorical",
    "TorchMultiDistribution": "multi",
}
PIPELINE_SETTINGS = (
    "normalize_actions",
    "clip_actions",
    "_env_to_module_connector",
    "_module_to_env_connector",
    "add_default_connectors_to_env_to_module_pipeline",
    "add_default_connectors_to_module_to_env_pipeline",
    "observation_space",
    "action_space",
)
"""What of an algorithm's configuration decides its connector pipelines (ray 2.60)."""
REFUSED_MODULES = {
    "DreamerV3TorchRLModule": "DreamerV3 draws its world model's state at random in every step, exploring or not, so "
    "there is no one action to prove an export with",
}
"""Modules of RLlib's own that can be restored and not exported, and why."""
QF_PREDS = "qf_preds"  # DQN's key for the Q-values, in ray/rllib/algorithms/dqn/default_dqn_rl_module.py


class Network(nn.Module):
    """RLlib's inference forward pass as a module that can be traced: network input to named tensors.

    Where the module computes its actions itself, their leaves come first; a recurrent one's next state comes last.
    """

    def __init__(
        self, module: Any, names: tuple[str, ...], given: int = 0, rule: Callable[[Tensor], Tree] | None = None
    ) -> None:
        super().__init__()
        self.module = module
        self.names = names
        self.given = given
        """How many action leaves the module, or the distribution's own rule, gives ready-made."""
        self._rule = rule
        self.state = module.get_initial_state() if module.is_stateful() else None

    def forward(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]:
        """Return one tensor `[batch, ...]` for each of `names`, given the network's input `[batch, ...]`."""
        stateful = self.state is not None
        found: dict[str, Tensor] = {}
        ready: list[Tensor] = []
        after: list[Tensor] = []
        given: dict[str, Any] = {}
        # A value alone does not say what to do: then the forward pass is run for the actions or the state.
        for name in self.names if set(self.names) - {"value"} else ("", *self.names):
            # A user's forward may change its batch, so each call gets its own.
            batch = {Columns.OBS: map_tree(lambda leaf: leaf.unsqueeze(1) if stateful else leaf, obs)}
            if stateful:
                batch[Columns.STATE_IN] = build_like(self.state, state[0])
            if name == "value":
                found[name] = self.module.compute_values(batch)
            elif name == "q_values":
                given = self.module.compute_q_values(batch)
                found[name] = given[QF_PREDS]
            else:
                given = self.module._forward_inference(batch)
                if name:
                    found[name] = given[Columns.ACTION_DIST_INPUTS]
        if self.given:
            chosen = self._rule(given[Columns.ACTION_DIST_INPUTS].clone()) if self._rule else given[Columns.ACTIONS]
            ready = tree_leaves(chosen)
        if stateful:
            after = tree_leaves(given[Columns.STATE_OUT])
            ready = [leaf.squeeze(1) for leaf in ready]
            found = {name: leaf.squeeze(1) for name, leaf in found.items()}
        return (*ready, *found.values(), *after)


class RllibLoop:
    """RLlib acting step after step, as `SingleAgentEnvRunner._sample` does it (ray 2.60): exploration off."""

    def __init__(self, pipelines: Pipelines, recipe: Recipe, network: Network) -> None:
        self._pipelines = pipelines
        self._recipe = recipe
        self._network = network
        self._episodes: list[Any] = []
        self._last: list[tuple[Any, dict[str, Any]]] = []

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """Return what RLlib computes for one step of every row, by output name."""
        rows = _rows(self._recipe.observation_space, inputs, len(restart))
        rewards = inputs.get("reward", np.zeros(len(restart)))
        if not self._episodes:
            self._episodes = [None] * len(rows)
        for row, obs in enumerate(rows):
            if restart[row] or self._episodes[row] is None:
                self._episodes[row] = self._pipelines.begin(obs)
            else:
                action, extra = self._last[row]
                self._pipelines.advance(self._episodes[row], obs, action, float(rewards[row]), extra)
        # RLlib's log-probability of a nested deterministic action does not fit more than one environment (ray 2.60):
        # there, it acts for one at a time.
        alone = is_nested(self._recipe.action_space)
        groups = [[row] for row in range(len(rows))] if alone else [list(range(len(rows)))]
        self._last = []
        found = [self._decide([self._episodes[row] for row in group]) for group in groups]
        return {name: np.concatenate([one[name] for one in found]) for name in found[0]}

    def _decide(self, episodes: list[Any]) -> dict[str, NDArray[Any]]:
        """Return what RLlib computes for these episodes, and remember what they have to be told with the next step."""
        batch, shared = self._pipelines.to_module(episodes)
        given = self._pipelines.forward(batch)
        outputs = self._outputs(batch, given)
        sent = self._pipelines.to_env(given, episodes, shared)
        # The episodes remember the module's own actions; the environment gets those that have been scaled.
        own = sent.pop(Columns.ACTIONS)
        action = sent.pop(Columns.ACTIONS_FOR_ENV, own)
        self._last += [
            (_pick(own, row), {key: values[row] for key, values in sent.items()}) for row in range(len(episodes))
        ]
        named = {name: np.asarray(leaf) for name, leaf in named_leaves(action, "action").items()}
        return {**named, **outputs}

    def _outputs(self, batch: dict[str, Any], given: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """Return the network's outputs: those of the forward pass, copied, and those that take a pass of their own."""
        module, stateful = self._pipelines.module, self._network.state is not None
        found: dict[str, NDArray[Any]] = {}
        with torch.no_grad():
            for name in self._network.names:
                if name == "value":
                    tensor = module.compute_values(own_copy(batch))
                elif name == "q_values":
                    tensor = module.compute_q_values(own_copy(batch))[QF_PREDS]
                else:
                    tensor = given[Columns.ACTION_DIST_INPUTS]
                found[name] = (tensor.squeeze(1) if stateful else tensor).numpy().copy()
        after = tree_leaves(given[Columns.STATE_OUT]) if stateful else []
        for leaf, tensor in zip(self._recipe.network_state, after, strict=True):
            found[f"state_out.{leaf.name}"] = tensor.numpy().copy()
        return found


def _pick(tree: Tree, row: int) -> Tree:
    return map_tree(lambda leaf: leaf[row], tree)


@dataclass(frozen=True)
class Checkpoint:
    """A restored policy: the recipe around its network, the network for tracing, and RLlib's own way to act."""

    recipe: Recipe
    network: Network
    module_class: str
    pipelines: Pipelines
    agents: tuple[str, ...] = ()

    def reference(self, inputs: Inputs) -> dict[str, NDArray[Any]]:
        """Return what RLlib computes for a batch of raw observations `[batch, ...]` by input name, by output name.

        `action` is what RLlib would pass to `env.step`: exploration off, filter frozen. Every row is an episode's
        first step.
        """
        rows = len(next(iter(inputs.values())))
        return self.loop().step(inputs, np.ones(rows, np.bool_))

    def loop(self) -> RllibLoop:
        """Return RLlib acting step after step, which a policy with a memory is compared with."""
        return RllibLoop(self.pipelines, self.recipe, self.network)


def _rows(space: Any, inputs: Inputs, count: int) -> list[Any]:
    """Return each observation in the form an environment gives it."""
    names = list(space_leaves(space, "obs"))
    return [build(space, [inputs[name][row] for name in names]) for row in range(count)]


def load_checkpoint(files: CheckpointFiles, notify: Callable[[str], None], *, value: bool = True) -> Checkpoint:
    """Restore one policy; `value` False leaves the value head out.

    Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
    """
    module: Any = _restore(RLModule, files.module)
    if files.has_pipelines:
        env_to_module: Any = _restore(EnvToModulePipeline, files.env_to_module)
        module_to_env: Any = _restore(ModuleToEnvPipeline, files.module_to_env)
    else:
        env_to_module, module_to_env = _build_pipelines(files, module, notify)

    name = type(module).__name__
    if not isinstance(module, TorchRLModule):
        raise UnsupportedError(f"module {name} is not a torch RLModule: only torch modules are exported")
    if why := REFUSED_MODULES.get(name):
        raise UnsupportedError(f"module {name} is not exported: {why}")
    module.eval().requires_grad_(False)
    no_value = _check_weights(files, module)
    seat = find_seat(files, env_to_module, module_to_env)
    observation_space = seat.part(env_to_module.input_observation_space)
    action_space: Any = seat.part(module_to_env.input_action_space) or module.action_space
    check_spaces(observation_space, action_space)
    steps = read_observation_steps(env_to_module, files, seat)
    transform, action_steps = read_action_steps(module_to_env, action_space)
    state = _network_state(module)
    pipelines = pipelines_of(seat, module, env_to_module, module_to_env, observation_space, action_space)
    # What the module gives decides the rule, and asking it takes observations.
    asked = Recipe(observation_space, action_space, steps, "argmax", transform, None, state, action_steps)
    given = _forward_once(pipelines, asked)
    distribution, mode, names = _action_rule(module, given, action_space, notify)
    recipe = Recipe(observation_space, action_space, steps, mode, transform, distribution, state, action_steps)
    for surprise in surprises(recipe):
        notify(surprise)
    if value and isinstance(module, ValueFunctionAPI):
        if no_value:
            notify(f"the checkpoint holds no value head ({no_value}): the export has no output 'value'")
        else:
            names = (*names, "value")
    traced = _twin(module, files)
    replace_heads(traced)
    given_leaves = len(recipe.action_leaves) if mode == "given" else 0
    rule = _deterministic(module) if Columns.ACTION_DIST_INPUTS in names else None
    network = Network(traced, names, given_leaves, rule)
    return Checkpoint(recipe, network, f"{type(module).__module__}.{name}", pipelines, seat.agents)


def _twin(module: Any, files: CheckpointFiles) -> Any:
    """Return a second module of the same weights, to trace: the first is the reference's."""
    try:
        return copy.deepcopy(module)
    except Exception:  # a module that keeps tensors of its last forward pass (an old ModelV2 inside) has no copy
        return _restore(RLModule, files.module).eval().requires_grad_(False)


def _build_pipelines(files: CheckpointFiles, module: Any, notify: Callable[[str], None]) -> tuple[Any, Any]:
    """Return the pipelines RLlib would build for this policy, where none were saved.

    From the algorithm's configuration; of a module alone, RLlib's default ones around the module's own spaces.
    """
    config: Any = AlgorithmConfig()
    if files.alone:
        notify(
            f"{files.root} is an RLModule alone: the observation is what the module itself reads, so a filter, one-hot "
            "or other step before it is NOT in the export; its actions are unsquashed to the bounds as RLlib does by "
            "default"
        )
    else:
        given = read_config(unpickle(files.root / CTOR_FILE).get("ctor_args_and_kwargs"))
        for name in PIPELINE_SETTINGS:
            if name in given:
                setattr(config, name, given[name])
        notify(
            "the checkpoint has no environment runner (recorded data): the pipelines are built from its configuration"
        )
    spaces = (config.observation_space or module.observation_space, config.action_space or module.action_space)
    try:
        return (
            config.build_env_to_module_connector(spaces={INPUT_ENV_SINGLE_SPACES: spaces, INPUT_ENV_SPACES: spaces}),
            config.build_module_to_env_connector(spaces={INPUT_ENV_SINGLE_SPACES: spaces, INPUT_ENV_SPACES: spaces}),
        )
    except Exception as error:  # the user's own functions may raise anything
        raise CheckpointError(
            f"{files.root}: the connector pipelines cannot be built from its configuration: {explain(error)}"
        ) from error


def _restore(kind: Any, folder: Path) -> Any:
    unpickle(folder / CTOR_FILE)  # RLlib's own loader hides a missing class behind an unrelated error
    deprecation = logging.getLogger("ray._common.deprecation")
    deprecation.addFilter(_not_rllibs_own)
    try:
        return kind.from_checkpoint(str(folder))
    except Exception as error:  # whatever RLlib, torch or the user's own constructor raises
        raise CheckpointError(f"{folder} cannot be restored: {explain(error)}{_other_ray(folder)}") from error
    finally:
        deprecation.removeFilter(_not_rllibs_own)


def _other_ray(folder: Path) -> str:
    """Return what to do where another Ray wrote a part that this one cannot read; empty where it was this one."""
    try:
        written_by = str(json.loads((folder / "metadata.json").read_text(encoding="utf-8"))["ray_version"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    if written_by == ray.__version__:
        return ""
    return (
        f"; Ray {written_by} wrote it and this is Ray {ray.__version__}: export with Ray {written_by}, or train on and "
        "save with a later one"
    )


def _not_rllibs_own(record: logging.LogRecord) -> bool:
    """Drop the warning about RLModuleConfig, which RLlib's own constructor raises against itself (ray 2.60)."""
    return "RLModuleConfig object" not in record.getMessage()


def _check_weights(files: CheckpointFiles, module: Any) -> str:
    """Return '' when every weight was in the checkpoint, or why the value head has none.

    RLlib ignores weights that are missing and leaves them random. Raises CheckpointError where an action needs them,
    and where a weight is not a finite number.
    """
    unneeded = _unneeded(module)
    for key, weights in module.state_dict().items():
        if not torch.isfinite(weights).all() and not any(key.startswith(f"{prefix}.") for prefix in unneeded):
            raise CheckpointError(f"{files.module}: the weights '{key}' are not all finite: training diverged")
    if module.inference_only:
        return "it was saved for inference only"
    state_file = files.module / f"{STATE_STEMS['module']}.pkl"
    if type(module).get_state is not TorchRLModule.get_state or not state_file.is_file():
        return ""  # a custom layout, which only the module itself can judge, or msgpack
    missing = set(module.state_dict()) - set(unpickle(state_file))
    if needed := sorted(key for key in missing if not any(key.startswith(f"{prefix}.") for prefix in unneeded)):
        raise CheckpointError(f"{state_file} lacks weights that {type(module).__name__} needs: {', '.join(needed[:3])}")
    return f"{len(missing)} weights are missing" if missing else ""


def _unneeded(module: Any) -> list[str]:
    """Return the names of the parts that inference does without."""
    return module.get_non_inference_attributes() if isinstance(module, InferenceOnlyAPI) else []


def _network_state(module: Any) -> tuple[StateLeaf, ...]:
    """Return a recurrent module's state by name; a stateless one has none."""
    if not module.is_stateful():
        return ()
    named = named_leaves(module.get_initial_state(), "")
    return tuple(
        StateLeaf(name.removeprefix("."), np.asarray(torch.as_tensor(leaf).detach().cpu().numpy()))
        for name, leaf in named.items()
    )


def _action_rule(
    module: Any, given: dict[str, Any], action_space: Any, notify: Callable[[str], None]
) -> tuple[DistributionKind | None, Mode, tuple[str, ...]]:
    """Return the distribution's kind, how its mode is computed and the outputs' names, by asking the class."""
    name = type(module).__name__
    has_q_values = isinstance(module, QNetAPI)  # SAC's module has them, too, but gives a distribution
    if has_q_values and Columns.ACTION_DIST_INPUTS not in given:
        return None, "argmax", ("q_values",)
    if Columns.ACTIONS in given:
        notify(f"module {name} computes its actions itself: the export does the same, and cannot explore")
        return None, "given", ()
    if Columns.ACTION_DIST_INPUTS not in given:
        raise UnsupportedError(
            f"module {name} gives neither '{Columns.ACTIONS}' nor '{Columns.ACTION_DIST_INPUTS}': its inference "
            f"forward gives {', '.join(sorted(given))}"
        )
    kind = module.get_inference_action_dist_cls()
    mode = find_mode(_deterministic(module), kind.__name__, action_space, given[Columns.ACTION_DIST_INPUTS])
    exploring = module.get_exploration_action_dist_cls()
    distribution = None if mode == "given" else _distribution_kind(exploring)
    if distribution is None:
        notify(f"the action distribution {exploring.__name__} is not one of RLlib's: the export cannot explore with it")
    return distribution, mode, ("action_dist_inputs",)


def _deterministic(module: Any) -> Callable[[Tensor], Tree]:
    """Return what RLlib's `GetActions` does with the module's numbers while it does not explore (ray 2.60)."""
    kind = module.get_inference_action_dist_cls()
    return lambda inputs: kind.from_logits(inputs).to_deterministic().sample()


def _distribution_kind(kind: Any) -> DistributionKind | None:
    """Return which of RLlib's distributions a class is; None for the user's own, whose samples are not known."""
    if not kind.__module__.startswith("ray.rllib.core.distribution"):
        return None
    # RLlib binds a space to MultiCategorical and MultiDistribution by a class of one more level.
    named = kind.__mro__[1] if kind.__name__.endswith("Partial") else kind
    return DISTRIBUTIONS.get(named.__name__)


def _forward_once(pipelines: Pipelines, recipe: Recipe) -> dict[str, Any]:
    """Return the inference forward's output for two likely observations."""
    batch = next(batch for batch in draw_batches(recipe, seed=0) if len(batch) == 2)
    episodes = [pipelines.begin(obs) for obs in _rows(recipe.observation_space, batch.inputs, 2)]
    name = type(pipelines.module).__name__
    try:
        given = pipelines.forward(pipelines.to_module(episodes)[0])
    except Exception as error:  # the user's own forward may raise anything
        raise UnsupportedError(
            f"module {name} does not run on what the pipeline gives it: {first_line(error)}"
        ) from error
    if pipelines.module.is_stateful() and Columns.STATE_OUT not in given:
        raise UnsupportedError(f"module {name} has a state, but its inference forward gives no '{Columns.STATE_OUT}'")
    return given
