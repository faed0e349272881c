"""The oldest Python: every source file parses with its grammar, and base and client run on every interpreter found."""

from __future__ import annotations

import ast
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from environments import find_python, virtual_environment
from rlservo.robots.arm_interface import no_driver

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("rlservo", "envs", "export", "serve_app", "deploy", "examples")
OLDEST = (3, 10)
CLASSIFIER = re.compile(r'"Programming Language :: Python :: 3\.(\d+)"')

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
    """Return a Python 3.`minor` that starts, or skip."""
    return find_python(minor) or pytest.skip(f"there is no Python 3.{minor} here")


def requirements(*extras: str) -> list[str]:
    """Return what the base and these extras need, as the project file says."""
    lists = [re.search(rf"^{name} = \[\n?(.*?)\]$", project(), re.M | re.S) for name in ("dependencies", *extras)]
    named = [line for found in lists if found is not None for line in re.findall(r'"([^"]+)"', found[1])]
    assert len(lists) == 1 + len(extras) and None not in lists
    return [line for line in named if not line.startswith("rlservo[")]


def environment_of(minor: str, *options: str | Path) -> Path:
    """Return the Python of an environment of Python 3.`minor`, or skip if there is none or pip cannot install."""
    try:
        return virtual_environment(*options, python=interpreter(minor), name=f"python3.{minor}")
    except RuntimeError as error:
        pytest.skip(str(error))


def linked_package(folder: Path) -> Path:
    """Return a folder for PYTHONPATH where this tree is the package `rlservo`, and nothing else."""
    path = folder / "path"
    path.mkdir()
    (path / "rlservo").symlink_to(ROOT / "rlservo")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("minor", CLASSIFIER.findall(project()))
def test_base_and_client_run_on_every_python_that_is_named(minor: str, ur5: Path, tmp_path: Path) -> None:
    python = environment_of(minor, *requirements("client"))
    path = linked_package(tmp_path)
    environment = {"PYTHONPATH": str(path), "ORT_DISABLE_TELEMETRY": "1"}
    done = subprocess.run(
        [str(python), "-W", "error", "-c", PROGRAM, str(ur5)],
        capture_output=True, text=True, timeout=200, cwd=tmp_path, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("refused\nacted (6,)\n") and "algorithm" in done.stdout


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
@pytest.mark.parametrize("minor", CLASSIFIER.findall(project()))
def test_missing_arm_driver_is_installed_where_it_has_a_wheel(
    minor: str, machine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Elsewhere the extra leaves it out, and the sentence names what to do instead."""
    (line,) = (one for one in requirements("ur") if one.startswith("ur-rtde"))
    here = {"python_version": f"3.{minor}", "platform_machine": machine}
    has_wheel = Requirement(line).marker.evaluate(here)  # type: ignore[union-attr]  # it has one
    monkeypatch.setattr(sys, "version_info", (3, int(minor), 0))
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert has_wheel == (machine == "x86_64" and minor in ("11", "12"))
    assert has_wheel == no_driver().endswith("pip install '.[ur]' in the checkout of rlservo")
    assert has_wheel != (f"this is Python 3.{minor} on {machine}: use one of these, compile it" in no_driver())


@pytest.mark.parametrize(
    ("minor", "sentence"),
    [
        ("10", r"Python 3\.10: the versions in constraints\.txt need 3\.11"),
        ("12", r"has Python 3\.11, and PYTHON=.*3\.12"),
    ],
)
def test_set_up_says_that_a_python_is_too_old_or_not_the_environments(
    minor: str, sentence: str, tmp_path: Path
) -> None:
    for name in ("Makefile", ".ci", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).symlink_to(ROOT / name)
    theirs = tmp_path / ".venv" / "bin" / "python"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("#!/bin/sh\necho 3.11\n")
    theirs.chmod(0o755)
    command = ["make", "setup", f"PYTHON={interpreter(minor)}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert re.search(sentence, done.stderr.splitlines()[0]), done
