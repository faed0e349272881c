"""`rlservo verify`: prove a bundle against its checkpoint again, and let both drive the environment on the same seeds.

The gate here draws other observations than the export did. The closed loop shows what the gate cannot: that rounding
does not grow into another episode that matters.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rlservo.export.bundle import Bundle, Contract, Evaluation, Parity, load_bundle, write_contract
from rlservo.export.errors import BundleError, UsageError
from rlservo.export.exporter import LOADING_RUNS_CODE
from rlservo.export.location import locate_checkpoint
from rlservo.export.parity import prove, record
from rlservo.export.samples import draw_batches
from rlservo.export.unpickle import first_line, user_code

SEED = 20241  # not the export's: other observations

Act = Callable[[NDArray[Any]], NDArray[Any]]


@dataclass(frozen=True)
class VerifyResult:
    """What was found; the evaluation is in the bundle's contract as well."""

    parity: Parity
    evaluation: Evaluation | None
    same_checkpoint: bool
    """Whether the checkpoint's hash is the one the bundle was exported from."""


def verify_bundle(
    bundle: str | Path,
    checkpoint: str | Path,
    *,
    env_id: str | None = None,
    episodes: int = 20,
    first_seed: int = 0,
    app_dir: str | Path = ".",
    notify: Callable[[str], None],
) -> VerifyResult:
    """Compare a bundle with a checkpoint and, given `env_id`, run both for `episodes` seeds from `first_seed`.

    The environment is made with the `env_config` the policy was trained with. The evaluation is added to contract.json
    and SHA256SUMS is written anew; the copy of the contract inside policy.onnx stays as exported.

    Raises ParityError when they differ, BundleError, CheckpointError or UsageError.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be 1 or more, got {episodes}")
    loaded = load_bundle(bundle)
    files = locate_checkpoint(checkpoint, loaded.contract.provenance.module_id)
    notify(LOADING_RUNS_CODE.format(path=files.root))
    same = files.sha256() == loaded.contract.provenance.checkpoint_sha256
    if not same:
        notify("the bundle was exported from another checkpoint: expect a difference")
    with user_code(app_dir):
        from rlservo.export.restore import restore

        has_value = any(output.name == "value" for output in loaded.contract.outputs)
        restored = restore(files, notify, value=has_value)
        _check_spaces(loaded.contract, restored.recipe)
        formats = _formats(loaded)
        labels = [element.name for element in loaded.contract.action_space.elements]
        recorded = record(restored.reference, draw_batches(restored.recipe, SEED))
        parity = prove(restored.recipe, recorded, formats, labels, files.api_stack)
        evaluation = None
        if env_id is not None:
            run = formats["onnx"]
            drivers: tuple[Act, Act] = (lambda obs: run(obs)["action"], lambda obs: restored.reference(obs)["action"])
            evaluation = _evaluate(loaded.contract, env_id, drivers, episodes, first_seed)
            contract = loaded.contract.model_copy(update={"evaluations": (*loaded.contract.evaluations, evaluation)})
            write_contract(loaded.path, contract)
    return VerifyResult(parity, evaluation, same)


def _formats(bundle: Bundle) -> dict[str, Any]:
    from rlservo.export.onnx import run_onnx
    from rlservo.export.torchscript import run_torchscript

    names = tuple(output.name for output in bundle.contract.outputs)
    try:
        return {"onnx": run_onnx(bundle.onnx), "torchscript": run_torchscript(bundle.torchscript, names)}
    except Exception as error:  # onnxruntime's and torch's own exceptions share no base but Exception
        raise BundleError(f"{bundle.path}: its graphs cannot be loaded: {first_line(error)}") from error


def _check_spaces(contract: Contract, recipe: Any) -> None:
    for which, spec, space in (
        ("observation", contract.observation_space, recipe.observation_space),
        ("action", contract.action_space, recipe.action_space),
    ):
        if tuple(spec.shape) != tuple(space.shape):
            raise UsageError(
                f"policy '{contract.name}' has {which}s of shape {tuple(spec.shape)}, the checkpoint's have "
                f"{tuple(space.shape)}: they do not belong together"
            )


def _evaluate(contract: Contract, env_id: str, drivers: tuple[Act, Act], episodes: int, first_seed: int) -> Evaluation:
    try:
        # Gymnasium's checker warns about the environment's style, which is not what is measured here.
        env: gymnasium.Env[Any, Any] = gymnasium.make(
            env_id, disable_env_checker=True, **contract.provenance.env_config
        )
    except Exception as error:  # the environment's own constructor may raise anything
        raise UsageError(f"environment {env_id} cannot be made: {first_line(error)}") from error
    try:
        if env.observation_space.shape != contract.observation_space.shape:
            raise UsageError(
                f"environment {env_id} gives observations of shape {env.observation_space.shape}, policy "
                f"'{contract.name}' expects {contract.observation_space.shape}"
            )
        runs = [[_episode(env, act, contract, first_seed + number) for number in range(episodes)] for act in drivers]
    finally:
        env.close()  # type: ignore[no-untyped-call]  # gymnasium 1.2 leaves it unannotated
    returns = [float(np.mean([one.reward for one in run])) for run in runs]
    success = [_success_rate(run) for run in runs]
    return Evaluation(
        env_id=env_id,
        episodes=episodes,
        first_seed=first_seed,
        return_bundle=returns[0],
        return_checkpoint=returns[1],
        success_rate_bundle=success[0],
        success_rate_checkpoint=success[1],
        evaluated_at=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    )


@dataclass(frozen=True)
class _Episode:
    reward: float
    success: bool | None  # None where the environment does not tell


def _episode(env: gymnasium.Env[Any, Any], act: Act, contract: Contract, seed: int) -> _Episode:
    dtype = np.dtype(contract.observation_space.dtype)
    discrete = contract.action_space.kind == "discrete"
    obs, info = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        action = act(np.asarray(obs, dtype)[None])[0]
        obs, reward, terminated, truncated, info = env.step(int(action) if discrete else action)
        total += float(reward)
        done = terminated or truncated
    return _Episode(total, _succeeded(info))


def _succeeded(info: dict[str, Any]) -> bool | None:
    """Return an episode's outcome as robotics environments tell it in the last step's info, if they do."""
    if "is_success" in info:
        return bool(info["is_success"])
    if "final_status" in info:
        return bool(info["final_status"] == "success")
    return None


def _success_rate(run: list[_Episode]) -> float | None:
    told = [one.success for one in run if one.success is not None]
    return sum(told) / len(run) if told else None
