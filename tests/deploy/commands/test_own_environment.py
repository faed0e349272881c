"""An environment in one's own folder, which is installed nowhere."""

from __future__ import annotations

import json
from pathlib import Path

from bundles import write_box_policy
from command_line import rlservo

MINE = """
import gymnasium as gym
import numpy as np

class Line(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (27,), np.float32)
    action_space = gym.spaces.Box(-np.array([1, 1, 1, 2, 1, 1], np.float32), np.array([1, 1, 1, 2, 1, 1], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(27, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(27, np.float32), 1.0, False, self.steps == 7, {}

gym.register("Line-v0", entry_point="line_of_mine:Line")
"""


def test_rollout_takes_the_folder_of_ones_own_environment(tmp_path: Path) -> None:
    bundle = write_box_policy(tmp_path / "policies")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "line_of_mine.py").write_text(MINE)
    words = ("rollout", "line_of_mine:Line-v0", "--bundle", bundle, "--episodes", 2, "--json")
    done = rlservo(*words, "--app-dir", "mine", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [each["steps"] for each in json.loads(done.stdout)["episodes"]] == [7, 7]
    here = rlservo(*words, cwd=tmp_path / "mine")  # the folder of the command, by default
    assert here.returncode == 0, here.stderr
    missing = rlservo(*words, cwd=tmp_path)
    assert missing.returncode == 2 and "name its folder with --app-dir" in missing.stderr, missing.stderr
    nowhere = rlservo(*words, "--app-dir", "nowhere", cwd=tmp_path)
    assert nowhere.returncode == 2 and "nowhere is not a folder" in nowhere.stderr


def test_verify_takes_it_too(tmp_path: Path) -> None:
    bundle = write_box_policy(tmp_path / "policies")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "line_of_mine.py").write_text(MINE)
    words = ("verify", bundle, "--env", "line_of_mine:Line-v0", "--disturb", "drop=0.1", "--episodes", 1, "--json")
    done = rlservo(*words, "--app-dir", "mine", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [row["disturbance"] for row in json.loads(done.stdout)["disturbances"]["rows"]] == ["none", "drop=0.1"]
