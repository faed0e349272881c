"""Navigation with rare fixes: what is hidden, when, and that nothing else differs from the task it is made of."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.mir100.sparse_fix_navigation import FIX_INTERVAL, SparseFixNavigationMir100Sim

SPARSE = "rlservo/SparseFixNavigationMir100Sim-v0"
WHOLE = "rlservo/NoObstacleNavigationMir100Sim-v0"


@pytest.mark.parametrize("interval", [1, 3, FIX_INTERVAL])
def test_only_target_elements_are_hidden_and_only_between_fixes(interval: int) -> None:
    sparse, whole = gym.make(SPARSE, fix_interval=interval), gym.make(WHOLE)
    for seed in (0, 1):
        hidden, seen = sparse.reset(seed=seed)[0], whole.reset(seed=seed)[0]
        actions = np.random.default_rng(seed)
        np.testing.assert_array_equal(hidden, seen)  # a reset is a fix, also after an episode
        for step in range(1, 2 * FIX_INTERVAL + 2):
            action = actions.uniform(-1.0, 1.0, 2).astype(np.float32)
            hidden, *rest = sparse.step(action)
            seen, *expected = whole.step(action)
            assert rest == expected  # reward, endings, info
            np.testing.assert_array_equal(hidden[2:], seen[2:])
            np.testing.assert_array_equal(hidden[:2], seen[:2] if step % interval == 0 else [0.0, 0.0])
            assert hidden.dtype == np.float32


def test_it_names_its_elements() -> None:
    described = SparseFixNavigationMir100Sim.describe(fix_interval=5)
    assert [element["name"] for element in described["observation"]][:2] == ["target_r", "target_theta"]


@pytest.mark.parametrize("wrong", [0, -1, 2.5, True, "20"])
def test_an_interval_that_is_no_number_of_cycles_is_refused(wrong: Any) -> None:
    with pytest.raises(ValueError, match=r"fix_interval is .*: expected a whole number of control cycles, 1 or more"):
        SparseFixNavigationMir100Sim(fix_interval=wrong)
