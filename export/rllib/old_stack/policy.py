"""A policy of RLlib's old API stack, restored and run as RLlib itself would.

`OldStackLoop` is the policy's own agent connectors, `compute_actions_from_input_dict` and action connectors, as
`EnvRunnerV2` calls them. `Policy.compute_single_action` would leave filter, preprocessor and unsquashing out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from ray.rllib.algorithms.dqn.dqn_torch_model import DQNTorchModel
from ray.rllib.models.torch.modules.noisy_layer import NoisyLayer
from ray.rllib.models.torch.recurrent_net import LSTMWrapper
from ray.rllib.models.torch.torch_action_dist import TorchCategorical
from ray.rllib.policy.policy import Policy
from ray.rllib.policy.sample_batch import SampleBatch, concat_samples
from ray.rllib.policy.torch_mixins import ValueNetworkMixin
from ray.rllib.policy.torch_policy import TorchPolicy
from ray.rllib.policy.torch_policy_v2 import TorchPolicyV2
from ray.rllib.utils.annotations import is_overridden
from ray.rllib.utils.exploration.parameter_noise import ParameterNoise
from ray.rllib.utils.numpy import convert_to_numpy
from ray.rllib.utils.spaces.space_utils import unbatch
from ray.rllib.utils.torch_utils import convert_to_torch_tensor
from ray.rllib.utils.typing import ActionConnectorDataType, AgentConnectorDataType
from torch import Tensor, nn

from rlservo.bundle.scores import ACTION_DIST_INPUTS, Q_VALUES
from rlservo.errors import CheckpointError, UnsupportedError, first_line
from rlservo.export.checkpoints.old_location import OldStackFiles
from rlservo.export.checkpoints.unpickle import explain, unpickle
from rlservo.export.recipe.recipe import DistributionKind, Mode, ObservationStep, Recipe, StateLeaf
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.trees import build_in_order, named_leaves, space_leaves, tree_leaves
from rlservo.export.rllib.distribution_mode import distribution_kind, find_mode
from rlservo.export.rllib.gaussian_heads import replace_heads
from rlservo.export.rllib.old_stack.connectors import check_connectors, read_old_steps, read_old_transform
from rlservo.export.rllib.old_stack.custom_models import register_custom_parts
from rlservo.export.rllib.old_stack.older_policies import MIXTURES, update_policy_state
from rlservo.export.rllib.supported_spaces import check_spaces
from rlservo.export.sources.restored_policy import RestoredPolicy, diverged_weights

AGENT = "agent0"  # RLlib's name for the one agent of an environment


class OldStackNetwork(nn.Module):
    """The policy's forward pass as a module that can be traced: network input to named tensors, then the next state."""

    def __init__(self, policy: Any, names: tuple[str, ...], *, acts: bool) -> None:
        """`acts` says that the distribution's own rule gives the action's leaves."""
        super().__init__()
        self.module: Any = policy.model
        self.names = names
        self._acts = acts
        self._policy = policy

    def forward(self, obs: Tensor, *state: list[Tensor]) -> tuple[Tensor, ...]:
        """Return one tensor `[batch, ...]` for each of `names`, given the network's input `[batch, ...]`."""
        inputs, kind, next_state = _distribution(self._policy, obs, state[0] if state else [])
        named = [self.module.value_function() if name == "value" else inputs for name in self.names]
        actions = tree_leaves(kind(inputs.clone(), self.module).deterministic_sample()) if self._acts else []
        return (*actions, *named, *(next_state if state else []))


def _distribution(policy: Any, obs: Any, state: list[Tensor]) -> tuple[Tensor, Any, list[Tensor]]:
    """Return (distribution parameters or Q-values, distribution class, state), as `_compute_action_helper` does it."""
    batch = SampleBatch({SampleBatch.OBS: obs})
    batch.set_get_interceptor(partial(convert_to_torch_tensor, device=policy.device))
    batch.set_training(True)  # RLlib also does so for inference
    lengths = torch.ones_like(state[0][:, 0], dtype=torch.long) if state else None
    how: dict[str, Any] = {"explore": False, "timestep": 0, "is_training": False}
    how.update({"state_batches": state, "seq_lens": lengths})
    kind: Any = policy.dist_class
    if issubclass(type(policy), TorchPolicyV2) and is_overridden(policy.action_distribution_fn):
        inputs, kind, next_state = policy.action_distribution_fn(policy.model, obs_batch=batch, **how)
    elif issubclass(type(policy), TorchPolicy) and policy.action_distribution_fn:
        inputs, kind, next_state = policy.action_distribution_fn(policy, policy.model, input_dict=batch, **how)
    else:
        inputs, next_state = policy.model(batch, state, lengths)
    return inputs, kind, next_state


