"""Content of the image of deploy/Dockerfile: serving without torch, and without the secrets beside it."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SECRETS = ("secrets/tls_key", "secrets/redis_password", "kuberay/secrets.yaml", "kuberay/secrets-lab.yaml")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """An operator's checkout after docs/how-to/ray-and-kubernetes.md, as far as `deploy` goes."""
    ignore = shutil.ignore_patterns("__pycache__", "secrets", "secrets*.yaml")
    shutil.copytree(ROOT / "deploy", tmp_path / "deploy", ignore=ignore)
    for name in (*SECRETS, "kuberay/secrets.example.yaml", "compose/tls.pem"):
        (tmp_path / "deploy" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "deploy" / name).write_text("a secret")
    return tmp_path


def test_no_secret_is_in_the_build_context_or_in_git(checkout: Path) -> None:
    rules = (checkout / "deploy" / "Dockerfile.dockerignore").read_text().splitlines()

    def in_context(name: str) -> bool:
        """As Docker: the last line that matches the file or a folder above it says whether it is left out."""
        places = [name, *map(str, Path(name).parents)]
        left_out = False
        for line in rules:
            pattern = line.removeprefix("!")
            if line and not line.startswith("#") and any(expression(pattern).fullmatch(place) for place in places):
                left_out = not line.startswith("!")
        return not left_out

    for name in SECRETS:
        assert not in_context(f"deploy/{name}"), name
    for name in (
        "deploy/kuberay/secrets.example.yaml",
        "deploy/compose/nginx.conf",
        "serve_app/engines/uvicorn_server.py",
    ):
        assert in_context(name), name
    assert not in_context(".git/config") and not in_context("deploy/__pycache__/cli.pyc")
    subprocess.run(["git", "init", "-q", str(checkout)], check=True)
    shutil.copy(ROOT / ".gitignore", checkout)
    names = [f"deploy/{name}" for name in (*SECRETS, "kuberay/secrets.example.yaml")]
    ignored = subprocess.run(["git", "check-ignore", *names], capture_output=True, text=True, cwd=checkout)
    assert ignored.stdout.split() == names[: len(SECRETS)]


def expression(pattern: str) -> re.Pattern[str]:
    """Return what a line of a .dockerignore matches."""
    words = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*"}
    parts = re.split(r"(\*\*/|\*\*|\*)", pattern)
    return re.compile("".join(words.get(part, re.escape(part)) for part in parts))


def test_package_data_is_what_is_meant_and_nothing_that_lies_beside_it(checkout: Path) -> None:
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, checkout)
    shutil.copytree(ROOT / "rlservo", checkout / "rlservo", symlinks=True)  # it links to the others
    for folder in ("envs", "export", "serve_app"):
        (checkout / folder).symlink_to(ROOT / folder)
    program = """
from setuptools import Distribution
distribution = Distribution({"script_name": "setup.py"})
distribution.parse_config_files()
build = distribution.get_command_obj("build_py")
build.ensure_finalized()
print(*(f"{folder}/{name}" for package, folder, _, names in build.data_files if package == "rlservo.deploy"
        for name in names), sep="\\n")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=checkout)
    assert done.returncode == 0, done.stderr
    packed = {line.removeprefix("./rlservo/deploy/") for line in done.stdout.splitlines()}
    there = {
        str(file.relative_to(checkout / "deploy"))
        for folder in (".", "compose", "kuberay")
        for file in (checkout / "deploy" / folder).iterdir()
        if file.is_file() and file.suffix != ".py"
    }
    assert packed == there - {*SECRETS, "compose/tls.pem"}


@pytest.mark.slow
def test_the_image_has_no_torch_and_no_ray(image_environment: Path, tmp_path: Path) -> None:
    names = "('torch', 'ray', 'gymnasium', 'mujoco')"
    program = f"import importlib.util as u; print([n for n in {names} if u.find_spec(n)])"
    command = [image_environment / "bin" / "python", "-I", "-c", program]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "[]\n", "")
