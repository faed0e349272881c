"""The wheel, and Pythons with packages that cannot share our environment: other servers' clients, robo-gym."""

from __future__ import annotations

import compileall
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from cache import PYTHON, cached, versions

ROOT = Path(__file__).resolve().parents[1]
PACKAGED = ("rlservo", "envs", "export", "serve_app", "deploy", "pyproject.toml", "README.md", "LICENSE")
ROBO_GYM = ("robo-gym==2.0.1", "robo-gym-server-modules==0.3.0.1")
# What our light client imports. Not rlservo's own requirements: onnxruntime wants a newer protobuf than robo-gym, and
# pip would settle that with an old robo-gym-server-modules that has no pin and does not work.
CLIENT = ("httptools>=0.6.3", "orjson>=3.10", "pydantic>=2.10")
INSTALLED_S = 500
UNPACKED = "unpacked"  # beside the wheel


@pytest.fixture(scope="session")
def wheel() -> Path:
    """The wheel of this tree."""

    def build(folder: Path) -> None:
        with tempfile.TemporaryDirectory() as temporary:
            source = Path(temporary) / "tree"
            # A copy without build leftovers: setuptools would take stale files from build/.
            subprocess.run(["git", "-C", str(ROOT), "checkout-index", "-a", f"--prefix={source}/"], check=False)
            for name in PACKAGED:
                subprocess.run(["cp", "-r", str(ROOT / name), str(source)], check=True)
            command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(source)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=300)
            assert done.returncode == 0, done.stdout + done.stderr
            assert "WARNING" not in done.stdout + done.stderr  # setuptools' are pages long
            with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
                archive.extractall(folder / UNPACKED)
            assert compileall.compile_dir(folder / UNPACKED, quiet=1)

    made_of = [*(ROOT / name for name in PACKAGED), UNPACKED]
    return next(cached("wheel", [*made_of, versions("build")], build).glob("*.whl"))


@pytest.fixture
def image_environment(wheel: Path, tmp_path: Path) -> Path:
    """The virtual environment of deploy/Dockerfile: the wheel and what its extra `serve` requires, nothing else."""
    return environment_with(wheel, tmp_path / "environment", "serve")


def environment_with(wheel: Path, folder: Path, *extras: str) -> Path:
    """Make a virtual environment of the wheel and what these extras require, nothing else.

    Linked to the packages that are installed here, so that it costs no download, and to what Python has compiled of
    them, which takes longer than most of what is run. Made again each time, in a second: one that is kept may outlive
    the packages that it links to.
    """
    venv.create(folder)
    site = folder / "lib" / PYTHON / "site-packages"
    for distribution in _required("rlservo", set(extras)):
        if distribution.name == "rlservo":  # its files are the wheel's
            tree = wheel.parent / UNPACKED
            _link(tree, site, [file.relative_to(tree) for file in tree.rglob("*") if file.is_file()])
        else:
            root = Path(str(distribution.locate_file("."))).absolute()
            for top, files in _files(distribution.name).items():
                if Path(top, "__init__.py") in files and not (site / top).exists():  # some share a package
                    (site / top).symlink_to(root / top)
                else:
                    _link(root, site, files)
        for point in distribution.entry_points.select(group="console_scripts"):
            script = folder / "bin" / point.name
            program = f"import sys\nfrom {point.module} import {point.attr}\nsys.exit({point.attr}())\n"
            script.write_text(f"#!{folder / 'bin' / 'python'}\n{program}")
            script.chmod(0o755)
    return folder


@functools.cache
def _files(name: str) -> dict[str, set[Path]]:
    """Return an installed distribution's files by the folder, or the file, that they are below in site-packages."""
    files: dict[str, set[Path]] = {}
    for file in map(Path, metadata.files(name) or ()):
        if ".." not in file.parts:
            files.setdefault(file.parts[0], set()).add(file)
    return files


