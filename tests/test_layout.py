"""Imports between folders, read off the source, run one way; heavy libraries have their named place."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("envs", "export", "serve_app", "deploy")
WHOLE = ("envs", "deploy")  # one part each, with their subfolders

# Imports that a folder may have besides its own. Each is below those that name it, so no two can import each other.
MAY_IMPORT: dict[str, set[str]] = {
    "export/contract": set(),
    "export/checkpoints": {"export/contract"},
    "export/recipe": {"export/contract"},
    "export/sources": {"export/contract", "export/checkpoints", "export/recipe"},
    "export/rllib": {"export/contract", "export/checkpoints", "export/recipe", "export/sources"},
    "export/graph": {"export/contract", "export/recipe"},
    "export/proof": {"export/contract", "export/recipe"},
    "serve_app/interface.py": {"export/contract"},
    "serve_app/wire": {"export/contract"},
    "serve_app/runtime": {"export/contract", "serve_app/interface.py", "serve_app/wire"},
    "export/compiled": {"export/contract", "serve_app/runtime"},
    "serve_app/recording": {"export/contract", "serve_app/interface.py"},
    "serve_app/replay": {"export/contract", "serve_app/recording", "serve_app/runtime"},
    "serve_app/client": {"export/contract", "serve_app/interface.py", "serve_app/recording", "serve_app/wire"},
    "serve_app/rollout": {"export/contract", "serve_app/interface.py", "serve_app/recording"},
    "export": {
        "export/contract", "export/checkpoints", "export/recipe", "export/sources", "export/graph", "export/proof",
        "serve_app/rollout",
    },
    "serve_app/repository": {"export/contract", "serve_app/wire"},
    "serve_app/learning": {
        "export", "export/contract", "export/checkpoints", "export/rllib", "serve_app/interface.py", "serve_app/client",
        "serve_app/recording", "serve_app/repository",
    },
    "serve_app/versions": {"export/contract", "serve_app/interface.py", "serve_app/repository", "serve_app/runtime"},
    "serve_app/episodes": {"export/contract", "serve_app/runtime", "serve_app/versions", "serve_app/wire"},
    "serve_app/server": {
        "export/contract", "serve_app/repository", "serve_app/runtime", "serve_app/versions", "serve_app/episodes",
        "serve_app/wire", "serve_app/recording",
    },
    "serve_app/protocols": {
        "export/contract", "serve_app/runtime", "serve_app/versions", "serve_app/episodes", "serve_app/server",
        "serve_app/wire",
    },
    "serve_app/engines": {
        "export/contract", "serve_app/repository", "serve_app/versions", "serve_app/episodes", "serve_app/server",
        "serve_app/protocols", "serve_app/wire",
    },
    "envs": {"export/contract", "serve_app/wire"},
    "deploy": {"envs", "export", "serve_app"},
    "export/__init__.py": set(),
    "serve_app/__init__.py": set(),
}  # fmt: skip

# The folders (or files) that may import a library, by the library's dotted name. The longest name that fits counts.
ONLY_IN: dict[str, tuple[str, ...]] = {
    "ray": ("export/rllib/", "serve_app/engines/ray_serve.py"),
    "ray.serve": ("serve_app/engines/ray_serve.py",),
    "ray.rllib": ("export/rllib/", "serve_app/learning/rllib_"),
    "ray.tune": ("export/rllib/",),
    "uvicorn": ("serve_app/engines/uvicorn_server.py", "serve_app/engines/connection_bounds.py"),
    "fastapi": ("serve_app/protocols/openapi.py",),
    "torch": ("export/graph/", "export/rllib/", "export/sources/", "export/export_policy.py"),
    "rsl_rl": ("export/sources/rsl_rl.py",),
    "skrl": ("export/sources/skrl.py",),
    "leapp": ("export/sources/leapp.py",),
    "stable_baselines3": ("export/sources/sb3.py", "export/sources/sb3_policy.py"),
    "sb3_contrib": ("export/sources/sb3_policy.py",),
    "mujoco": ("envs/",),
    "grpc": ("envs/robot_server/", "serve_app/protocols/", "serve_app/engines/"),
    "google.protobuf": (
        "envs/robot_server/",
        "serve_app/protocols/open_inference/grpc_service.py",
        "serve_app/wire/protobuf_messages.py",
    ),
    "google.protobuf.message_factory": ("serve_app/wire/protobuf_messages.py",),
    "mcap": (
        "serve_app/recording/log_file.py", "serve_app/recording/reader.py", "serve_app/recording/repair.py",
    ),
    "pyarrow": ("serve_app/recording/conversion/", "export/"),
    "fsspec": ("export/checkpoints/remote.py",),
    "botocore": ("serve_app/repository/object_storage.py",),
    "aiohttp": (),
    "minari": ("serve_app/recording/conversion/minari.py",),
    "httpx": (),
    "httpcore": (
        "serve_app/client/http_transport.py", "serve_app/wire/http_deadlines.py",
    ),
    "websockets": (
        "deploy/cockpit/page.py", "envs/ros2/rosbridge_server.py", "serve_app/client/websocket_connection.py",
    ),
    "rclpy": ("envs/ros2/rclpy_link.py",),
    "roslibpy": ("envs/ros2/rosbridge_link.py",),
    "viser": ("deploy/cockpit/",),
    "trimesh": ("deploy/cockpit/meshes.py", "deploy/cockpit/scenery.py"),
    "pickle": ("export/checkpoints/unpickle.py",),
    "onnxruntime": ("export/contract/ort_session.py", "serve_app/runtime/"),
    "asyncio": (
        "serve_app/versions/", "serve_app/episodes/", "serve_app/server/", "serve_app/protocols/",
        "serve_app/engines/",
    ),
}  # fmt: skip


IMPORTING = ("optional_package", "import_module", "importlib.import_module")


def modules() -> list[Path]:
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Every dotted name that the file imports, in functions and under TYPE_CHECKING as well."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in IMPORTING:
            names |= {each.value for each in node.args[:1] if isinstance(each, ast.Constant)}
    return frozenset(names)


def file_of(module: str) -> Path | None:
    """Return the file of a module of ours, by its dotted name."""
    path = ROOT / Path(*module.split(".")[1:])
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if module.startswith("rlservo.") and file.is_file():
            return file
    return None


def part_of(path: Path) -> str:
    """Return the part of the house that a file belongs to: a folder of `MAY_IMPORT`, or the file itself."""
    names = path.relative_to(ROOT).parts
    inside = "/".join(names[:2])
    return inside if inside in MAY_IMPORT or (len(names) > 2 and names[0] not in WHOLE) else names[0]


def ours(path: Path) -> Iterator[tuple[str, Path]]:
    """Yield (dotted name, file) of what a file imports from us; a folder's own `__init__` only if it is meant."""
    names = imports_of(path)
    for name in sorted(names):
        file = file_of(name)
        if file is None or (file.name == "__init__.py" and any(other.startswith(f"{name}.") for other in names)):
            continue
        yield name, file


