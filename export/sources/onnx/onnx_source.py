"""Source of a given ONNX file: taken as it is, with what its metadata and the files beside it say of it.

No trainer is asked, so the proof says less than that of other sources: the written graph is compared with onnxruntime
on the given file, and the file with its own test vectors where it has some.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Dict

from rlservo.bundle.bundle import CONTRACT_KEY
from rlservo.bundle.spaces import Element
from rlservo.errors import CheckpointError, UsageError
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.recipe.recipe import Affine, Recipe, StateLeaf
from rlservo.export.sources.isaac_env import KINDS
from rlservo.export.sources.isaac_observations import (
    BODY,
    JOINTS,
    body_elements,
    fill,
    joint_elements,
    last_action,
    scaled,
    velocity_command,
)
from rlservo.export.sources.leapp_description import StageTensor, leaf_names, placeholders, space
from rlservo.export.sources.onnx.onnx_annotations import (
    Annotation,
    Term,
    annotation_files,
    limit_of,
    merged,
    read_annotations,
    read_facts,
)
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from rlservo.export.sources.onnx.onnx_tensors import Tensors
    from rlservo.export.sources.restored_policy import ElementNames, RestoredPolicy

UNITS: dict[str, str] = {quantity: unit for unit, _, quantity in KINDS.values()}
OBSERVATIONS = ("obs", "observation", "observations", "policy", "actor", "state", "observation.state")
"""Names of the input that the files describe, if there are several."""
WEIGHTS = ".data"  # what torch's exporter adds to the name of the file with the weights


class GivenOnnx(Source):
    """A policy.onnx of any exporter."""

    name = "onnx"
    framework = "onnxruntime"
    distribution = "onnxruntime"
    extra = "export"
    packages = ("yaml",)
    expects = "a policy.onnx, or a folder with one and a manifest.json"
    reference = "onnxruntime on the given file, one row at a time (taken as given: no trainer was asked)"
    options = ("--joint-order", "--action-range", "--output")

    def detects(self, path: Path) -> bool:
        return (path.is_file() and path.suffix == ".onnx") or len(_models(path)) == 1

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        models = _models(given) or [given]
        if len(models) != 1 or not models[0].is_file():
            raise CheckpointError(f"{given} holds {len(models)} ONNX files: give one of them")
        weights = models[0].with_name(models[0].name + WEIGHTS)
        files = [models[0], *([weights] if weights.is_file() else []), *annotation_files(models[0])]
        return one_policy(models[0], files, module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return ""  # protobuf, YAML and JSON hold no code

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002
        return read_facts(files.root)

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        import torch

        from rlservo.export.sources.leapp_pipeline import Pipeline
        from rlservo.export.sources.onnx.onnx_replay import OrtLoop, golden_sets, one_row, open_given
        from rlservo.export.sources.onnx.onnx_tensors import describe_graph
        from rlservo.export.sources.onnx_stage import read_graph
        from rlservo.export.sources.present_position import with_targets
        from rlservo.export.sources.restored_policy import RestoredPolicy

        file = files.root
        model = read_graph(file)
        metadata = {one.key: one.value for one in model.metadata_props}
        if CONTRACT_KEY in metadata:
            raise UsageError(f"{file} is the graph of a bundle: serve or publish the bundle as it is")
        session = open_given(file)
        defaults = {one.name: one.shape for one in session.get_overridable_initializers()}
        tensors = describe_graph(file, model.graph, *one_row(file, session), options.outputs, defaults)
        observed = tensors.description.given
        annotations = read_annotations(file, metadata, int(np.prod(tensors.action.row)), options.joint_order)
        main = next((tensor for name, tensor in observed.items() if name is None or name in OBSERVATIONS), None)
        for annotation in annotations:
            _check_sizes(annotation, file, observed, main, tensors.action)
            for key, gains in annotation.gains.items():
                if only := placeholders(gains):
                    notify(
                        f"{annotation.place}: {key} is {only} for every joint: some exporters write this for gains "
                        "they do not know; check it before a robot uses it"
                    )
            for note in annotation.notes:
                notify(f"{annotation.place}: {note}")
            if annotation.left_out:
                notify(f"{annotation.place}: {annotation.left_out}: the export gives the policy's own numbers")
        if tensors.unused:
            notify(f"{file.name}: left out, as '{tensors.action.name}' is the action: {', '.join(tensors.unused)}")
        said = merged(annotations)
        recipe = _recipe(said, file, tensors, options)
        recipe, elements = with_targets(recipe, _elements(said, recipe, main, options.joint_order))
        _ask(elements, recipe, options, notify)
        first = {tensor.key: torch.zeros(tensor.shape, dtype=getattr(torch, tensor.dtype)) for tensor in tensors.zeros}
        network = Pipeline(tensors.description, first)
        given = leaf_names(observed, "obs")
        own = golden_sets(file, session)
        return RestoredPolicy(
            recipe,
            network,
            file.name,
            lambda: OrtLoop(file, tensors, given, recipe),
            elements=elements,
            reference=self.reference + (f", and {own} test vectors of its own" if own else ""),
        )


def _models(path: Path) -> list[Path]:
    return sorted(path.glob("*.onnx")) if (path / "manifest.json").is_file() else []


def _check_sizes(
    said: Annotation,
    file: Path,
    observed: Mapping[str | None, StageTensor],
    main: StageTensor | None,
    action: StageTensor,
) -> None:
    """Raise CheckpointError, with both values, where sizes are not the graph's."""
    sizes = [("action", said.action_size, action), ("observation", said.observation_size, main)]
    if main is not None and said.observation_names:
        sizes.append(("list of observation names", len(said.observation_names), main))
    least = sum((term.size or 1) * term.history for term in said.terms)
    if main is not None and least > (own := int(np.prod(main.row))):
        raise CheckpointError(
            f"{said.place}: its observation terms with their histories have at least {least} elements, "
            f"'{main.name}' of {file.name} has {own}"
        )
    for what, size, tensor in sizes:
        if size is not None and tensor is not None and size != (own := int(np.prod(tensor.row))):
            raise CheckpointError(
                f"{said.place}: its {what} has {size} elements, '{tensor.name}' of {file.name} has {own}"
            )
    named = {tensor.name: tensor for tensor in observed.values()}
    for name, shape in said.inputs.items():
        if name not in named or named[name].row != shape:
            raise CheckpointError(
                f"{said.place}: it has the input '{name}' {list(shape)}, {file.name} has "
                f"{', '.join(f'{one} {list(tensor.row)}' for one, tensor in named.items())}"
            )


