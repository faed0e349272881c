"""Real export of a policy, and its verdict on mutants: the gate is whatever `rlservo export` runs.

A mutated recipe goes through the whole export, its checkpoint and the framework's own loop untouched. A mutated graph
goes to the proof with everything that the export gave it for the graph it had written.
"""

from __future__ import annotations

import inspect
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import onnx
from mutating.judge import Arrays, Judge, leaves, run_model

from rlservo.errors import ParityError
from rlservo.export import export_checkpoint
from rlservo.export.proof import parity
from rlservo.export.sources.restored_policy import RestoredPolicy


@dataclass(frozen=True)
class MutatedPolicy:
    """A policy whose export is mutated."""

    name: str
    source: type[Any]
    """The class of its source, whose `restore` is replaced."""
    export: Callable[[Path], Any]
    """Export it into a folder; return an ExportResult."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of one mutant: 'caught' by the gate, 'stopped' before it, or 'accepted'."""

    outcome: str
    why: str = ""


class Gate:
    """One policy: its honest export, and the same export of mutants."""

    def __init__(self, policy: MutatedPolicy) -> None:
        self._policy = policy
        self.restored: RestoredPolicy
        self.model: onnx.ModelProto
        self._proof: Any = None
        self._honest()
        recipe = self.restored.recipe
        self.judge = Judge(self.model, self.state, recipe.observation_space, recipe.action_space, self._seen)

    def _honest(self) -> None:
        restore, prove = self._policy.source.restore, parity.prove

        def kept(*arguments: Any, **more: Any) -> Any:
            self.restored = restore(*arguments, **more)
            return self.restored

        def proof(*arguments: Any, **more: Any) -> Any:
            self._proof = inspect.signature(prove).bind(*arguments, **more)
            return prove(*arguments, **more)

        with (
            tempfile.TemporaryDirectory() as folder,
            mock.patch.object(self._policy.source, "restore", kept),
            mock.patch.object(export_checkpoint, "prove", proof),
        ):
            result = self._policy.export(Path(folder))
            self.model, self.state = _read(result.path)
        self._prove = prove

    def _seen(self, name: str, space: Any) -> tuple[Any, Any]:
        """Return the recorded mean and spread of a leaf's observations: the checkpoint's, before any mutation."""
        for step in self.restored.recipe.steps:
            if getattr(step, "leaf", "") == name and getattr(step, "mean", np.zeros(0)).shape == space.shape:
                return step.mean, np.maximum(step.std.astype(np.float64), 1e-3)  # type: ignore[union-attr]
        return 0.0, 1.0

    def of_graph(self, model: onnx.ModelProto) -> Verdict:
        """Return the gate's verdict on a mutated graph."""
        try:
            run = run_model(model)
        except Exception as error:  # onnxruntime's own
            return Verdict("stopped", str(error)[:200])
        self._proof.arguments["formats"] = {"onnx": run}
        try:
            self._prove(*self._proof.args, **self._proof.kwargs)
        except ParityError as error:
            return Verdict("caught", error.message[:200])
        return Verdict("accepted")

    def of_recipe(self, recipe: Any) -> tuple[Verdict, onnx.ModelProto | None, Arrays]:
        """Return the verdict of a whole export with a mutated recipe, and the graph and state if it was written."""
        mutated = replace(self.restored, recipe=recipe)
        with (
            tempfile.TemporaryDirectory() as folder,
            mock.patch.object(self._policy.source, "restore", lambda *_, **__: mutated),
        ):
            try:
                model, state = _read(self._policy.export(Path(folder)).path)
            except ParityError as error:
                return Verdict("caught", error.message[:200]), None, {}
            except Exception as error:  # what a wrong recipe meets before the gate
                return Verdict("stopped", f"{type(error).__name__}: {error}"[:200]), None, {}
        return Verdict("accepted"), model, state


def _read(bundle: Path) -> tuple[onnx.ModelProto, Arrays]:
    """Return a bundle's graph, and what its state starts with."""
    contract = json.loads((bundle / "contract.json").read_text())
    initial = {
        leaf["name"]: np.broadcast_to(
            np.asarray(leaf["initial"], leaf["dtype"]).reshape(leaf["shape"] if np.ndim(leaf["initial"]) else ()),
            leaf["shape"],
        )
        for leaf in contract.get("state", ())
    }
    return onnx.load(str(bundle / "policy.onnx")), initial


__all__ = ["Gate", "MutatedPolicy", "Verdict", "leaves"]
