"""Pictures of every simulator: off screen, and in a real window on a virtual display."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from rlservo.envs.registration import ENTRY_POINTS, NAMESPACE

WINDOW = """
import sys
import gymnasium as gym
for env_id in sys.argv[1:]:
    env = gym.make(env_id, render_mode="human")
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
print("closed")
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs a virtual display (Debian: xvfb)")
def test_windows_open_and_close_one_after_another() -> None:
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    # Randomized-v0 is one of the others, disturbed.
    env_ids = [f"{NAMESPACE}/{name}" for name in ENTRY_POINTS if name != "Randomized-v0"]
    done = subprocess.run(
        ["xvfb-run", "-a", "-s", "-screen 0 1024x768x24", sys.executable, "-c", WINDOW, *env_ids],
        capture_output=True,
        text=True,
        timeout=180,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "closed"
