"""A policy of RLlib's new API stack, restored and run as RLlib itself would.

The module and both connector pipelines come from their own folders in the checkpoint; `connectors.py` reads off
them what they do. `NewStackLoop` is RLlib's own pipelines around RLlib's own forward pass.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import json
import logging
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.connectors.env_to_module.env_to_module_pipeline import EnvToModulePipeline
from ray.rllib.connectors.module_to_env.module_to_env_pipeline import ModuleToEnvPipeline
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, QNetAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from torch import Tensor, nn

from rlservo.bundle.scores import Q_VALUES
from rlservo.errors import AgentsDifferError, CheckpointError, NoNetworkError, UnsupportedError, first_line
from rlservo.export.checkpoints.facts import read_config
from rlservo.export.checkpoints.location import (
    CTOR_FILE,
    ENV_TO_MODULE,
    MODULE_TO_ENV,
    CheckpointFiles,
    weights_pickle,
)
from rlservo.export.checkpoints.unpickle import explain, unpickle
from rlservo.export.recipe.recipe import DistributionKind, Mode, Recipe, StateLeaf
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.samples import draw_batches, draw_pair
from rlservo.export.recipe.trees import (
    Tree,
    build_like,
    is_nested,
    map_tree,
    named_leaves,
    tree_leaves,
)
from rlservo.export.rllib import private_names
from rlservo.export.rllib.configuration import (
    build_actor,
    check_own_code,
    folder_of_connectors,
    freeze,
    read_algorithm_config,
    restore_pipelines,
)
from rlservo.export.rllib.distribution_mode import distribution_kind, find_mode
from rlservo.export.rllib.gaussian_heads import replace_heads
from rlservo.export.rllib.new_stack.connectors import SINGLE_AGENT, read_action_steps, read_observation_steps
from rlservo.export.rllib.new_stack.older_components import (
    CONSTANT,
    is_older,
    lists_connectors,
    restore_older,
    saved_spaces,
    set_saved_state,
)
from rlservo.export.rllib.new_stack.pipelines import NoInfo, Pipelines, find_agent_slot, own_copy, pipelines_of
from rlservo.export.rllib.new_stack.same_connectors import ADVICE, check_same
from rlservo.export.rllib.supported_spaces import check_spaces
from rlservo.export.sources.restored_policy import RestoredPolicy, diverged_weights

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
"""Settings of an algorithm that decide its connector pipelines (ray 2.60)."""
LISTED = (
    "RLlib's own connectors as the checkpoint lists them (without the algorithm's configuration, by which RLlib itself "
    "restores them), inference forward and module-to-env connectors, observation filter frozen, exploration off"
)
ALONE = "RLlib's own default connectors around the RLModule alone and its inference forward, exploration off"
"""The parity gate's reference where RLlib's own restore could not be repeated."""
WHOLE = (
    "RLlib's own connectors and inference forward of the whole RLModule (it could not be built for inference only, as "
    "RLlib's actors build theirs), observation filter frozen, exploration off"
)
"""The same where the actors' module could not be built."""
REFUSED_MODULES = {
    "DreamerV3TorchRLModule": "DreamerV3 draws its world model's state at random in every step, exploring or not, so "
    "no single action can prove an export",
}
"""Modules of RLlib's own that can be restored and not exported, and why."""
ACTING = ("forward_inference", "_forward_inference", "_forward")
AGENT_STEPS = 16  # observations for which agents of one module are compared
QF_PREDS = "qf_preds"  # DQN's key for the Q-values, in ray/rllib/algorithms/dqn/default_dqn_rl_module.py


