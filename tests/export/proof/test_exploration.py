"""Exploratory actions: drawn in numpy by the runtime, distributed as RLlib draws them for every algorithm.

Both draw for one observation many times; what reaches the environment is compared, so that a wrong scale, a missing
squashing or a missing unsquash shows. Two samples of one distribution stay within the bound of Kolmogorov and Smirnov
in all but 1 of 10,000 cases, and the seeds are fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.policy.sample_batch import SampleBatch

from rlservo.errors import RequestError
from rlservo.export.checkpoints.location import CheckpointFiles, locate_checkpoint
from rlservo.export.checkpoints.old_location import OldStackFiles
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import ExportResult
from rlservo.export.recipe.trees import named_leaves
from rlservo.export.rllib.restore import restore
from rlservo.policy.policy import Policy

DRAWS = 1200
BOUND = 2.23 * np.sqrt(2 / DRAWS)  # sqrt(-log(1e-4 / 2) / 2), for two samples of one size
NEW = ["pendulum", "cart_pole", "clipped", "unbounded", "free_std", "sac", "appo"]
WIDE = [
    "act_multi_discrete", "bc", "marwil", "cql", "iql", "impala", "sac_discrete", "tqc", "lstm_box",
]  # fmt: skip
OLD = ["pendulum", "cart_pole", "clipped", "sac", "unnormalized_sac", "discrete_sac", "cql", "appo", "dials", "limbs"]
pytestmark = pytest.mark.filterwarnings("ignore:.*PPOTorchRLModule.*:DeprecationWarning")


def assert_distributed_alike(ours: Any, theirs: Mapping[str, Any]) -> None:
    for name, leaf in named_leaves(ours, "action").items():
        a, b = (np.asarray(one, np.float64).reshape(DRAWS, -1) for one in (leaf, theirs[name]))
        for column in range(a.shape[1]):
            at = np.union1d(a[:, column], b[:, column])
            shares = [np.searchsorted(np.sort(one[:, column]), at, side="right") / DRAWS for one in (a, b)]
            assert np.abs(shares[0] - shares[1]).max() < BOUND, (name, column)


def observed(zoo: Path, name: str) -> dict[str, Any]:
    """Return one observation of RLlib's own rollout, by input name."""
    return {key: values[3] for key, values in np.load(zoo / f"{name}.npz").items() if key.startswith("obs")}


def explore(zoo: Path, exported: Callable[..., ExportResult], name: str) -> Any:
    (obs,) = observed(zoo, name).values()
    return Policy.load(exported(zoo / name).path).act(np.repeat(obs[None], DRAWS, axis=0), explore=True, seed=5)


def drawn_by_rllib(zoo: Path, app: Path, name: str) -> Mapping[str, Any]:
    with user_code(app):
        files = locate_checkpoint(zoo / name)
        assert isinstance(files, CheckpointFiles)
        loop: Any = restore(files, app, lambda _: None).start_loop()
        ours = loop.pipelines
    (obs,) = observed(zoo, name).values()
    episodes = [ours.begin(obs) for _ in range(DRAWS)]
    torch.manual_seed(1)
    shared: dict[str, Any] = {}
    how: dict[str, Any] = {"rl_module": ours.module, "episodes": episodes, "explore": True, "shared_data": shared}
    with torch.no_grad():
        batch = ours.env_to_module(batch={}, **how)
        sent = ours.module_to_env(batch=ours.module.forward_exploration(batch, t=10**7), **how)
    return named_leaves(sent.get(Columns.ACTIONS_FOR_ENV, sent[Columns.ACTIONS]), "action")


@pytest.mark.parametrize("name", NEW)
def test_exploring_actions_are_distributed_as_rllibs(
    zoo: Path, app: Path, exported: Callable[..., ExportResult], name: str
) -> None:
    assert_distributed_alike(explore(zoo, exported, name), drawn_by_rllib(zoo, app, name))


@pytest.mark.parametrize("name", WIDE)
def test_every_algorithm_and_space_explores_as_rllib_does(
    wide_zoo: Path, app: Path, exported: Callable[..., ExportResult], name: str
) -> None:
    assert_distributed_alike(explore(wide_zoo, exported, name), drawn_by_rllib(wide_zoo, app, name))


@pytest.mark.parametrize("name", OLD)
def test_the_old_stack_explores_as_rllib_does(
    old_zoo: Path, app: Path, exported: Callable[..., ExportResult], name: str
) -> None:
    ours = explore(old_zoo, exported, name)
    with user_code(app):
        files = locate_checkpoint(old_zoo / name)
        assert isinstance(files, OldStackFiles)
        loop: Any = restore(files, app, lambda _: None).start_loop()
    policy = loop.policy
    seen: list[Any] = []
    compute = policy.compute_actions_from_input_dict

    def exploring(batch: SampleBatch, **_: Any) -> Any:  # the loop asks for the deterministic action
        torch.manual_seed(1)
        seen.append(compute(batch, explore=True, timestep=10**7))
        return seen[-1]

    policy.compute_actions_from_input_dict = exploring
    inputs = {key: np.repeat(value[None], DRAWS, axis=0) for key, value in observed(old_zoo, name).items()}
    theirs = loop.step(inputs, np.ones(DRAWS, np.bool_))
    assert len(seen) == 1
    assert_distributed_alike(ours, theirs)


def test_a_policy_without_a_distribution_says_that_it_cannot_explore(
    zoo: Path, exported: Callable[..., ExportResult]
) -> None:
    with pytest.raises(RequestError, match="has no action distribution and cannot explore"):
        explore(zoo, exported, "dqn")
