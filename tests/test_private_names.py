"""Private names of other packages: the product uses none but those of RLlib, in `export/rllib`."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("rlservo", "envs", "export", "serve_app", "deploy")
RLLIB = ROOT / "export" / "rllib"  # restores what RLlib keeps in private attributes
DOCUMENTED = {"_replace", "_asdict", "_exit"}  # of named tuples and `os`: documented, in spite of their names
RAY_VARIABLES = {
    "RAY_SERVE_ENABLE_HA_PROXY", "RAY_SERVE_THROUGHPUT_OPTIMIZED", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_ADDRESS",
    "RAY_USAGE_STATS_ENABLED",
}  # fmt: skip
SERVERS = ("serve_app/engines/connection_bounds.py", "serve_app/engines/uvicorn_server.py")
DOTTED = re.compile(r"[A-Za-z]\w*(\.\w+)+")


def modules(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def is_private(name: object) -> bool:
    return isinstance(name, str) and name.startswith("_") and not name.startswith("__")


def own_private_names(tree: ast.AST) -> set[str]:
    """Return the private names that a file itself defines: functions, classes, attributes of `self`, variables."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and is_self(node.value):
            found.add(node.attr)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return {name for name in found if is_private(name)}


def is_self(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id in ("self", "cls")


@cache
def names_of_all_files() -> set[str]:
    """Return the private names that any file of the product defines: `self` may have them from a class of ours."""
    return {name for path in modules(*FOLDERS) for name in own_private_names(ast.parse(path.read_text()))}


def private_names_of_others(source: str) -> Iterator[tuple[int, str]]:
    """Yield (line, name) of each private name that a file uses and does not define."""
    tree = ast.parse(source)
    own = own_private_names(tree) | DOCUMENTED
    for node in ast.walk(tree):
        names: list[str] = []
        known = own
        if isinstance(node, ast.Attribute):
            names = [node.attr]
            if is_self(node.value) or ast.unparse(node.value) == "super()":
                known = own | names_of_all_files()
        elif isinstance(node, ast.Import):
            names = [part for alias in node.names for part in alias.name.split(".")]
        elif isinstance(node, ast.ImportFrom):
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id.endswith("attr"):
            names = [word.value for word in node.args[1:2] if isinstance(word, ast.Constant)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and DOTTED.fullmatch(node.value):
            names = node.value.split(".")  # of something to import
        yield from ((node.lineno, name) for name in names if is_private(name) and name not in known)


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_file_uses_a_private_name_of_another_package(folder: str) -> None:
    used = {
        str(path.relative_to(ROOT)): found
        for path in modules(folder)
        if not path.is_relative_to(RLLIB)
        if (found := list(private_names_of_others(path.read_text())))
    }
    assert used == {}


@pytest.mark.parametrize(
    "source",
    [
        "import ray._private.services",
        "from ray.serve._private import constants",
        "from uvicorn.server import _Hidden",
        "def f(server): return server._servers",
        "class A(B):\n    def f(self): return self._inherited",
        "class A(B):\n    def f(self): return super()._inherited",
        "getattr(websocket, '_transport')",
        "import importlib\nimportlib.import_module('ray._private.services')",
    ],
)
def test_the_check_finds(source: str) -> None:
    assert list(private_names_of_others(source))


def test_our_servers_classes_have_no_private_name_in_common_with_their_bases() -> None:
    """A definition of ours under a name that the base uses itself would silently replace it."""
    for file in SERVERS:
        module = importlib.import_module("rlservo." + file.removesuffix(".py").replace("/", "."))
        for node in ast.walk(ast.parse((ROOT / file).read_text())):
            if not isinstance(node, ast.ClassDef):
                continue
            for base in inspect.getmro(getattr(module, node.name))[1:]:
                library = base.__module__.split(".")[0]
                if library == "rlservo" or library in sys.stdlib_module_names:
                    continue
                theirs = ast.parse(textwrap.dedent(inspect.getsource(base)))
                used = {
                    each.attr for each in ast.walk(theirs) if isinstance(each, ast.Attribute) and is_self(each.value)
                }
                assert not own_private_names(node) & (own_private_names(theirs) | used), f"{node.name}, {base}"


def test_of_rays_variables_only_the_documented_ones_are_named() -> None:
    deploy = ROOT / "deploy"
    files = [*modules(*FOLDERS), *deploy.rglob("*.yaml"), deploy / "Dockerfile"]
    assert len(files) > 100
    named = {name for file in files for name in re.findall(r"\bRAY_[A-Z_]+[A-Z]\b", file.read_text())}
    assert named <= RAY_VARIABLES
