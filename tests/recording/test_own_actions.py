"""A module's own actions, recovered from the sent ones: RLlib's unsquash and clip undone, clipped ones flagged."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest

from rlservo.bundle.action_transform import Transform, to_own, to_sent
from rlservo.bundle.contract import BakedStep
from rlservo.bundle.spaces import BoxSpec, DiscreteSpec, LeafSpec, MultiDiscreteSpec
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.recording.conversion.parquet import export_parquet
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.unsquashed_actions import modes, own_actions

ROWS = 2000


def box(low: Any, high: Any, dtype: str = "float32") -> BoxSpec:
    bounds = [tuple(None if np.isinf(x) else float(np.dtype(dtype).type(x)) for x in side) for side in (low, high)]
    return BoxSpec(shape=(len(low),), dtype=dtype, low=bounds[0], high=bounds[1], elements=())


def send_by_rllib(own: np.ndarray[Any, Any], transform: Transform, leaf: BoxSpec) -> np.ndarray[Any, Any]:
    """RLlib's own connector's output for a module's actions."""
    pytest.importorskip("ray.rllib")
    from ray.rllib.connectors.module_to_env import NormalizeAndClipActions
    from ray.rllib.core.columns import Columns
    from ray.rllib.env.single_agent_episode import SingleAgentEpisode

    kind = np.dtype(leaf.dtype)
    low, high = (bound.astype(kind) for bound in leaf.bounds())
    space = gym.spaces.Box(low, high, leaf.shape, kind.type)
    connector = NormalizeAndClipActions(
        space, space, normalize_actions=transform == "unsquash", clip_actions=transform == "clip"
    )
    episode = SingleAgentEpisode(id_="0")
    batch = connector(
        rl_module=cast(Any, None),
        batch={Columns.ACTIONS: {("0",): list(own)}},
        episodes=[episode],
        explore=False,
        shared_data={},
    )
    return np.stack(batch.get(Columns.ACTIONS_FOR_ENV, batch[Columns.ACTIONS])[("0",)])


@pytest.mark.parametrize("transform", ["unsquash", "clip", "none"])
@pytest.mark.parametrize(
    "leaf",
    [
        box([-1.0, -2.0, 0.1], [1.0, 2.0, 0.7]),
        box([-1.0, -2.0, 0.1], [1.0, 2.0, 0.7], "float64"),
        box([-2.0, -np.inf], [2.0, 1.0]),
        box([-np.inf, -np.inf], [np.inf, np.inf]),
        box([-3, 0], [3, 5], "int64"),
    ],
)
def test_own_actions_come_back_from_what_rllib_sends(leaf: BoxSpec, transform: Transform) -> None:
    rng = np.random.default_rng(0)
    kind = np.dtype(leaf.dtype)
    own = (
        rng.integers(0, 6, (ROWS, leaf.size)).astype(kind)
        if kind.kind == "i"
        else rng.normal(0.0, 0.8, (ROWS, leaf.size)).astype(kind)
    )
    sent = send_by_rllib(own, transform, leaf).astype(kind)
    np.testing.assert_allclose(to_sent(own, transform, leaf), sent, rtol=1e-6, atol=1e-6)
    back, clipped = to_own(sent, transform, leaf)
    assert back.dtype == kind
    low, high = leaf.bounds()
    bounded = bool(np.isfinite(low).all() and np.isfinite(high).all())
    beyond = np.zeros(ROWS, bool)
    if kind.kind == "f" and transform == "unsquash" and bounded:
        beyond = (np.abs(own) >= 1.0).any(axis=1)
        assert (np.abs(back) <= 1.0).all()
    elif transform == "clip":
        beyond = ((own <= low.astype(kind)) | (own >= high.astype(kind))).any(axis=1)
    assert clipped.tolist() == beyond.tolist()
    assert beyond.any() or transform == "none" or not bounded or kind.kind == "i"
    # Rounding of the sent number, in units of the own one: the bounds are wide or narrow, and far from zero or not.
    span = np.where(np.isfinite(high - low), high - low, 2.0)
    slack = 4 * np.finfo(kind).eps * (1 + np.abs(sent).max(axis=0) / span) if kind.kind == "f" else 0.0
    assert (np.abs(back - own)[~clipped] <= slack).all()
    again = to_sent(back, transform, leaf)
    np.testing.assert_allclose(again, sent, rtol=1e-6, atol=1e-6)  # clipped ones as well: the bound is sent so


