"""Source of skrl 2: `agent_*.pt` with the runner's `params/agent.yaml`, as Isaac Lab writes them.

A checkpoint holds only weights. agent.yaml names their models, and the weights give the sizes; models that
were written in Python go through `rlservo.export_policy`.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from rlservo.bundle.scores import ACTION_DIST_INPUTS, Q_VALUES
from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.unpickle import explain
from rlservo.export.recipe.recipe import ObservationFilter, Recipe
from rlservo.export.sources.rsl_rl import environment_files, load_weights
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from torch import Tensor

    from rlservo.export.sources.restored_policy import RestoredPolicy

PARAMS = "params"
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
        "skrl's own agent, restored by its runner and agent.load: agent.act with its preprocessor, the mean action or "
        "the likeliest choice; with an env.yaml, then its action terms' process_actions, as Isaac Lab computes it"
    )
    options = ("--joint-order",)

    def detects(self, path: Path) -> bool:
        found = find_run(path)
        return found is not None and bool(re.search(r"^models:", found[1].read_text("utf-8", errors="replace"), re.M))

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        found = find_run(given)
        if found is None:
            raise CheckpointError(f"{given} is not a run of skrl: expected {self.expects}")
        return one_policy(found[0], [*found, *environment_files(found[1])], module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return "its agent.yaml holds expressions that skrl evaluates; export only those you trust"

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002
        from rlservo.export.sources.isaac_env import read_yaml, section

        found = find_run(files.root)
        assert found is not None, "locate has found it"
        agent = section(read_yaml(found[1]), "agent", found[1])
        match, environment = _AGENT.fullmatch(files.root.name), found[1].with_name("env.yaml")
        steps = None
        if match and environment.is_file():  # the number in the name counts steps of all environments at once
            count = section(read_yaml(environment), "scene", environment).get("num_envs")
            steps = int(match[1]) * count if isinstance(count, int) else None
        return CheckpointFacts(str(agent.get("class") or "unknown"), env_steps=steps)

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        found = find_run(files.root)
        assert found is not None, "locate has found it"
        return _restore(*found, options.joint_order, notify)


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


def _restore(file: Path, agent_file: Path, joint_order: tuple[str, ...], notify: Notify) -> RestoredPolicy:
    from rlservo.export.sources.isaac_env import ActionTerms, action_terms, read_yaml
    from rlservo.export.sources.isaac_observations import clip_notes, observation_elements
    from rlservo.export.sources.present_position import with_targets
    from rlservo.export.sources.restored_policy import ElementNames
    from rlservo.export.sources.torch_policy import TorchPolicy, restored

    config = read_yaml(agent_file)
    weights = load_weights(file)
    layout = _layout(file, agent_file, config, weights)
    agent = _agent(file, config, layout)
    environment = agent_file.with_name("env.yaml")
    terms = ActionTerms()
    if layout.choices is None:
        terms = action_terms(environment, layout.actions, None, joint_order)
    for note in (*terms.notes, *clip_notes(environment, ("policy",))):
        notify(note)
    best = file.with_name("best_agent.pt")
    if _AGENT.fullmatch(file.name) and best.is_file():
        notify(f"this is {file.name}; to export the weights with the best return, give {best}")
    frozen = _filter(file, agent)
    if frozen is None and weights.get("observation_preprocessor"):
        raise CheckpointError(
            f"{file} has an observation_preprocessor, and {agent_file} names none: they do not belong together"
        )
    low, high = terms.bounds or (-np.inf, np.inf)
    action_space = Box(low, high, (layout.actions,), np.float32) if layout.choices is None else Discrete(layout.actions)
    recipe = Recipe(
        _unbounded(layout.observed),
        action_space,
        (frozen,) if frozen else (),
        "given" if layout.choices is None else "argmax",
        "clip" if terms.bounds else "none",
        "categorical" if layout.choices in ("log_probabilities", "probabilities") else None,
        affine=terms.affine,
    )
    observed = observation_elements(environment, ("policy",), layout.observed, terms, joint_order)
    recipe, elements = with_targets(recipe, ElementNames(observed, terms.elements, terms.control_rate_hz))

    def act(policy: Any, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        output = policy.compute({"observations": obs, "states": None}, layout.role)[0]
        return _scores(output, layout.choices), state

    reference = _SkrlReference(
        file, agent_file, layout, environment if terms.processed else None, joint_order,
        ("policy",) if recipe.present else (),
    )  # fmt: skip
    untrained = f"the scaler's statistics come from {frozen.count} observation" if frozen and frozen.count <= 1 else ""
    names = {None: (), "q_values": (Q_VALUES,)}.get(layout.choices, (ACTION_DIST_INPUTS,))
    traced = TorchPolicy(recipe, agent.models[layout.role], act, lambda: reference, names)
    return restored(traced, elements, str(file), "", untrained)


def _scores(output: Tensor, choices: str | None) -> Tensor:
    """Return what a choice is drawn by: logarithms of probabilities, whichever of both a model gives."""
    import torch

    if choices == "log_probabilities":
        return torch.log_softmax(output, dim=-1)
    if choices == "probabilities":
        tiny = torch.finfo(output.dtype).eps
        return (output / output.sum(-1, keepdim=True)).clamp(tiny, 1 - tiny).log()
    return output


class _SkrlReference:
    """The agent of skrl's own runner, made from skrl's own reading of agent.yaml, then the environment's action terms.

    Exploration is off: random first steps, noise, and drawing at random are settings of the agent.
    """

    def __init__(
        self,
        file: Path,
        agent_file: Path,
        layout: _Layout,
        environment: Path | None,
        joint_order: tuple[str, ...],
        positions_in: Sequence[str],
    ) -> None:
        from skrl.utils.runner.torch import Runner

        from rlservo.export.sources.isaac_actions import process_actions

        with _quiet():
            config = Runner.load_cfg_from_yaml(str(agent_file))
        if not config:
            raise CheckpointError(f"{agent_file} cannot be read by skrl: expected plain YAML")
        config["agent"] = {name: value for name, value in config["agent"].items() if not _explores(name)}
        self._agent = _agent(file, config, layout)
        self._role, self._choices, self._states = layout.role, layout.choices, layout.states
        self._process = process_actions(environment, joint_order, None, positions_in)

    def __call__(self, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        # A value function may take states, whatever they are.
        states = obs.new_zeros((len(obs), self._states)) if self._states else None
        actions, outputs = self._agent.act(obs, states, timestep=0, timesteps=1)
        if self._choices is None:
            return self._process(outputs.get("mean_actions", actions), obs), state
        model = self._agent.models[self._role]
        if self._choices != "q_values":
            return model.distribution(role=self._role).logits, state
        scaler = self._agent.checkpoint_modules.get("observation_preprocessor")
        scaled = obs if scaler is None else scaler(obs)
        values = model.act({"observations": scaled, "states": None}, role=self._role)[0]
        if not (values.argmax(-1, keepdim=True) == actions).all():
            raise UnsupportedError("its agent does not act by its largest Q-value")
        return values, state


def _explores(setting: str) -> bool:
    return setting.startswith("exploration_") or setting == "random_timesteps"


@dataclass(frozen=True)
class _Layout:
    """What agent.yaml and the weights say of the model that acts."""

    role: str
    """Its name among the agent's models: `policy`, or `q_network`."""
    observed: int
    states: int | None
    """Number of elements of the state that only a value function sees; None if there is none."""
    actions: int
    """Number of elements of an action, or of its choices."""
    choices: str | None
    """What the model gives for each choice: q_values, probabilities or log_probabilities; None if it gives a Box."""


