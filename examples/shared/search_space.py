"""Read hyper-parameters from a command line or a YAML file: `lr=1e-4,3e-4` and ranges, checked against an algorithm.

    lr: [0.0001, 0.0003]            # each of them, as --sweep lr=1e-4,3e-4
    gamma: {uniform: [0.95, 0.999]}  # drawn for each of --num-samples
    entropy_coeff: {loguniform: [0.0001, 0.01]}
    minibatch_size: {choice: [64, 128, 256]}
    train_batch_size_per_learner: {randint: [1000, 4000]}

A name is an attribute of the algorithm's configuration (`PPOConfig().lr`). Names of RLlib's old API stack are refused
with today's.
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import yaml
from ray import tune
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.tune.search.sample import Categorical, Domain

from rlservo import errors

assert ray_settings
DISTRIBUTIONS: dict[str, Callable[..., Any]] = {
    "uniform": tune.uniform,
    "loguniform": tune.loguniform,
    "randint": tune.randint,
    "quniform": tune.quniform,
}

NEW_NAMES = {
    "num_workers": "--num-cpus",
    "num_rollout_workers": "--num-cpus",
    "num_env_runners": "--num-cpus",
    "num_gpus": "--num-gpus",
    "num_envs_per_worker": "--num-envs-per-env-runner",
    "num_envs_per_env_runner": "--num-envs-per-env-runner",
    "num_sgd_iter": "num_epochs",
    "sgd_minibatch_size": "minibatch_size",
    "train_batch_size": "train_batch_size_per_learner",
    "lambda": "lambda_",
    "evaluation_num_workers": "--evaluation-num-env-runners",
    "fcnet_hiddens": "--hidden",
    "model": "--hidden and --use-lstm",
    "env": "--name-env",
    "env_config": "--env-arg",
    "seed": "--seed",
}


def parse_settings(pairs: Sequence[str], option: str) -> dict[str, list[Any]]:
    """Return NAME=VALUE[,VALUE...] pairs as lists of YAML values (`1e-4` is also a number).

    Raises UsageError naming the malformed pair.
    """
    settings: dict[str, list[Any]] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        values = [_value(part) for part in text.split(",")] if not text.startswith(("[", "{")) else [_value(text)]
        if not equals or not name.isidentifier() or any(value is None for value in values):
            raise errors.UsageError(f"{option} {pair}: expected NAME=VALUE or NAME=VALUE,VALUE,..., as in lr=1e-4,3e-4")
        if name in settings:
            raise errors.UsageError(
                f"{option} {pair}: {name} was given before; write its values after one =, with commas"
            )
        settings[name] = values
    return settings


def _value(text: str) -> Any:
    try:
        return float(text) if "e" in text.lower() and _is_number(text) else yaml.safe_load(text)
    except yaml.YAMLError:
        return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def load_search_space(path: Path) -> dict[str, Any]:
    """Return a YAML file's search space, by name, as Tune's domains.

    Raises UsageError when it cannot be read, naming the entry that is wrong.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise errors.UsageError(f"--search-space {path}: cannot be read: {reason}") from error
    if not isinstance(document, Mapping) or not document:
        raise errors.UsageError(f"--search-space {path}: expected a map from a setting's name to its values or range")
    return {str(name): _domain(path, str(name), entry) for name, entry in document.items()}


def _domain(path: Path, name: str, entry: Any) -> Any:
    if isinstance(entry, list) and entry:
        return tune.grid_search([_number(value) for value in entry])
    if isinstance(entry, Mapping) and len(entry) == 1:
        kind, values = next(iter(entry.items()))
        if kind == "choice" and isinstance(values, list) and values:
            return tune.choice([_number(value) for value in values])
        if kind in DISTRIBUTIONS and isinstance(values, list):
            numbers = [_number(value) for value in values]
            count = 3 if kind == "quniform" else 2
            if len(numbers) == count and all(isinstance(one, int | float) for one in numbers):
                if numbers[0] < numbers[1] and (kind != "loguniform" or numbers[0] > 0):
                    return DISTRIBUTIONS[kind](*numbers)
                raise errors.UsageError(
                    f"--search-space {path}: {name}: {kind} {values} needs low < high (above 0 for log)"
                )
    if not isinstance(entry, list | Mapping):
        return _number(entry)
    raise errors.UsageError(
        f"--search-space {path}: {name}: expected a value, a list, or one of "
        f"{', '.join(['choice', *DISTRIBUTIONS])} with a list, got {entry}"
    )


def _number(value: Any) -> Any:
    """YAML 1.1 reads 1e-4, without a point, as text."""
    return float(value) if isinstance(value, str) and _is_number(value) else value


def apply(config: AlgorithmConfig, settings: Mapping[str, Any], option: str) -> None:
    """Set each setting on the configuration.

    Raises UsageError for a name the algorithm does not have, naming today's or the closest ones.
    """
    names = [name for name in vars(config) if not name.startswith("_")]
    names += [name.removeprefix("_") for name in vars(config) if hasattr(type(config), name.removeprefix("_"))]
    for name, value in settings.items():
        if name in NEW_NAMES:
            raise errors.UsageError(f"{option} {name}: use {NEW_NAMES[name]} instead")
        if name not in names:
            close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
            hint = f"did you mean {' or '.join(close)}?" if close else f"see {type(config).__name__}'s attributes"
            raise errors.UsageError(f"{option} {name}: {type(config).__name__} has no such setting: {hint}")
        try:
            setattr(config, name, value)
        except Exception as error:  # RLlib's deprecated names raise in their setters
            raise errors.UsageError(f"{option} {name}: RLlib refuses it: {str(error).splitlines()[0]}") from error


def validate(config: AlgorithmConfig, of: str = "this configuration") -> None:
    """Raise UsageError when RLlib would refuse the configuration."""
    try:
        config.copy(copy_frozen=False).validate()
    except Exception as error:  # RLlib's checks raise ValueError and much else
        raise errors.UsageError(f"RLlib refuses {of}: {' '.join(str(error).split())}") from error


def check_combinations(config: AlgorithmConfig, space: Mapping[str, Any], at_most: int = 100) -> list[AlgorithmConfig]:
    """Return the configuration of each combination of swept values: all of a list's, one of a range's.

    Raises UsageError for one that RLlib would refuse.
    """
    combinations = []
    axes = [_values(domain) for domain in space.values()]
    for values in itertools.islice(itertools.product(*axes), at_most) if space else ():
        combination = dict(zip(space, values, strict=True))
        one = config.copy(copy_frozen=False)
        apply(one, combination, "--sweep")
        validate(one, " ".join(f"{name}={value}" for name, value in combination.items()))
        combinations.append(one)
    return combinations


def _values(domain: Any) -> list[Any]:
    if isinstance(domain, Mapping):
        return list(domain["grid_search"])
    if isinstance(domain, Categorical):
        return list(domain.categories)
    return [domain.sample()] if isinstance(domain, Domain) else [domain]
