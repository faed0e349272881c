"""The gate catches what exporters get wrong: each mistake is made on purpose, on a real checkpoint."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.bundle.contract import Parity
from rlservo.errors import ParityError
from rlservo.export.checkpoints.location import locate_checkpoint
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import comparer_of
from rlservo.export.graph.onnx_file import run_onnx, write_onnx
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.proof.parity import GraphLoop, prove
from rlservo.export.proof.references import record
from rlservo.export.recipe.recipe import ObservationFilter, Recipe, Transform
from rlservo.export.recipe.runners import Outputs, Runner, first_step
from rlservo.export.recipe.samples import BATCH_SIZES, draw_batches
from rlservo.export.rllib.restore import restore
from rlservo.export.sources.restored_policy import RestoredPolicy


@pytest.fixture
def load(zoo: Path, app: Path, notices: list[str]) -> Callable[[str], RestoredPolicy]:
    def load(name: str) -> RestoredPolicy:
        with user_code(app):
            return restore(locate_checkpoint(zoo / name), app, notices.append)

    return load


def filter_of(recipe: Recipe) -> ObservationFilter:
    assert recipe.filter is not None
    return recipe.filter


def prove_as(checkpoint: RestoredPolicy, recipe: Recipe, tmp_path: Path) -> Parity:
    """Prove a graph built from `recipe` against RLlib's own pipeline of `checkpoint`."""
    graph = PolicyGraph(recipe, checkpoint.network)
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))
    pair = next(one.batch for one in references if len(one.batch) == 2)
    example = GraphLoop(lambda inputs: inputs, recipe.state).complete(pair.inputs, np.ones(2, np.bool_))
    write_onnx(graph, example, tmp_path / "policy.onnx")
    comparer = comparer_of(checkpoint, graph, references)
    return prove(checkpoint.recipe, references, {"onnx": run_onnx(tmp_path / "policy.onnx")}, comparer=comparer)


@pytest.mark.parametrize("name", ["pendulum", "unbounded", "offset", "grid", "double"])
def test_the_filter_as_rllib_has_it_passes(load: Callable[[str], RestoredPolicy], tmp_path: Path, name: str) -> None:
    checkpoint = load(name)
    assert checkpoint.recipe.filter is not None
    result = prove_as(checkpoint, checkpoint.recipe, tmp_path).formats["onnx"]
    assert 0.0 < result.max_rel < 1e-5


@pytest.mark.parametrize("name", ["pendulum", "unbounded", "offset", "grid", "double"])
def test_a_dropped_filter_is_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path, name: str) -> None:
    checkpoint = load(name)
    steps = tuple(step for step in checkpoint.recipe.steps if step is not checkpoint.recipe.filter)
    with pytest.raises(ParityError, match="likely observations: output"):
        prove_as(checkpoint, dataclasses.replace(checkpoint.recipe, steps=steps), tmp_path)


def tampered_filter(recipe: Recipe, **changes: Any) -> Recipe:
    changed = dataclasses.replace(filter_of(recipe), **changes)
    return dataclasses.replace(recipe, steps=tuple(changed if step is recipe.filter else step for step in recipe.steps))


def test_swapped_mean_and_std_are_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("pendulum")
    frozen = filter_of(checkpoint.recipe)
    swapped = tampered_filter(checkpoint.recipe, mean=frozen.std.astype(np.float64), std=frozen.mean.astype(np.float32))
    with pytest.raises(ParityError):
        prove_as(checkpoint, swapped, tmp_path)


def test_a_missing_filter_clip_is_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("pendulum")
    with pytest.raises(ParityError):
        prove_as(checkpoint, tampered_filter(checkpoint.recipe, clip=None), tmp_path)


def test_a_biased_std_is_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("pendulum")
    n = filter_of(checkpoint.recipe).count
    biased = filter_of(checkpoint.recipe).std * np.float32(np.sqrt((n - 1) / n))
    with pytest.raises(ParityError):
        prove_as(checkpoint, tampered_filter(checkpoint.recipe, std=biased), tmp_path)


@pytest.mark.parametrize(
    ("name", "transform"),
    [("pendulum", "clip"), ("pendulum", "none"), ("mixed", "clip"), ("clipped", "unsquash"), ("clipped", "none")],
)
def test_a_wrong_action_transform_is_caught(
    load: Callable[[str], RestoredPolicy], tmp_path: Path, name: str, transform: Transform
) -> None:
    checkpoint = load(name)
    if transform == "none":  # actions of a fresh network stay within bounds: make some that do not
        loop: Any = checkpoint.start_loop()
        for module in (checkpoint.network.module, loop.pipelines.module):
            module.pi.net.mlp[-1].weight *= 50
    with pytest.raises(ParityError, match="output 'action'"):
        prove_as(checkpoint, dataclasses.replace(checkpoint.recipe, transform=transform), tmp_path)