class RLModuleNetwork(nn.Module):
    """RLlib's inference forward pass as a module that can be traced: network input to named tensors.

    If the module computes its actions itself, their leaves come first; a recurrent one's next state comes last.
    """

    def __init__(
        self, module: Any, names: tuple[str, ...], *, acts: bool = False, rule: Callable[[Tensor], Tree] | None = None
    ) -> None:
        """`acts` says that the module, or with `rule` its distribution, gives the action's leaves."""
        super().__init__()
        self.module = module
        self.names = names
        self._acts = acts
        self._rule = rule
        self.state = module.get_initial_state() if module.is_stateful() else None

    def forward(self, obs: Tree, *state: list[Tensor]) -> tuple[Tensor, ...]:
        """Return one tensor `[batch, ...]` for each of `names`, given the network's input `[batch, ...]`."""
        stateful = self.state is not None
        named: dict[str, Tensor] = {}
        actions: list[Tensor] = []
        next_state: list[Tensor] = []
        outputs: dict[str, Any] = {}
        # A value alone does not give an action: then the forward pass is run for the actions or the state.
        for name in self.names if set(self.names) - {"value"} else ("", *self.names):
            # A user's forward may change its batch, so each call gets its own.
            batch = {Columns.OBS: map_tree(lambda leaf: leaf.unsqueeze(1) if stateful else leaf, obs)}
            if stateful:
                batch[Columns.STATE_IN] = build_like(self.state, state[0])
            if name == "value":
                named[name] = self.module.compute_values(batch)
            elif name == Q_VALUES:
                outputs = self.module.compute_q_values(batch)
                named[name] = outputs[QF_PREDS]
            else:
                outputs = self.module.forward_inference(batch)
                if name:
                    named[name] = outputs[Columns.ACTION_DIST_INPUTS]
        if self._acts:
            rule = self._rule
            actions = tree_leaves(rule(named[Columns.ACTION_DIST_INPUTS].clone()) if rule else outputs[Columns.ACTIONS])
        if stateful:
            next_state = tree_leaves(outputs[Columns.STATE_OUT])
            actions = [leaf.squeeze(1) for leaf in actions]
            named = {name: leaf.squeeze(1) for name, leaf in named.items()}
        return (*actions, *named.values(), *next_state)


class NewStackLoop:
    """RLlib acting step after step, as `SingleAgentEnvRunner._sample` does it (ray 2.60): exploration off.

    It begins with new episodes and connectors that remember nothing.
    """

    def __init__(self, pipelines: Pipelines, recipe: Recipe, network: RLModuleNetwork, whole: Any) -> None:
        """`whole` is the module with what only training needs, such as the value head."""
        self.pipelines = pipelines.fresh()
        self.recipe = recipe
        self._network = network
        self._whole = whole
        self._shared: dict[str, Any] = {}
        self._episodes: list[Any] = []
        self._last: list[tuple[Any, dict[str, Any]]] = []

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return what RLlib computes for one step of every row, by output name.

        `inputs` may hold the last step's rewards as "reward", whether the policy sees them or not.
        """
        rows = _rows(self.pipelines, inputs, len(restart))
        rewards = inputs.get("reward", np.zeros(len(restart)))
        if not self._episodes:
            self._episodes = [None] * len(rows)
        for row, obs in enumerate(rows):
            if restart[row] or self._episodes[row] is None:
                self._episodes[row] = self.pipelines.begin(obs)
            else:
                action, extra = self._last[row]
                self.pipelines.advance(self._episodes[row], obs, action, float(rewards[row]), extra)
        batch = self.pipelines.to_module(self._episodes, self._shared, **self._columns(rows, rewards))
        forward = self.pipelines.forward(batch)
        outputs = self._outputs(batch, forward)
        if is_nested(self.recipe.action_space):
            # RLlib's log-probability of a nested deterministic action does not fit more than one environment (ray
            # 2.60). No action depends on it.
            forward.setdefault(Columns.ACTION_LOGP, torch.zeros(len(rows)))
        columns = self.pipelines.to_env(forward, self._episodes, self._shared)
        # The episodes remember the module's own actions; the environment gets those that have been scaled.
        own = columns.pop(Columns.ACTIONS)
        action = columns.pop(Columns.ACTIONS_FOR_ENV, own)
        self._last = [
            (_pick(own, row), {key: values[row] for key, values in columns.items()}) for row in range(len(rows))
        ]
        actions = {name: np.asarray(leaf) for name, leaf in named_leaves(action, "action").items()}
        return {**actions, **outputs}

    def _columns(self, rows: list[Any], rewards: NDArray[Any]) -> dict[str, Any]:
        """Return the last step as RLlib gives it to connectors beside the episodes: of a first step without actions."""
        column = self.pipelines.column
        columns = {Columns.OBS: column(rows), Columns.INFOS: column([NoInfo() for _ in rows])}
        if self._last:
            columns[Columns.ACTIONS] = column([action for action, _ in self._last])
            columns[Columns.REWARDS] = column([float(reward) for reward in rewards])
            for name in (Columns.TERMINATEDS, Columns.TRUNCATEDS):
                columns[name] = column([False] * len(rows))
        return columns

    def _outputs(self, batch: dict[str, Any], forward: dict[str, Any]) -> Outputs:
        """Return the network's outputs: those of the forward pass, copied, and those that take a pass of their own."""
        module, stateful = self._whole, self._network.state is not None
        outputs: Outputs = {}
        with torch.no_grad():
            for name in self._network.names:
                if name == "value":
                    tensor = module.compute_values(own_copy(batch))
                elif name == Q_VALUES:
                    tensor = module.compute_q_values(own_copy(batch))[QF_PREDS]
                else:
                    tensor = forward[Columns.ACTION_DIST_INPUTS]
                outputs[name] = (tensor.squeeze(1) if stateful else tensor).numpy().copy()
        next_state = tree_leaves(forward[Columns.STATE_OUT]) if stateful else []
        for leaf, tensor in zip(self.recipe.network_state, next_state, strict=True):
            outputs[f"state_out.{leaf.name}"] = tensor.numpy().copy()
        return outputs