class OldStackLoop:
    """RLlib acting step after step, as `EnvRunnerV2` does it (ray 2.60): exploration off, filter frozen.

    It begins with new episodes: what the policy's connectors have kept of others is forgotten.
    """

    def __init__(self, policy: Any, recipe: Recipe, names: tuple[str, ...]) -> None:
        self.policy = policy
        self._recipe = recipe
        self._names = names
        self._steps: dict[str, int] = {}

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return what RLlib computes for one step of every row, each an environment of its own, by output name.

        `inputs` may hold the last step's rewards as "reward", whether the policy sees them or not.
        """
        policy, envs = self.policy, [str(row) for row in range(len(restart))]
        rewards = inputs.get("reward", np.zeros(len(restart)))
        items = []
        for row, env in enumerate(envs):
            begins = restart[row] or env not in self._steps
            if begins:
                policy.agent_connectors.reset(env)
            self._steps[env] = -1 if begins else self._steps[env] + 1  # RLlib counts the initial observation as -1
            leaves = {name: values[row, ...] for name, values in inputs.items()}  # of no axis: still an array
            columns = {
                SampleBatch.NEXT_OBS: build_in_order(self._recipe.observation_space, leaves),
                SampleBatch.INFOS: {},
                SampleBatch.T: self._steps[env],
                SampleBatch.AGENT_INDEX: 0,
            }
            if not begins:
                columns |= {SampleBatch.REWARDS: float(rewards[row])}
                columns |= {SampleBatch.TERMINATEDS: False, SampleBatch.TRUNCATEDS: False}
            items.append(AgentConnectorDataType(env, AGENT, columns))
        processed = policy.agent_connectors(items)
        batch: Any = concat_samples([item.data.sample_batch for item in processed])
        if "state_in_0" in batch:
            batch[SampleBatch.SEQ_LENS] = np.ones(len(envs), np.int32)
        network_obs = np.asarray(batch[SampleBatch.OBS])
        actions, states, fetches = policy.compute_actions_from_input_dict(
            batch, explore=False, timestep=policy.global_timestep
        )
        outputs = self._outputs(network_obs, fetches, states)
        commands = []
        for row, action in enumerate(unbatch(convert_to_numpy(actions))):
            env, raw, own = envs[row], processed[row].data.raw_dict, [state[row] for state in states]
            ready = policy.action_connectors(ActionConnectorDataType(env, AGENT, raw, (action, own, {}))).output[0]
            commands.append(named_leaves(ready, "action"))
            policy.agent_connectors.on_policy_output(ActionConnectorDataType(env, AGENT, raw, (action, own, {})))
        return {**{name: np.stack([command[name] for command in commands]) for name in commands[0]}, **outputs}

    def _outputs(self, network_obs: NDArray[Any], fetches: dict[str, Any], states: list[Any]) -> Outputs:
        outputs: Outputs = {}
        with torch.no_grad():
            if "value" in self._names:
                outputs["value"] = self.policy.model.value_function().numpy().copy()
            parameters = fetches[SampleBatch.ACTION_DIST_INPUTS]
            if not states:  # a temperature, DQN's or the user's own, divides them in place: compute them again
                parameters = _distribution(self.policy, network_obs, [])[0].numpy()
        outputs[self._names[0]] = np.asarray(parameters)
        for leaf, state in zip(self._recipe.network_state, states, strict=True):
            outputs[f"state_out.{leaf.name}"] = np.asarray(state).copy()
        return outputs


def restore_old_stack(
    files: OldStackFiles, app_dir: Path, notify: Callable[[str], None], *, value: bool = True
) -> RestoredPolicy:
    """Restore one policy; the user's own classes are in `app_dir`. `value` False leaves the value head out.

    Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
    """
    policy = _restore(files, app_dir)
    _check_policy(files, policy)
    action_space = policy.action_space
    observation_space = getattr(policy.observation_space, "original_space", policy.observation_space)
    steps = read_old_steps(policy.agent_connectors)
    _check_spaces(policy, observation_space, action_space, steps)
    transform = read_old_transform(policy.action_connectors, action_space)
    state = _network_state(policy)
    distribution, mode, names = _action_rule(policy, action_space, notify)
    recipe = Recipe(observation_space, action_space, steps, mode, transform, distribution, state)
    if value and _has_value(policy, notify):
        names = (*names, "value")
    # A second policy to trace: a model keeps tensors of its last forward pass, which the reference needs for itself.
    traced = _restore(files, app_dir)
    _prepare(traced)
    replace_heads(traced.model)
    network = OldStackNetwork(traced, names, acts=mode == "given")
    model = type(policy.model)
    module_class = f"{model.__module__}.{model.__qualname__}"
    return RestoredPolicy(recipe, network, module_class, partial(OldStackLoop, policy, recipe, names))


def _network_state(policy: Any) -> tuple[StateLeaf, ...]:
    """Return a recurrent model's state by name; a stateless one has none."""
    initial = [np.asarray(convert_to_numpy(one)) for one in policy.get_initial_state()]
    names = ("h", "c") if isinstance(policy.model, LSTMWrapper) else tuple(str(index) for index in range(len(initial)))
    return tuple(StateLeaf(name, one) for name, one in zip(names if initial else (), initial, strict=True))


