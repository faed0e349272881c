"""Source of Stable-Baselines3 and sb3-contrib: `model.zip`, and VecNormalize's statistics beside it.

The zip names its policy's class but not its algorithm, which follows from class and settings. Everything that only
training needs (the replay buffer, schedules, the last observation) is left in the zip, so no code of the user's
environment is imported.
"""

from __future__ import annotations

import base64
import importlib
import json
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Dict

from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.unpickle import explain, unpickle, unpickle_bytes
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from rlservo.export.sources.restored_policy import RestoredPolicy

MEMBERS = {"data", "policy.pth", "_stable_baselines3_version"}
SERIALIZED = ":serialized:"
LOADED = ("policy_class", "policy_kwargs", "observation_space", "action_space")
"""The zip's pickles that acting needs."""
HARMLESS: dict[str, Any] = {
    "learning_rate": 0.0, "clip_range": 0.2, "train_freq": 1, "buffer_size": 1, "n_steps": 1, "n_envs": 1,
    "target_entropy": 0.0, "seed": None, "optimize_memory_usage": False, "replay_buffer_kwargs": {},
    "rollout_buffer_kwargs": {},
}  # fmt: skip
"""Replacements of training's own settings; those not named here become None."""
ALGORITHMS = (  # (policy's class, a setting that only this algorithm saves, the algorithm)
    ("sb3_contrib.common.recurrent.policies:RecurrentActorCriticPolicy", "", "sb3_contrib:RecurrentPPO"),
    ("sb3_contrib.common.maskable.policies:MaskableActorCriticPolicy", "", "sb3_contrib:MaskablePPO"),
    ("stable_baselines3.common.policies:ActorCriticPolicy", "clip_range", "stable_baselines3:PPO"),
    ("stable_baselines3.common.policies:ActorCriticPolicy", "cg_max_steps", "sb3_contrib:TRPO"),
    ("stable_baselines3.common.policies:ActorCriticPolicy", "", "stable_baselines3:A2C"),
    ("stable_baselines3.sac.policies:SACPolicy", "", "stable_baselines3:SAC"),
    ("stable_baselines3.td3.policies:TD3Policy", "", "stable_baselines3:TD3"),
    ("stable_baselines3.dqn.policies:DQNPolicy", "", "stable_baselines3:DQN"),
    ("sb3_contrib.tqc.policies:TQCPolicy", "", "sb3_contrib:TQC"),
    ("sb3_contrib.qrdqn.policies:QRDQNPolicy", "", "sb3_contrib:QRDQN"),
    ("sb3_contrib.crossq.policies:CrossQPolicy", "", "sb3_contrib:CrossQ"),
    ("sb3_contrib.ars.policies:ARSPolicy", "", "sb3_contrib:ARS"),
)


class StableBaselines3(Source):
    """Models that `model.save` wrote."""

    name = "sb3"
    framework = "Stable-Baselines3"
    distribution = "stable-baselines3"
    extra = "sb3"
    packages = ("stable_baselines3", "sb3_contrib")
    expects = "the zip that Stable-Baselines3's model.save wrote, or a folder with one"
    reference = (
        "Stable-Baselines3's own VecNormalize.normalize_obs, frame stack and predict(deterministic=True), restored "
        "from the zip by the algorithm's own load"
    )

    def detects(self, path: Path) -> bool:
        return bool(_zips(path))

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        found = _zips(given)
        if not found:
            raise CheckpointError(f"{given} is not a model of Stable-Baselines3: expected {self.expects}")
        if len(found) > 1:
            names = ", ".join(file.name for file in found[:4])
            raise CheckpointError(f"{given} holds {len(found)} models ({names}): name one of them")
        beside = statistics_beside(found[0])
        return one_policy(found[0], [found[0], *([beside] if beside else [])], module_id, agent_id)

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002  # nothing is left out
        data = read_data(files.root)
        algorithm = algorithm_path(data, load_member(files.root, data, "policy_class"))
        steps = data.get("num_timesteps")
        return CheckpointFacts(
            algorithm=algorithm.rpartition(":")[2] or "unknown", env_steps=steps if isinstance(steps, int) else None
        )

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        from rlservo.export.sources.sb3_policy import restore_policy

        file = files.root
        data = read_data(file)
        for member in LOADED:  # the framework's own loader hides what is missing behind an unrelated error
            load_member(file, data, member)
        # One to act as the reference, one to trace: a policy with state-dependent exploration cannot be copied.
        policy, traced = (load_model(file, data).policy for _ in range(2))
        statistics = options.vecnormalize or statistics_beside(file)
        if statistics is None and looks_normalized(file, data):
            raise CheckpointError(
                f"{file}: the model was trained with VecNormalize, whose statistics are not beside it: looked for "
                "vecnormalize.pkl; give the file that VecNormalize.save wrote with --vecnormalize"
            )
        if statistics is None:
            notify("no vecnormalize.pkl beside the model: it is exported as trained without VecNormalize")
        else:
            notify(f"the observations are normalized by {statistics}")
        vec = None if statistics is None else load_statistics(statistics)
        return restore_policy(file, policy, traced, vec, options, notify)


