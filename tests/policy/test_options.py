"""Per-policy options: observations out of bounds, and steps of the action."""

from __future__ import annotations

import logging
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from bundles import rewrite_contract, write_box_policy, write_discrete_policy
from rlservo.bundle.bundle import read_contract
from rlservo.bundle.spaces import BoxSpec
from rlservo.errors import ActionError, ObservationError, UsageError
from rlservo.policy import observation_leaf_check
from rlservo.policy.observation_leaf_check import LeafParser
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn
from stores import control_of, load_store

ZEROS = np.zeros(27, np.float32)
OUTSIDE = np.where(np.arange(27) == 3, np.float32(1.5), ZEROS)


@pytest.fixture
def bounded(tmp_path: Path) -> Callable[..., Policy]:
    """Load a policy whose observations are within [-1, 1]."""
    folder = write_box_policy(tmp_path)
    space = read_contract(folder).observation_space
    rewrite_contract(folder, observation_space=space.model_copy(update={"low": -1.0, "high": 1.0}))
    return lambda **options: Policy.load(folder, options=PolicyOptions(**options))


def test_an_observation_out_of_bounds_is_refused_clipped_or_used_as_the_options_say(
    bounded: Callable[..., Policy], caplog: pytest.LogCaptureFixture
) -> None:
    sentence = r"element 3 (element_3) outside the observation space's [-1, 1]"
    accepting, warning, clipping, refusing = (
        bounded(out_of_bounds=choice) for choice in ("accept", "warn", "clip", "refuse")
    )
    as_it_is, warned, clipped = (policy.step(OUTSIDE) for policy in (accepting, warning, clipping))
    assert (as_it_is.notices, warned.notices, clipped.notices) == ((), (sentence,), (f"{sentence}: clipped",))
    np.testing.assert_array_equal(warned.action, as_it_is.action)
    np.testing.assert_array_equal(clipped.action, accepting.act(np.clip(OUTSIDE, -1, 1)))
    assert clipping.step(ZEROS).notices == ()  # a step reports only its own notices
    with pytest.raises(ObservationError, match=r"element 3 \(element_3\) is 1\.5, outside the .* \[-1, 1\]"):
        refusing.act(OUTSIDE)
    assert [record.getMessage() for record in caplog.records] == [
        f"policy 'ur5': {sentence} (1 times)",
        f"policy 'ur5': {sentence}: clipped (1 times)",
    ]


def test_every_row_of_a_batch_is_looked_at_and_rounding_is_no_offence(bounded: Callable[..., Policy]) -> None:
    batch = np.stack([ZEROS, ZEROS, -OUTSIDE])
    with pytest.raises(ObservationError, match=r"element 3 \(element_3\) of observation 2 is -1\.5"):
        bounded(out_of_bounds="refuse").act(batch)
    clipping = bounded(out_of_bounds="clip")
    np.testing.assert_allclose(clipping.act(batch)[2], clipping.act(np.clip(batch, -1, 1))[2], atol=1e-6)
    assert len(clipping.step(batch).notices) == 1
    strict = bounded(out_of_bounds="refuse")
    strict.act(np.full(27, np.float32(1.000001)))
    with pytest.raises(ObservationError):
        strict.act(np.full(27, np.float32(1.0001)))
    for bad in (np.nan, np.inf):
        with pytest.raises(ObservationError, match="not a finite number"):
            clipping.act(np.full(27, bad))


def test_a_warning_is_logged_once_a_minute_however_often_it_comes(
    bounded: Callable[..., Policy], caplog: pytest.LogCaptureFixture
) -> None:
    policy = bounded()
    for _ in range(50):
        policy.act(OUTSIDE)
    assert len(caplog.records) == 1 and caplog.records[0].levelno == logging.WARNING


def test_actions_are_kept_within_a_step_of_the_last_one(bounded: Callable[..., Policy]) -> None:
    free = bounded()
    limited = bounded(max_action_step=(0.1, None, 0.1, 0.1, 0.1, 0.1))
    first = limited.act(ZEROS + 0.5)
    np.testing.assert_array_equal(first, free.act(ZEROS + 0.5))  # nothing came before
    wanted = free.act(ZEROS - 0.5)
    (notice,) = limited.step(ZEROS - 0.5, last={"action": first[None]}).notices
    assert notice.endswith("is allowed: limited")
    second = limited.act(ZEROS - 0.5)
    steps = np.array([0.1, np.inf, 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(second, first + np.clip(wanted - first, -steps, steps), atol=1e-6)
    assert (np.abs(wanted - first) > steps).any()
    for _ in range(30):
        third = limited.act(ZEROS - 0.5)
    np.testing.assert_allclose(third, wanted, atol=1e-6)  # it arrives
    limited.reset()
    np.testing.assert_array_equal(limited.act(ZEROS + 0.5), first)
    refusing = bounded(max_action_step=0.1, beyond_action_step="refuse")
    refusing.act(ZEROS + 0.5)
    with pytest.raises(ActionError, match=r"element 0 \(joint_0\) of the action would step by .*, at most 0\.1"):
        refusing.act(ZEROS - 0.5)


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        ((0.1, 0.2), "has 2 numbers for 6 elements"),
        ({"action.arm": 0.1}, "names 'action.arm': its action has action"),
    ],
)
def test_a_step_that_does_not_fit_the_action_is_refused_at_load(
    bounded: Callable[..., Policy], step: Any, sentence: str
) -> None:
    with pytest.raises(UsageError, match=sentence):
        bounded(max_action_step=step)


