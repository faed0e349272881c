"""Mutants of two trained policies before the real gate: a small part of `benchmarks/mutations.py`."""

from __future__ import annotations

from collections import Counter
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from mutating.campaign import Outcome, judge_graph, judge_recipe
from mutating.gate import Gate, MutatedPolicy, Verdict
from mutating.graph_mutants import graph_mutants
from mutating.recipe_mutants import recipe_mutants
from onnx import numpy_helper

from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.sources.registry import find_source

EVERY = 4  # of these mutants one is tried
pytestmark = pytest.mark.filterwarnings("ignore:.*PPOTorchRLModule.*:DeprecationWarning")


@pytest.fixture(scope="module")
def gate(zoo: Path) -> Gate:
    """The gate of an export with a filter and bounds."""
    return gate_of(zoo / "pendulum")


def gate_of(checkpoint: Path) -> Gate:
    def export(out: Path) -> object:
        return export_checkpoint(checkpoint, out, name="policy", notify=lambda _: None)

    return Gate(MutatedPolicy(checkpoint.name, type(find_source(checkpoint)), export))


def none_is_missed(outcomes: list[Outcome], least: float) -> None:
    """Check that at least this share was caught, and of the others none changes an action."""
    counts = Counter(each.outcome for each in outcomes)
    assert not [each for each in outcomes if each.outcome == "missed"]
    assert counts["caught"] + counts["stopped"] >= least * len(outcomes)


def test_every_kind_of_wrong_number_and_step_in_a_graph_is_caught(gate: Gate) -> None:
    mutants = list(graph_mutants(gate.model, numbers=3))
    chosen = mutants[::EVERY]
    assert {each.kind for each in chosen} >= {"weight", "bias or vector", "row", "step", "order", "constant"}
    none_is_missed([judge_graph(gate, each) for each in chosen], 0.7)


def test_wrong_statistics_steps_bounds_and_flags_of_a_recipe_are_caught(gate: Gate) -> None:
    first: dict[tuple[str, str], object] = {}
    for kind, what, recipe in recipe_mutants(gate.restored.recipe, 1):
        first.setdefault((kind, what.partition(":")[0].partition("[")[0]), (kind, what, recipe))
    chosen = [each for (kind, _), each in first.items() if kind not in ("observation space", "mode")]
    none_is_missed([judge_recipe(gate, *each) for each in chosen], 0.4)  # type: ignore[misc]


def test_a_recurrent_graphs_mutants_are_caught(wide_zoo: Path) -> None:
    gate = gate_of(wide_zoo / "lstm_box")
    none_is_missed([judge_graph(gate, each) for each in islice(graph_mutants(gate.model, numbers=2), 0, None, 12)], 0.7)


def test_the_judge_sees_a_changed_weight_and_no_change_in_the_original(gate: Gate) -> None:
    assert gate.judge.largest_change(gate.model, gate.state)[0] == 0
    turned = islice((m for m in graph_mutants(gate.model, 1) if m.kind == "weight" and "other sign" in m.what), 4)
    assert (
        max(gate.judge.largest_change(one.of(gate.model), gate.state)[0] for one in turned) > 0.01
    )  # one may be small
    biases = [tensor for tensor in gate.model.graph.initializer if numpy_helper.to_array(tensor).ndim == 1]
    assert biases and gate.judge.samples == 20_000


def test_a_gate_that_lets_everything_pass_is_found_out(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "of_graph", lambda model: Verdict("accepted"))
    orders = [each for each in graph_mutants(gate.model, 1) if each.kind == "order" and "obs" in each.what]
    outcomes = [judge_graph(gate, each) for each in orders]
    assert {each.outcome for each in outcomes} == {"missed"}
    assert all(np.isfinite(each.change) and each.change > 0.01 for each in outcomes)
