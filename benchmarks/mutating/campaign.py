"""Campaign over one policy: every mutant of its graph and recipe before the gate, and what the accepted ones change."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from mutating.gate import Gate, MutatedPolicy
from mutating.graph_mutants import GraphMutant, graph_mutants
from mutating.recipe_mutants import recipe_mutants

MISS = 0.01
"""Share of an action's range that an accepted mutant must change for it to be a miss."""


@dataclass(frozen=True)
class Outcome:
    """One mutant: 'caught', 'stopped' (before the gate), 'equivalent' (accepted, changes too little) or 'missed'."""

    kind: str
    what: str
    outcome: str
    change: float = 0.0
    """Largest change of an action over the judge's observations, as a share of its range."""
    where: Any = None


def mutate(policy: MutatedPolicy, numbers: int, progress: Any = lambda _: None) -> tuple[list[Outcome], dict[str, Any]]:
    """Return every mutant's outcome, and figures of the run."""
    began = time.perf_counter()
    gate = Gate(policy)
    outcomes = []
    recipes = recipe_mutants(gate.restored.recipe, max(2, numbers // 5))
    from_recipes = (judge_recipe(gate, *mutant) for mutant in recipes)
    from_graphs = (judge_graph(gate, mutant) for mutant in graph_mutants(gate.model, numbers))
    for outcome in itertools.chain(from_recipes, from_graphs):
        outcomes.append(outcome)
        if outcome.outcome == "missed":
            progress(f"{policy.name}: MISSED {outcome.kind}: {outcome.what}: {outcome.change:.3g}")
    figures = {"seconds": time.perf_counter() - began, "samples": gate.judge.samples, "unsure": gate.judge.unsure}
    return outcomes, figures


def judge_recipe(gate: Gate, kind: str, what: str, recipe: Any) -> Outcome:
    """Return the outcome of a whole export with this recipe."""
    verdict, model, state = gate.of_recipe(recipe)
    if model is None:
        return Outcome(kind, what, verdict.outcome, where=verdict.why)
    return _judged(gate, kind, what, model, state)


def judge_graph(gate: Gate, mutant: GraphMutant) -> Outcome:
    """Return the outcome of the proof of this graph."""
    try:
        model = mutant.of(gate.model)
    except Exception as error:  # protobuf's, for a number out of its type's range
        return Outcome(mutant.kind, mutant.what, "stopped", where=str(error)[:200])
    verdict = gate.of_graph(model)
    if verdict.outcome != "accepted":
        return Outcome(mutant.kind, mutant.what, verdict.outcome)
    return _judged(gate, mutant.kind, mutant.what, model, gate.state)


def _judged(gate: Gate, kind: str, what: str, model: Any, state: Any) -> Outcome:
    change, where = gate.judge.largest_change(model, state)
    return Outcome(kind, what, "missed" if change > MISS else "equivalent", float(np.minimum(change, 1e9)), where)