def test_a_choice_has_no_step(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="action is a choice, which has no step size"):
        Policy.load(write_discrete_policy(tmp_path), options=PolicyOptions(max_action_step=1.0))


def test_options_come_from_the_environment_by_policy_name() -> None:
    variable = '{"ur5": {"out_of_bounds": "clip", "max_action_step": [0.1, null]}, "*": {"out_of_bounds": "refuse"}}'
    settings = ServerSettings.from_environment(environment={"RLSERVO_POLICY_OPTIONS": variable})
    assert settings.policy_options["ur5"].max_action_step == (0.1, None)
    assert ServerSettings(**settings.model_dump()) == settings  # as it travels to a replica
    for wrong in ('{"ur5": {"out_of_bounds": "ignore"}}', "{", '{"ur5": {"max_action_step": -1}}'):
        with pytest.raises(UsageError, match="RLSERVO_POLICY_OPTIONS is not usable"):
            ServerSettings.from_environment(environment={"RLSERVO_POLICY_OPTIONS": wrong})


def test_a_served_policy_has_its_options_and_says_what_they_did(bounded: Callable[..., Policy]) -> None:
    folder = bounded().path
    options = {"ur5": PolicyOptions(out_of_bounds="clip", max_action_step=0.1), "*": PolicyOptions()}
    store = load_store(folder, options=options)
    free = bounded(out_of_bounds="accept")
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as port, httpx.Client() as client:

        def act(**request: Any) -> Any:
            return client.post(f"http://127.0.0.1:{port}/v1/policies/ur5/act", json=request).json()

        obs = (ZEROS + 0.5).tolist()
        assert "has a limit on the step" in act(obs=obs)["error"]
        first = act(obs=obs, session_id="s", reset=True)
        np.testing.assert_allclose(first["action"], free.act(obs), rtol=1e-6)
        second = act(obs=(-3 * ZEROS - 1.5).tolist(), session_id="s")
        steps = np.array(second["action"]) - np.array(first["action"])
        assert np.abs(steps).max() == pytest.approx(0.1, rel=1e-4)
        clipped, limited = second["warnings"]
        assert clipped.endswith(": clipped") and limited.endswith(": limited")
        alone = act(obs=obs, last_action=[0.0] * 6)
        assert np.abs(alone["action"]).max() <= 0.1 * (1 + 1e-6)
        assert "state" not in alone


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_lists_of_numbers_become_what_numpy_makes_of_them(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = LeafParser("p", BoxSpec(shape=(3,), dtype=dtype, low=None, high=None))
    monkeypatch.setattr(observation_leaf_check, "PACKED", {})
    general = LeafParser("p", BoxSpec(shape=(3,), dtype=dtype, low=None, high=None))
    large = [2**24 + 1, 2**53 + 1, 2**60 + 2**36 + 1, -(2**63), 2**64, 2**70, 10**400]
    floats = [0.1, -0.0, 1e-45, 1e-310, 3.4028235e38, 3.4028236e38, 1e39, 1e308, float("nan"), float("inf")]
    others = [True, False, 0, -3, None, "1", [1.0], 1j, np.float32(0.1), np.int64(7)]
    draw, taken = random.Random(0), 0
    for _ in range(4000):
        obs = draw.choices(
            [0.5, 7, *draw.sample(large + floats, 2), draw.choice(others)], k=draw.choice((2, 3, 3, 3, 3))
        )
        results = []
        for parser in (quick, general):
            try:
                array, batch, notice = parser.parse(obs)
                results.append((array.tobytes(), array.shape, array.dtype, array.flags.writeable, batch, notice))
            except ObservationError as error:
                results.append((error.message, error.details))
        assert repr(results[0]) == repr(results[1]), obs
        taken += quick.pack(obs) is not None
    assert taken > 500