def _recipe(said: Annotation, file: Path, tensors: Tensors, options: RestoreOptions) -> Recipe:
    shape = tensors.action.row
    affine, limit = None, limit_of(file)
    if _is_scaled(said):
        affine = Affine(
            np.array(said.scale, np.float32).reshape(shape), np.array(said.offset, np.float32).reshape(shape), limit
        )
    elif limit is not None:
        affine = Affine(np.ones(shape, np.float32), np.zeros(shape, np.float32), limit)
    low, high = (np.array(side, np.float32).reshape(shape) for side in zip(*said.clip, strict=True)) if said.clip else (
        np.full(shape, side, np.float32) for side in options.action_range or (-np.inf, np.inf)
    )  # fmt: skip
    if options.action_range is not None and (low > high).any():
        raise UsageError(f"the action range {options.action_range}: expected the lower bound first")
    bounded = bool(np.isfinite([low, high]).any())
    if said.clip and bounded and options.action_range is not None:
        raise UsageError(f"--action-range {options.action_range}: {said.place} has the clip {list(said.clip)}")
    states = tuple(StateLeaf(name, np.zeros(into.row, np.float32)) for name, (into, _) in tensors.states.items())
    return Recipe(
        space(file, tensors.description.given),
        Box(low, high, dtype=np.float32),
        (),
        "given",
        "clip" if bounded else "none",
        None,
        states,
        affine=affine,
    )


