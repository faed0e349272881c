"""Reasons why a network cannot be exported faithfully: operators, and numbers that tracing froze."""

from __future__ import annotations

import ast
import re
import traceback
import warnings
from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch

from rlservo.errors import first_line
from rlservo.export.recipe.kept_values import INSTALLED
from rlservo.export.recipe.runners import Inputs

INSTEAD = {
    "cummax|cummin": "take torch.maximum or torch.minimum of one column after the other and torch.stack them",
    r"complex|polar|real|imag|view_as_\w+|fft_\w+": "keep real and imaginary parts as two tensors (torch.hypot and "
    "torch.atan2 give radius and angle, torch.cos and torch.sin the way back)",
    r"linalg_\w+|inverse|cholesky\w*|qr|svd|lu\w*": "write a small matrix's solution out by its elements, or compute "
    "what does not depend on the observation beforehand and keep it in a buffer",
    r"nonzero\w*|masked_select|\w*unique\w*": "its result's shape depends on the numbers: use torch.where and a mask",
    r"rand\w*|normal\w*|bernoulli\w*|multinomial": "an exported policy does not draw numbers: leave the noise out",
}
"""Replacements for operators that no exporter takes, by a pattern of ATen's names."""
OTHERWISE = "compose it of arithmetic, comparisons, torch.where, torch.cat and sums along an axis"


def tracer_warning() -> type[Warning]:
    """Return the class of tracing's warnings; in a torch without that private name every warning counts as one."""
    kind: type[Warning] = getattr(torch.jit, "TracerWarning", Warning)
    return kind


def frozen_by_tracing(caught: Sequence[warnings.WarningMessage]) -> list[str]:
    """Return the places, outside installed packages, where a number left torch while it was traced."""
    places = {
        f"{one.filename}:{one.lineno}"
        for one in caught
        if issubclass(one.category, tracer_warning())
        and not any(part in INSTALLED for part in Path(one.filename).parts)
    }
    return sorted(places)


def why_not_onnx(graph: torch.nn.Module, example: Inputs, errors: Sequence[Exception]) -> str:
    """Return a sentence: which operator has no ONNX form, where the user wrote it, and what to write instead.

    `errors` are those of torch's exporters, the more thorough one's first.
    """
    places = _operators(graph, example)
    refused = [name for error in errors for name in _refused_operators(error)]
    if refused:
        # The thorough one takes operators apart first, and may name a part that no user wrote.
        name = next((name for name in refused if name in places), refused[-1])
        public = re.sub(r"^(linalg|fft|special)_", r"\1.", name)
        hint = next((hint for pattern, hint in INSTEAD.items() if re.fullmatch(pattern, name)), OTHERWISE)
        return f"the operator torch.{public}{places.get(name, '')} has no ONNX form that onnxruntime runs: {hint}"
    return f"the network cannot be written as ONNX: {first_line(_cause(errors[0]))}{raised_at(errors[0])}"


def raised_at(error: BaseException) -> str:
    """Return ' in CLASS.METHOD (FILE:LINE)' for where the user's own code, or else RLlib's, raised; '' if neither."""
    frames = traceback.extract_tb(_cause(error).__traceback__)
    return _place((frame.filename, frame.lineno or 0, frame.name) for frame in reversed(frames))


def _cause(error: BaseException) -> BaseException:
    """Return the exception that torch wrapped in advice."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _refused_operators(error: BaseException) -> list[str]:
    """Return ATen's names of the operators that an exception of torch.onnx reports as unsupported."""
    return re.findall(r"(?:operator '|OpOverload\(op=')aten(?:::|\.)(\w+)", f"{_cause(error)}\n{error}")


def _operators(graph: torch.nn.Module, example: Inputs) -> dict[str, str]:
    """Return every operator of a graph by ATen's name, with the place where it is first used."""
    places: dict[str, str] = {}
    names: Any = graph.input_names
    tensors = tuple(torch.from_numpy(example[name]) for name in names)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        try:
            traced: Any = torch.jit.trace(graph, tensors, check_trace=False)  # type: ignore[no-untyped-call]
            operators = [(node.kind(), node.sourceRange()) for node in traced.inlined_graph.nodes()]
        except Exception:  # untraceable, or a torch whose graphs are read otherwise: the exporter's own error says more
            return places
    for kind, source in operators:
        space, _, name = kind.partition("::")
        if space == "aten" and name not in places:
            frames = re.findall(r"^(.+)\((\d+)\): (.+)$", source, re.MULTILINE)
            places[name] = _place((file, int(line), function) for file, line, function in frames)
    return places


def _place(frames: Iterable[tuple[str, int, str]]) -> str:
    """Return ' in CLASS.METHOD (FILE:LINE)' of the user's frame, else of RLlib's; '' if the graph's own code is first.

    `frames` come from the innermost outwards: (file, line, function).
    """
    torchs, ours = Path(torch.__file__).parent, Path(__file__).parent
    called = list(takewhile(lambda frame: Path(frame[0]).parent != ours, frames))
    outside = [frame for frame in called if torchs not in Path(frame[0]).parents]
    own = [frame for frame in outside if not any(part in INSTALLED for part in Path(frame[0]).parts)]
    for file, line, function in (own or outside)[:1]:
        kind = _class_at(file, line)
        return f" in {kind}.{function} ({file}:{line})" if kind else f" in {function} ({file}:{line})"
    return ""


def _class_at(file: str, line: int) -> str:
    """Return the name of the class whose body holds a line; '' if there is none."""
    try:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return ""
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    holding = [node for node in classes if node.lineno <= line <= (node.end_lineno or 0)]
    return max(holding, key=lambda node: node.lineno).name if holding else ""
