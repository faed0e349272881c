"""Registration of the environments with Gymnasium, once, in any process."""

from __future__ import annotations

import subprocess
import sys

import pytest

from rlservo.envs.registration import ENTRY_POINTS

LIST = "import gymnasium; print(sorted(name for name in gymnasium.registry if name.startswith('rlservo/')))"
ID = "rlservo.envs:rlservo/NoObstacleNavigationMir100Sim-v0"


@pytest.mark.parametrize(
    "first",
    [
        "import rlservo.envs",
        "import gymnasium, rlservo.envs; gymnasium.register_envs(rlservo.envs)",
        f"import gymnasium; gymnasium.spec('CartPole-v1'); gymnasium.make('{ID}')",
        "import rlservo.envs.registration as r; r.register_envs(); r.register_envs()",
    ],
)
def test_every_environments_are_registered_whatever_comes_first(first: str) -> None:
    done = subprocess.run([sys.executable, "-c", f"{first}\n{LIST}"], capture_output=True, text=True, timeout=120)
    assert done.stdout.count("rlservo/") == len(ENTRY_POINTS), done.stdout + done.stderr
    assert "Warning" not in done.stderr


def test_what_does_not_use_the_environments_does_not_import_them() -> None:
    """Nothing of ours runs at Python's start, and Gymnasium's own import brings none of it."""
    code = "import sys, gymnasium; print([name for name in sys.modules if name.startswith(('rlservo', 'mujoco'))])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_an_environment_named_with_its_module_has_the_plain_id_afterwards() -> None:
    names = [f"rlservo/{name}-v0" for name in ("NoObstacleNavigationMir100Sim", "EndEffectorPositioningURSim")]
    code = f"import gymnasium; [print(gymnasium.make('rlservo.envs:' + name).spec.id) for name in {names}]"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines() == names, done.stderr
