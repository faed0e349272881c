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
from rlservo.bundle.bundle import (
    CONTRACT_KEY,
    ONNX_FILE,
    TORCHSCRIPT_FILE,
    load_bundle,
    write_contract,
    write_golden,
)
from rlservo.bundle.contract import (
    VALUE,
    Contract,
    Distribution,
    Parity,
    Provenance,
    TensorSpec,
    contract_json,
)
from rlservo.bundle.spaces import leaf_specs
from rlservo.errors import (
    ActionError,
    AgentsDifferError,
    CheckpointError,
    NoNetworkError,
    ParityError,
    RlservoError,
    UnsupportedError,
    UsageError,
)
from rlservo.export.bundle_names import bundle_name, check_names, choose_target, default_name
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.checkpoints.remote import fetch, is_uri
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.element_names import described_by, open_conventions, read_elements, with_conventions, with_rate
from rlservo.export.graph.one_thread import one_thread
from rlservo.export.proof.differences import Comparer, ties
from rlservo.export.proof.parity import GraphLoop, prove, replay
from rlservo.export.proof.reaching import reaching_batches
from rlservo.export.proof.reference_checks import check_reference, check_repeatable
from rlservo.export.proof.references import Reference, record
from rlservo.export.proof.rounding import measure_rounding
from rlservo.export.recipe.describe import baked_steps
from rlservo.export.recipe.recipe import Recipe, loose_bounds
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.samples import BATCH_SIZES, draw_batches
from rlservo.export.recipe.to_contract import space_spec, state_spec
from rlservo.export.recipe.trees import build, named_leaves
from rlservo.export.sources.registry import find_source
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source
from rlservo.extras import require

