"""Find the class of an old-stack custom model, which a checkpoint often holds by name only.

`ModelCatalog.register_custom_model("mine", Mine)` puts the class into a registry of the training process, and
`{"custom_model": "mine"}` into the checkpoint: no other process can restore it, RLlib's own included. The user's code
still says which class it was, so it is read, as text, for that call; then only the class's own module is imported.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ray.rllib.models.catalog import ModelCatalog
from ray.tune.registry import RLLIB_MODEL, _global_registry

from rlservo.export.errors import CheckpointError
from rlservo.export.unpickle import explain, searched

REGISTER = "register_custom_model"
SKIPPED = {"site-packages", "node_modules", "__pycache__", "build", "dist"}
MANY_FILES = 2000  # of an --app-dir that is not meant: a home folder, a file system's root


@dataclass(frozen=True)
class Registration:
    """A call `register_custom_model(name, class)` in the user's code."""

    module: str
    """Where the class is defined, as it is imported."""
    attribute: str


def register_custom_model(model_config: Mapping[str, Any], app_dir: Path) -> None:
    """Put the custom model that `model_config` names into RLlib's registry, unless it is there or none is named.

    Raises CheckpointError when the code in `app_dir` does not say which class has that name, or it cannot be imported.
    """
    name = model_config.get("custom_model")
    if not isinstance(name, str) or _global_registry.contains(RLLIB_MODEL, name):
        return
    found = next((one for file in _sources(app_dir) for one in find_registrations(file, app_dir, name)), None)
    if found is None:
        raise CheckpointError(
            f"the checkpoint names its custom model '{name}' but does not hold the class: looked in the Python files "
            f"of {app_dir} for a call {REGISTER}('{name}', ...); give the folder that has it with --app-dir, or train "
            "with the class itself as custom_model"
        )
    try:
        kind = getattr(importlib.import_module(found.module), found.attribute)
    except (Exception, SystemExit) as error:  # importing runs the user's own code
        raise CheckpointError(
            f"the custom model '{name}' is {found.module}.{found.attribute}, which cannot be imported: "
            f"{explain(error)}; looked in {searched()}"
        ) from error
    ModelCatalog.register_custom_model(name, kind)


def find_registrations(file: Path, app_dir: Path, name: str) -> Iterator[Registration]:
    """Yield what `file`, somewhere below `app_dir`, registers under `name`."""
    try:
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text) if REGISTER in text else None
    except (OSError, ValueError, SyntaxError):
        return
    if tree is None:
        return
    own = ".".join(file.relative_to(app_dir).with_suffix("").parts)
    imported = dict(_imports(tree))
    for call in ast.walk(tree):
        if not (isinstance(call, ast.Call) and _last_name(call.func) == REGISTER):
            continue
        given = [*call.args, *(keyword.value for keyword in call.keywords)]
        if len(given) != 2 or not (isinstance(given[0], ast.Constant) and given[0].value == name):
            continue
        match given[1]:
            case ast.Name(id=kind):
                yield imported.get(kind, Registration(own, kind))
            case ast.Attribute(value=ast.Name(id=module), attr=kind):
                prefix = imported.get(module)
                yield Registration(f"{prefix.module}.{prefix.attribute}" if prefix else module, kind)


def _imports(tree: ast.AST) -> Iterator[tuple[str, Registration]]:
    """Yield each name that a `from module import name` gives a file, and where it comes from."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                yield alias.asname or alias.name, Registration(node.module, alias.name)


def _last_name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def _sources(app_dir: Path) -> Iterator[Path]:
    """Yield the Python files of `app_dir`, its own first, without installed packages and hidden folders."""
    folders, seen = [app_dir], 0
    while folders:
        folder = folders.pop(0)
        try:
            entries = sorted(folder.iterdir())
        except OSError:
            continue
        for entry in entries:
            if entry.suffix == ".py" and entry.is_file():
                seen += 1
                yield entry
            elif entry.is_dir() and not entry.name.startswith(".") and entry.name not in SKIPPED:
                folders.append(entry)
        if seen > MANY_FILES:
            return
