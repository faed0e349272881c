"""`rlservo verify`: prove a bundle against its checkpoint again, and drive the environment with both on the same seeds.

The gate here draws other observations than the export did. The closed loop shows what the gate cannot: that rounding
does not grow into another episode that matters.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from typing_extensions import Self

from rlservo.bundle.bundle import Bundle, load_bundle, write_contract
from rlservo.bundle.contract import REWARD, Contract, Evaluation, Parity
from rlservo.bundle.spaces import leaf_specs
from rlservo.drive.control_loop import rollout
from rlservo.drive.report import RolloutReport
from rlservo.drive.success import success_rates
from rlservo.errors import BundleError, UsageError, first_line
from rlservo.export.checkpoints.remote import fetch, is_uri
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import TORCH, comparer_of, silent
from rlservo.export.graph.one_thread import one_thread
from rlservo.export.proof.parity import GraphLoop, prove
from rlservo.export.proof.reaching import reaching_batches
from rlservo.export.proof.reference_checks import check_reference
from rlservo.export.proof.references import record
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop
from rlservo.export.recipe.samples import draw_batches
from rlservo.export.recipe.to_contract import space_spec
from rlservo.export.recipe.trees import build, named_leaves
from rlservo.export.sources.registry import find_source
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source
from rlservo.extras import require

SEED = 20241  # not the export's: other observations


@dataclass(frozen=True)
class VerifyResult:
    """Result of a verification; the evaluation is also in the bundle's contract."""

    parity: Parity
    evaluation: Evaluation | None
    same_checkpoint: bool
    """Whether the checkpoint's hash is the one the bundle was exported from."""


