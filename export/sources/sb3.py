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
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.unpickle import explain, unpickle, unpickle_bytes
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from rlservo.export.sources.restored_policy import RestoredPolicy

MEMBERS = {"data", "policy.pth", "_stable_baselines3_version"}
SERIALIZED = ":serialized:"
LOADED = ("policy_class", "policy_kwargs", "observation_space", "action_space")
"""The zip's pickles that acting needs."""
SMALL, INFLATION = 64_000_000, 20
"""Size of a zip's member that is read whatever the file's own, in bytes, and its largest multiple of the file's."""
GYM = "reading them needs gym and shimmy: pip install gym==0.26.2 shimmy"
NO_STATISTICS = Path("none")
"""Value of `vecnormalize` for a model that is exported without statistics, whatever lies beside it."""
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
        "predict(deterministic=True) of the model that Stable-Baselines3's own load gives, in an environment behind "
        "its own VecNormalize, VecFrameStack and VecTransposeImage"
    )
    options = ("--vecnormalize", "--frame-stack")

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
        policy_class = load_member(files.root, data, "policy_class")
        algorithm = algorithm_path(data, policy_class) if isinstance(policy_class, type) else ""
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
        statistics = find_statistics(file, data, options.vecnormalize, notify)
        vec = None if statistics is None else load_statistics(statistics)
        # It is loaded twice, to act as the reference and to be traced: state-dependent exploration cannot be copied.
        return restore_policy(file, partial(load_model, file, data), statistics, vec, options, notify)


def _zips(path: Path) -> list[Path]:
    files = sorted(path.glob("*.zip")) if path.is_dir() else [path]
    return [file for file in files if file.is_file() and _is_model(file)]


def _is_model(file: Path) -> bool:
    try:
        with zipfile.ZipFile(file) as archive:
            return set(archive.namelist()) >= MEMBERS
    except Exception:  # a damaged zip raises almost anything
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


def find_statistics(model: Path, data: Mapping[str, Any], given: Path | None, notify: Notify) -> Path | None:
    """Return the file of VecNormalize's statistics: the given one, else the one beside the model; None without them.

    Raises CheckpointError if the model was trained behind VecNormalize, and there is none.
    """
    if given == NO_STATISTICS:
        notify("the model is exported without VecNormalize")
        return None
    if (statistics := given or statistics_beside(model)) is not None:
        has_acted = "replay_buffer_class" not in data and _pickled(data.get("_last_obs"))
        if given is None and has_acted and not shows_vecnormalize(data):
            raise CheckpointError(
                f"{model}: the model was trained without VecNormalize, and {statistics.name} lies beside it: give "
                f"--vecnormalize none, or --vecnormalize {statistics} if it does belong to this model"
            )
        notify(f"VecNormalize is the one of {statistics}")
        return statistics
    if shows_vecnormalize(data):
        raise CheckpointError(
            f"{model}: the model was trained behind VecNormalize, whose statistics are not beside it: looked for "
            "vecnormalize.pkl; give the file that VecNormalize.save wrote with --vecnormalize, or --vecnormalize none "
            "if only rewards were normalized"
        )
    # Nor does the proof show it: its reference has no statistics either.
    unsure = ": an off-policy model does not record it, so if it was trained with VecNormalize, give --vecnormalize"
    notify(
        "no vecnormalize.pkl beside the model: it is exported as trained without VecNormalize"
        f"{unsure if 'replay_buffer_class' in data else ''}"
    )
    return None


def read_data(file: Path) -> dict[str, Any]:
    """Return the model's settings; those that are not JSON stay pickled."""
    try:
        with zipfile.ZipFile(file) as archive:
            inflated = max(0, *(member.file_size for member in archive.infolist()))
            if inflated > max(SMALL, INFLATION * file.stat().st_size):
                raise CheckpointError(f"it has a member of {inflated:,} bytes in a file of {file.stat().st_size:,}: "
                                      "model.save compresses nothing")  # fmt: skip
            data = json.loads(archive.read("data"))
    except RecursionError as error:
        raise CheckpointError(f"{file} cannot be read: its 'data' is nested too deeply") from error
    except Exception as error:  # a damaged zip raises almost anything
        raise CheckpointError(f"{file} cannot be read: {explain(error)}") from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{file} cannot be read: its 'data' is a JSON {type(data).__name__}, expected the "
                              "settings that model.save wrote")  # fmt: skip
    return data


def load_member(file: Path, data: Mapping[str, Any], name: str) -> Any:
    """Return one of the model's settings. Raises CheckpointError if the code it names cannot be imported."""
    if name not in data:
        raise CheckpointError(f"{file} is incomplete: it holds no '{name}'")
    kept = data[name]
    if not (isinstance(kept, dict) and SERIALIZED in kept):
        return kept
    try:
        pickled = base64.b64decode(kept[SERIALIZED])
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{file}: its '{name}' is not base64: {error}") from error
    try:
        return unpickle_bytes(pickled, f"{file}: its '{name}'")
    except CheckpointError as error:
        cause = error.__cause__
        if isinstance(cause, ModuleNotFoundError) and (cause.name or "").partition(".")[0] == "gym":
            raise CheckpointError(f"{file} was saved by Stable-Baselines3 1 with Gym's spaces: {GYM}") from error
        raise


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


def load_model(file: Path, data: Mapping[str, Any], env: Any = None) -> Any:
    """Return the model as its algorithm's own `load` gives it, on the CPU and without what only training needs.

    With an environment, `load` puts it behind VecTransposeImage if it gives images, and compares the spaces.
    """
    policy_class = load_member(file, data, "policy_class")
    if not isinstance(policy_class, type):
        raise CheckpointError(f"{file}: its 'policy_class' is {str(policy_class)[:60]!r}, expected a class")
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
            return getattr(importlib.import_module(module), name).load(
                file, env=env, device="cpu", custom_objects=unneeded
            )
    except Exception as error:  # whatever the framework, torch or the user's own constructor raises
        if "shimmy" in str(error):
            raise CheckpointError(f"{file} was saved by Stable-Baselines3 1 with Gym's spaces: {GYM}") from error
        # torch says which weights do not fit on the lines below the first.
        reason = " ".join(str(error).split())[:300] if "state_dict" in str(error) else explain(error)
        raise CheckpointError(f"{file} cannot be restored as {name}: {reason}") from error


def shows_vecnormalize(data: Mapping[str, Any]) -> bool:
    """Return whether the model was certainly trained behind VecNormalize.

    Algorithms on policy keep the original observation only then. Those off policy keep the previous one in its place,
    which pickles to the same length as the last one unless that was normalized, to single precision. If the
    environment's are of single precision too, the model does not show it.
    """
    last, original = (_pickled(data.get(name)) for name in ("_last_obs", "_last_original_obs"))
    if "replay_buffer_class" in data:
        return len(last) != len(original)
    return bool(original)


def _pickled(kept: Any) -> str:
    return str(kept[SERIALIZED]) if isinstance(kept, dict) and SERIALIZED in kept else ""


def load_statistics(file: Path) -> Any:
    """Return the VecNormalize that `file` holds, without an environment; its statistics stay as they are."""
    from stable_baselines3.common.vec_env import VecNormalize

    vec = unpickle(file)
    if not isinstance(vec, VecNormalize):
        raise CheckpointError(f"{file} holds a {type(vec).__name__}: expected what VecNormalize.save wrote")
    vec.training = False
    return vec
