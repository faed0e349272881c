"""The environments are there in every process, whatever is imported first, and only once."""

from __future__ import annotations

import subprocess
import sys

import pytest

LIST = "import gymnasium; print(sorted(name for name in gymnasium.registry if name.startswith('rlservo/')))"


@pytest.mark.parametrize(
    "first",
    [
        "pass",
        "import gymnasium",
        "import gymnasium.envs.registration",
        "import rlservo.envs.registration",
        "import rlservo.envs.discovery as d; d.install(); d.install()",
        "import rlservo.envs.registration as r; r.register_envs(); r.register_envs()",
        pytest.param("import ray.rllib", marks=pytest.mark.slow),
    ],
)
def test_seven_environments_are_registered_whatever_comes_first(first: str) -> None:
    done = subprocess.run([sys.executable, "-c", f"{first}\n{LIST}"], capture_output=True, text=True, timeout=120)
    assert done.stdout.count("rlservo/") == 7, done.stdout + done.stderr
    assert "Warning" not in done.stderr


def test_the_hook_imports_nothing_heavy_at_start() -> None:
    code = "import sys; print([m for m in ('gymnasium', 'numpy', 'mujoco', 'importlib.util') if m in sys.modules])"
    without = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, timeout=60)
    with_hook = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "gymnasium" not in with_hook.stdout
    assert "numpy" not in with_hook.stdout
    assert "mujoco" not in with_hook.stdout
    assert without.returncode == with_hook.returncode == 0
