"""An environment of its own for each peer, installed from PyPI or npm on demand and kept in the user's cache.

Every package is pinned (`benchmarks/peers/requirements/`), and an environment is made anew when its list changes. The
lists are complete, so nothing is resolved, which Debian's pip takes minutes for; none has torch and its gigabytes.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

PEERS = Path(__file__).resolve().parent.parent / "peers"
REQUIREMENTS = PEERS / "requirements"
INSTALL_S = 900.0
COMPLETE = ".complete"  # written last: an environment without it is half of one


class InstallError(Exception):
    """A peer that cannot be measured here, and why."""


def python_of(name: str) -> Path:
    """Return the Python of the environment `name`, made now if it is not there. Raises InstallError."""
    requirements = REQUIREMENTS / f"{name}.txt"
    digest = hashlib.sha256(requirements.read_bytes() + sys.version.encode()).hexdigest()[:12]
    root = _cache()
    folder = root / f"{name}-{digest}"
    python = folder / "bin" / "python"
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / COMPLETE).exists():
            shutil.rmtree(folder, ignore_errors=True)
            pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
            run([sys.executable, "-m", "venv", str(folder)], name)
            run([*pip, "-r", str(requirements)], name)
            (folder / COMPLETE).touch()
    return python


def node_modules_of(name: str) -> Path:
    """Return the packages of a peer in JavaScript, installed now if they are not there. Raises InstallError."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        raise InstallError("node and npm are missing")
    package = PEERS / name / "package.json"
    folder = _cache() / f"{name}-{hashlib.sha256(package.read_bytes()).hexdigest()[:12]}"
    with (_cache() / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / COMPLETE).exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            shutil.copy(package, folder)
            # No scripts: onnxruntime-node's would fetch CUDA's libraries, and the CPU's are in the package.
            options = ["--ignore-scripts", "--no-audit", "--no-fund", "--no-package-lock", "--loglevel=error"]
            run(["npm", "install", "--prefix", str(folder), *options], name)
            (folder / COMPLETE).touch()
    return folder / "node_modules"


def _cache() -> Path:
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rlservo-bench"
    root.mkdir(parents=True, exist_ok=True)
    return root


def run(command: list[str], name: str) -> None:
    """Run one step of an installation. Raises InstallError."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=INSTALL_S)
    except subprocess.TimeoutExpired:
        raise InstallError(f"installing {name} took longer than {INSTALL_S:g} s") from None
    if done.returncode != 0:
        errors = [line for line in done.stderr.splitlines() if line.startswith(("ERROR", "npm error"))]
        raise InstallError(f"{name} could not be installed: {(errors or ['its installer gave no reason'])[-1][:300]}")