def _link(root: Path, site: Path, files: Iterable[Path]) -> None:
    """Link files, and the folders where Python keeps what it has compiled of them."""
    for file in files:
        if "__pycache__" in file.parts or (site / file).exists():
            continue
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        (site / file).symlink_to(root / file)
        compiled = file.parent / "__pycache__"
        if (root / compiled).is_dir() and not (site / compiled).exists():
            (site / compiled).symlink_to(root / compiled)


@functools.cache
def required_by(*extras: str) -> set[str]:
    """Return the names of all packages that these extras require."""
    return {distribution.name.lower() for distribution in _required("rlservo", set(extras))}


def _required(name: str, extras: set[str]) -> list[metadata.Distribution]:
    """Return the installed distribution and, without end, those it requires with these extras."""
    found: dict[str, metadata.Distribution] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(name, extra) for extra in ("", *extras)]
    while waiting:
        name, extra = waiting.pop()
        if (name.lower(), extra) in seen:
            continue
        seen.add((name.lower(), extra))
        found[name.lower()] = metadata.distribution(name)
        for line in found[name.lower()].requires or ():
            wanted = Requirement(line)
            if wanted.marker is None or wanted.marker.evaluate({"extra": extra}):
                waiting += [(wanted.name, more) for more in ("", *wanted.extras)]
    return list(found.values())


def find_python(minor: str) -> str | None:
    """Return a Python 3.`minor` that starts: a version manager has names for ones that are switched off."""
    names = [shutil.which(f"python3.{minor}"), *sorted(Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/python3"))]
    for name in filter(None, names):
        if subprocess.run([str(name), "-c", ""], capture_output=True, timeout=60).returncode == 0:
            return str(name)
    return None


def virtual_environment(*packages: str | Path, python: str = sys.executable, name: str = "") -> Path:
    """Return the Python of an environment with these packages, which cannot share ours; made once and kept.

    `packages` is what pip installs, its options and their files included; `name` is for the cache's folder, by default
    the first package's. Raises RuntimeError where pip cannot install them.
    """

    def make(folder: Path) -> None:
        for command in (
            # Our own pip installs: one in each environment takes longer to unpack than most packages.
            [python, "-m", "venv", "--without-pip", str(folder)],
            [*install_into(folder / "bin" / "python"), *map(str, packages)],
        ):
            done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALLED_S)
            if done.returncode != 0:
                named = " ".join(map(str, packages))
                raise RuntimeError(f"{named} cannot be installed here: {done.stderr.strip()[-500:]}")

    said = subprocess.run([python, "-VV"], capture_output=True, text=True, timeout=60).stdout
    name = name or re.split(r"[^\w-]", str(packages[0]))[0]
    return cached(f"{name}-environment", [*packages, said], make) / "bin" / "python"


def install_into(python: Path) -> list[str]:
    """Return the beginning of a command with which our pip installs for another Python.

    What a test imports is compiled then, and kept; compiling all that there is takes a third of the processor's time.
    """
    return [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-compile"]


@pytest.fixture(scope="session")
def client_environment() -> Callable[..., Path]:
    """`virtual_environment`, or skip."""

    def install(*packages: str) -> Path:
        try:
            return virtual_environment(*packages)
        except RuntimeError as error:
            pytest.skip(str(error))

    return install


@pytest.fixture(scope="session")
def robo_gym_python() -> Path:
    """Return the Python of an environment with robo-gym, and without Ray, MuJoCo and rlservo.

    robo-gym pins a protobuf that Ray cannot use. Python 3.10, if there is one, is the last to have that compiled:
    otherwise a client spends a third of its time reading a laser's 500 numbers a step.

    If the environment cannot be built (without a network, for example) these tests skip with the reason, unless
    RLSERVO_REQUIRE_ROBO_GYM is set, as it is in CI.
    """
    try:
        return virtual_environment(*ROBO_GYM, *CLIENT, python=find_python("10") or sys.executable)
    except RuntimeError as error:
        if os.environ.get("RLSERVO_REQUIRE_ROBO_GYM"):
            pytest.fail(str(error))
        pytest.skip(str(error))