def _pick(tree: Tree, row: int) -> Tree:
    return map_tree(lambda leaf: leaf[row], tree)


def _rows(pipelines: Pipelines, inputs: Inputs, count: int) -> list[Any]:
    """Return each observation in the form an environment gives it."""
    return [pipelines.observation({name: values[row] for name, values in inputs.items()}) for row in range(count)]


def restore_new_stack(files: CheckpointFiles, notify: Callable[[str], None], *, value: bool = True) -> RestoredPolicy:
    """Restore one policy; `value` False leaves the value head out.

    Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
    """
    module: Any = _restore(RLModule, files.module)
    env_to_module, module_to_env = _read_pipelines(files, files.runner, module, notify)

    name = type(module).__name__
    if not isinstance(module, TorchRLModule):
        raise NoNetworkError(f"module {name} is not a torch RLModule: only torch modules are exported")
    if why := REFUSED_MODULES.get(name):
        raise UnsupportedError(f"module {name} is not exported: {why}")
    no_value = _check_weights(files, module)
    module.eval().requires_grad_(False)
    # The gate's own connectors, by RLlib's own way: an error of the recipe must not be in both.
    config = read_algorithm_config(files)
    own, how = _reference_pipelines(files, config, (env_to_module, module_to_env), module, notify)
    slot = find_agent_slot(files, module, env_to_module, module_to_env)
    observation_space = slot.part(env_to_module.input_observation_space)
    action_space: Any = slot.part(module_to_env.input_action_space) or module.action_space
    steps = read_observation_steps(env_to_module, files, slot)
    check_spaces(observation_space, action_space, steps)
    transform, action_steps = read_action_steps(module_to_env, action_space)
    state = _network_state(module)
    pipelines = pipelines_of(slot, module, env_to_module, module_to_env, observation_space, action_space)
    # The output of the module's forward pass decides the rule, and running it takes observations.
    draft = Recipe(observation_space, action_space, steps, "argmax", transform, None, state, action_steps)
    forward = _forward_once(pipelines, draft)
    build = partial(build_actor, config, module, None if slot is SINGLE_AGENT else slot.module, own[0])
    actor = _actor(files, module, build if config is not None else lambda: None, notify)
    if actor is None:
        actor, how = module, "; ".join(filter(None, (WHOLE, how)))
    acting = pipelines_of(slot, actor, env_to_module, module_to_env, observation_space, action_space)
    is_repeatable = _acts_alike(forward, _forward_once(pipelines, draft))  # else the gate says so
    if is_repeatable and not _acts_alike(forward, _forward_once(acting, draft)):
        raise UnsupportedError(
            f"module {name} acts differently when it is built for inference only, from the algorithm's configuration, "
            "as RLlib's actors build it: make both act the same, and change none of its arguments (model_config.pop)"
        )
    distribution, mode, names = _action_rule(module, forward, action_space, notify)
    recipe = dataclasses.replace(draft, mode=mode, distribution=distribution)
    if value and isinstance(module, ValueFunctionAPI):
        if no_value:
            notify(f"the checkpoint holds no value head ({no_value}): the export has no output 'value'")
        else:
            names = (*names, "value")
    traced = _second_module(module, files)
    replace_heads(traced)
    rule = _deterministic(module) if Columns.ACTION_DIST_INPUTS in names else None
    network = RLModuleNetwork(traced, names, acts=mode == "given", rule=rule)
    module_class = f"{type(module).__module__}.{name}"
    reference = pipelines_of(slot, actor, *own, observation_space, action_space)
    start_loop = partial(NewStackLoop, reference, recipe, network, module)
    if slot is not SINGLE_AGENT and reference.has_own:
        _check_agents(files, reference, start_loop)
    return RestoredPolicy(recipe, network, module_class, start_loop, slot.agents, reference=how)