def _is_scaled(said: Annotation) -> bool:
    return bool(said.command and said.scale and said.offset)


def _elements(said: Annotation, recipe: Recipe, main: StageTensor | None, joint_order: Sequence[str]) -> ElementNames:
    from rlservo.export.sources.restored_policy import ElementNames

    size = int(np.prod(recipe.action_space.shape))
    joints = said.joints or tuple(joint_order)
    if joints and len(joints) != size:
        raise CheckpointError(f"the joint order has {len(joints)} joints, but the action has {size} elements")
    if twice := [joint for joint in dict.fromkeys(joints) if joints.count(joint) > 1]:
        raise CheckpointError(f"the action's joints ({', '.join(joints)}) have {', '.join(twice)} more than once")
    if not set(joints) <= set(joint_order or joints):
        raise CheckpointError(
            f"the joint order that was given ({', '.join(joint_order)}) is not that of {said.place} "
            f"({', '.join(joints)})"
        )
    actions = []
    for index in range(size):
        joint = joints[index] if joints else ""
        known: dict[str, Any] = {"quantity": "raw"}
        if _is_scaled(said):
            known = {"quantity": said.command[index], "unit": UNITS[said.command[index]], "scale": 1.0, "offset": 0.0}
        actions.append(Element(name=joint or f"action_{index}", joint=joint, **known))
    observation: tuple[Element, ...] = ()
    if main is not None and said.terms:
        terms = [_term(term, actions, said) for term in said.terms]
        # mjlab does not say which joints a term has: only a size that fits shows that it has all.
        if not (any(isinstance(each, str) for each in terms) and any(term.size is None for term in said.terms
                                                                     if term.kind in JOINTS)):  # fmt: skip
            observation = fill(terms, int(np.prod(main.row)))
    elif main is not None:
        observation = tuple(Element(name=name) for name in said.observation_names)
    alone = not isinstance(recipe.observation_space, Dict)
    return ElementNames(
        observation if alone or main is None else {f"obs.{main.name}": observation},
        tuple(actions),
        said.control_rate_hz,
    )


def _term(term: Term, actions: Sequence[Element], said: Annotation) -> list[Element] | str:
    """Return a term's elements; its name if their number is not known."""
    elements = [Element(name=f"{term.name}_{index}") for index in range(term.size or 0)]
    known: list[Element] = []
    if term.kind in JOINTS and term.joints:
        known = joint_elements(term.name, term.kind, term.joints, term.offsets)
    elif term.kind in BODY:
        known = body_elements(term.name, term.kind, said.order)
    elif term.kind in ("last_action", "actions"):
        known = last_action(term.name, actions, *((said.scale, said.offset) if _is_scaled(said) else ()))
    elif term.kind == "velocity_commands":
        known = velocity_command(term.name)
    if len(known) == (term.size or len(known)):
        elements = known or elements
    elements = scaled(elements, term.scale)
    if term.history > 1:
        steps = reversed(range(term.history))
        elements = [  # only the last is what a robot measures now
            e.model_copy(update={"name": f"{e.name}_0_before"})
            if step == 0
            else Element(name=f"{e.name}_{step}_before")
            for step in steps
            for e in elements
        ]
    return elements or term.name


def _ask(elements: ElementNames, recipe: Recipe, options: RestoreOptions, notify: Notify) -> None:
    """Say in a sentence what no file does, with the option for each."""
    actions = elements.action
    missing = [
        text
        for text, is_missing in (
            ("what the observation's elements are (--env)", not elements.observation),
            ("the joints of the action (--joint-order)", not any(element.joint for element in actions)),  # type: ignore[union-attr]
            ("the action's range (--action-range)", recipe.transform == "none"),
            ("the control rate (--control-rate)", elements.control_rate_hz is None and not options.control_rate_hz),
        )
        if is_missing
    ]
    if missing:
        notify(f"no file says {', nor '.join(missing)}")
