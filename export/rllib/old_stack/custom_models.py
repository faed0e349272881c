"""Classes of an old-stack custom model and action distribution, which a checkpoint often holds only by name.

`ModelCatalog.register_custom_model("mine", Mine)` puts the class into a registry of the training process, and
`{"custom_model": "mine"}` into the checkpoint: no other process can restore it, RLlib's own included. The user's code
still says which class it was, so it is read, as text, for that call; then only the class's own module is imported.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ray.rllib.models.catalog import ModelCatalog
from ray.rllib.models.torch.torch_action_dist import TorchDistributionWrapper
from ray.rllib.models.torch.torch_modelv2 import TorchModelV2
from ray.tune.registry import RLLIB_ACTION_DIST, RLLIB_MODEL

from rlservo.errors import CheckpointError
from rlservo.export.checkpoints.unpickle import explain, searched
from rlservo.export.rllib import private_names

REGISTER = "register_custom_model"
SKIPPED = {"site-packages", "node_modules", "__pycache__", "build", "dist"}
MANY_FILES = 2000  # more than this: an --app-dir given by mistake, such as a home folder


@dataclass(frozen=True)
class Registration:
    """A call `register_custom_model(name, class)`, or of a distribution, in the user's code."""

    module: str
    """Module of the class, as it is imported."""
    attribute: str


@dataclass(frozen=True)
class _Part:
    """One kind of class that RLlib's catalog knows by name."""

    setting: str
    category: str
    call: str
    called: str
    kind: type
    register: Callable[[str, Any], None]


PARTS = (
    _Part("custom_model", RLLIB_MODEL, REGISTER, "model", TorchModelV2, ModelCatalog.register_custom_model),
    _Part(
        "custom_action_dist", RLLIB_ACTION_DIST, "register_custom_action_dist", "action distribution",
        TorchDistributionWrapper, ModelCatalog.register_custom_action_dist,
    ),
)  # fmt: skip


def register_custom_parts(model_config: Mapping[str, Any], app_dir: Path) -> None:
    """Put the custom model and distribution that `model_config` names into RLlib's registry, unless they are there.

    Raises CheckpointError when the code in `app_dir` does not register a class of that name, or it cannot be imported.
    """
    registry = private_names.find("ray.tune.registry", "_global_registry")
    for part in PARTS:
        name = model_config.get(part.setting)
        if isinstance(name, str) and not registry.contains(part.category, name):
            part.register(name, _find_class(part, name, app_dir))


def _find_class(part: _Part, name: str, app_dir: Path) -> Any:
    """Return the torch class registered under `name`; the first one if there are several (one for each framework)."""
    reason: CheckpointError | None = None
    for found in (one for file in _sources(app_dir) for one in find_registrations(file, app_dir, name, part.call)):
        try:
            kind = getattr(importlib.import_module(found.module), found.attribute)
        except (Exception, SystemExit) as error:  # importing runs the user's own code
            reason = reason or CheckpointError(
                f"the custom {part.called} '{name}' is {found.module}.{found.attribute}, which cannot be imported: "
                f"{explain(error)}; looked in {searched()}"
            )
            continue
        if isinstance(kind, type) and issubclass(kind, part.kind):
            return kind
        reason = reason or CheckpointError(
            f"the custom {part.called} '{name}' is {found.module}.{found.attribute}, which is not a "
            f"{part.kind.__name__}"
        )
    raise reason or CheckpointError(
        f"the checkpoint names its custom {part.called} '{name}' but does not hold the class: looked in the Python "
        f"files of {app_dir} for a call {part.call}('{name}', ...); give the folder that has it with --app-dir, or "
        f"train with the class itself as {part.setting}"
    )


def find_registrations(file: Path, app_dir: Path, name: str, call: str = REGISTER) -> Iterator[Registration]:
    """Yield the classes that `file`, below `app_dir`, registers under `name` with `call`."""
    try:
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text) if call in text else None
    except (OSError, ValueError, SyntaxError):
        return
    if tree is None:
        return
    own = ".".join(file.relative_to(app_dir).with_suffix("").parts)
    imported = dict(_imports(tree))
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and _last_name(node.func) == call):
            continue
        given = [*node.args, *(keyword.value for keyword in node.keywords)]
        if len(given) != 2 or not (isinstance(given[0], ast.Constant) and given[0].value == name):
            continue
        for chosen in _branches(given[1]):
            match chosen:
                case ast.Name(id=kind):
                    yield imported.get(kind, Registration(own, kind))
                case ast.Attribute(value=ast.Name(id=module), attr=kind):
                    prefix = imported.get(module)
                    yield Registration(f"{prefix.module}.{prefix.attribute}" if prefix else module, kind)


def _branches(node: ast.expr) -> Iterator[ast.expr]:
    """Yield the possible values of an expression: RLlib's examples register `A if framework == "torch" else B`."""
    if isinstance(node, ast.IfExp):
        yield from _branches(node.body)
        yield from _branches(node.orelse)
    else:
        yield node


def _imports(tree: ast.AST) -> Iterator[tuple[str, Registration]]:
    """Yield each name that a `from module import name` gives a file, and its origin."""
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
