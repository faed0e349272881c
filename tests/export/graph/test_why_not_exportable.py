"""Reasons why a network cannot be exported, also by a torch without the private names they are read from."""

from __future__ import annotations

import inspect
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn

from rlservo.errors import UnsupportedError
from rlservo.export.graph import why_not_exportable
from rlservo.export.graph.onnx_file import write_onnx
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.torchscript_file import write_torchscript
from rlservo.export.recipe.recipe import Recipe, UserStep

EXAMPLE = {"obs": np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)}


class Untouched(nn.Module):
    """A network that gives its input as the action."""

    names: tuple[str, ...] = ()

    def forward(self, obs: Tensor) -> tuple[Tensor, ...]:
        return (obs,)


def freezes(obs: Tensor) -> Tensor:
    return obs * float(obs[0, 0])


def advises(obs: Tensor) -> Tensor:
    warnings.warn("nothing about tracing", UserWarning, stacklevel=1)
    return obs


def turns(obs: Tensor) -> Tensor:
    return torch.cummax(obs, 1).values


def graph_of(function: Any) -> PolicyGraph:
    box = Box(-np.inf, np.inf, (2,), np.float32)
    return PolicyGraph(Recipe(box, box, (UserStep("mine", function),), "given", "none", None), Untouched())


def places(function: Any, tmp_path: Path) -> list[str]:
    return write_torchscript(graph_of(function), EXAMPLE, tmp_path / "policy.ts")


def test_a_number_that_left_torch_is_told_with_its_place(tmp_path: Path) -> None:
    line = inspect.getsourcelines(freezes)[1] + 1
    assert places(freezes, tmp_path) == [f"{__file__}:{line}"]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert places(advises, tmp_path) == []


def test_a_torch_without_its_class_of_warnings_tells_every_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Only from us: torch continues to raise it.
    monkeypatch.setattr(why_not_exportable, "getattr", lambda _owner, _name, otherwise: otherwise, raising=False)
    assert why_not_exportable.tracer_warning() is Warning
    lines = {function: inspect.getsourcelines(function)[1] + 1 for function in (freezes, advises)}
    for function, line in lines.items():
        assert places(function, tmp_path) == [f"{__file__}:{line}"]


def test_a_torch_whose_graphs_are_read_otherwise_names_the_operator_without_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusal() -> str:
        with pytest.raises(UnsupportedError) as error:
            write_onnx(graph_of(turns), EXAMPLE, tmp_path / "policy.onnx")
        return error.value.message

    assert f"torch.cummax in turns ({__file__}:" in refusal()
    monkeypatch.setattr(torch.jit, "trace", lambda *_, **__: object())
    assert refusal().startswith("the operator torch.cummax has no ONNX form that onnxruntime runs: take torch.maximum")
