"""Programs of examples/compiled, compiled against a policy and stubs around it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from rlservo.export.compiled.compile import Compiled

ROOT = Path(__file__).resolve().parents[3]
STUBS = Path(__file__).with_name("targets") / "stubs"
LOOP, CONTROLLER, SKETCH = (
    (ROOT / "examples" / "compiled" / name).read_text() for name in ("loop.c", "policy_controller.cpp", "policy.ino")
)


def compiles(source: str, folder: Path, name: str, *flags: str) -> Path:
    compiler = "g++" if name.endswith("cpp") else "gcc"
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    (folder / name).write_text(source)
    command = [compiler, "-Wall", "-Wextra", "-Werror", *flags, f"-I{STUBS}", name, "-c", "-o", f"{name}.o"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / f"{name}.o"


def test_the_loop_keeps_its_rate_and_holds_where_an_action_is_refused(compiled_ur5: Compiled, tmp_path: Path) -> None:
    assert len(LOOP.splitlines()) <= 40
    here = f"-I{compiled_ur5.folder}"
    loop = compiles(LOOP, tmp_path, "loop.c", "-std=c99", here)
    robot = compiles((STUBS / "robot.c").read_text(), tmp_path, "robot.c", "-std=c99", here)
    policy = compiles((compiled_ur5.folder / "ur5.c").read_text(), tmp_path, "ur5.c", "-std=c99", "-O1", here)
    subprocess.run(["gcc", loop, robot, policy, "-o", "loop", "-lm"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "loop"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    assert done.stderr == "2: element_5\n"  # not finite
    assert done.stdout == "moved 200, held 100\n"


def test_the_ros2_controller_compiles(compiled_ur5: Compiled, tmp_path: Path) -> None:
    compiles(CONTROLLER, tmp_path, "controller.cpp", "-std=c++17", f"-I{compiled_ur5.folder}")


def test_the_sketch_compiles(compiled_ur5: Compiled, tmp_path: Path) -> None:
    compiles('#include "Arduino.h"\n' + SKETCH, tmp_path, "sketch.cpp", "-std=c++17", f"-I{compiled_ur5.folder}")
