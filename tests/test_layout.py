"""Imports between folders, read off the source, run one way; heavy libraries have their named place."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PUBLIC_NAMES = ROOT / "rlservo" / "__init__.py"
FOLDERS = ("rlservo", "export", "serve_app", "envs", "deploy")

# Imports that a part may have besides its own: a part is a folder with its subfolders, or a file. Each is below those
# that name it, so no two can import each other.
GROUND = {"rlservo/errors.py", "rlservo/extras.py", "rlservo/protobuf_messages.py", "rlservo/bundle"}
MAY_IMPORT: dict[str, set[str]] = {
    "rlservo/errors.py": set(),
    "rlservo/extras.py": {"rlservo/errors.py"},
    "rlservo/protobuf_messages.py": set(),
    "rlservo/bundle": {"rlservo/errors.py"},
    "rlservo/policy/acting_policy.py": {"rlservo/bundle"},
    "rlservo/policy": GROUND - {"rlservo/extras.py"} | {"rlservo/policy/acting_policy.py"},
    "rlservo/recording": GROUND - {"rlservo/protobuf_messages.py"} | {"rlservo/policy/acting_policy.py"},
    "rlservo/recording/replay": {"rlservo/errors.py", "rlservo/bundle", "rlservo/policy", "rlservo/recording"},
    "rlservo/client/formats": {"rlservo/errors.py"},
    "rlservo/client": {
        "rlservo/errors.py", "rlservo/bundle", "rlservo/policy/acting_policy.py", "rlservo/recording",
        "rlservo/client/formats",
    },
    "rlservo/drive": {
        "rlservo/errors.py", "rlservo/extras.py", "rlservo/bundle", "rlservo/policy/acting_policy.py",
        "rlservo/recording", "rlservo/client/formats",
    },
    "rlservo/robots": set(),
    "rlservo/robots/simulated": {"rlservo/robots"},
    "export/checkpoints": {"rlservo/errors.py", "rlservo/bundle"},
    "export/recipe": {"rlservo/errors.py", "rlservo/bundle"},
    "export/sources": {"rlservo/errors.py", "rlservo/bundle", "export/checkpoints", "export/recipe"},
    "export/sources/onnx": {
        "rlservo/errors.py", "rlservo/bundle", "rlservo/policy", "export/checkpoints", "export/recipe",
        "export/sources",
    },
    "export/rllib": {"rlservo/errors.py", "rlservo/bundle", "export/checkpoints", "export/recipe", "export/sources"},
    "export/graph": {"rlservo/errors.py", "rlservo/bundle", "rlservo/policy", "export/recipe"},
    "export/proof": {"rlservo/errors.py", "rlservo/bundle", "export/recipe"},
    "export/compiled": {"rlservo/errors.py", "rlservo/bundle", "rlservo/policy"},
    "export": {
        "rlservo/errors.py", "rlservo/extras.py", "rlservo/bundle", "rlservo/drive", "export/checkpoints",
        "export/recipe", "export/sources", "export/graph", "export/proof",
    },
    "serve_app/repository": GROUND - {"rlservo/protobuf_messages.py"} | {"rlservo/client/formats"},
    "serve_app/versions": {"rlservo/errors.py", "rlservo/bundle", "rlservo/policy", "serve_app/repository"},
    "serve_app/sessions": {"rlservo/errors.py", "rlservo/policy", "rlservo/client/formats", "serve_app/versions"},
    "serve_app/server": {
        "rlservo/errors.py", "rlservo/extras.py", "rlservo/bundle", "rlservo/policy", "rlservo/recording",
        "rlservo/client/formats", "serve_app/repository", "serve_app/versions", "serve_app/sessions",
    },
    "serve_app/protocols": {
        "rlservo/errors.py", "rlservo/protobuf_messages.py", "rlservo/bundle", "rlservo/policy",
        "rlservo/client/formats", "serve_app/versions", "serve_app/sessions", "serve_app/server",
    },
    "serve_app/engines": {
        "rlservo/errors.py", "rlservo/client/formats", "serve_app/repository", "serve_app/versions",
        "serve_app/sessions", "serve_app/server", "serve_app/protocols",
    },
    "serve_app": set(),
    "envs": {"rlservo/bundle", "rlservo/robots"},
    "envs/ur": {"rlservo/robots", "envs"},
    "envs/mir100": {"rlservo/robots", "envs"},
    "envs/panda": {"rlservo/robots", "envs", "envs/ur"},
    "envs/robot_server": {
        "rlservo/protobuf_messages.py", "rlservo/robots", "envs", "envs/ur", "envs/mir100", "envs/panda",
    },
    "deploy/terminal.py": set(),
    "deploy/cockpit": {
        "rlservo/errors.py", "rlservo/bundle", "rlservo/policy", "rlservo/recording", "rlservo/recording/replay",
        "rlservo/client", "rlservo/drive", "rlservo/robots", "envs", "envs/ur", "envs/robot_server",
        "deploy/terminal.py",
    },
    "deploy/page": {
        "rlservo/errors.py", "rlservo/bundle", "rlservo/policy", "rlservo/drive", "rlservo/robots", "envs", "envs/ur",
        "envs/mir100", "envs/panda", "export",
    },
    "deploy/ros2": {
        "rlservo/errors.py", "rlservo/bundle", "rlservo/policy/acting_policy.py", "rlservo/drive", "rlservo/robots",
    },
    "deploy/learning": {
        "rlservo/errors.py", "rlservo/bundle", "rlservo/policy/acting_policy.py", "rlservo/recording",
        "rlservo/client", "export", "export/checkpoints", "export/rllib", "serve_app/repository",
    },
    "rlservo": {"rlservo", "export"},  # its public names
    "deploy": {"rlservo", "envs", "export", "serve_app", "deploy"},
}  # fmt: skip

# The folders (or files) that may import a library, by the library's dotted name. The longest name that fits counts.
ONLY_IN: dict[str, tuple[str, ...]] = {
    "ray": ("export/rllib/", "serve_app/engines/ray_serve.py"),
    "ray.serve": ("serve_app/engines/ray_serve.py",),
    "ray.rllib": ("export/rllib/", "deploy/learning/rllib_"),
    "ray.tune": ("export/rllib/",),
    "uvicorn": ("serve_app/engines/uvicorn_server.py", "serve_app/engines/connection_bounds.py"),
    "fastapi": ("serve_app/protocols/openapi.py",),
    "torch": (
        "export/graph/", "export/recipe/kept_values.py", "export/rllib/", "export/sources/", "export/export_policy.py",
    ),
    "rsl_rl": ("export/sources/rsl_rl.py",),
    "skrl": ("export/sources/skrl.py",),
    "leapp": ("export/sources/leapp.py",),
    "stable_baselines3": ("export/sources/sb3",),
    "sb3_contrib": ("export/sources/sb3_policy.py",),
    "mujoco": ("envs/", "rlservo/robots/"),
    "grpc": ("envs/robot_server/", "serve_app/protocols/", "serve_app/engines/"),
    "google.protobuf": (
        "envs/robot_server/",
        "serve_app/protocols/open_inference/grpc_service.py",
        "rlservo/protobuf_messages.py",
    ),
    "google.protobuf.message_factory": ("rlservo/protobuf_messages.py",),
    "mcap": (
        "rlservo/recording/log_file.py", "rlservo/recording/reader.py", "rlservo/recording/repair.py",
    ),
    "pyarrow": ("rlservo/recording/conversion/", "export/"),
    "fsspec": ("export/checkpoints/remote.py",),
    "huggingface_hub": ("serve_app/repository/hub_storage.py",),
    "botocore": ("serve_app/repository/object_storage.py",),
    "aiohttp": (),
    "minari": ("rlservo/recording/conversion/minari.py",),
    "httpx": (),
    "httpcore": (),
    "httptools": ("rlservo/client/formats/http_connection.py",),
    "websockets": (
        "deploy/cockpit/page.py", "rlservo/robots/simulated/rosbridge_server.py",
        "rlservo/client/websocket_connection.py",
    ),
    "rclpy": ("rlservo/robots/ros2/rclpy_link.py",),
    "roslibpy": ("rlservo/robots/ros2/rosbridge_link.py",),
    "viser": ("deploy/cockpit/",),
    "trimesh": ("deploy/cockpit/meshes.py", "deploy/cockpit/scenery.py"),
    "pickle": ("export/checkpoints/unpickle.py",),
    "onnxruntime": ("rlservo/policy/",),
    "asyncio": (
        "serve_app/versions/", "serve_app/sessions/", "serve_app/server/", "serve_app/protocols/",
        "serve_app/engines/",
    ),
}  # fmt: skip


IMPORTING = ("optional_package", "import_module", "importlib.import_module")


def modules() -> list[Path]:
    """Return every module; `rglob` does not follow the links of rlservo/ to the other folders."""
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
    path = ROOT / Path(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if module.startswith("rlservo.") and file.is_file():
            return file.resolve()
    return None


def part_of(path: Path) -> str:
    """Return the part of the house that a file belongs to: itself, or the innermost folder that `MAY_IMPORT` has."""
    relative = path.relative_to(ROOT)
    return next((str(one) for one in (relative, *relative.parents) if str(one) in MAY_IMPORT), "")


def is_in(part: str, parts: set[str]) -> bool:
    return any(part == one or part.startswith(f"{one}/") for one in parts)


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
    for name, file in ours(path):
        there = part_of(file)
        assert there == part or is_in(there, MAY_IMPORT[part]), f"{path.relative_to(ROOT)} imports {name}"
    bare = (*FOLDERS[1:], "examples", "tests", "benchmarks", "shared")
    assert not any(reaches(imports_of(path), name) for name in bare)


def test_folders_stand_one_above_the_other() -> None:
    """No circle: what a folder may import stands before it in the table."""
    below: set[str] = set()
    for part, allowed in MAY_IMPORT.items():
        assert all(name in below or any(known.startswith(f"{name}/") for known in below) for name in allowed), part
        below.add(part)


def test_every_arrow_of_the_table_is_needed() -> None:
    used: dict[str, set[str]] = {part: set() for part in MAY_IMPORT}
    for path in modules():
        used[part_of(path)] |= {part_of(file) for _, file in ours(path)}
    unused = {
        (part, one) for part, allowed in MAY_IMPORT.items() for one in allowed
        if not any(is_in(there, {one}) for there in used[part])
    }  # fmt: skip
    assert not unused


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    """Nor in a function, or for a type checker alone."""
    arrows = {path: {file for _, file in ours(path)} - {path, PUBLIC_NAMES} for path in modules()}
    del arrows[PUBLIC_NAMES]
    while leaves := [path for path, targets in arrows.items() if not targets]:
        for leaf in leaves:
            del arrows[leaf]
        for targets in arrows.values():
            targets.difference_update(leaves)
    while above := arrows.keys() - set().union(*arrows.values()):
        for path in above:
            del arrows[path]
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


@pytest.mark.parametrize("folder", ["client", "drive"])
def test_client_and_control_loop_need_no_runtime(folder: str) -> None:
    allowed = {
        f"rlservo/{folder}", "rlservo/policy/acting_policy.py", "rlservo/recording", "rlservo/client/formats", *GROUND,
    }  # fmt: skip
    assert reached_from(ROOT / "rlservo" / folder) <= allowed


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


SAME_FILE_NAME = {
    "one for each robot": {
        "arm_env.py", "end_effector_positioning.py", "model.py", "parameters.py", "sensor_errors.py", "server_state.py",
        "simulation.py",
    },
    "one for each API stack of RLlib": {"connectors.py", "policy.py"},
    "a command, and its work": {"compile.py", "demo.py", "policy.py", "replay.py", "robot_server.py"},
    "a bundle's page, and the cockpit's": {"page.py"},
}  # fmt: skip
SAME_CLASS_NAME = {
    "an RLlib connector, and the step of a recipe that it becomes": {"Logarithm", "SineAndCosine"},
}


def test_a_file_name_has_one_meaning() -> None:
    names = Counter(path.name for path in modules() if path.name != "__init__.py")
    assert {name for name, count in names.items() if count > 1} == set().union(*SAME_FILE_NAME.values())


def test_a_class_name_has_one_meaning() -> None:
    names = Counter(
        node.name
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    )
    assert {name for name, count in names.items() if count > 1} == set().union(*SAME_CLASS_NAME.values())
