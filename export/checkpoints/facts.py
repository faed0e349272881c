"""Facts that a checkpoint records about itself: algorithm, environment, progress.

None of it changes the policy, so none of it may stop an export: facts that cannot be read are left out, with a
notice. A pruned checkpoint holds these facts as JSON; a full one holds them in RLlib's configuration pickles, which
this file opens without importing RLlib itself. On the old API stack that is the algorithm's state; a policy's folder on
its own has only the policy's configuration.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rlservo.bundle.environment_id import plain_id
from rlservo.errors import CheckpointError
from rlservo.export.checkpoints.location import CTOR_FILE, FACTS_FILE
from rlservo.export.checkpoints.old_location import ALGORITHM_STATE, POLICY_STATE, RLLIB_FILE, old_stack_root
from rlservo.export.checkpoints.unpickle import unpickle

# Path of RLlib's counter in algorithm_state.pkl: up to Ray 2.39, 2.40, and from 2.41 on.
_STEPS = "num_env_steps_sampled_lifetime"
_ENV_STEPS = ((_STEPS,), ("env_runners", _STEPS), f"env_runners--{_STEPS}")


@dataclass(frozen=True)
class CheckpointFacts:
    """Facts for the contract's provenance; None if the checkpoint does not have them."""

    algorithm: str = "unknown"
    env_id: str | None = None
    env_config: dict[str, Any] = field(default_factory=dict)
    training_iterations: int | None = None
    env_steps: int | None = None
    ray_version: str | None = None

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2) + "\n"


def read_facts(root: Path, notify: Callable[[str], None]) -> CheckpointFacts:
    """Return the facts in the algorithm checkpoint at `root`, with a notice for each unreadable part."""
    if (root / FACTS_FILE).is_file():
        return _from_json(root / FACTS_FILE, notify)
    if not (root / CTOR_FILE).is_file() and old_stack_root(root) is not None:
        return _read_old_facts(root, notify)
    algorithm: str = "unknown"
    config: Mapping[str, Any] = {}
    if (opened := _open(root / CTOR_FILE, "algorithm and environment", notify)) is not None:
        algorithm = getattr(opened.get("class"), "__name__", "unknown")
        config = read_config(opened.get("ctor_args_and_kwargs"))
    state = _open(root / ALGORITHM_STATE, "training progress", notify) or {}
    stats = state.get("metrics_logger", {}).get("stats", {})
    return CheckpointFacts(
        algorithm=algorithm,
        env_id=_env_name(config.get("env")),
        env_config=_json_values(config.get("env_config") or {}, notify),
        training_iterations=_whole(state.get("training_iteration")),
        env_steps=_env_steps(stats),
        ray_version=_ray_version(root),
    )


def _read_old_facts(root: Path, notify: Callable[[str], None]) -> CheckpointFacts:
    state = _open(root / ALGORITHM_STATE, "algorithm, environment and progress", notify) or {}
    algorithm = getattr(state.get("algorithm_class"), "__name__", "unknown")
    config = _as_mapping(state.get("config"))
    if not state and (
        spec := (_open(root / POLICY_STATE, "algorithm and environment", notify) or {}).get("policy_spec")
    ):
        kind = spec.get("policy_class")
        name = kind if isinstance(kind, str) else getattr(kind, "__name__", "")
        algorithm = name.removesuffix("TorchPolicy") or "unknown"  # BC's policy is MARWIL's: they look the same
        config = _as_mapping(spec.get("config"))
    return CheckpointFacts(
        algorithm=algorithm,
        env_id=_env_name(config.get("env")),
        env_config=_json_values(config.get("env_config") or {}, notify),
        training_iterations=_whole(state.get("training_iteration")),
        env_steps=_whole(state.get("counters", {}).get("num_env_steps_sampled")),
        ray_version=_ray_version(root),
    )


def _from_json(file: Path, notify: Callable[[str], None]) -> CheckpointFacts:
    try:
        return CheckpointFacts(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        notify(f"{file} cannot be read ({error}): algorithm, environment and progress stay unnamed")
        return CheckpointFacts()


def _open(file: Path, what: str, notify: Callable[[str], None]) -> dict[str, Any] | None:
    if not file.is_file():
        return None
    try:
        opened = unpickle(file, missing_ok=True)
    except CheckpointError as error:
        notify(f"the checkpoint's {what} cannot be read: {error}")
        return None
    return opened if isinstance(opened, dict) else None


def read_config(ctor_args_and_kwargs: Any) -> Mapping[str, Any]:
    """Return the algorithm's configuration as a mapping, from its place among the constructor's arguments."""
    if not isinstance(ctor_args_and_kwargs, tuple) or len(ctor_args_and_kwargs) != 2:
        return {}
    args, kwargs = ctor_args_and_kwargs
    return _as_mapping(kwargs.get("config", args[0] if args else {}))


def _as_mapping(config: Any) -> Mapping[str, Any]:
    if isinstance(config, Mapping):
        return config
    return dict(getattr(config, "__dict__", {}))


def _env_name(env: Any) -> str | None:
    """Return the environment's id; for a class given directly, its import path."""
    if isinstance(env, str):
        return plain_id(env)
    if isinstance(env, type):
        return f"{env.__module__}:{env.__qualname__}"
    return None


def _json_values(env_config: Mapping[str, Any], notify: Callable[[str], None]) -> dict[str, Any]:
    """Return the part of an env_config that JSON can hold."""
    kept: dict[str, Any] = {}
    for key, value in dict(env_config).items():
        try:
            kept[str(key)] = json.loads(json.dumps(value, allow_nan=False))
        except (TypeError, ValueError):
            notify(f"env_config['{key}'] is a {type(value).__name__}, which JSON cannot hold: left out of the contract")
    return kept


def _env_steps(stats: Mapping[Any, Mapping[str, Any]]) -> int | None:
    counter = next((stats[key] for key in _ENV_STEPS if key in stats), {})
    return _whole(counter.get("lifetime_sum", sum(counter.get("values", ())) or None))  # the values until Ray 2.50


def _whole(number: Any) -> int | None:
    try:
        return int(number)
    except (TypeError, ValueError, OverflowError):
        return None


def _ray_version(root: Path) -> str | None:
    try:
        return str(json.loads((root / RLLIB_FILE).read_text(encoding="utf-8"))["ray_version"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
