"""Source of rsl_rl 5: `model_*.pt` with `params/agent.yaml`, as Isaac Lab and mjlab write them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box

from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.unpickle import explain
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.recipe.recipe import ObservationFilter, Recipe, StateLeaf
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from torch import Tensor

    from rlservo.export.sources.restored_policy import RestoredPolicy

AGENT, ENVIRONMENT = Path("params/agent.yaml"), Path("params/env.yaml")
ACTORS = {"actor": "actor_state_dict", "student": "student_state_dict"}
"""The part of agent.yaml that acts, by algorithm (PPO, distillation), and its weights in the checkpoint."""
_MODEL = re.compile(r"model_(\d+)\.pt")


class RslRl(Source):
    """Runs of Isaac Lab, mjlab or rsl_rl itself."""

    name = "rsl_rl"
    framework = "rsl_rl"
    distribution = "rsl-rl-lib"
    extra = "rsl-rl"
    packages = ("rsl_rl", "tensordict")
    expects = "rsl_rl's model_*.pt with params/agent.yaml beside it, or that folder"
    reference = (
        "rsl_rl's own actor, the module that runner.get_inference_policy() returns, with its normalizer and memory; "
        "then the scale and offset of the environment's action terms"
    )

    def detects(self, path: Path) -> bool:
        model = newest_model(path)
        agent = _agent_file(model) if model else None
        # skrl's agent.yaml has other parts.
        return agent is not None and bool(
            re.search(r"^(actor|student|policy):", agent.read_text("utf-8"), re.MULTILINE)
        )

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        model = newest_model(given)
        agent = _agent_file(model) if model else None
        if model is None or agent is None:
            raise CheckpointError(f"{given} is not a run of rsl_rl: expected {self.expects}")
        environment = agent.with_name(ENVIRONMENT.name)
        files = [model, agent, *([environment] if environment.is_file() else [])]
        return one_policy(model, files, module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return ""  # torch.load(weights_only=True) and plain YAML

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002
        from rlservo.export.sources.isaac_env import read_yaml

        agent = read_yaml(_agent_file(files.root) or files.root)
        algorithm = (agent.get("algorithm") or {}).get("class_name") or "unknown"
        match = _MODEL.fullmatch(files.root.name)
        return CheckpointFacts(str(algorithm), training_iterations=int(match[1]) if match else None)

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:  # noqa: ARG002
        return _restore(files.root, notify)


def newest_model(path: Path) -> Path | None:
    """Return the `model_*.pt` that `path` is, or the newest that it holds."""
    if path.is_file():
        return path if path.suffix == ".pt" else None
    numbered = [(int(match[1]), file) for file in path.glob("model_*.pt") if (match := _MODEL.fullmatch(file.name))]
    return max(numbered)[1] if numbered else None


def _agent_file(model: Path) -> Path | None:
    file = model.parent / AGENT
    return file if file.is_file() else None


def load_weights(file: Path) -> dict[str, Any]:
    """Return what `torch.save` wrote, without running code. Raises CheckpointError if it cannot be read."""
    import torch

    try:
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged archives and forbidden classes raise several unrelated types
        raise CheckpointError(f"{file} cannot be read as weights alone: {explain(error)}") from error
    if not isinstance(loaded, dict):
        raise CheckpointError(f"{file} holds a {type(loaded).__name__}: expected a dictionary of weights")
    return loaded


def _restore(file: Path, notify: Notify) -> RestoredPolicy:
    from rlservo.export.sources.isaac_env import ActionTerms, action_terms, read_yaml
    from rlservo.export.sources.restored_policy import ElementNames
    from rlservo.export.sources.torch_policy import TorchPolicy, restored

    agent_file = _agent_file(file)
    assert agent_file is not None, "locate has found it"
    agent, weights = read_yaml(agent_file), load_weights(file)
    part = next((part for part, key in ACTORS.items() if key in weights), None)
    if part is None or part not in agent:
        raise UnsupportedError(
            f"{file}: expected the weights and settings of an actor as rsl_rl 5 writes them (actor_state_dict, and "
            f"'actor' in {agent_file}), got {', '.join(sorted(weights)[:4])}: continue a run of an older rsl_rl with "
            "rsl_rl 5 first, or export its network with rlservo.export_policy"
        )
    state_dict = weights[ACTORS[part]]
    actor, acting = (_actor(file, agent, part, state_dict) for _ in range(2))
    groups = (agent.get("obs_groups") or {}).get(part) or ["policy"]
    if len(groups) > 1:
        notify(f"an observation concatenates the groups {', '.join(groups)}, in this order")
    size = acting.distribution.output_dim if acting.distribution is not None else state_dict[_last(state_dict)].shape[0]
    environment = file.parent / ENVIRONMENT
    limit = agent.get("clip_actions")
    terms = ActionTerms(notes=("no params/env.yaml: the export gives the policy's own numbers, unscaled",))
    if environment.is_file():
        terms = action_terms(read_yaml(environment), size, float(limit) if limit is not None else None)
    for note in terms.notes:
        notify(note)
    frozen = _filter(file, actor)
    memory = _memory(actor)
    recipe = Recipe(
        Box(-np.inf, np.inf, (actor.obs_dim,), np.float32),
        Box(-np.inf, np.inf, (size,), np.float32),
        (frozen,) if frozen else (),
        "given",
        "none",
        None,
        memory,
        affine=terms.affine,
    )
    exported = actor.as_onnx(verbose=False)
    if frozen is not None:
        import torch

        exported.obs_normalizer = torch.nn.Identity()  # it is the recipe's
    untrained = (
        f"the normalizer's statistics come from {frozen.count} observations" if frozen and not frozen.count else ""
    )
    policy = TorchPolicy(recipe, exported, _traced(len(memory)), lambda: _Reference(acting))
    elements = ElementNames((), terms.elements, terms.control_rate_hz)
    return restored(policy, elements, str(file), f"{type(acting).__module__}.{type(acting).__qualname__}", untrained)


def _actor(file: Path, agent: Mapping[str, Any], part: str, state_dict: Mapping[str, Tensor]) -> Any:
    """Return the actor with its weights; sizes are those of the weights, as the checkpoint does not store them."""
    import torch
    from rsl_rl.models import MLPModel
    from rsl_rl.utils import resolve_class
    from tensordict import TensorDict

    try:
        kind, settings = resolve_class(agent[part])
    except Exception as error:  # a class of the user's own is imported
        raise CheckpointError(f"{file}: the class of its {part} cannot be imported: {explain(error)}") from error
    if not (isinstance(kind, type) and issubclass(kind, MLPModel)) or any("cnn" in key for key in state_dict):
        raise UnsupportedError(f"{file}: its {part} is a {kind}: only rsl_rl's models of vectors are exported")
    first = next((key for key in ("rnn.rnn.weight_ih_l0", "mlp.0.weight") if key in state_dict), None)
    if first is None:
        raise UnsupportedError(f"{file}: its {part} has no layer mlp.0 or rnn.rnn: the observation's size is unknown")
    obs = TensorDict({"obs": torch.zeros(1, state_dict[first].shape[1])}, batch_size=[1])
    rows = int(state_dict[_last(state_dict)].shape[0])
    errors = []
    for size in (rows, rows // 2):  # a distribution may take two numbers for each action
        try:
            model: Any = kind(obs, {part: ["obs"]}, part, size, **settings)
            model.load_state_dict(state_dict)
        except Exception as error:  # of another size, or settings that do not fit the weights
            errors.append(error)
            continue
        return model.eval().requires_grad_(False)
    raise CheckpointError(f"{file}: its weights do not fit {AGENT}: {' '.join(str(errors[0]).split())[:300]}")


def _last(state_dict: Mapping[str, Tensor]) -> str:
    """Return the name of the last layer's weights."""
    return max(
        (key for key in state_dict if re.fullmatch(r"mlp\.\d+\.weight", key)), key=lambda key: int(key.split(".")[1])
    )