def _zips(path: Path) -> list[Path]:
    files = sorted(path.glob("*.zip")) if path.is_dir() else [path]
    return [file for file in files if file.is_file() and _is_model(file)]


def _is_model(file: Path) -> bool:
    try:
        with zipfile.ZipFile(file) as archive:
            return set(archive.namelist()) >= MEMBERS
    except (OSError, zipfile.BadZipFile):
        return False


def statistics_beside(model: Path) -> Path | None:
    """Return VecNormalize's statistics for a model, as users, SB3's CheckpointCallback and the RL zoo name them."""
    stem = model.stem
    names = (
        f"{stem}_vecnormalize.pkl",
        re.sub(r"_(\d+)_steps$", r"_vecnormalize_\1_steps", stem) + ".pkl",
        "vecnormalize.pkl",
        "vec_normalize.pkl",
    )
    inside = sorted(model.parent.glob("*/vecnormalize.pkl"))  # the zoo's folder of an environment
    found = [model.with_name(name) for name in names if name != f"{stem}.pkl"]
    return next((file for file in [*found, *(inside if len(inside) == 1 else [])] if file.is_file()), None)


def read_data(file: Path) -> dict[str, Any]:
    """Return the model's settings; those that are not JSON stay pickled."""
    try:
        with zipfile.ZipFile(file) as archive:
            return dict(json.loads(archive.read("data")))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError) as error:
        raise CheckpointError(f"{file} cannot be read: {explain(error)}") from error


def load_member(file: Path, data: Mapping[str, Any], name: str) -> Any:
    """Return one of the model's settings. Raises CheckpointError if the code it names cannot be imported."""
    if name not in data:
        raise CheckpointError(f"{file} is incomplete: it holds no '{name}'")
    kept = data[name]
    if not (isinstance(kept, dict) and SERIALIZED in kept):
        return kept
    return unpickle_bytes(base64.b64decode(kept[SERIALIZED]), f"{file}: its '{name}'")


def algorithm_path(data: Mapping[str, Any], policy_class: type) -> str:
    """Return the algorithm of a model as `module:class`; '' if the policy's class belongs to no known one."""
    for policy, setting, algorithm in ALGORITHMS:
        module, _, name = policy.partition(":")
        if issubclass(policy_class, getattr(importlib.import_module(module), name)) and (
            not setting or setting in data
        ):
            is_ddpg = algorithm.endswith(":TD3") and data.get("policy_delay") == 1 and not data.get("target_noise_clip")
            return "stable_baselines3:DDPG" if is_ddpg else algorithm
    return ""


def load_model(file: Path, data: Mapping[str, Any]) -> Any:
    """Return the model as its algorithm's own `load` gives it, on the CPU and without what only training needs."""
    policy_class = load_member(file, data, "policy_class")
    path = algorithm_path(data, policy_class)
    if not path:
        raise UnsupportedError(
            f"{file}: the policy class {policy_class.__module__}.{policy_class.__qualname__} belongs to no known "
            "algorithm of Stable-Baselines3 or sb3-contrib"
        )
    module, _, name = path.partition(":")
    unneeded = {
        key: HARMLESS.get(key)
        for key, value in data.items()
        if key in HARMLESS or (isinstance(value, dict) and SERIALIZED in value and key not in LOADED)
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about training's settings, which were replaced
            return getattr(importlib.import_module(module), name).load(file, device="cpu", custom_objects=unneeded)
    except Exception as error:  # whatever the framework, torch or the user's own constructor raises
        # torch says which weights do not fit on the lines below the first.
        reason = " ".join(str(error).split())[:300] if "state_dict" in str(error) else explain(error)
        raise CheckpointError(f"{file} cannot be restored as {name}: {reason}") from error


def looks_normalized(file: Path, data: Mapping[str, Any]) -> bool:
    """Return whether the last observation of training shows VecNormalize: changed, or outside of the space."""
    try:
        last, original = (load_member(file, data, name) for name in ("_last_obs", "_last_original_obs"))
        space = load_member(file, data, "observation_space")
    except CheckpointError:
        return False
    spaces = space.spaces if isinstance(space, Dict) else {"": space}
    lasts, originals = (each if isinstance(each, dict) else {"": each} for each in (last, original))
    for key, leaf in spaces.items():
        now, before = lasts.get(key), originals.get(key)
        if isinstance(before, np.ndarray) and isinstance(now, np.ndarray) and not np.array_equal(now, before):
            return True
        if not (isinstance(leaf, Box) and isinstance(now, np.ndarray) and np.dtype(leaf.dtype).kind == "f"):
            continue
        if not ((now >= leaf.low - 1e-3) & (now <= leaf.high + 1e-3)).all():
            return True
    return False


def load_statistics(file: Path) -> Any:
    """Return the VecNormalize that `file` holds, without an environment; its statistics stay as they are."""
    from stable_baselines3.common.vec_env import VecNormalize

    vec = unpickle(file)
    if not isinstance(vec, VecNormalize):
        raise CheckpointError(f"{file} holds a {type(vec).__name__}: expected what VecNormalize.save wrote")
    vec.training = False
    return vec
