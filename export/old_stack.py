"""Restore a policy of RLlib's old API stack, and run it as RLlib itself would. It imports ray.rllib, as checkpoint.py.

Restoring starts nothing: no `ray.init`, no environment, no worker. `OldStackCheckpoint.reference` is the truth an
export is compared with: the policy's own agent connectors, `compute_actions_from_input_dict` and action connectors, as
`EnvRunnerV2` calls them. `Policy.compute_single_action` is not: it leaves filter, preprocessor and unsquashing out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from ray.rllib.algorithms.dqn.dqn_torch_model import DQNTorchModel
from ray.rllib.evaluation.env_runner_v2 import _batch_inference_sample_batches
from ray.rllib.models.torch.modules.noisy_layer import NoisyLayer
from ray.rllib.models.torch.torch_action_dist import TorchCategorical, TorchDiagGaussian, TorchSquashedGaussian
from ray.rllib.policy.policy import Policy
from ray.rllib.policy.sample_batch import SampleBatch
from ray.rllib.policy.torch_mixins import ValueNetworkMixin
from ray.rllib.policy.torch_policy import TorchPolicy
from ray.rllib.policy.torch_policy_v2 import TorchPolicyV2
from ray.rllib.utils.annotations import is_overridden
from ray.rllib.utils.numpy import convert_to_numpy
from ray.rllib.utils.spaces.space_utils import unbatch
from ray.rllib.utils.typing import ActionConnectorDataType, AgentConnectorDataType
from torch import Tensor, nn

from rlservo.export.errors import CheckpointError, UnsupportedError
from rlservo.export.heads import replace_bias_layers
from rlservo.export.old_connectors import check_connectors, read_old_steps, read_old_transform
from rlservo.export.old_location import OldStackFiles
from rlservo.export.old_models import register_custom_model
from rlservo.export.recipe import AnyDiscrete, DistributionKind, Mode, Recipe
from rlservo.export.unpickle import explain, first_line, unpickle, user_folder

DISTRIBUTIONS: dict[type, DistributionKind] = {
    TorchDiagGaussian: "diag_gaussian",
    TorchSquashedGaussian: "squashed_gaussian",
    TorchCategorical: "categorical",
}
AGENT = "agent0"  # what RLlib calls the one agent of an environment


class OldStackNetwork(nn.Module):
    """The policy's forward pass as a module that can be traced: network input to named tensors."""

    def __init__(self, policy: Any, names: tuple[str, ...]) -> None:
        super().__init__()
        self.module: Any = policy.model
        self.names = names
        self._policy = policy

    def forward(self, obs: Tensor) -> tuple[Tensor, ...]:
        """Return one tensor `[batch, ...]` for each of `names`, given the network's input `[batch, ...]`."""
        inputs, _ = _distribution(self._policy, obs)
        return tuple(self.module.value_function() if name == "value" else inputs for name in self.names)


def _distribution(policy: Any, obs: Any) -> tuple[Tensor, Any]:
    """Return (distribution parameters or Q-values, distribution class), computed as `_compute_action_helper` does."""
    batch = policy._lazy_tensor_dict({SampleBatch.OBS: obs})
    batch.set_training(True)  # RLlib does so for inference, too
    how: dict[str, Any] = {"explore": False, "timestep": 0, "is_training": False, "state_batches": [], "seq_lens": None}
    kind: Any = policy.dist_class
    if issubclass(type(policy), TorchPolicyV2) and is_overridden(policy.action_distribution_fn):
        inputs, kind, _ = policy.action_distribution_fn(policy.model, obs_batch=batch, **how)
    elif issubclass(type(policy), TorchPolicy) and policy.action_distribution_fn:
        inputs, kind, _ = policy.action_distribution_fn(policy, policy.model, input_dict=batch, **how)
    else:
        inputs, _ = policy.model(batch, [], None)
    return inputs, kind


