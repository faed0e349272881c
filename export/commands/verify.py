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

from rlservo.export.checkpoints.location import Files, locate_checkpoint
from rlservo.export.checkpoints.remote import fetched, is_uri
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.commands.export import LOADING_RUNS_CODE
from rlservo.export.contract.bundle import Bundle, load_bundle, write_contract
from rlservo.export.contract.contract import Contract, Evaluation, Parity
from rlservo.export.contract.errors import BundleError, UsageError, first_line
from rlservo.export.contract.spaces import leaf_specs
from rlservo.export.graph.one_thread import one_thread
from rlservo.export.proof.parity import GraphLoop, prove, record
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop
from rlservo.export.recipe.samples import draw_batches
from rlservo.export.recipe.trees import build, named_leaves, space_leaves

SEED = 20241  # not the export's: other observations


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
    progress: Callable[[str], None] = lambda _: None,
) -> VerifyResult:
    """Compare a bundle with a checkpoint and, given `env_id`, run both for `episodes` seeds from `first_seed`.

    The environment is made with the `env_config` the policy was trained with. The evaluation is added to contract.json
    and SHA256SUMS is written anew; the copy of the contract inside policy.onnx stays as exported.

    Raises ParityError when they differ, BundleError, CheckpointError or UsageError.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be 1 or more, got {episodes}")
    loaded = load_bundle(bundle)
    with fetched(checkpoint, progress) as local:
        origin = loaded.contract.provenance
        files = locate_checkpoint(local, origin.module_id, origin.agents[0] if origin.agents else None)
        notify(LOADING_RUNS_CODE.format(path=checkpoint if is_uri(checkpoint) else files.root))
        return _verify(loaded, files, (env_id, episodes, first_seed), app_dir, notify, progress)


def _verify(
    loaded: Bundle,
    files: Files,
    driven: tuple[str | None, int, int],
    app_dir: str | Path,
    notify: Callable[[str], None],
    progress: Callable[[str], None],
) -> VerifyResult:
    env_id, episodes, first_seed = driven
    same = files.sha256() == loaded.contract.provenance.checkpoint_sha256
    if not same:
        notify("the bundle was exported from another checkpoint: expect a difference")
    progress("importing torch and RLlib")
    with user_code(app_dir) as folder, one_thread():
        from rlservo.export.rllib.restore import restore

        has_value = any(output.name == "value" for output in loaded.contract.outputs)
        restored = restore(files, folder, notify, value=has_value)
        _check_spaces(loaded.contract, restored.recipe)
        formats = _formats(loaded)
        labels = [element.name for element in loaded.contract.action_space.elements]
        progress("comparing both formats with RLlib's actions")
        recorded = record(restored.reference, draw_batches(restored.recipe, SEED), restored.loop)
        parity = prove(restored.recipe, recorded, formats, labels, files.api_stack)
        evaluation = None
        if env_id is not None:
            run, recipe = formats["onnx"], restored.recipe
            progress(f"running {episodes} episodes with each")
            drivers = (lambda: GraphLoop(run, recipe.state), restored.loop)
            evaluation = _evaluate(loaded.contract, recipe, env_id, drivers, episodes, first_seed)
            contract = loaded.contract.model_copy(update={"evaluations": (*loaded.contract.evaluations, evaluation)})
            write_contract(loaded.path, contract)
    return VerifyResult(parity, evaluation, same)


def _formats(bundle: Bundle) -> dict[str, Any]:
    from rlservo.export.graph.onnx_file import run_onnx
    from rlservo.export.graph.torchscript_file import run_torchscript

    inputs = [tensor.name for tensor in bundle.contract.inputs]
    outputs = [tensor.name for tensor in bundle.contract.outputs]
    try:
        return {"onnx": run_onnx(bundle.onnx), "torchscript": run_torchscript(bundle.torchscript, inputs, outputs)}
    except Exception as error:  # onnxruntime's and torch's own exceptions share no base but Exception
        raise BundleError(f"{bundle.path}: its graphs cannot be loaded: {first_line(error)}") from error


def _check_spaces(contract: Contract, recipe: Recipe) -> None:
    for which, root, spec, leaves in (
        ("observation", "obs", contract.observation_space, recipe.observation_leaves),
        ("action", "action", contract.action_space, recipe.action_leaves),
    ):
        ours = {name: tuple(leaf.shape) for name, leaf in leaf_specs(spec, root).items()}
        theirs = {name: tuple(leaf.shape) for name, leaf in leaves.items()}
        if ours != theirs:
            raise UsageError(
                f"policy '{contract.name}' has {which}s of shape {_shapes(ours)}, the checkpoint's have "
                f"{_shapes(theirs)}: they do not belong together"
            )


def _shapes(leaves: dict[str, tuple[int, ...]]) -> str:
    if len(leaves) == 1:
        return str(next(iter(leaves.values())))
    return ", ".join(f"{name} {shape}" for name, shape in leaves.items())


def _evaluate(
    contract: Contract,
    recipe: Recipe,
    env_id: str,
    drivers: tuple[Callable[[], Loop], Callable[[], Loop]],
    episodes: int,
    first_seed: int,
) -> Evaluation:
    try:
        # Gymnasium's checker warns about the environment's style, which is not what is measured here.
        env: gymnasium.Env[Any, Any] = gymnasium.make(
            env_id, disable_env_checker=True, **contract.provenance.env_config
        )
    except Exception as error:  # the environment's own constructor may raise anything
        raise UsageError(f"environment {env_id} cannot be made: {first_line(error)}") from error
    try:
        theirs = {name: tuple(leaf.shape) for name, leaf in space_leaves(env.observation_space, "obs").items()}
        ours = {name: tuple(leaf.shape) for name, leaf in recipe.observation_leaves.items()}
        if theirs != ours:
            raise UsageError(
                f"environment {env_id} gives observations of shape {_shapes(theirs)}, policy "
                f"'{contract.name}' expects {_shapes(ours)}"
            )
        runs = [
            [_episode(env, start(), recipe, first_seed + number) for number in range(episodes)] for start in drivers
        ]
    finally:
        env.close()
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


def _episode(env: gymnasium.Env[Any, Any], loop: Loop, recipe: Recipe, seed: int) -> _Episode:
    obs, info = env.reset(seed=seed)
    total, reward, first, done = 0.0, 0.0, True, False
    spaces = recipe.observation_leaves
    while not done:
        inputs = {name: np.asarray(leaf, spaces[name].dtype)[None] for name, leaf in named_leaves(obs, "obs").items()}
        if recipe.needs_reward:
            inputs["reward"] = np.array([reward], np.float32)
        outputs = loop.step(inputs, np.array([first]))
        action = build(recipe.action_space, [_sent(outputs[name][0]) for name in recipe.action_leaves])
        obs, earned, terminated, truncated, info = env.step(action)
        reward, first = float(earned), False
        total += reward
        done = terminated or truncated
    return _Episode(total, _succeeded(info))


def _sent(leaf: NDArray[Any]) -> Any:
    """A Discrete action is a number to most environments, and an array to some."""
    return leaf.item() if leaf.ndim == 0 else leaf


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
