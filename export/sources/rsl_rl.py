"""Source of rsl_rl 5: `model_*.pt` with `params/agent.yaml`, as Isaac Lab and mjlab write them."""

from __future__ import annotations

import contextlib
import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from gymnasium.spaces import Box

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.facts import CheckpointFacts, read_facts
from rlservo.export.checkpoints.location import FACTS_FILE
from rlservo.export.checkpoints.unpickle import explain
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
        "the policy of rsl_rl's own runner, restored by runner.load: get_inference_policy() with its normalizer and "
        "memory; with an env.yaml, then its action terms' process_actions, as Isaac Lab computes it"
    )
    options = ("--joint-order",)

    def detects(self, path: Path) -> bool:
        model = newest_model(path)
        agent = _agent_file(model) if model else None
        # skrl's agent.yaml has other parts.
        return agent is not None and bool(
            re.search(r"^(actor|student|policy):", agent.read_text("utf-8", errors="replace"), re.MULTILINE)
        )

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        model = newest_model(given)
        agent = _agent_file(model) if model else None
        if model is None or agent is None:
            raise CheckpointError(f"{given} is not a run of rsl_rl: expected {self.expects}")
        return one_policy(model, [model, agent, *environment_files(agent)], module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return ""  # torch.load(weights_only=True) and plain YAML

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:
        if (files.root.parent / FACTS_FILE).is_file():  # one of the policies that ship
            return read_facts(files.root.parent, notify)
        from rlservo.export.sources.isaac_env import read_yaml, section

        agent_file = _agent_file(files.root) or files.root
        algorithm = section(read_yaml(agent_file), "algorithm", agent_file).get("class_name") or "unknown"
        match = _MODEL.fullmatch(files.root.name)
        return CheckpointFacts(str(algorithm), training_iterations=int(match[1]) if match else None)

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        return _restore(files.root, options.joint_order, notify)


def newest_model(path: Path) -> Path | None:
    """Return the `model_*.pt` that `path` is, or the newest that it holds."""
    if path.is_file():
        return path if path.suffix == ".pt" else None
    numbered = [(int(match[1]), file) for file in path.glob("model_*.pt") if (match := _MODEL.fullmatch(file.name))]
    return max(numbered)[1] if numbered else None


def environment_files(agent: Path) -> list[Path]:
    """Return the files beside `agent` that describe the environment."""
    from rlservo.export.sources.isaac_env import DESCRIPTORS

    files = (agent.with_name(ENVIRONMENT.name), agent.parent.parent / DESCRIPTORS)
    return [file for file in files if file.is_file()]


def _agent_file(model: Path) -> Path | None:
    file = model.parent / AGENT
    return file if file.is_file() else None


def load_weights(file: Path) -> dict[str, Any]:
    """Return what `torch.save` wrote, without running code. Raises CheckpointError if it cannot be read."""
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a pickle's version
            loaded = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged archives and forbidden classes raise several unrelated types
        raise CheckpointError(f"{file} cannot be read as weights alone: {_why_not_weights(error)}") from error
    if not isinstance(loaded, dict):
        raise CheckpointError(f"{file} holds a {type(loaded).__name__}: expected a dictionary of weights")
    return loaded


def _why_not_weights(error: Exception) -> str:
    """Return a reason in our own words: torch's advice is to load the file unsafely."""
    words = str(error)
    if "TorchScript" in words:
        return "it is a TorchScript module: expected what the trainer saved"
    if "Weights only load failed" in words or "weights_only" in words:
        named = re.search(r"GLOBAL ([\w.]+)", words)
        what = f"the Python class {named[1]}" if named else "Python objects"
        return f"it is a pickle with {what} in it, which would run code when loaded: save tensors and numbers only"
    return explain(error) if words.strip() else "it is empty or damaged"


def _restore(file: Path, joint_order: tuple[str, ...], notify: Notify) -> RestoredPolicy:
    from rlservo.export.sources.isaac_env import action_terms, clip_actions, read_yaml
    from rlservo.export.sources.isaac_observations import clip_notes, observation_elements
    from rlservo.export.sources.present_position import with_targets
    from rlservo.export.sources.restored_policy import ElementNames
    from rlservo.export.sources.torch_policy import TorchPolicy, restored

    agent_file = _agent_file(file)
    assert agent_file is not None, "locate has found it"
    agent, weights = read_yaml(agent_file), load_weights(file)
    part, state_dict = _acting_part(file, agent_file, agent, weights)
    actor = _actor(file, agent, part, state_dict)
    size = actor.distribution.output_dim if actor.distribution is not None else state_dict[_last(state_dict)].shape[0]
    environment = file.parent / ENVIRONMENT
    terms = action_terms(environment, size, clip_actions(agent_file, agent), joint_order)
    groups = _groups(agent_file, agent, part)
    if len(groups) > 1:
        notify(f"an observation concatenates the groups {', '.join(groups)}, in this order")
    for note in (*terms.notes, *clip_notes(environment, groups)):
        notify(note)
    frozen = _filter(file, actor)
    memory = _memory(actor)
    low, high = terms.bounds or (-np.inf, np.inf)
    recipe = Recipe(
        Box(-np.inf, np.inf, (actor.obs_dim,), np.float32),
        Box(low, high, (size,), np.float32),
        (frozen,) if frozen else (),
        "given",
        "clip" if terms.bounds else "none",
        None,
        memory,
        affine=terms.affine,
    )
    observed = observation_elements(environment, groups, actor.obs_dim, terms, joint_order)
    recipe, elements = with_targets(recipe, ElementNames(observed, terms.elements, terms.control_rate_hz))
    exported = actor.as_onnx(verbose=False)
    if frozen is not None:
        import torch

        exported.obs_normalizer = torch.nn.Identity()  # it is the recipe's
    untrained = (
        f"the normalizer's statistics come from {frozen.count} observations" if frozen and not frozen.count else ""
    )
    reference = _RslRlReference(
        file, part, (actor.obs_dim, size), environment if terms.processed else None, joint_order,
        groups if recipe.present else (),
    )  # fmt: skip
    policy = TorchPolicy(recipe, exported, _traced(len(memory)), lambda: reference)
    made = restored(policy, elements, str(file), _name(actor), untrained)
    _check_as_onnx(file, actor)
    return made


def _check_as_onnx(file: Path, actor: Any) -> None:
    """Raise UnsupportedError for a class of the user's own whose way to act is not in what its base gives for ONNX."""
    for part, acts, gives in (
        (actor, "forward", "as_onnx"),
        (actor, "get_latent", "as_onnx"),
        (actor.distribution, "deterministic_output", "as_deterministic_output_module"),
    ):
        owners = [next((kind for kind in type(part).__mro__ if name in vars(kind)), type) for name in (acts, gives)]
        if owners[0] is not owners[1] and issubclass(*owners):
            raise UnsupportedError(
                f"{file}: {_name(part)} acts by its own '{acts}', which the '{gives}' of {owners[1].__name__} leaves "
                f"out: give it a '{gives}' that does the same"
            )


def _acting_part(
    file: Path, agent_file: Path, agent: Mapping[str, Any], weights: Mapping[str, Any]
) -> tuple[str, dict[str, Tensor]]:
    """Return the part of agent.yaml that acts, and its weights."""
    import torch

    part = next((part for part, key in ACTORS.items() if key in weights), None)
    state_dict = weights.get(ACTORS[part]) if part else None
    if "model_state_dict" in weights or (isinstance(state_dict, dict) and {"std", "log_std"} & state_dict.keys()):
        raise UnsupportedError(
            f"{file} is of rsl_rl 2, 3 or 4, whose networks rsl_rl 5 does not load: give its actor to "
            "rlservo.export_policy, as examples/rsl_rl_older.py does"
        )
    if part is None or part not in agent:
        raise UnsupportedError(
            f"{file}: expected the weights and settings of an actor as rsl_rl 5 writes them (actor_state_dict, and "
            f"'actor' in {agent_file}), got {', '.join(sorted(map(str, weights))[:4])}"
        )
    if not isinstance(state_dict, dict) or not all(isinstance(each, torch.Tensor) for each in state_dict.values()):
        raise CheckpointError(f"{file}: its '{ACTORS[part]}' is not a dictionary of tensors")
    return part, state_dict


def _groups(agent_file: Path, agent: Mapping[str, Any], part: str) -> list[str]:
    """Return the groups that the part's observation concatenates; rsl_rl's own default is 'policy'."""
    from rlservo.export.sources.isaac_env import section

    groups = section(agent, "obs_groups", agent_file).get(part, ["policy"])
    if not isinstance(groups, list) or not groups or not all(isinstance(group, str) for group in groups):
        raise CheckpointError(f"{agent_file}: obs_groups has {groups!r} for the {part}: expected a list of names")
    return groups


def _actor(file: Path, agent: Mapping[str, Any], part: str, state_dict: Mapping[str, Tensor]) -> Any:
    """Return the actor with its weights; sizes are those of the weights, as the checkpoint does not store them."""
    import torch
    from rsl_rl.models import MLPModel
    from rsl_rl.utils import resolve_class
    from tensordict import TensorDict

    from rlservo.export.sources.isaac_env import section

    try:
        kind, settings = resolve_class(dict(section(agent, part, file.parent / AGENT)))
    except CheckpointError:
        raise
    except Exception as error:  # a class of the user's own is imported
        raise CheckpointError(f"{file}: the class of its {part} cannot be imported: {explain(error)}") from error
    if not (isinstance(kind, type) and issubclass(kind, MLPModel)) or any("cnn" in key for key in state_dict):
        raise UnsupportedError(f"{file}: its {part} is a {kind}: only rsl_rl's models of vectors are exported")
    first = next((key for key in ("rnn.rnn.weight_ih_l0", "mlp.0.weight") if key in state_dict), None)
    if first is None or state_dict[first].ndim != 2:
        raise UnsupportedError(f"{file}: its {part} has no layer mlp.0 or rnn.rnn: the observation's size is unknown")
    obs = TensorDict({"obs": torch.zeros(1, state_dict[first].shape[1])}, batch_size=[1])
    rows = int(state_dict[_last(state_dict)].shape[0]) if _last(state_dict) else 0
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
    """Return the name of the last layer's weights; '' if there is none."""
    numbers = [int(match[1]) for key in state_dict if (match := re.fullmatch(r"mlp\.(\d+)\.weight", key))]
    return f"mlp.{max(numbers)}.weight" if numbers else ""


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


class _RslRlReference:
    """The inference policy of rsl_rl's own runner, then the environment's action terms.

    The policy keeps its memory itself, which is set to that of the gate's rows. Nothing of the recipe is used but the
    sizes, with which other weights could not be loaded.
    """

    def __init__(
        self,
        file: Path,
        part: str,
        sizes: tuple[int, int],
        environment: Path | None,
        joint_order: tuple[str, ...],
        positions_in: Sequence[str],
    ) -> None:
        """`positions_in` are the observation's groups if a relative action is added to the positions in them."""
        from rlservo.export.sources.isaac_actions import process_actions

        try:
            settings = yaml.full_load((file.parent / AGENT).read_text("utf-8"))
            self._runner, self._widths = _runner(file, settings, part, sizes)
        except Exception as error:  # the user's own classes, or settings that no runner takes
            raise CheckpointError(f"{file} cannot be restored by rsl_rl's own runner: {explain(error)}") from error
        self._policy = self._runner.get_inference_policy()
        self._is_own = not all(
            kind.__module__.startswith(("rsl_rl.", "torch.", "builtins")) for kind in type(self._policy).__mro__
        )
        if self._is_own and len(self._widths) > 1:
            raise UnsupportedError(
                f"{file}: its {part} is of a class of its own ({_name(self._policy)}), which may treat the groups "
                f"{', '.join(self._widths)} apart; their sizes are in no file, so it cannot be compared"
            )
        if self._policy.is_recurrent:
            self._check_begin(file, sizes[0])
        self._process = process_actions(environment, joint_order, settings.get("clip_actions"), positions_in)

    def __call__(self, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        if state:
            hidden = [leaf.transpose(0, 1).contiguous() for leaf in state]
            self._policy.reset(hidden_state=tuple(hidden) if len(hidden) > 1 else hidden[0])
        action = self._policy(self._observed(obs))
        after = self._memory() if state else []
        return self._process(action, obs), [leaf.transpose(0, 1) for leaf in after]

    def _memory(self) -> list[Tensor]:
        hidden = self._policy.get_hidden_state()
        return list(hidden) if isinstance(hidden, tuple) else [hidden]

    def _observed(self, obs: Any) -> Any:
        """Return the policy's observation. A class of the user's own may not ask whether there are other groups."""
        from tensordict import TensorDict

        policy, own = _name(self._policy), tuple(self._widths)

        class Groups(TensorDict):  # type: ignore[no-untyped-call]
            def keys(self, *_: Any, **__: Any) -> Any:
                raise UnsupportedError(
                    f"{policy} asks which observation groups there are: it may read others than {own}"
                )

            def get(self, key: Any, *default: Any, **more: Any) -> Any:
                if key not in own:
                    raise UnsupportedError(f"{policy} asks for the observation group {key!r}: its obs_groups are {own}")
                return super().get(key, *default, **more)

        groups = dict(zip(own, obs.split(list(self._widths.values()), dim=-1), strict=True))
        return (Groups if self._is_own else TensorDict)(groups, batch_size=[len(obs)])

    def _check_begin(self, file: Path, size: int) -> None:
        """Raise UnsupportedError for a memory that begins an episode, the first or another, otherwise than at zero."""
        import torch

        with torch.random.fork_rng(), torch.no_grad():
            obs = self._observed(torch.randn(2, size))
        with torch.no_grad():
            first = self._policy(obs)
            zeros = [torch.zeros_like(leaf) for leaf in self._memory()]
            self._policy.reset(hidden_state=tuple(zeros) if len(zeros) > 1 else zeros[0])
            from_zero = self._policy(obs)
            before = [leaf.clone() for leaf in self._memory()]
            self._policy.reset(torch.tensor([1, 0]))
            after = self._memory()
        begins = all(not new[..., 0, :].any() and torch.equal(new[..., 1, :], old[..., 1, :])
                     for new, old in zip(after, before, strict=True))  # fmt: skip
        if not (begins and torch.allclose(first, from_zero, atol=1e-6)):
            raise UnsupportedError(
                f"{file}: {_name(self._policy)} does not begin an episode with a memory of zeros, as rsl_rl's own "
                "models do: not exported"
            )


def _name(model: Any) -> str:
    return f"{type(model).__module__}.{type(model).__qualname__}"


def _runner(file: Path, settings: dict[str, Any], part: str, sizes: tuple[int, int]) -> tuple[Any, dict[str, int]]:
    """Return rsl_rl's runner with the checkpoint loaded, and the width of each group of the part's observation.

    What only trains is left out: the critic or teacher is the smallest, and extensions may need the user's code.
    """
    import torch
    from rsl_rl.runners import DistillationRunner, OnPolicyRunner
    from tensordict import TensorDict

    other, runner = {"actor": ("critic", OnPolicyRunner), "student": ("teacher", DistillationRunner)}[part]
    groups = {part: (settings.get("obs_groups") or {}).get(part, ["policy"]), other: ["trained"]}
    rest = len(groups[part]) - 1  # no file has the groups' widths, and only their sum matters
    widths = {group: 1 if number else sizes[0] - rest for number, group in enumerate(groups[part])}
    seen = TensorDict({name: torch.zeros(1, width) for name, width in {**widths, "trained": 1}.items()}, batch_size=[1])
    env = SimpleNamespace(num_envs=1, num_actions=sizes[1], device="cpu", cfg={}, get_observations=lambda: seen)
    algorithm = {**settings["algorithm"], "rnd_cfg": None, "symmetry_cfg": None}
    small = {"class_name": "MLPModel", "hidden_dims": [1]}
    settings = {**settings, "algorithm": algorithm, other: small, "obs_groups": groups, "num_steps_per_env": 1,
                "torch_compile_mode": None, "multi_gpu": None}  # fmt: skip
    with _quiet():
        made: Any = runner(env, settings, log_dir=None, device="cpu")
        made.load(str(file), load_cfg={part: True}, map_location="cpu")  # load_weights has read it as weights alone
    made.get_inference_policy().requires_grad_(False)
    return made, widths


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep rsl_rl from printing models, from advice on training and from changing others' random numbers."""
    import torch

    with torch.random.fork_rng(), contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