def _check_agents(files: CheckpointFiles, pipelines: Any, start_loop: Callable[[], NewStackLoop]) -> None:
    """Let connectors of the user's own act for the module's other agents, and beside agents of other modules.

    Raises AgentsDifferError if they act otherwise for those, UnsupportedError if they act otherwise beside these.
    """
    slot = pipelines.slot
    varied = {
        agent: dataclasses.replace(pipelines, slot=dataclasses.replace(slot, agent=agent)) for agent in slot.others
    }
    loops = [start_loop() for _ in range(2 + len(varied))]
    for loop, changed in zip(loops[1:], (pipelines.in_company(), *varied.values()), strict=True):
        loop.pipelines = changed.fresh()
    for batch in [batch for batch in draw_batches(loops[0].recipe, seed=0) if len(batch) == 1][:AGENT_STEPS]:
        restart = np.ones(1, np.bool_) if batch.restart is None else batch.restart
        try:
            first, *others = (loop.step(batch.inputs, restart) for loop in loops)
        except UnsupportedError:
            raise
        except Exception as error:  # the user's own connectors may raise anything
            raise UnsupportedError(
                f"{files.root}: a connector of your own fails for another agent, or beside one: {first_line(error)}"
            ) from error
        same = [
            all(np.allclose(outputs[name], first[name], 1e-4, 1e-5, equal_nan=True) for name in first)
            for outputs in others
        ]
        if not same[0]:
            raise UnsupportedError(
                f"{files.root}: a connector of your own acts differently for agent {slot.agent} when other agents act "
                "too: a served policy is given one agent's observation, so put into it what it needs of the others"
            )
        for agent, is_same in zip(varied, same[1:], strict=True):
            if not is_same:
                raise AgentsDifferError(
                    f"{files.root}: module '{slot.module}' serves the agents {slot.agent} and {agent}, and a connector "
                    "of your own acts differently for them: name the one to export for with --agent-id",
                    list(slot.agents),
                )


def _reference_pipelines(
    files: CheckpointFiles, config: Any, listed: tuple[Any, Any], module: Any, notify: Callable[[str], None]
) -> tuple[tuple[Any, Any], str]:
    """Return (pipelines of the parity gate's reference, what they are if not what RLlib itself would restore).

    `listed` are those that the recipe is read from. Raises UnsupportedError if they are not the configuration's.
    """
    if not files.has_pipelines:
        return listed, ALONE if config is None else ""
    if config is not None:
        check_own_code(files, config, notify)
    if config is None or is_older(files.env_to_module):
        folder = files.runner if config is None else folder_of_connectors(files, config)
        if files.has_own_connectors:
            notify(
                f"{files.root} holds connectors of your own and "
                + ("no configuration of the algorithm" if config is None else "was saved by an older Ray")
                + ": their arguments are those that RLlib recorded, often wrongly, and NOT proven; export the "
                "checkpoint as a current Ray saved it, if you can"
            )
        again = _read_pipelines(files, folder, module, lambda _: None)
        for pipeline in again:
            freeze(pipeline)
        return again, LISTED
    folder = folder_of_connectors(files, config)
    spaces = (listed[0].input_observation_space, listed[0].input_action_space)
    build = partial(restore_pipelines, files, config, folder, spaces)
    check_same(str(files.root), listed, built := build(), build)
    for pipeline in built:
        freeze(pipeline)
    return built, ""


def _read_pipelines(
    files: CheckpointFiles, runner: Path, module: Any, notify: Callable[[str], None]
) -> tuple[Any, Any]:
    """Return both pipelines from the folder `runner`; missing ones come from the configuration."""
    folders = (runner / ENV_TO_MODULE, runner / MODULE_TO_ENV)
    if files.has_pipelines and lists_connectors(folders[0]):
        return _restore(EnvToModulePipeline, folders[0]), _restore(ModuleToEnvPipeline, folders[1])
    pipelines = _build_pipelines(files, module, notify)
    if files.has_pipelines:
        for pipeline, folder in zip(pipelines, folders, strict=True):
            with _explained(folder):
                set_saved_state(pipeline, folder)
    return pipelines


