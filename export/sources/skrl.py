"""Source of skrl 2: `agent_*.pt` with the runner's `params/agent.yaml`, as Isaac Lab writes them.

A checkpoint holds only weights. agent.yaml names their models, and the weights give the sizes; models that
were written in Python go through `rlservo.export_policy`.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.unpickle import explain
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.contract.scores import ACTION_DIST_INPUTS, Q_VALUES
from rlservo.export.recipe.recipe import ObservationFilter, Recipe
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from torch import Tensor

    from rlservo.export.sources.restored_policy import RestoredPolicy

PARAMS = "params"
AFTER_EXPLORATION = 10**9
"""A time step at which no algorithm draws its actions at random any more."""
_AGENT = re.compile(r"agent_(\d+)\.pt")


class Skrl(Source):
    """Runs of skrl's Runner."""

    name = "skrl"
    framework = "skrl"
    distribution = "skrl"
    extra = "skrl"
    packages = ("skrl",)
    expects = "skrl's agent_*.pt of a run with params/agent.yaml, or the run's folder"
    reference = (
        "skrl's own agent, restored by its runner and agent.load: agent.act with its preprocessor, the mean action; "
        "then the scale and offset of the environment's action terms"
    )

    def detects(self, path: Path) -> bool:
        found = find_run(path)
        return found is not None and bool(re.search(r"^models:", found[1].read_text("utf-8"), re.M))

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        found = find_run(given)
        if found is None:
            raise CheckpointError(f"{given} is not a run of skrl: expected {self.expects}")
        environment = found[1].with_name("env.yaml")
        files = [*found, *([environment] if environment.is_file() else [])]
        return one_policy(found[0], files, module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return "its agent.yaml holds expressions that skrl evaluates; export only those you trust"

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002
        from rlservo.export.sources.isaac_env import read_yaml

        found = find_run(files.root)
        agent = (read_yaml(found[1]) if found else {}).get("agent") or {}
        match = _AGENT.fullmatch(files.root.name)
        return CheckpointFacts(str(agent.get("class") or "unknown"), env_steps=int(match[1]) if match else None)

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:  # noqa: ARG002
        found = find_run(files.root)
        assert found is not None, "locate has found it"
        return _restore(*found, notify)


def find_run(path: Path) -> tuple[Path, Path] | None:
    """Return (weights, agent.yaml) of the run that `path` is, is in, or holds; the newest if there are several."""
    if path.is_file():
        weights = path if path.suffix == ".pt" else None
    else:
        files = [*path.glob("agent_*.pt"), *path.glob("checkpoints/agent_*.pt")]
        numbered = [(int(match[1]), file) for file in files if (match := _AGENT.fullmatch(file.name))]
        weights = max(numbered)[1] if numbered else None
    if weights is None:
        return None
    beside = (folder / PARAMS / "agent.yaml" for folder in (weights.parent, weights.parent.parent))
    agent = next((file for file in beside if file.is_file()), None)
    return None if agent is None else (weights, agent)


def _restore(file: Path, agent_file: Path, notify: Notify) -> RestoredPolicy:
    from rlservo.export.sources.isaac_env import ActionTerms, action_terms, read_yaml
    from rlservo.export.sources.restored_policy import ElementNames
    from rlservo.export.sources.torch_policy import TorchPolicy, restored

    config = read_yaml(agent_file)
    kind = str((config.get("agent") or {}).get("class"))
    if kind.lower().endswith("_rnn"):
        raise UnsupportedError(
            f"{file} is of a recurrent agent ({kind}), and agent.yaml does not describe its models: make the agent in "
            "Python and export it with rlservo.export_policy, as examples/skrl_recurrent.py does"
        )
    weights = _load(file)
    observation_space, state_space, action_space = _spaces(file, config, weights)
    agent, acting = (_agent(file, config, (observation_space, state_space, action_space)) for _ in range(2))
    policy = agent.models["policy"]
    environment = agent_file.with_name("env.yaml")
    terms = ActionTerms(notes=("no params/env.yaml: the export gives the policy's own numbers, unscaled",))
    if isinstance(action_space, Box):
        if environment.is_file():
            terms = action_terms(read_yaml(environment), action_space.shape[0], None)
        for note in terms.notes:
            notify(note)
    frozen = _filter(file, agent)
    scored = isinstance(action_space, Discrete)
    is_q = "q_network" in agent.models
    recipe = Recipe(
        observation_space,
        action_space,
        (frozen,) if frozen else (),
        "argmax" if scored else "given",
        "none",
        None if is_q or not scored else "categorical",
        affine=terms.affine,
    )

    def act(policy: Any, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        return policy.compute({"observations": obs, "states": None}, "policy")[0], state

    def reference(obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        actions, outputs = acting.act(obs, None, timestep=AFTER_EXPLORATION, timesteps=AFTER_EXPLORATION)
        return outputs["net_output"] if scored and "net_output" in outputs else outputs.get(
            "mean_actions", actions
        ), state

    untrained = f"the scaler's statistics come from {frozen.count} observation" if frozen and frozen.count <= 1 else ""
    names = (Q_VALUES if is_q else ACTION_DIST_INPUTS,) if scored else ()
    traced = TorchPolicy(recipe, policy, act, lambda: reference, names)
    return restored(traced, ElementNames((), terms.elements, terms.control_rate_hz), str(file), "", untrained)


def _load(file: Path) -> dict[str, Any]:
    from rlservo.export.sources.rsl_rl import load_weights

    weights = load_weights(file)
    if not isinstance(weights.get("policy"), Mapping):
        raise UnsupportedError(f"{file} holds no weights of a 'policy': it holds {', '.join(sorted(weights)[:5])}")
    return weights


def _spaces(file: Path, config: Mapping[str, Any], weights: Mapping[str, Any]) -> tuple[Any, Any, Any]:
    """Return the spaces of observation, state (None) and action, with the weights' sizes."""
    models = config.get("models") or {}
    of_policy = models.get("policy") or {}
    kind = str(of_policy.get("class", ""))
    if not kind.startswith(("Gaussian", "Deterministic", "Categorical")):
        raise UnsupportedError(f"{file}: its policy is a {kind or 'model without a class'}: GaussianMixin, "
                               "DeterministicMixin and CategoricalMixin are exported")  # fmt: skip
    if of_policy.get("clip_mean_actions") or (of_policy.get("clip_actions") and kind.startswith("Deterministic")):
        raise UnsupportedError(f"{file}: its policy clips to the action space, whose bounds are in no file of the run: "
                               "give the model to rlservo.export_policy")  # fmt: skip
    matrices = [weight for weight in weights["policy"].values() if getattr(weight, "ndim", 0) == 2]
    if not matrices:
        raise UnsupportedError(f"{file}: its policy has no linear layer: the sizes of its observations are unknown")
    size = _scaled(weights, "observation_preprocessor") or int(matrices[0].shape[1])
    state = _scaled(weights, "state_preprocessor")
    log_std = weights["policy"].get("log_std_parameter")
    actions = int(log_std.shape[0]) if log_std is not None else int(matrices[-1].shape[0])
    if not models.get("separate", True) and log_std is None:
        raise UnsupportedError(f"{file}: a shared model does not give its number of actions")
    # Only sampled actions are clipped to these bounds, which acting without exploration does not give.
    action_space = Discrete(actions) if kind.startswith("Categorical") else Box(-1e30, 1e30, (actions,), np.float32)
    return _unbounded(size), _unbounded(state) if state else None, action_space


def _unbounded(size: int) -> Box:
    return Box(-np.inf, np.inf, (size,), np.float32)


def _scaled(weights: Mapping[str, Any], name: str) -> int | None:
    """Return the number of elements that a preprocessor scales."""
    mean = (weights.get(name) or {}).get("running_mean")
    return None if mean is None else int(mean.shape[0])


def _agent(file: Path, config: Mapping[str, Any], spaces: tuple[Any, Any, Any]) -> Any:
    """Return the agent that skrl's runner makes of agent.yaml, with the weights of `file`, which are only numbers."""
    observation_space, state_space, action_space = spaces
    env: Any = SimpleNamespace(
        device="cpu", num_envs=1, num_agents=1, observation_space=observation_space, state_space=state_space,
        action_space=action_space,
    )  # fmt: skip
    from skrl.utils.runner.torch import Runner

    trainer = {**(config.get("trainer") or {}), "close_environment_at_exit": False}
    try:
        with _quiet():
            agent = Runner(env, {**config, "seed": 0, "trainer": trainer}).agent
            agent.load(str(file))
            agent.enable_models_training_mode(False)
    except Exception as error:  # skrl evaluates what the file says, which raises anything
        raise CheckpointError(f"{file} cannot be restored from agent.yaml: {explain(error)}") from error
    return agent


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep skrl from printing models and seeds and from changing others' random numbers."""
    import torch

    logger = logging.getLogger("skrl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    numpy_state = np.random.get_state()
    try:
        with torch.random.fork_rng(), contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        np.random.set_state(numpy_state)
        logger.setLevel(level)


def _filter(file: Path, agent: Any) -> ObservationFilter | None:
    """Return the RunningStandardScaler, `clip((obs - mean) / (sqrt(var) + epsilon))`, or None."""
    scaler = agent.checkpoint_modules.get("observation_preprocessor")
    if scaler is None:
        return None
    if type(scaler).__name__ != "RunningStandardScaler":
        raise UnsupportedError(f"{file}: its observation preprocessor is a {type(scaler).__name__}: only a "
                               "RunningStandardScaler is exported")  # fmt: skip
    mean = scaler.running_mean.float().double().numpy()
    std = scaler.running_variance.float().sqrt().numpy()
    if not (np.isfinite(mean).all() and np.isfinite(std).all()):
        raise CheckpointError(f"{file}: the scaler's mean or variance is not finite: training diverged")
    count = int(scaler.current_count)
    return ObservationFilter(count, mean, std, float(scaler.clip_threshold), epsilon=float(scaler.epsilon))
