"""`rlservo export`: restore a checkpoint, build the graph, prove it, and only then name the bundle.

Everything is written into a temporary folder next to the target, which is renamed at the end or removed: a bundle
exists whole or not at all.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import logging
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

import rlservo
from rlservo.export.bundle_names import bundle_name, check_names, choose_target, default_name
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.remote import fetch, is_uri
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.contract.bundle import (
    CONTRACT_KEY,
    ONNX_FILE,
    TORCHSCRIPT_FILE,
    load_bundle,
    write_contract,
    write_golden,
)
from rlservo.export.contract.contract import (
    VALUE,
    Contract,
    Distribution,
    Parity,
    Provenance,
    TensorSpec,
    contract_json,
)
from rlservo.export.contract.errors import AgentsDifferError, CheckpointError, NoNetworkError, ParityError, UsageError
from rlservo.export.contract.extras import require
from rlservo.export.contract.spaces import leaf_specs
from rlservo.export.element_names import read_elements
from rlservo.export.graph.one_thread import one_thread
from rlservo.export.proof.parity import GraphLoop, Reference, prove, record, record_perturbed, replay, ties
from rlservo.export.recipe.describe import baked_steps
from rlservo.export.recipe.recipe import Recipe, loose_bounds
from rlservo.export.recipe.runners import Inputs, Outputs, Runner
from rlservo.export.recipe.samples import BATCH_SIZES, draw_batches
from rlservo.export.recipe.to_contract import space_spec, state_spec
from rlservo.export.sources.registry import find_source
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source

if TYPE_CHECKING:
    from rlservo.export.sources.restored_policy import RestoredPolicy

logger = logging.getLogger(__name__)

GOLDEN_SAMPLES = {"likely": 48, "wide": 8, "extreme": 8}
GOLDEN_BYTES = 2_000_000  # a bundle should carry only a few observations if they are images
SEED = 20240
TORCH = ("torch", "onnx", "onnxscript", "gymnasium")


def silent(_sentence: str) -> None:
    """Show no progress."""


@dataclass(frozen=True)
class ExportResult:
    """The bundle that was written."""

    path: Path
    contract: Contract


@dataclass(frozen=True)
class ExportOptions:
    """Options that all bundles of one export share."""

    source: Source
    out: Path
    name: str | None
    version: str | None
    description: str
    restore: RestoreOptions
    untrained_filter: bool
    notify: Notify
    progress: Notify
    reward: str = ""


def export_checkpoint(
    checkpoint: str | Path,
    out: str | Path,
    *,
    name: str | None = None,
    version: str | None = None,
    description: str = "",
    module_id: str | None = None,
    agent_id: str | None = None,
    app_dir: str | Path = ".",
    value: bool = True,
    untrained_filter: bool = False,
    source: str | None = None,
    vecnormalize: str | Path | None = None,
    frame_stack: int = 1,
    reward: str = "",
    notify: Notify = logger.warning,
    progress: Notify = silent,
) -> ExportResult:
    """Export one policy of a checkpoint to `out/<name>/<version>/`.

    `checkpoint` is a path that a source knows (docs/how-to/sources.md), or a URI of such a folder; `source` names the
    source, by default recognised from the path. `name` defaults to the environment's (followed by the module's if there
    are several), `version` to the next integer after the newest one present. `app_dir` holds the user's own classes, if
    the checkpoint needs any. `value` False leaves out the value head, which other servers would compute for each
    action: a third of a small policy's time. `untrained_filter` also exports an observation filter whose statistics are
    empty, or only evaluation's. `vecnormalize` and `frame_stack` are for Stable-Baselines3: its observation statistics,
    if they are not beside the model, and the number of frames it stacked. `reward` names the contract's reward
    function, `module:function`. `notify` gets one sentence for each thing a person should know (by default they are
    logged), `progress` what is being done.

    Raises UsageError for a name or version that cannot be used, CheckpointError or UnsupportedError when the checkpoint
    cannot be exported, ParityError when the graph does not give the trainer's own actions. Nothing is left behind then.
    """
    with fetch(checkpoint, progress) as local:
        chosen = find_source(Path(local), source, notify)
        files = chosen.locate(Path(local), module_id, agent_id)
        restore = RestoreOptions(
            Path(app_dir), value, None if vecnormalize is None else Path(vecnormalize), frame_stack=frame_stack
        )
        options = ExportOptions(
            chosen, Path(out), name, version, description, restore, untrained_filter, notify, progress, reward
        )
        return export_files([files], options, checkpoint)[0]


def export_all_modules(
    checkpoint: str | Path,
    out: str | Path,
    *,
    name: str | None = None,
    version: str | None = None,
    description: str = "",
    app_dir: str | Path = ".",
    value: bool = True,
    untrained_filter: bool = False,
    source: str | None = None,
    notify: Notify,
    progress: Notify = silent,
) -> list[ExportResult]:
    """Export every policy of a checkpoint, each to `out/<name>-<module id>/<version>/`: all of them, or none.

    A module that is a script and not a network is left out and reported to `notify`. A module whose agents are treated
    differently gives one bundle per agent, `<name>-<module id>-<agent id>`. The rest is as for `export_checkpoint`.
    """
    with fetch(checkpoint, progress) as local:
        chosen = find_source(Path(local), source, notify)
        restore = RestoreOptions(Path(app_dir), value)
        options = ExportOptions(
            chosen, Path(out), name, version, description, restore, untrained_filter, notify, progress
        )
        return export_files(chosen.locate_all(Path(local)), options, checkpoint, name_all=True)


def export_files(
    policies: Sequence[PolicyFiles], options: ExportOptions, checkpoint: str | Path, *, name_all: bool = False
) -> list[ExportResult]:
    """Write a bundle for each of `policies`; they are named once all are proven."""
    check_names(options.name, options.version)
    root, source = policies[0].root, options.source
    require(source.extra, *source.packages, *TORCH, what=f"exporting from {source.framework}")
    if warning := source.loads(policies[0]):
        options.notify(f"loading {checkpoint if is_uri(checkpoint) else root}: {warning}")
    with user_code(options.restore.app_dir) as folder, contextlib.ExitStack() as folders:
        options = dataclasses.replace(options, restore=dataclasses.replace(options.restore, app_dir=folder))
        options.progress("reading the checkpoint")
        facts = source.facts(policies[0], options.notify)
        base = options.name or default_name(
            facts.env_id, facts.env_config, root.with_suffix("") if root.is_file() else root
        )
        written: list[tuple[Path, ExportResult]] = []
        queue = list(policies)
        while queue:
            files = queue.pop(0)
            extended = files.is_one_of_several and (name_all or not options.name)
            name = bundle_name(base, files.module_id, files.agent_id) if extended else base
            target = choose_target(options.out, name, options.version)
            if any(result.path == target for _, result in written):
                raise UsageError(f"two modules would both be written to {target}: export them one by one, with --name")
            try:
                written.append(_build(files, facts, target, options, folders))
            except AgentsDifferError as error:
                if not name_all:
                    raise
                queue[:0] = [source.locate(files.root, files.module_id, agent) for agent in error.agents]
            except NoNetworkError as error:
                if not name_all or not (written or queue):
                    raise
                options.notify(f"module '{files.module_id}' is left out: {error.message}")
        _publish(written)
    return [result for _, result in written]


def _publish(written: Sequence[tuple[Path, ExportResult]]) -> None:
    """Give every finished folder its name, or none."""
    named: list[Path] = []
    try:
        for folder, result in written:
            folder.rename(result.path)
            named.append(result.path)
    except BaseException:
        for path in named:
            shutil.rmtree(path, ignore_errors=True)
        raise


def _build(
    files: PolicyFiles,
    facts: CheckpointFacts,
    target: Path,
    options: ExportOptions,
    folders: contextlib.ExitStack,
) -> tuple[Path, ExportResult]:
    """Return the finished bundle in a folder that is not named yet."""
    source = options.source
    options.progress(f"restoring '{files.module_id}' (importing torch and {source.framework} takes seconds)")
    restored = source.restore(files, options.restore, options.notify)
    _check_filter(files, facts, restored, options)
    for warning in loose_bounds(restored.recipe):
        options.notify(warning)
    elements = restored.elements
    if elements is None:
        elements = read_elements(facts.env_id, facts.env_config, restored.recipe, options.notify)
    folder = folders.enter_context(_temporary_folder(target))
    with one_thread():
        labels = [] if isinstance(elements.action, Mapping) else [element.name for element in elements.action]
        parity, inputs, outputs = _write_graphs(folder, restored, labels, options)
        recipe = restored.recipe
        unread = recipe.observation_leaves.keys() - inputs.keys()
        contract = Contract(
            name=target.parent.name,
            version=target.name,
            description=options.description,
            observation_space=space_spec(recipe.observation_space, elements.observation, unread=unread),
            action_space=space_spec(recipe.action_space, elements.action, action=True, name="action"),
            inputs=tuple(_tensor(name, values) for name, values in inputs.items()),
            outputs=tuple(_tensor(output, values) for output, values in outputs.items()),
            state=tuple(state_spec(leaf) for leaf in recipe.state),
            distribution=(
                Distribution(kind=recipe.distribution, transform=recipe.transform) if recipe.distribution else None
            ),
            baked_in=baked_steps(recipe, restored.module_class, restored.network.module, sorted(unread)),
            control_rate_hz=elements.control_rate_hz,
            reward=options.reward,
            provenance=_provenance(files, facts, restored, source),
            parity=parity,
        )
        _write_rest(folder, contract, inputs, outputs)
    return folder, ExportResult(target, contract)


def _check_filter(files: PolicyFiles, facts: CheckpointFacts, restored: RestoredPolicy, options: ExportOptions) -> None:
    """Raise CheckpointError for an observation filter that training has not filled, unless it was allowed."""
    steps, frozen = facts.env_steps, restored.recipe.filter
    trained = "how long training took is unknown" if steps is None else f"training took {steps:,} environment steps"
    if why := restored.untrained_filter:
        if not options.untrained_filter:
            raise CheckpointError(
                f"{files.root}: {why}; {trained}. Give --untrained-filter to export what the checkpoint holds, or "
                "train on and save again"
            )
        options.notify(f"{why}; {trained}")
    elif frozen is not None and steps is not None and frozen.count < steps / 2:
        options.notify(
            f"the observation filter's statistics come from {frozen.count:,} observations; {trained}: the env "
            "runners that acted in training had seen more than the checkpoint holds"
        )


@contextlib.contextmanager
def _temporary_folder(target: Path) -> Iterator[Path]:
    """Give a folder next to `target`; it and the parents made for it are always gone or in use afterwards."""
    made = [parent for parent in (target.parent, target.parent.parent) if not parent.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".export-", dir=target.parent))
        folder.chmod(0o755)  # mkdtemp's own mode would keep a server under another user out
    except OSError as error:
        raise UsageError(f"{target.parent} cannot be written: {error.strerror or error}") from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        for parent in made:
            with contextlib.suppress(OSError):  # not empty: the export succeeded
                parent.rmdir()


def _write_graphs(
    folder: Path, restored: RestoredPolicy, labels: list[str], options: ExportOptions
) -> tuple[Parity, Inputs, Outputs]:
    """Write both formats, prove them, and return the proof and the golden vectors.

    Parts of the observation that nothing reads are not inputs.
    """
    from rlservo.export.graph.onnx_file import inputs_read, run_onnx, write_onnx
    from rlservo.export.graph.policy_graph import PolicyGraph
    from rlservo.export.graph.torchscript_file import run_torchscript, write_torchscript
    from rlservo.export.proof.why_different import why_different

    recipe, progress, framework = restored.recipe, options.progress, options.source.framework
    batches = draw_batches(recipe, SEED)
    progress(f"asking {framework} itself for {sum(len(batch) for batch in batches):,} actions")
    references = record(restored.start_loop, batches, framework)
    pair = next(batch for batch in batches if len(batch) == BATCH_SIZES[1])
    example = GraphLoop(lambda inputs: inputs, recipe.state).complete(pair.inputs, np.ones(len(pair), np.bool_))
    progress("writing TorchScript and ONNX")

    def write(left_out: Collection[str]) -> tuple[PolicyGraph, list[str]]:
        graph = PolicyGraph(recipe, restored.network, left_out)
        frozen = write_torchscript(graph, example, folder / TORCHSCRIPT_FILE)
        write_onnx(graph, example, folder / ONNX_FILE)
        return graph, frozen

    graph, frozen = write(())
    if left_out := _left_out(recipe, inputs_read(folder / ONNX_FILE)):
        graph, frozen = write(left_out)
    only_valued = _left_out(recipe, inputs_read(folder / ONNX_FILE, without=VALUE)) - left_out
    if only_valued:
        options.notify(
            f"{', '.join(sorted(only_valued))}: only the value head reads it, and the policy asks for it; --no-value "
            "exports without both"
        )
    onnx = run_onnx(folder / ONNX_FILE)
    script = run_torchscript(folder / TORCHSCRIPT_FILE, graph.input_names, graph.output_names)
    progress(f"proving both against {framework}'s actions")
    perturb = partial(record_perturbed, restored.start_loop, references)
    try:
        runners = {"onnx": onnx, "torchscript": script}
        parity = prove(recipe, references, runners, labels, options.source.reference, perturb)
    except ParityError as error:
        if why := why_different(restored.start_loop, references, frozen):
            raise ParityError(f"{error.message}; {why}", error.details) from error
        raise
    inputs = _golden_inputs(recipe, references, onnx)
    outputs = onnx(inputs)
    ordered = {name: inputs[name] for name in graph.input_names}
    return parity, ordered, {name: outputs[name] for name in graph.output_names}


def _left_out(recipe: Recipe, read: Collection[str]) -> set[str]:
    """Return the observation's leaves that a graph need not have: a Dict's unread ones, unless nothing is read."""
    leaves = recipe.observation_leaves.keys()
    unread = leaves - set(read)
    kept = leaf_specs(space_spec(recipe.observation_space, unread=unread), "obs").keys()
    return set(leaves - kept) if unread < leaves else set()


def _golden_inputs(recipe: Recipe, references: list[Reference], run: Runner) -> Inputs:
    """Return inputs of every kind; those where two choices tie stay out, as another machine may choose either.

    For a policy with a state they are steps of sequences, each with its state.
    """
    pools: dict[str, list[Inputs]] = {kind: [] for kind in GOLDEN_SAMPLES}
    discrete = any(not isinstance(space, Box) for space in recipe.action_leaves.values())
    everything: list[Inputs] = []
    for reference, (inputs, _) in zip(references, replay(references, run, recipe.state), strict=True):
        batch = reference.batch
        clear = ~ties(recipe, reference.outputs) if discrete else np.ones(len(batch), np.bool_)
        pools[batch.kind].append({name: values[clear] for name, values in inputs.items()})
        everything.append(inputs)
    size = sum(values[0].nbytes for values in everything[0].values())
    chosen: list[Inputs] = []
    for kind, count in GOLDEN_SAMPLES.items():
        if pools[kind]:
            chosen.append(_spread(_concatenate(pools[kind]), max(2, min(count, GOLDEN_BYTES // (3 * max(1, size))))))
    golden = _concatenate(chosen)
    # A policy that never has a clear favourite still needs vectors; its runtime excuses ties as the gate does.
    return (
        golden if len(next(iter(golden.values()))) else _spread(_concatenate(everything), sum(GOLDEN_SAMPLES.values()))
    )


def _concatenate(parts: list[Inputs]) -> Inputs:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _spread(inputs: Inputs, count: int) -> Inputs:
    """Return `count` rows, evenly spread."""
    rows = len(next(iter(inputs.values())))
    picked = np.unique(np.linspace(0, rows - 1, min(count, rows)).astype(int)) if rows else np.zeros(0, int)
    return {name: values[picked] for name, values in inputs.items()}


def _tensor(name: str, values: NDArray[Any]) -> TensorSpec:
    return TensorSpec(name=name, dtype=str(values.dtype), shape=(-1, *values.shape[1:]))


def _provenance(files: PolicyFiles, facts: CheckpointFacts, restored: RestoredPolicy, source: Source) -> Provenance:
    from importlib.metadata import version

    return Provenance(
        algorithm=facts.algorithm,
        source=source.name,
        framework=f"{source.framework} {version(source.distribution)}",
        api_stack=getattr(files, "api_stack", None),
        module_id=files.module_id,
        agents=restored.agents,
        module_class=restored.module_class,
        checkpoint_sha256=files.sha256(),
        training_iterations=facts.training_iterations,
        env_steps=facts.env_steps,
        env_id=facts.env_id,
        env_config=facts.env_config,
        ray_version=facts.ray_version,
        torch_version=version("torch"),
        rlservo_version=rlservo.__version__,
        exported_at=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    )


def _write_rest(folder: Path, contract: Contract, golden_inputs: Inputs, golden_outputs: Outputs) -> None:
    """Write golden vectors, contract and hashes, and check that the finished files are those that were proven."""
    from rlservo.export.graph.onnx_file import add_metadata, run_onnx

    add_metadata(folder / ONNX_FILE, {CONTRACT_KEY: contract_json(contract)})
    write_golden(folder, golden_inputs, golden_outputs)
    write_contract(folder, contract)
    inputs, outputs = load_bundle(folder).golden()
    replayed = run_onnx(folder / ONNX_FILE)(inputs)
    for name, values in outputs.items():
        if not np.array_equal(values, replayed[name], equal_nan=True):
            raise ParityError(f"the finished file's '{name}' is not what was proven: is the disk full or failing?")