def reaches(names: frozenset[str] | set[str], target: str) -> bool:
    return any(name == target or name.startswith(f"{target}.") for name in names)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_file_imports_only_folders_below_its_own(path: Path) -> None:
    part = part_of(path)
    assert part in MAY_IMPORT, f"{path.relative_to(ROOT)} is in no folder that MAY_IMPORT knows"
    for name, file in ours(path):
        allowed = {part, *MAY_IMPORT[part]}
        there = part_of(file)
        assert there in allowed or there.split("/")[0] in allowed, f"{path.relative_to(ROOT)} imports {name}"
    assert not any(reaches(imports_of(path), bare) for bare in (*FOLDERS, "examples", "tests", "benchmarks", "shared"))


def test_folders_stand_one_above_the_other() -> None:
    """No circle: what a folder may import stands before it in the table."""
    below: set[str] = set()
    for part, allowed in MAY_IMPORT.items():
        assert all(name in below or any(known.startswith(f"{name}/") for known in below) for name in allowed), part
        below.add(part)


def test_every_arrow_of_the_table_is_needed() -> None:
    used: dict[str, set[str]] = {part: set() for part in MAY_IMPORT}
    for path in modules():
        for _, file in ours(path):
            used[part_of(path)] |= {part_of(file), part_of(file).split("/")[0]}
    unused = {part: allowed - used[part] for part, allowed in MAY_IMPORT.items() if allowed - used[part]}
    assert not unused


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    """At import time; an import in a function, or for a type checker alone, makes no circle."""
    arrows: dict[Path, set[Path]] = {}
    for path in modules():
        names: set[str] = set()
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        found = {file_of(name) for name in names}
        arrows[path] = {file for file in found if file is not None and file.name != "__init__.py"}
    while leaves := [path for path, targets in arrows.items() if not targets]:
        for leaf in leaves:
            del arrows[leaf]
        for targets in arrows.values():
            targets.difference_update(leaves)
    assert not arrows, f"a circle through {sorted(str(path.relative_to(ROOT)) for path in arrows)}"


@pytest.mark.parametrize("library", list(ONLY_IN))
def test_library_has_its_named_place(library: str) -> None:
    deeper = [other for other in ONLY_IN if other.startswith(f"{library}.")]
    used: set[str] = set()
    for path in modules():
        relative = str(path.relative_to(ROOT))
        names = {name for name in imports_of(path) if not any(reaches({name}, other) for other in deeper)}
        if reaches(names, library):
            places = {place for place in ONLY_IN[library] if relative.startswith(place)}
            assert places, f"{relative} imports {library}"
            used |= places
    assert used == set(ONLY_IN[library]), "a place that does not need it"


def reached_from(start: Path) -> set[str]:
    """Return the parts that a folder's files reach, whatever is between."""
    seen: set[Path] = set()
    queue = sorted(start.rglob("*.py"))
    while queue:
        path = queue.pop()
        if path not in seen:
            seen.add(path)
            queue += [file for _, file in ours(path)]
    return {part_of(path) for path in seen}


@pytest.mark.parametrize("folder", ["client", "rollout"])
def test_client_and_rollout_reach_neither_runtime_nor_server(folder: str) -> None:
    allowed = {
        f"serve_app/{folder}", "serve_app/interface.py", "serve_app/recording", "serve_app/wire", "export/contract",
    }  # fmt: skip
    assert reached_from(ROOT / "serve_app" / folder) <= allowed


def test_every_folder_says_what_lives_in_it() -> None:
    for folder in sorted({path.parent for path in modules()}):
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text())), f"{folder} has no docstring"


@pytest.mark.parametrize("folder", (*FOLDERS, "examples", "benchmarks", "tests"))
def test_every_module_begins_with_a_noun_or_a_verb(folder: str) -> None:
    questions = ("What ", "Who ", "How ", "Whether ", "From ", "When ", "Where ", "Which ")
    files = sorted((ROOT / folder).rglob("*.py"))
    assert files
    docs = {str(path.relative_to(ROOT)): ast.get_docstring(ast.parse(path.read_text())) or "" for path in files}
    assert {path: text.splitlines()[0] for path, text in docs.items() if text.startswith(questions)} == {}
