"""Write typings/: one-line stubs that show type checkers folder X as the package rlservo.X, deploy/package as rlservo.

Setuptools' `package-dir` gives the folders that name at run time; mypy, pyright and editors do not read it.
`make check` runs this first.
"""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("envs", "export", "serve_app", "deploy")
PACKAGE = Path("deploy") / "package"  # imports as `rlservo` itself


def main() -> None:
    typings = ROOT / "typings" / "rlservo"
    shutil.rmtree(typings.parent, ignore_errors=True)
    typings.mkdir(parents=True)
    (typings / "__init__.pyi").write_text("from deploy.package import *\n")
    for folder in FOLDERS:
        for module in sorted((ROOT / folder).rglob("*.py")):
            path = module.relative_to(ROOT)
            if path.parent == PACKAGE:
                continue
            stub = typings / path.with_suffix(".pyi")
            stub.parent.mkdir(parents=True, exist_ok=True)
            names = path.with_suffix("").parts
            dotted = ".".join(names[:-1] if names[-1] == "__init__" else names)
            stub.write_text(f"from {dotted} import *\n")
    # MuJoCo is compiled and ships no types: say that everything in it is Any.
    for name in ("__init__", "viewer"):
        stub = typings.parent / "mujoco" / f"{name}.pyi"
        stub.parent.mkdir(exist_ok=True)
        stub.write_text("from typing import Any\n\ndef __getattr__(name: str) -> Any: ...\n")


if __name__ == "__main__":
    main()