def _actor(
    files: CheckpointFiles, module: Any, build: Callable[[], Any | None], notify: Callable[[str], None]
) -> Any | None:
    """Return the module as RLlib's actors build it: for inference only, and from the configuration, as `build` does.

    RLlib saves a module's arguments as it finds them in its attributes, and does not restore by them. The actor gets
    all weights: a critic's memory, which it may have, is compared too. None if it cannot be built.
    """
    if files.alone or is_older(files.module):
        return module
    try:
        with torch.random.fork_rng():
            if (actor := build()) is None:
                args, given = module.get_ctor_args_and_kwargs()
                actor = type(module)(*args, **{**given, "inference_only": True})
        actor.set_state(module.get_state())
    except Exception as error:  # the user's own constructor and state may raise anything
        notify(
            f"module {type(module).__name__} cannot be built for inference only, as RLlib's actors build it "
            f"({first_line(error)}): the actions are those of the whole module"
        )
        return None
    return actor.eval().requires_grad_(False)


def _acts_alike(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return whether two forward passes give the same actions and states, but for rounding."""
    names = (Columns.ACTIONS, Columns.ACTION_DIST_INPUTS, Columns.STATE_OUT)
    leaves = [
        [torch.as_tensor(leaf) for name in names if name in given for leaf in tree_leaves(given[name])]
        for given in (one, other)
    ]
    return len(leaves[0]) == len(leaves[1]) and all(
        mine.shape == theirs.shape and torch.allclose(mine.double(), theirs.double(), 1e-4, 1e-5, equal_nan=True)
        for mine, theirs in zip(*leaves, strict=True)
    )


def _second_module(module: Any, files: CheckpointFiles) -> Any:
    """Return a second module of the same weights, to trace: the first is the reference's."""
    try:
        return copy.deepcopy(module)
    except Exception:  # a module that keeps tensors of its last forward pass (an old ModelV2 inside) has no copy
        return _restore(RLModule, files.module).eval().requires_grad_(False)


def _build_pipelines(files: CheckpointFiles, module: Any, notify: Callable[[str], None]) -> tuple[Any, Any]:
    """Return the pipelines RLlib would build for this policy, where none were saved.

    From the algorithm's configuration; of a module alone, RLlib's default ones around the module's own spaces.
    """
    # Here and not at the top: it imports every algorithm, and few checkpoints need it.
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

    config: Any = AlgorithmConfig()
    if files.alone:
        notify(
            f"{files.root} is an RLModule alone: the observation is what the module itself reads, so a filter, one-hot "
            "or other step before it is NOT in the export; its actions are unsquashed to the bounds as RLlib does by "
            "default"
        )
    else:
        saved = read_config(unpickle(files.root / CTOR_FILE, missing_ok=True).get("ctor_args_and_kwargs"))
        for name in PIPELINE_SETTINGS:
            if name in saved:
                private_names.replace(config, name, saved[name])
        lacks = "holds no connectors (recorded data, or an environment elsewhere)"
        if files.has_pipelines:
            lacks = "does not list its connectors (a Ray before 2.39)"
        notify(f"the checkpoint {lacks}: the pipelines are built from its configuration")
    spaces = (config.observation_space or module.observation_space, config.action_space or module.action_space)
    if files.has_pipelines:
        spaces = saved_spaces(files.env_to_module)
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
    with _explained(folder):
        return restore_older(folder) if is_older(folder) else kind.from_checkpoint(str(folder))


@contextlib.contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Raise CheckpointError if the content of `folder` cannot be restored."""
    unpickle(folder / CTOR_FILE)  # RLlib's own loader hides a missing class behind an unrelated error
    deprecation = logging.getLogger("ray._common.deprecation")
    deprecation.addFilter(_not_rllibs_own)
    try:
        yield
    except CheckpointError:
        raise
    except Exception as error:  # whatever RLlib, torch or the user's own constructor raises
        arguments = isinstance(error, TypeError) and folder.name in (ENV_TO_MODULE, MODULE_TO_ENV)
        advice = f"; {ADVICE}" if arguments else ""
        raise CheckpointError(f"{folder} cannot be restored: {explain(error)}{_other_ray(folder) or advice}") from error
    finally:
        deprecation.removeFilter(_not_rllibs_own)


def _other_ray(folder: Path) -> str:
    """Return advice for a part that another Ray wrote and this one cannot read; empty if it was this one."""
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

    RLlib ignores weights that are missing and leaves them random. Raises CheckpointError if an action needs them,
    and where training has diverged.
    """
    unneeded = _unneeded(module)
    for key in diverged_weights(module):
        if not any(key.startswith(f"{prefix}.") for prefix in unneeded):
            raise CheckpointError(f"{files.module}: the weights '{key}' are not all finite: training diverged")
    if module.inference_only:
        return "it was saved for inference only"
    state_file = weights_pickle(files.module)
    if type(module).get_state is not TorchRLModule.get_state or not state_file.is_file():
        return ""  # a custom layout, which only the module itself can judge, or msgpack
    missing = {key for key in module.state_dict() if not key.endswith(CONSTANT)} - set(unpickle(state_file))
    if needed := sorted(key for key in missing if not any(key.startswith(f"{prefix}.") for prefix in unneeded)):
        raise CheckpointError(f"{state_file} lacks weights that {type(module).__name__} needs: {', '.join(needed[:3])}")
    return f"{len(missing)} weights are missing" if missing else ""


def _unneeded(module: Any) -> list[str]:
    """Return the names of the parts that inference does not need."""
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
    module: Any, forward: dict[str, Any], action_space: Any, notify: Callable[[str], None]
) -> tuple[DistributionKind | None, Mode, tuple[str, ...]]:
    """Return the distribution's kind, how its mode is computed and the outputs' names, by asking the class."""
    name = type(module).__name__
    has_q_values = isinstance(module, QNetAPI)  # SAC's module has them as well, but gives a distribution
    if has_q_values and Columns.ACTION_DIST_INPUTS not in forward and _acts_by_rllib(module):
        return None, "argmax", (Q_VALUES,)
    if Columns.ACTIONS in forward:
        notify(f"module {name} computes its actions itself: the export does the same, and cannot explore")
        return None, "given", ()
    if Columns.ACTION_DIST_INPUTS not in forward:
        raise UnsupportedError(
            f"module {name} gives neither '{Columns.ACTIONS}' nor '{Columns.ACTION_DIST_INPUTS}': its inference "
            f"forward gives {', '.join(sorted(forward))}"
        )
    kind = module.get_inference_action_dist_cls()
    mode = find_mode(_deterministic(module), (_unbound(kind),), action_space, forward[Columns.ACTION_DIST_INPUTS])
    exploring = module.get_exploration_action_dist_cls()
    distribution = None if mode == "given" else distribution_kind(_unbound(exploring))
    if distribution is None:
        notify(f"the action distribution {exploring.__name__} is not one of RLlib's: the export cannot explore with it")
    return distribution, mode, (Columns.ACTION_DIST_INPUTS,)


