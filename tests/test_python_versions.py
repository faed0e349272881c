"""The oldest Python: every source is in its grammar, and where an interpreter is found, base and client run on each."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cache import cached

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("envs", "export", "serve_app", "deploy", "examples")
OLDEST = (3, 10)
CLASSIFIER = re.compile(r'"Programming Language :: Python :: 3\.(\d+)"')
INSTALLED_S = 400

PROGRAM = """
import sys
import numpy as np
import rlservo
from rlservo.deploy.cli import main
action = rlservo.Policy.load(sys.argv[1]).act(np.zeros(27, np.float32))
try:
    rlservo.PolicyClient("http://127.0.0.1:9", "ur5", timeout_s=5, retries=0).act(np.zeros(27, np.float32))
except rlservo.errors.UnavailableError:
    print("refused")
rlservo.StreamClient, rlservo.AdminClient, rlservo.WithFallback, rlservo.rollout
print("acted", action.shape)
sys.argv = ["rlservo", "inspect", sys.argv[1]]
main()
"""


def project() -> str:
    return (ROOT / "pyproject.toml").read_text()


def test_the_oldest_python_is_said_once() -> None:
    assert f'requires-python = ">={OLDEST[0]}.{OLDEST[1]}"' in project()
    assert min(map(int, CLASSIFIER.findall(project()))) == OLDEST[1]


def test_every_source_is_in_the_oldest_pythons_grammar() -> None:
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py"))]
    assert len(files) > 200
    for file in files:
        ast.parse(file.read_text(encoding="utf-8"), str(file), feature_version=OLDEST)
    with pytest.raises(SyntaxError):  # the check refuses what is newer
        ast.parse("try:\n    ...\nexcept* ValueError:\n    ...\n", feature_version=OLDEST)


def interpreter(minor: str) -> str:
    """Return a Python 3.`minor` that starts, or skip: a version manager has names for ones that are switched off."""
    names = [shutil.which(f"python3.{minor}"), *sorted(Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/python3"))]
    for name in filter(None, names):
        if subprocess.run([str(name), "-c", ""], capture_output=True, timeout=60).returncode == 0:
            return str(name)
    pytest.skip(f"there is no Python 3.{minor} here")


def requirements() -> list[str]:
    """Return what the base and the extra `client` need, as the project file says."""
    base, client = (re.search(rf"^{name} = \[(.*?)\]", project(), re.M | re.S) for name in ("dependencies", "client"))
    assert base is not None and client is not None
    return re.findall(r'"([^"]+)"', base[1] + client[1])


def module_of(requirement: str) -> str:
    """Return what a requirement is imported as."""
    return re.split(r"[<>=\[; ]", requirement)[0].replace("-", "_")


@pytest.mark.slow
@pytest.mark.parametrize("minor", CLASSIFIER.findall(project()))
def test_base_and_client_run_on_every_python_that_is_named(minor: str, ur5: Path, tmp_path: Path) -> None:
    named = interpreter(minor)

    def install(folder: Path) -> None:
        for command in (
            [named, "-m", "venv", "--without-pip", str(folder)],
            [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install", "--quiet",
             "--no-compile", *requirements()],
            # Compiles what is imported, and nothing else: a third of what an installation took.
            [str(folder / "bin" / "python"), "-c", f"import {', '.join(map(module_of, requirements()))}"],
        ):  # fmt: skip
            done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALLED_S)
            if done.returncode != 0:
                pytest.skip(f"Python 3.{minor} cannot have the requirements: {done.stderr.strip()[-300:]}")

    said = subprocess.run([named, "-VV"], capture_output=True, text=True, timeout=60).stdout
    python = cached(f"base-python3.{minor}", [said, *requirements()], install) / "bin" / "python"
    package = tmp_path / "path" / "rlservo"  # what setuptools' package-dir makes of the tree
    package.mkdir(parents=True)
    for source in [*(ROOT / "deploy" / "package").glob("*.py"), *(ROOT / name for name in FOLDERS[:4])]:
        (package / source.name).symlink_to(source)
    environment = {"PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1", "ORT_DISABLE_TELEMETRY": "1"}
    done = subprocess.run(
        [str(python), "-W", "error", "-c", PROGRAM, str(ur5)],
        capture_output=True, text=True, timeout=200, cwd=tmp_path, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("refused\nacted (6,)\n") and "algorithm" in done.stdout