def _layout(file: Path, agent_file: Path, config: Mapping[str, Any], weights: Mapping[str, Any]) -> _Layout:
    from rlservo.export.sources.isaac_env import section

    algorithm = str(section(config, "agent", agent_file).get("class"))
    if algorithm.lower().endswith("_rnn"):
        raise UnsupportedError(
            f"{file} is of a recurrent agent ({algorithm}), and agent.yaml does not describe its models: make the "
            "agent in Python and export it with rlservo.export_policy, as examples/skrl_recurrent.py does"
        )
    if algorithm.lower() in ("ippo", "mappo"):
        raise UnsupportedError(
            f"{file} is of several agents ({algorithm}: {', '.join(sorted(map(str, weights)))}): give the policy of "
            "each, with its preprocessor, to rlservo.export_policy"
        )
    role = next((role for role in ("policy", "q_network") if isinstance(weights.get(role), Mapping)), None)
    if role is None:
        raise UnsupportedError(f"{file} holds no weights of a 'policy' or 'q_network': it holds "
                               f"{', '.join(sorted(map(str, weights))[:5])}")  # fmt: skip
    models = section(config, "models", agent_file)
    model = section(models, role, agent_file)
    kind = str(model.get("class", ""))
    if not kind.startswith(("Gaussian", "Deterministic", "Categorical")):
        raise UnsupportedError(f"{file}: its {role} is a {kind or 'model without a class'}: GaussianMixin, "
                               "DeterministicMixin and CategoricalMixin are exported")  # fmt: skip
    if any("STATES" in str(network.get("input")) for network in _networks(model)):
        raise UnsupportedError(f"{file}: its {role} takes STATES, which only a simulator has: train it on OBSERVATIONS")
    if model.get("clip_mean_actions") or (model.get("clip_actions") and kind.startswith("Deterministic")):
        raise UnsupportedError(f"{file}: its policy clips to the action space, whose bounds are in no file of the run: "
                               "give the model to rlservo.export_policy")  # fmt: skip
    log_std = weights[role].get("log_std_parameter")
    if not models.get("separate", True) and log_std is None:
        raise UnsupportedError(f"{file}: a shared model does not give its number of actions")
    matrices = [weight for weight in weights[role].values() if getattr(weight, "ndim", 0) == 2]
    if not matrices:
        raise UnsupportedError(f"{file}: its {role} has no linear layer: the sizes of its actions are unknown")
    actions = int(matrices[-1].shape[0]) if getattr(log_std, "ndim", 0) != 1 else int(log_std.shape[0])
    choices = "q_values" if role == "q_network" else None
    if kind.startswith("Categorical"):
        choices = "log_probabilities" if model.get("unnormalized_log_prob", True) else "probabilities"
    states = _scaled(weights, "state_preprocessor")
    for other in [] if states else models:  # such as a critic of its own
        states = states or _width(models[other], weights, other, "STATES")
    return _Layout(role, _observed(file, model, weights, role), states, actions, choices)