def _restore(files: OldStackFiles, app_dir: Path) -> Any:
    """Return the policy, as `Policy.from_checkpoint` would, but always on the CPU and without its optimizer."""
    state = unpickle(files.state, missing_ok=True)
    if not isinstance(state, dict) or not isinstance(state.get("policy_spec"), dict) or "weights" not in state:
        raise CheckpointError(
            f"{files.state} is not a policy's state: expected a dictionary with 'policy_spec' and 'weights'"
        )
    update_policy_state(state, files)
    config = state["policy_spec"].get("config") or {}
    _check_config(files, state["policy_spec"].get("policy_class"), config)
    check_connectors(state)
    for part in ("model", "policy_model_config", "q_model_config"):  # the last two are SAC's
        register_custom_parts(config.get(part) or {}, app_dir)
    config.update({"num_gpus": 0, "num_gpus_per_env_runner": 0})
    state.pop("_optimizer_variables", None)
    chatty = logging.getLogger("ray._common.deprecation")
    level = chatty.level
    chatty.setLevel(logging.ERROR)  # it warns that the old stack is deprecated
    try:
        policy: Any = Policy.from_state(state)
    except Exception as error:  # whatever RLlib, torch or the user's own constructor raises
        # torch says which weights are missing on the lines below the first.
        reason = " ".join(str(error).split())[:300] if "state_dict" in str(error) else explain(error)
        raise CheckpointError(f"{files.state} cannot be restored: {reason}") from error
    finally:
        chatty.setLevel(level)
    if not issubclass(type(policy), TorchPolicy | TorchPolicyV2):
        raise UnsupportedError(
            f"policy {type(policy).__name__} is not a torch policy: only torch policies are exported"
        )
    return policy


def _check_config(files: OldStackFiles, policy_class: Any, config: Mapping[str, Any]) -> None:
    name = policy_class if isinstance(policy_class, str) else getattr(policy_class, "__name__", str(policy_class))
    framework = config.get("framework", "torch")
    if framework != "torch":
        raise UnsupportedError(
            f"policy {name} of {files.root} is written in {framework} (TensorFlow): only torch policies are exported; "
            "train with framework='torch'"
        )
    if any(config.get(setting) is True for setting in MIXTURES):
        raise UnsupportedError(
            f"{files.root} holds an RLModule inside an old-stack policy ({name}), which today's Ray cannot restore; of "
            "these, only RLlib's own for vectors without memory are exported: train again with a later Ray"
        )


