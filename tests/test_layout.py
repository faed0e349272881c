"""Who may import whom, read off the source: DESIGN.md's picture stays true because this test fails when it is not."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("envs", "export", "serve_app", "deploy")

# The one file (or folder) that may import a heavy library, by top-level module.
ONLY_IN = {
    "ray.rllib": (
        "export/rllib/new_stack.py",
        "export/rllib/new_pipelines.py",
        "export/rllib/old_stack.py",
        "export/rllib/old_models.py",
        "examples/",
    ),
    "ray.serve": (
        "serve_app/ray_serve/app.py",
        "serve_app/ray_serve/loopback_ports.py",
        "serve_app/ray_serve/closed_endpoints.py",
    ),
    "ray.experimental": ("serve_app/ray_serve/gcs_ledger.py",),
    "fastapi": (
        "serve_app/protocols/json_act.py",
        "serve_app/protocols/http_endpoint.py",
        "serve_app/protocols/oip_infer.py",
        "serve_app/protocols/oip_config.py",
        "serve_app/protocols/docs_page.py",
        "serve_app/protocols/admin_routes.py",
        "serve_app/ray_serve/app.py",
    ),
    "mujoco": ("envs/",),
    "grpc": (
        "envs/robot_server/",
        "serve_app/protocols/oip_grpc.py",
        "serve_app/ray_serve/grpc_ingress.py",
        "serve_app/ray_serve/closed_endpoints.py",
    ),
    "google.protobuf": ("envs/robot_server/", "serve_app/protocols/oip_grpc.py", "serve_app/protocols/oip_messages.py"),
    "torch": ("export/",),
    "pickle": ("export/checkpoints/unpickle.py",),
}


def modules() -> list[Path]:
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def imports_of(path: Path) -> set[str]:
    """Every dotted name that the file imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def reaches(names: set[str], target: str) -> bool:
    return any(name == target or name.startswith(f"{target}.") for name in names)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_module_imports_only_what_the_design_allows(path: Path) -> None:
    names = imports_of(path)
    folder = path.relative_to(ROOT).parts[0]
    allowed = {
        "envs": {"rlservo.envs"},
        "export": {"rlservo.export"},
        "serve_app": {
            "rlservo.serve_app",
            "rlservo.export.contract.errors",
            "rlservo.export.contract.regular_files",
            "rlservo.export.contract.bundle",
            "rlservo.export.contract.scores",
            "rlservo.export.contract.onnx_session",
        },
        "deploy": {f"rlservo.{name}" for name in FOLDERS},
    }[folder]
    ours = {name for name in names if reaches({name}, "rlservo")}
    for name in ours:
        assert any(reaches({name}, permitted) or reaches({permitted}, name) for permitted in allowed), (
            f"{path.relative_to(ROOT)} imports {name}"
        )
    assert not any(reaches(names, bare) for bare in (*FOLDERS, "examples", "tests", "benchmarks"))


@pytest.mark.parametrize("library", list(ONLY_IN))
def test_heavy_library_has_its_named_place(library: str) -> None:
    for path in modules():
        relative = str(path.relative_to(ROOT))
        if reaches(imports_of(path), library):
            assert any(relative.startswith(place) for place in ONLY_IN[library]), f"{relative} imports {library}"


def test_client_imports_no_server_code() -> None:
    seen: set[str] = set()
    queue = ["rlservo.serve_app.client.policy_client"]
    while queue:
        name = queue.pop()
        path = ROOT / Path(*name.split(".")[1:]).with_suffix(".py")
        if name in seen or not path.is_file():
            continue
        seen.add(name)
        queue += [n for n in imports_of(path) if n.startswith("rlservo.")]
    assert "rlservo.serve_app.client.policy_client" in seen
    assert not seen & {f"rlservo.serve_app.{name}" for name in ("http", "app", "store", "launcher", "policy")}


def test_every_package_folder_is_in_the_project_file() -> None:
    project = (ROOT / "pyproject.toml").read_text()
    for path in modules():
        folder = path.relative_to(ROOT).parent
        package = "rlservo" if folder == Path("deploy/package") else "rlservo." + ".".join(folder.parts)
        assert f'"{package}"' in project, f"{package} is missing from [tool.setuptools] packages"