def _observed(file: Path, model: Mapping[str, Any], weights: Mapping[str, Any], role: str) -> int:
    """Return the number of elements of an observation: those that are scaled, or that a network takes whole."""
    if scaled := _scaled(weights, "observation_preprocessor"):
        return scaled
    if width := _width(model, weights, role, "OBSERVATIONS"):
        return width
    raise UnsupportedError(
        f"{file}: no network of its {role} takes all of OBSERVATIONS, and no preprocessor scales them: the number of "
        "elements of an observation is in no file of the run; give the model to rlservo.export_policy"
    )


def _width(model: Any, weights: Mapping[str, Any], role: str, what: str) -> int | None:
    """Return the number of elements of OBSERVATIONS or STATES, if a network of the model takes all of them."""
    own = weights.get(role)
    if not isinstance(own, Mapping):
        return None
    for network in _networks(model):
        if str(network.get("input")).strip() == what:
            prefix = f"{network.get('name')}_container."
            first: Any = next((weight for name, weight in own.items() if str(name).startswith(prefix)), None)
            if getattr(first, "ndim", 0) == 2:
                return int(first.shape[1])
    return None


def _networks(model: Any) -> list[Mapping[str, Any]]:
    networks = model.get("network") if isinstance(model, Mapping) else None
    return [each for each in networks if isinstance(each, Mapping)] if isinstance(networks, list) else []


def _unbounded(size: int) -> Box:
    return Box(-np.inf, np.inf, (size,), np.float32)


def _scaled(weights: Mapping[str, Any], name: str) -> int | None:
    """Return the number of elements that a preprocessor scales."""
    module = weights.get(name)
    mean: Any = module.get("running_mean") if isinstance(module, Mapping) else None
    return int(mean.shape[0]) if getattr(mean, "ndim", 0) == 1 else None


def _agent(file: Path, config: Mapping[str, Any], layout: _Layout) -> Any:
    """Return the agent that skrl's runner makes of agent.yaml, with the weights of `file`, which are only numbers."""
    # Only sampled actions are clipped to these bounds, which acting without exploration does not give.
    action_space = Box(-1e30, 1e30, (layout.actions,), np.float32)
    env: Any = SimpleNamespace(
        device="cpu", num_envs=1, num_agents=1, observation_space=_unbounded(layout.observed),
        state_space=_unbounded(layout.states) if layout.states else None,
        action_space=action_space if layout.choices is None else Discrete(layout.actions),
    )  # fmt: skip
    from skrl.utils.runner.torch import Runner

    try:
        trainer = {**(config.get("trainer") or {}), "close_environment_at_exit": False}
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