def verify_bundle(
    bundle: str | Path,
    checkpoint: str | Path,
    *,
    env_id: str | None = None,
    env_config: Mapping[str, Any] | None = None,
    episodes: int = 20,
    first_seed: int = 0,
    app_dir: str | Path = ".",
    source: str | None = None,
    vecnormalize: str | Path | None = None,
    notify: Notify,
    progress: Notify = silent,
) -> VerifyResult:
    """Compare a bundle with a checkpoint and, given `env_id`, run both for `episodes` seeds from `first_seed`.

    `source` and `vecnormalize` are those of the export. The environment is made with `env_config`, by default the one
    that the policy was trained with. The evaluation is added to contract.json and SHA256SUMS is written again; the copy
    of the contract inside policy.onnx stays as exported.

    Raises ParityError when they differ, BundleError, CheckpointError or UsageError.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be 1 or more, got {episodes}")
    loaded = load_bundle(bundle)
    with fetch(checkpoint, progress) as local:
        origin = loaded.contract.provenance
        arguments = origin.env_config if env_config is None else env_config
        origin_of = find_source(Path(local), source, notify)
        require(origin_of.extra, *origin_of.packages, *TORCH)
        files = origin_of.locate(Path(local), origin.module_id, origin.agents[0] if origin.agents else None)
        if warning := origin_of.loads(files):
            notify(f"loading {checkpoint if is_uri(checkpoint) else files.root}: {warning}")
        options = RestoreOptions(
            Path(app_dir),
            any(output.name == "value" for output in loaded.contract.outputs),
            None if vecnormalize is None else Path(vecnormalize),
            _frames(loaded.contract),
            joint_order=tuple(origin.options.get("joint_order", ())),
            action_range=tuple(origin.options["action_range"]) if "action_range" in origin.options else None,
            outputs=origin.options.get("outputs", {}),
        )
        seeds = range(first_seed, first_seed + episodes)
        return _verify(loaded, origin_of, files, options, env_id, arguments, seeds, notify, progress)


def _verify(
    loaded: Bundle,
    source: Source,
    files: PolicyFiles,
    options: RestoreOptions,
    env_id: str | None,
    arguments: Mapping[str, Any],
    seeds: range,
    notify: Notify,
    progress: Notify,
) -> VerifyResult:
    same = files.sha256() == loaded.contract.provenance.checkpoint_sha256
    if not same:
        notify("the bundle was exported from another checkpoint: expect a difference")
    progress(f"importing torch and {source.framework}")
    from rlservo.export.graph.policy_graph import PolicyGraph

    with user_code(options.app_dir) as folder, one_thread():
        restored = source.restore(files, replace(options, app_dir=folder), notify)
        _check_spaces(loaded.contract, restored.recipe)
        formats = _formats(loaded)
        labels = [element.name for element in loaded.contract.action_space.elements]
        progress(f"comparing both formats with {source.framework}'s actions")
        batches = [*draw_batches(restored.recipe, SEED), *reaching_batches(restored.recipe, formats["onnx"], SEED)]
        references = record(restored.start_loop, batches, source.framework)
        comparer = comparer_of(restored, PolicyGraph(restored.recipe, restored.network), references)
        check_reference(restored.start_loop, restored.recipe, references, comparer)
        parity = prove(restored.recipe, references, formats, labels, restored.reference or source.reference, comparer)
        evaluation = None
        if env_id is not None:
            run, recipe = formats["onnx"], restored.recipe
            progress(f"running {len(seeds)} episodes with each")
            bundle, checkpoint = (
                _rollout(_LoopPolicy(loaded.contract, recipe, start_loop), env_id, arguments, seeds)
                for start_loop in (lambda: GraphLoop(run, recipe.state), restored.start_loop)
            )
            evaluation = _evaluation(bundle, checkpoint, seeds)
            contract = loaded.contract.model_copy(update={"evaluations": (*loaded.contract.evaluations, evaluation)})
            write_contract(loaded.path, contract)
    return VerifyResult(parity, evaluation, same)


def _frames(contract: Contract) -> int:
    """Return how many frames of an observation the bundle stacks by itself."""
    return next((int(step.values["frames"]) for step in contract.baked_in if step.step == "frame_stack"), 1)


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
    unread = recipe.observation_leaves.keys() - {tensor.name for tensor in contract.inputs}
    read = leaf_specs(space_spec(recipe.observation_space, unread=unread), "obs")
    for which, root, spec, leaves in (
        ("observation", "obs", contract.observation_space, read),
        ("action", "action", contract.action_space, recipe.action_leaves),
    ):
        ours = {name: tuple(leaf.shape) for name, leaf in leaf_specs(spec, root).items()}
        theirs = {name: tuple(leaf.shape) for name, leaf in leaves.items()}
        if ours != theirs:
            raise UsageError(
                f"policy '{contract.name}' has {which}s of shape {_shapes(ours)}, but the checkpoint's have "
                f"{_shapes(theirs)}: they do not belong together"
            )


def _shapes(leaves: dict[str, tuple[int, ...]]) -> str:
    if len(leaves) == 1:
        return str(next(iter(leaves.values())))
    return ", ".join(f"{name} {shape}" for name, shape in leaves.items())


def _rollout(policy: _LoopPolicy, env_id: str, arguments: Mapping[str, Any], seeds: range) -> RolloutReport:
    report = rollout(policy, env_id, episodes=len(seeds), seed=seeds.start, env_kwargs=arguments)
    if report.interrupted:  # half a comparison says nothing
        raise KeyboardInterrupt
    return report


def _evaluation(bundle: RolloutReport, checkpoint: RolloutReport, seeds: range) -> Evaluation:
    assert bundle.return_mean is not None and checkpoint.return_mean is not None, "every episode was finished"
    ours, theirs = success_rates(*([row.success for row in report.episodes] for report in (bundle, checkpoint)))
    return Evaluation(
        env_id=bundle.env_id,
        episodes=len(seeds),
        first_seed=seeds.start,
        return_bundle=bundle.return_mean,
        return_checkpoint=checkpoint.return_mean,
        success_rate_bundle=ours and ours.rate,
        success_rate_checkpoint=theirs and theirs.rate,
        evaluated_at=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    )


class _LoopPolicy:
    """A `Loop` as an `ActingPolicy`, for one environment."""

    def __init__(self, contract: Contract, recipe: Recipe, start_loop: Callable[[], Loop]) -> None:
        # The checkpoint's own spaces: an action's Discrete has its start there, as in the environment.
        spaces = {
            "observation_space": space_spec(recipe.observation_space),
            "action_space": space_spec(recipe.action_space),
        }
        self.contract = contract.model_copy(update=spaces)
        self._recipe = recipe
        self._start_loop = start_loop
        self._loop, self._begins = start_loop(), True

    def act(self, obs: Any, *, explore: bool = False, seed: int | None = None, reward: float = 0.0) -> Any:  # noqa: ARG002
        spaces = self._recipe.observation_leaves
        inputs = {name: np.asarray(leaf, spaces[name].dtype)[None] for name, leaf in named_leaves(obs, "obs").items()}
        if self._recipe.needs_reward:
            inputs[REWARD] = np.array([reward], np.float32)
        outputs = self._loop.step(inputs, np.array([self._begins]))
        self._begins = False
        return build(self._recipe.action_space, [outputs[name][0] for name in self._recipe.action_leaves])

    def reset(self) -> None:
        self._loop, self._begins = self._start_loop(), True

    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