def test_squashing_the_mean_where_rllib_does_not_is_caught(
    load: Callable[[str], RestoredPolicy], tmp_path: Path
) -> None:
    checkpoint = load("sac")
    assert checkpoint.recipe.mode == "mean"
    with pytest.raises(ParityError, match="output 'action'"):
        prove_as(checkpoint, dataclasses.replace(checkpoint.recipe, mode="tanh_mean"), tmp_path)


def test_changed_weights_are_caught_in_the_discrete_action_too(
    load: Callable[[str], RestoredPolicy], tmp_path: Path
) -> None:
    checkpoint = load("cart_pole")
    checkpoint.network.module.pi.net.mlp[-1].weight *= -1
    with pytest.raises(ParityError):
        prove_as(checkpoint, checkpoint.recipe, tmp_path)


def test_a_discrete_choice_may_differ_only_where_rllibs_scores_tie(load: Callable[[str], RestoredPolicy]) -> None:
    checkpoint = load("cart_pole")
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))[:1]
    outputs = references[0].outputs

    def flipped_at(rows: list[int]) -> Runner:
        action = outputs["action"].astype(np.int64)
        action[rows] = 1 - action[rows]
        return lambda obs: {**outputs, "action": action}

    with pytest.raises(ParityError, match=r"sample 4: the export chooses \d, RLlib \d"):
        prove(checkpoint.recipe, references, {"onnx": flipped_at([4])})
    outputs["action_dist_inputs"][4] = 0.25
    assert prove(checkpoint.recipe, references, {"onnx": flipped_at([4])}).samples == 257


def test_an_error_names_output_element_sample_and_both_values(load: Callable[[str], RestoredPolicy]) -> None:
    checkpoint = load("mixed")
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))
    wrong: dict[int, Outputs] = {id(one): {**one.outputs, "action": one.outputs["action"].copy()} for one in references}
    wrong[id(references[0])]["action"][11, 2] += 0.5
    answers = iter(references)
    with pytest.raises(ParityError) as caught:
        prove(
            checkpoint.recipe, references, {"onnx": lambda obs: wrong[id(next(answers))]}, labels=["x", "y", "gripper"]
        )
    expected = float(references[0].outputs["action"][11, 2])
    assert "output 'action', element 2 (gripper), sample 11" in caught.value.message
    assert caught.value.details["reference"] == pytest.approx(expected)
    assert caught.value.details["exported"] == pytest.approx(expected + 0.5)


def test_the_reference_does_not_drift(load: Callable[[str], RestoredPolicy]) -> None:
    checkpoint = load("pendulum")
    obs = {"obs": np.array([[0.1, 0.9, 3.0]], np.float32)}
    before = first_step(checkpoint.start_loop(), obs)
    for batch in draw_batches(checkpoint.recipe, seed=5):
        first_step(checkpoint.start_loop(), {"obs": batch.obs.copy()})
    after = first_step(checkpoint.start_loop(), obs)
    for name, values in before.items():
        np.testing.assert_array_equal(after[name], values)


def test_samples_reach_the_filters_clip_the_bounds_and_every_batch_size(load: Callable[[str], RestoredPolicy]) -> None:
    recipe = load("pendulum").recipe
    batches = draw_batches(recipe, seed=0)
    assert {len(batch.obs) for batch in batches} == set(BATCH_SIZES)
    obs = np.concatenate([batch.obs for batch in batches])
    filtered = (obs - filter_of(recipe).mean) / filter_of(recipe).divisor()
    assert (np.abs(filtered) > 10).mean() > 0.05 and (np.abs(filtered) < 1).mean() > 0.05
    assert (obs == recipe.observation_space.low).any() and (obs == recipe.observation_space.high).any()
    assert all(np.isfinite(batch.obs).all() for batch in batches)


def test_samples_leave_no_bounds_and_are_huge_where_there_are_none(load: Callable[[str], RestoredPolicy]) -> None:
    bounded, unbounded = (load(name).recipe for name in ("clipped", "unbounded"))
    obs = np.concatenate([batch.obs for batch in draw_batches(bounded, seed=0)])
    space = bounded.observation_space
    assert (space.low <= obs).all() and (obs <= space.high).all()
    assert max(np.abs(batch.obs).max() for batch in draw_batches(unbounded, seed=0)) >= 1000