def _filter(file: Path, actor: Any) -> ObservationFilter | None:
    """Return the empirical normalizer, `(obs - mean) / (std + eps)`, or None."""
    if not actor.obs_normalization:
        return None
    normalizer = actor.obs_normalizer
    mean, std = normalizer.mean.double().numpy(), normalizer.std.numpy()
    if not (np.isfinite(mean).all() and np.isfinite(std).all()):
        raise CheckpointError(f"{file}: the normalizer's mean or standard deviation is not finite: training diverged")
    return ObservationFilter(int(normalizer.count), mean, std, None, epsilon=float(normalizer.eps))


def _memory(actor: Any) -> tuple[StateLeaf, ...]:
    if not actor.is_recurrent:
        return ()
    import torch

    network = actor.rnn.rnn
    names = ("h", "c") if isinstance(network, torch.nn.LSTM) else ("h",)
    zeros = np.zeros((network.num_layers, network.hidden_size), np.float32)
    return tuple(StateLeaf(name, zeros) for name in names)


def _traced(count: int) -> Any:
    """Return how rsl_rl's own module for ONNX takes an observation and a state."""

    def act(exported: Any, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        if not count:
            return exported(obs), []
        action, *after = exported(obs, *(leaf.transpose(0, 1).contiguous() for leaf in state))
        return action, [leaf.transpose(0, 1) for leaf in after[:count]]

    return act


class _Reference:
    """rsl_rl's inference policy; it keeps its memory itself, which is set to that of the gate's rows."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def __call__(self, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        from tensordict import TensorDict

        if state:
            hidden = [leaf.transpose(0, 1).contiguous() for leaf in state]
            self._actor.reset(hidden_state=tuple(hidden) if len(hidden) > 1 else hidden[0])
        action = self._actor(TensorDict({"obs": obs}, batch_size=[len(obs)]))
        after = self._actor.get_hidden_state() if state else ()
        after = after if isinstance(after, tuple) else (after,)
        return action, [leaf.transpose(0, 1) for leaf in after]