@pytest.mark.parametrize(
    "leaf", [DiscreteSpec(n=4, start=-1), MultiDiscreteSpec(shape=(2,), nvec=(3, 4), start=(5, -2))]
)
def test_choices_are_counted_from_zero(leaf: LeafSpec) -> None:
    low, high = leaf.bounds()
    sent = np.random.default_rng(0).integers(low.astype(int), high.astype(int) + 1, (50, *leaf.shape))
    back, clipped = to_own(sent, "unsquash", leaf)
    assert (back == sent - low).all()
    assert not clipped.any()
    assert (to_sent(back, "unsquash", leaf) == sent).all()


def record(policy: Policy, file: Path, *, explore: bool, steps: int = 40, commanded: Any = None) -> RecordedEpisode:
    rng = np.random.default_rng(0)
    with WithRecording(policy, file) as recorded:
        recorded.reset()
        for step in range(steps):
            recorded.act(rng.standard_normal(27).astype(np.float32), explore=explore)
            if commanded is not None and step % 2:
                recorded.set_last_action(commanded)
            recorded.outcome(0.0, terminated=step == steps - 1)
    (episode,) = episodes(Recording(file))
    return episode


def test_a_recorded_own_action_is_kept_beyond_the_bound(ur5: Path, tmp_path: Path) -> None:
    episode = record(Policy.load(ur5), tmp_path / "run.mcap", explore=True)
    own = own_actions(episode)
    assert own.recorded.all() and own.known.all() and not own.clipped.any()
    assert own.leaves["action"].tobytes() == episode.own_action["action"].tobytes()
    assert (np.abs(own.leaves["action"]) > 1.0).any()
    mode = modes(episode)
    assert mode.recorded.all()
    np.testing.assert_array_equal(mode.leaves["action"], episode.dist_inputs[:, :6])


def test_what_the_robot_did_counts_not_what_the_policy_wanted(ur5: Path, tmp_path: Path) -> None:
    space = Policy.load(ur5).contract.action_space
    assert isinstance(space, BoxSpec)
    low, high = space.bounds()
    own = np.array([0.5, -0.5, 0.0, 0.25, 1.0, -0.25])
    sent = (low + (own + 1) * (high - low) / 2).astype(np.float32)
    fallback = own_actions(record(Policy.load(ur5), tmp_path / "fallback.mcap", explore=True, commanded=sent))
    assert fallback.recorded.tolist() == [True, False] * 20
    np.testing.assert_allclose(fallback.leaves["action"][1::2], np.tile(own, (20, 1)), atol=1e-6)
    assert fallback.clipped.tolist() == [False, True] * 20  # its fifth element is at the bound
    limited = Policy.load(ur5, options=PolicyOptions(max_action_step=0.05))
    episode = record(limited, tmp_path / "limited.mcap", explore=True)
    computed = own_actions(episode)
    assert (~computed.recorded).sum() > 30
    again = to_sent(computed.leaves["action"].astype(np.float64), "unsquash", space)
    np.testing.assert_allclose(again, np.clip(episode.executed["action"], low, high), atol=1e-6)


def test_actions_that_own_connectors_change_are_not_known(ur5: Path, tmp_path: Path) -> None:
    episode = record(Policy.load(ur5), tmp_path / "run.mcap", explore=False)
    assert own_actions(episode).known.all()
    contract = episode.policy.contract
    steps = (*contract.baked_in, BakedStep(step="mode", detail=""), BakedStep(step="user_connector", detail=""))
    episode.policy.contract = contract.model_copy(update={"baked_in": steps})
    assert not own_actions(episode).known.any()


def test_parquet_has_own_actions_of_every_decision(ur5: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    episode = record(Policy.load(ur5), tmp_path / "run.mcap", explore=False)
    export_parquet(Recording(tmp_path / "run.mcap"), tmp_path / "run.parquet")
    table = parquet.read_table(tmp_path / "run.parquet")
    own = own_actions(episode)
    written = np.array(table.column("own_actions").to_pylist(), np.float32)
    assert written.tobytes() == own.leaves["action"].tobytes()
    assert table.column("own_actions_clipped").to_pylist() == own.clipped.tolist()
    assert table.column("action_logp").null_count == len(episode)