@dataclass(frozen=True)
class OldStackCheckpoint:
    """A restored policy: the recipe around its network, the network for tracing, and RLlib's own way to act."""

    recipe: Recipe
    network: OldStackNetwork
    module_class: str
    _policy: Any

    def reference(self, obs: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return what RLlib computes for a batch of raw observations `[batch, *obs_shape]`, by output name.

        `action` is what RLlib would pass to `env.step`: exploration off, filter frozen. Each observation starts an
        episode in an environment of its own. This repeats the steps of `EnvRunnerV2` (ray 2.60).
        """
        policy = self._policy
        envs = [str(row) for row in range(len(obs))]
        for env in envs:
            policy.agent_connectors.reset(env)
        first = {SampleBatch.INFOS: {}, SampleBatch.T: -1, SampleBatch.AGENT_INDEX: 0}
        items = [
            AgentConnectorDataType(env, AGENT, {SampleBatch.NEXT_OBS: one, **first})
            for env, one in zip(envs, obs, strict=True)
        ]
        processed = policy.agent_connectors(items)
        batch = _batch_inference_sample_batches([item.data.sample_batch for item in processed])
        seen = np.asarray(batch[SampleBatch.OBS])
        actions, _, fetches = policy.compute_actions_from_input_dict(
            batch, explore=False, timestep=policy.global_timestep
        )
        with torch.no_grad():
            value = policy.model.value_function().numpy() if "value" in self.network.names else None
            parameters = fetches[SampleBatch.ACTION_DIST_INPUTS]
            if self.recipe.distribution is None:  # a temperature divides DQN's Q-values in place: compute them again
                parameters = _distribution(policy, seen)[0].numpy()
        sent = [
            policy.action_connectors(ActionConnectorDataType(env, AGENT, item.data.raw_dict, (action, [], {}))).output
            for env, item, action in zip(envs, processed, unbatch(convert_to_numpy(actions)), strict=True)
        ]
        outputs = {"action": np.stack([action for action, _, _ in sent]), self.network.names[0]: np.asarray(parameters)}
        return outputs if value is None else {**outputs, "value": value}


def load_old_stack(files: OldStackFiles, notify: Callable[[str], None], *, value: bool = True) -> OldStackCheckpoint:
    """Restore one policy; `value` False leaves the value head out.

    Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
    """
    policy = _restore(files)
    _check_policy(files, policy)
    action_space = policy.action_space
    steps = read_old_steps(policy.agent_connectors)
    observation_space = getattr(policy.observation_space, "original_space", policy.observation_space)
    _check_spaces(observation_space, action_space)
    transform = read_old_transform(policy.action_connectors, action_space)
    distribution, mode = _action_rule(policy, action_space)
    recipe = Recipe(observation_space, action_space, steps, mode, transform, distribution)
    if recipe.filter is not None and recipe.filter.count == 0:
        notify("the observation filter has seen nothing yet: RLlib divides by 1e-6, and so does the export")
    if isinstance(action_space, Discrete) and action_space.start != 0:
        notify(
            f"the action space starts at {action_space.start}, but RLlib sends 0..{action_space.n - 1} to env.step: "
            "the export does the same"
        )
    names: tuple[str, ...] = ("action_dist_inputs" if distribution else "q_values",)
    if value and _has_value(policy, notify):
        names = (*names, "value")
    # A second policy to trace: a model keeps tensors of its last forward pass, which the reference needs for itself.
    traced = _restore(files)
    _prepare(traced)
    replace_bias_layers(traced.model)
    model = type(policy.model)
    return OldStackCheckpoint(
        recipe, OldStackNetwork(traced, names), f"{model.__module__}.{model.__qualname__}", policy
    )


def _restore(files: OldStackFiles) -> Any:
    """Return the policy, as `Policy.from_checkpoint` would, but always on the CPU and without its optimizer."""
    state = unpickle(files.state)
    if not isinstance(state, dict) or not isinstance(state.get("policy_spec"), dict) or "weights" not in state:
        raise CheckpointError(
            f"{files.state} is not a policy's state: expected a dictionary with 'policy_spec' and 'weights'"
        )
    config = state["policy_spec"].get("config") or {}
    _check_config(files, state["policy_spec"].get("policy_class"), config)
    check_connectors(state)
    for part in ("model", "policy_model_config", "q_model_config"):  # the last two are SAC's
        register_custom_model(config.get(part) or {}, user_folder())
    config.update({"num_gpus": 0, "num_gpus_per_env_runner": 0})
    state.pop("_optimizer_variables", None)
    chatty = logging.getLogger("ray._common.deprecation")
    level = chatty.level
    chatty.setLevel(logging.ERROR)  # that the old stack is old is known
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
    mixtures = ("enable_rl_module_and_learner", "_enable_rl_module_api", "_enable_new_api_stack")
    if any(config.get(setting) is True for setting in mixtures):
        raise UnsupportedError(
            f"{files.root} holds an RLModule inside an old-stack policy ({name}), a mixture that Ray 2.5 to 2.9 wrote "
            "and today's cannot restore: restore it in the Ray that wrote it"
        )


def _check_policy(files: OldStackFiles, policy: Any) -> None:
    name, model = type(policy).__name__, type(policy.model).__name__
    if policy.is_recurrent() or policy.model.get_initial_state():
        raise UnsupportedError(
            f"model {model} of policy {name} is recurrent (LSTM or attention), which is not exported yet: its state "
            "would have to become an input and an output of the graph"
        )
    for column, view in policy.model.view_requirements.items():
        if view.used_for_compute_actions and (column != SampleBatch.OBS or np.any(np.asarray(view.shift_arr) != 0)):
            raise UnsupportedError(
                f"model {model} of policy {name} is given more than the current observation ('{column}', shift "
                f"{view.shift}), which is not exported yet: the graph's only input is the observation"
            )
    samples_itself = (
        is_overridden(policy.action_sampler_fn) if issubclass(type(policy), TorchPolicyV2) else policy.action_sampler_fn
    )
    if samples_itself:
        raise UnsupportedError(f"policy {name} samples its actions itself (action_sampler_fn), which is not exported")
    if any(isinstance(part, NoisyLayer) for part in policy.model.modules()):
        raise UnsupportedError(
            f"model {model} has noisy layers (noisy=True), which RLlib's old stack draws anew for every action, "
            "exploring or not: there is no one action to prove an export with"
        )
    _prepare(policy)
    for key, weights in policy.model.state_dict().items():
        if not torch.isfinite(weights).all():
            raise CheckpointError(f"{files.state}: the weights '{key}' are not all finite: training diverged")


def _prepare(policy: Any) -> None:
    policy.model.eval().requires_grad_(False)


def _check_spaces(observation_space: Any, action_space: Any) -> None:
    """Raise UnsupportedError unless both spaces are of a kind that is exported."""
    if not isinstance(observation_space, Box):
        raise UnsupportedError(f"observation space {observation_space} is not exported yet: only Box is")
    if not isinstance(action_space, Box | Discrete):
        raise UnsupportedError(f"action space {action_space} is not exported yet: only Box and Discrete are")
    for space in (observation_space, action_space):
        if isinstance(space, Box) and space.dtype not in (np.float32, np.float64):
            raise UnsupportedError(f"{space} is not exported yet: only float32 and float64 Boxes are")
    if isinstance(action_space, Box) and len(action_space.shape) != 1:
        raise UnsupportedError(
            f"action space {action_space} has {len(action_space.shape)} dimensions, of which RLlib's old stack sends "
            "one: only one-dimensional Box actions are exported"
        )


def _action_rule(policy: Any, action_space: Box | AnyDiscrete) -> tuple[DistributionKind | None, Mode]:
    """Return the distribution's kind and how its mode is computed, found out by asking the class."""
    model = type(policy.model).__name__
    zeros = np.zeros((2, *policy.observation_space.shape), np.float32)
    try:
        with torch.no_grad():
            _, kind = _distribution(policy, zeros)
    except KeyError as error:
        raise UnsupportedError(
            f"model {model} reads {error} besides the observation, which is not exported: the graph's only input is "
            "the observation"
        ) from error
    except Exception as error:  # the user's own forward may raise anything
        raise UnsupportedError(
            f"model {model} does not run on a plain batch of observations: {first_line(error)}"
        ) from error
    plain = getattr(kind, "func", kind)  # RLlib binds the space to some of its classes
    if isinstance(policy.model, DQNTorchModel) and issubclass(plain, TorchCategorical):
        return None, "argmax"
    if plain not in DISTRIBUTIONS:
        known = ", ".join(one.__name__ for one in DISTRIBUTIONS)
        raise UnsupportedError(f"the action distribution {plain.__name__} is not exported yet: known are {known}")
    if isinstance(action_space, Discrete):
        return DISTRIBUTIONS[plain], "argmax"
    probe = torch.linspace(-2.0, 2.0, 2 * int(np.prod(action_space.shape))).reshape(1, -1)
    mode, mean = kind(probe, policy.model).deterministic_sample(), probe.chunk(2, dim=-1)[0]
    if torch.equal(mode, mean):
        return DISTRIBUTIONS[plain], "mean"
    if torch.allclose(mode, torch.tanh(mean), atol=1e-6):
        return DISTRIBUTIONS[plain], "tanh_mean"
    raise UnsupportedError(
        f"the deterministic action of {plain.__name__} is neither its mean nor the mean's tanh: not exported yet"
    )


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
