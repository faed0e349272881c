"""The environment that deploy/Dockerfile makes: serving without torch."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest


@pytest.mark.slow
def test_the_image_has_no_torch_and_its_build_writes_the_wrapper(image_environment: Path, tmp_path: Path) -> None:
    program = "import importlib.util as u; print([n for n in ('torch', 'gymnasium', 'mujoco') if u.find_spec(n)])"

    def run(*command: object) -> str:
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    assert run(image_environment / "bin" / "python", "-I", "-c", program) == "[]\n"
    printed = run(image_environment / "bin" / "rlservo", "cluster", "env", "--haproxy-folder", tmp_path / "haproxy")
    assert f"RAY_SERVE_HAPROXY_BINARY_PATH={tmp_path / 'haproxy' / 'haproxy'}" in printed
    assert (tmp_path / "haproxy" / "haproxy").read_text().count(str(image_environment)) >= 2