if TYPE_CHECKING:
    from rlservo.export.graph.policy_graph import PolicyGraph
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
    env: str | None = None
    env_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    conventions: Mapping[str, str] = dataclasses.field(default_factory=dict)


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
    joint_order: Sequence[str] = (),
    control_rate_hz: float | None = None,
    action_range: tuple[float, float] | None = None,
    outputs: Mapping[str, str] | None = None,
    env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    conventions: Mapping[str, str] | None = None,
    reward: str = "",
    notify: Notify = logger.warning,
    progress: Notify = silent,
) -> ExportResult:
    """Export one policy of a checkpoint to `out/<name>/<version>/`.

    `checkpoint` is a path that a source knows (docs/how-to/sources.md), or a URI of such a folder; `source` names the
    source, by default recognised from the path. `name` defaults to the environment's (followed by the module's if
    there are several), `version` to the next integer after the newest one present. `app_dir` holds the user's own
    classes, if the checkpoint needs any. `value` False leaves out the value head, which other servers would compute
    for each action: a third of a small policy's time. `untrained_filter` also exports an observation filter whose
    statistics are empty, or only evaluation's. `vecnormalize` and `frame_stack` are for Stable-Baselines3: its
    observation statistics, if they are not beside the model, and the number of frames it stacked. `joint_order` is
    for Isaac Lab and mjlab: the robot's joints in its own order, if no file of the run has them. `control_rate_hz` is
    the control rate, if none has it. For a given ONNX, `action_range` are bounds to clip every element of the action
    to, and `outputs` says of an output that its name does not tell: `action`, `none`, or the input that gets it at
    the next step. `env` is an environment whose `describe()`, called with `env_kwargs`, says what the elements are,
    if the checkpoint does not; `conventions` says what no file does (`{"quaternion": "xyzw", "frame": "base",
    "action": "relative"}`). `reward` names the contract's reward function, `module:function`. `notify` gets one
    sentence for each thing a person should know (by default they are logged), `progress` what is being done.

    Raises UsageError for a name or version that cannot be used, CheckpointError or UnsupportedError when the checkpoint
    cannot be exported, ParityError when the graph does not give the trainer's own actions. Nothing is left behind then.
    """
    with fetch(checkpoint, progress) as local:
        chosen = find_source(Path(local), source, notify)
        given = {
            "--vecnormalize": vecnormalize, "--frame-stack": frame_stack != 1, "--joint-order": joint_order,
            "--action-range": action_range, "--output": outputs,
        }  # fmt: skip
        if wrong := [option for option, value in given.items() if value and option not in chosen.options]:
            raise UsageError(f"{wrong[0]} is not for {chosen.name} checkpoints: leave it out")
        files = chosen.locate(Path(local), module_id, agent_id)
        restore = RestoreOptions(
            Path(app_dir),
            value,
            None if vecnormalize is None else Path(vecnormalize),
            frame_stack=frame_stack,
            joint_order=tuple(joint_order),
            control_rate_hz=control_rate_hz,
            action_range=action_range,
            outputs=outputs or {},
        )
        options = ExportOptions(
            chosen, Path(out), name, version, description, restore, untrained_filter, notify, progress, reward,
            env, env_kwargs or {}, conventions or {},
        )  # fmt: skip
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
    for warning in loose_bounds(restored.recipe, source.framework):
        options.notify(warning)
    elements = restored.elements
    if elements is None:
        elements = read_elements(facts.env_id, facts.env_config, restored.recipe, options.notify)
    if options.env is not None:
        elements = described_by(options.env, options.env_kwargs, restored.elements, restored.recipe)
    elements = with_conventions(elements, options.conventions, restored.recipe)
    elements = with_rate(elements, options.restore.control_rate_hz)
    if left_open := open_conventions(elements):
        options.notify(left_open)
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
            provenance=_provenance(files, facts, restored, options),
            parity=parity,
        )
        _write_rest(folder, contract, inputs, outputs)
        _answer_once(folder, recipe)
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
            f"the observation filter's statistics come from {frozen.count:,} observations; {trained}: what "
            "acted in training had seen more than the checkpoint holds"
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
    from rlservo.export.graph.eager_checks import check_eager
    from rlservo.export.graph.joined_rows import joined_rows
    from rlservo.export.graph.onnx_file import inputs_read, run_onnx, write_onnx
    from rlservo.export.graph.policy_graph import PolicyGraph
    from rlservo.export.graph.torchscript_file import run_torchscript, write_torchscript
    from rlservo.export.graph.unreached import unreached

    recipe, progress, framework = restored.recipe, options.progress, options.source.framework
    batches = draw_batches(recipe, SEED)
    progress(f"asking {framework} itself for {sum(len(batch) for batch in batches):,} actions")
    references = record(restored.start_loop, batches, framework)
    pair = next(batch for batch in batches if len(batch) == BATCH_SIZES[1])
    example = GraphLoop(lambda inputs: inputs, recipe.state).complete(pair.inputs, np.ones(len(pair), np.bool_))
    eager = PolicyGraph(recipe, restored.network)
    check_eager(eager, example)
    comparer = comparer_of(restored, eager, references)
    check_reference(restored.start_loop, recipe, references, comparer)
    progress("writing TorchScript and ONNX")

    def write(left_out: Collection[str]) -> tuple[PolicyGraph, list[str]]:
        graph = PolicyGraph(recipe, restored.network, left_out)
        frozen = write_torchscript(graph, example, folder / TORCHSCRIPT_FILE)
        write_onnx(graph, example, folder / ONNX_FILE)
        return graph, frozen

    graph, frozen = write(())
    joined = joined_rows(folder / ONNX_FILE, example)
    if joined and restored.one_by_one is not None:
        restored.one_by_one()
        graph, frozen = write(())
        joined = joined_rows(folder / ONNX_FILE, example)
    if joined:
        raise UnsupportedError(
            f"the network's result depends on the other observations of the batch, which cannot be exported: {joined} "
            "joins them; give the operation the axis of an observation's own numbers (dim=-1)"
        )
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
    try:
        if reaching := reaching_batches(recipe, onnx, SEED):
            references += record(restored.start_loop, reaching, framework)
            comparer = comparer_of(restored, eager, references)
        runners = {"onnx": onnx, "torchscript": script}
        parity = prove(recipe, references, runners, labels, restored.reference or options.source.reference, comparer)
    except ParityError as error:
        if frozen:
            raise ParityError(
                f"{error.message}; tracing froze sizes that the network reads outside torch at {', '.join(frozen[:3])}",
                error.details,
            ) from error
        raise
    check_repeatable(restored.start_loop, references[:1])  # again, after seconds: a clock has moved
    steps = [inputs for inputs, _ in replay(references, onnx, recipe.state)]
    missed = unreached(graph, recipe, steps, [reference.outputs for reference in references], labels)
    inputs = _golden_inputs(recipe, references, steps)
    outputs = onnx(inputs)
    ordered = {name: inputs[name] for name in graph.input_names}
    parity = parity.model_copy(update={"unreached": tuple(missed)})
    return parity, ordered, {name: outputs[name] for name in graph.output_names}