def _check_policy(files: OldStackFiles, policy: Any) -> None:
    name, model = type(policy).__name__, type(policy.model).__name__
    for column, view in policy.model.view_requirements.items():
        if not view.used_for_compute_actions:
            continue
        shift = {SampleBatch.OBS: 0}.get(column, -1 if column.startswith("state_in_") else None)
        if shift is None or np.any(np.asarray(view.shift_arr) != shift):
            raise UnsupportedError(
                f"model {model} of policy {name} is given more than the current observation and its own last state "
                f"('{column}', shift {view.shift}), which is not exported: the graph has no other input"
            )
    samples_itself = (
        is_overridden(policy.action_sampler_fn) if issubclass(type(policy), TorchPolicyV2) else policy.action_sampler_fn
    )
    if samples_itself:
        raise UnsupportedError(f"policy {name} samples its actions itself (action_sampler_fn), which is not exported")
    for method in ("compute_actions_from_input_dict", "_compute_action_helper"):
        owner = next(kind for kind in type(policy).__mro__ if method in vars(kind))
        if not owner.__module__.startswith("ray.rllib."):
            raise UnsupportedError(
                f"policy {name} computes its actions in a {method} of its own ({owner.__module__}), which is not "
                "exported: do it in the model or in its action distribution"
            )
    if any(isinstance(part, NoisyLayer) for part in policy.model.modules()):
        raise UnsupportedError(
            f"model {model} has noisy layers (noisy=True), which RLlib's old stack draws again for every action, "
            "exploring or not: no single action can prove an export"
        )
    if isinstance(policy.exploration, ParameterNoise):
        raise UnsupportedError(
            f"policy {name} explores with ParameterNoise, and RLlib saves its weights with that moment's noise (ray "
            "2.60): without exploration it acts with others"
        )
    for key in diverged_weights(policy.model):
        raise CheckpointError(f"{files.state}: the weights '{key}' are not all finite: training diverged")
    _prepare(policy)


def _prepare(policy: Any) -> None:
    policy.model.eval().requires_grad_(False)


def _check_spaces(policy: Any, observation_space: Any, action_space: Any, steps: tuple[ObservationStep, ...]) -> None:
    """Raise UnsupportedError unless both spaces are of a kind that is exported."""
    check_spaces(observation_space, action_space, steps, integer_actions=True)
    if policy.observation_space.shape is None:
        raise UnsupportedError(
            f"observations {observation_space} reach model {type(policy.model).__name__} in parts, as RLlib's "
            "preprocessors are switched off (_disable_preprocessor_api): not exported"
        )
    for name, space in space_leaves(action_space, "action").items():
        if isinstance(space, Box) and len(space.shape) != 1:
            raise UnsupportedError(
                f"{name}: {space} has {len(space.shape)} dimensions, of which RLlib's old stack sends one: only "
                "one-dimensional Box actions are exported"
            )


def _action_rule(
    policy: Any, action_space: Any, notify: Callable[[str], None]
) -> tuple[DistributionKind | None, Mode, tuple[str, ...]]:
    """Return the distribution's kind, how its mode is computed and the outputs' names, by asking the class."""
    model = type(policy.model).__name__
    zeros = np.zeros((2, *policy.observation_space.shape), np.float32)
    state = [torch.as_tensor(np.stack([leaf.initial] * 2)) for leaf in _network_state(policy)]
    try:
        with torch.no_grad():
            inputs, kind, _ = _distribution(policy, zeros, state)
    except KeyError as error:
        raise UnsupportedError(
            f"model {model} reads {error} besides the observation, which is not exported: the graph has no such input"
        ) from error
    except Exception as error:  # the user's own forward may raise anything
        raise UnsupportedError(
            f"model {model} does not run on a plain batch of observations: {first_line(error)}"
        ) from error
    plain = getattr(kind, "func", kind)  # RLlib binds the space to some of its classes
    if isinstance(policy.model, DQNTorchModel) and issubclass(plain, TorchCategorical):
        return None, "argmax", (Q_VALUES,)
    parts = getattr(kind, "keywords", {}).get("child_distributions", ())
    children = [getattr(part, "func", part) for part in parts]
    mode = find_mode(
        lambda probe: kind(probe, policy.model).deterministic_sample(), (plain, *children), action_space, inputs
    )
    all_known = all(map(distribution_kind, children))
    # The mode is "given" for counted integers and for the user's own distributions.
    distribution = distribution_kind(plain) if all_known and mode != "given" else None
    if distribution is None:
        notify(f"the action distribution {plain.__name__} on {action_space} is not one the export can explore with")
    return distribution, mode, (ACTION_DIST_INPUTS,)


def _has_value(policy: Any, notify: Callable[[str], None]) -> bool:
    """Return whether the policy's loss trains a value head (DQN's and SAC's models have one that nothing trains)."""
    if not issubclass(type(policy), ValueNetworkMixin):
        return False
    for setting, untrained in (("beta", 0), ("use_critic", False)):  # of MARWIL (then it is BC) and of PPO
        if setting in policy.config and policy.config[setting] == untrained:
            notify(f"with {setting}={untrained} training leaves the value head as it is: the export has no 'value'")
            return False
    try:
        policy.model.value_function()
    except Exception as error:  # the user's own model need not have one
        notify(f"model {type(policy.model).__name__} has no value function ({first_line(error)}): nor has the export")
        return False
    return True