def _acts_by_rllib(module: Any) -> bool:
    """Return whether no class of the user's own chooses the action."""
    owners = [next(kind for kind in type(module).__mro__ if name in vars(kind)) for name in ACTING]
    return all(owner.__module__.startswith("ray.rllib.") for owner in owners)


def _deterministic(module: Any) -> Callable[[Tensor], Tree]:
    """Return the actions that RLlib's `GetActions` takes from the module's numbers without exploring (ray 2.60)."""
    kind = module.get_inference_action_dist_cls()
    return lambda inputs: kind.from_logits(inputs).to_deterministic().sample()


def _unbound(kind: type) -> type:
    """Return the class itself: RLlib binds a space to MultiCategorical and MultiDistribution by one more level."""
    return kind.__mro__[1] if kind.__name__.endswith("Partial") else kind


def _forward_once(pipelines: Pipelines, recipe: Recipe) -> dict[str, Any]:
    """Return the inference forward's output for two likely observations."""
    episodes = [pipelines.begin(obs) for obs in _rows(pipelines, draw_pair(recipe), 2)]
    name = type(pipelines.module).__name__
    try:
        forward = pipelines.forward(pipelines.to_module(episodes, {}))
    except UnsupportedError:
        raise
    except Exception as error:  # the user's own forward may raise anything
        raise UnsupportedError(
            f"module {name} does not run on what the pipeline gives it: {first_line(error)}"
        ) from error
    if pipelines.module.is_stateful() and Columns.STATE_OUT not in forward:
        raise UnsupportedError(f"module {name} has a state, but its inference forward gives no '{Columns.STATE_OUT}'")
    return forward