def comparer_of(restored: RestoredPolicy, eager: PolicyGraph, references: Sequence[Reference]) -> Comparer:
    """Return how outputs are compared with references, given the policy's graph in torch."""
    from rlservo.export.graph.last_bits import moved_weights, run_eager

    measure = partial(
        measure_rounding,
        restored.start_loop,
        restored.recipe,
        references,
        run_eager(eager),
        partial(moved_weights, eager),
    )
    return Comparer(restored.recipe, references, measure)


def _left_out(recipe: Recipe, read: Collection[str]) -> set[str]:
    """Return the observation's leaves that a graph need not have: a Dict's unread ones, unless nothing is read."""
    leaves = recipe.observation_leaves.keys()
    unread = leaves - set(read)
    kept = leaf_specs(space_spec(recipe.observation_space, unread=unread), "obs").keys()
    return set(leaves - kept) if unread < leaves else set()


def _golden_inputs(recipe: Recipe, references: list[Reference], steps: Sequence[Inputs]) -> Inputs:
    """Return inputs of every kind; those where two choices tie stay out, as another machine may choose either.

    `steps` are the graph's inputs for each reference: for a policy with a state each with its state.
    """
    pools: dict[str, list[Inputs]] = {kind: [] for kind in GOLDEN_SAMPLES}
    discrete = any(not isinstance(space, Box) for space in recipe.action_leaves.values())
    everything: list[Inputs] = []
    for reference, inputs in zip(references, steps, strict=True):
        batch = reference.batch
        clear = ~ties(recipe, reference.outputs) if discrete else np.ones(len(batch), np.bool_)
        if batch.kind in pools:
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


def _provenance(
    files: PolicyFiles, facts: CheckpointFacts, restored: RestoredPolicy, options: ExportOptions
) -> Provenance:
    from importlib.metadata import version

    source, restore = options.source, options.restore
    again = {"joint_order": restore.joint_order, "action_range": restore.action_range, "outputs": restore.outputs}
    return Provenance(
        algorithm=facts.algorithm,
        source=source.name,
        framework=f"{source.framework} {version(source.distribution)}",
        api_stack=getattr(files, "api_stack", None),
        module_id=files.module_id,
        agents=restored.agents,
        module_class=restored.module_class,
        checkpoint_sha256=files.sha256(),
        options={name: value for name, value in again.items() if value},
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


def _answer_once(folder: Path, recipe: Recipe) -> None:
    """Load the finished bundle as its users will, and compare one action. Raises ParityError if it does not answer."""
    from rlservo.export.graph.onnx_file import run_onnx

    first = next(batch for batch in draw_batches(recipe, SEED) if batch.kind == "likely").row(0)
    expected = GraphLoop(run_onnx(folder / ONNX_FILE), recipe.state).step(first.inputs, np.ones(1, np.bool_))
    obs = build(recipe.observation_space, [first.inputs[name][0] for name in recipe.observation_leaves])
    try:
        with rlservo.Policy.load(folder) as policy:
            action = named_leaves(policy.act(obs), "action")
    except ActionError:  # outside of its bounds: a policy of whose actions `loose_bounds` has warned
        return
    except RlservoError as error:
        raise ParityError(f"the finished bundle does not answer: {error.message}") from error
    for name, leaf in action.items():
        if not np.allclose(leaf, expected[name][0], rtol=1e-4, atol=1e-5, equal_nan=True):
            raise ParityError(f"the finished bundle answers {name} = {leaf}, its graph {expected[name][0]}")
