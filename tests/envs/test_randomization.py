"""The domain randomisation wrapper: its effects in numbers, and none unless requested."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.randomization import DomainRandomization, make_randomized, wrapped_env

ARM, BASE = "rlservo/EndEffectorPositioningURSim-v0", "rlservo/NoObstacleNavigationMir100Sim-v0"


def episode(env: gym.Env, seed: int, steps: int = 25) -> np.ndarray:
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    rows = [observation]
    for _ in range(steps):
        observation, *_ = env.step(0.3 * env.action_space.sample())
        rows.append(observation)
    return np.array(rows)


def arm(**arguments: Any) -> DomainRandomization:
    return DomainRandomization(gym.make(ARM), **arguments)


@pytest.mark.parametrize("env_id", [ARM, BASE])
def test_nothing_asked_for_changes_nothing(env_id: str) -> None:
    plain, wrapped = gym.make(env_id), DomainRandomization(gym.make(env_id))
    assert (episode(plain, 3) == episode(wrapped, 3)).all()
    assert wrapped.observation_space == plain.observation_space


def test_action_latency_is_whole_cycles() -> None:
    plain, late = gym.make(BASE), DomainRandomization(gym.make(BASE), action_latency=(3, 3))
    turn, ahead = np.array([0, 1], np.float32), np.array([1, 0], np.float32)
    _, info = late.reset(seed=1)
    plain.reset(seed=1)
    assert info["randomization"] == {"action_latency": 3, "observation_latency": 0, "payload": 0.0}
    for step in range(12):
        seen, *_ = late.step(ahead if step else turn)
        # The first action repeats until the second comes through, three cycles late.
        expected, *_ = plain.step(turn if step <= 3 else ahead)
        assert (seen == expected).all()


def test_observation_latency_is_whole_cycles() -> None:
    plain = episode(gym.make(BASE), 2)
    old = episode(DomainRandomization(gym.make(BASE), observation_latency=(2, 2)), 2)
    assert (old[2:] == plain[:-2]).all()
    assert (old[:2] == plain[0]).all()


def test_noise_has_the_asked_spread_on_the_asked_elements_and_stays_in_the_space() -> None:
    sigma = {"target_x": 0.01, "base_position_normalized": 0.002}
    plain, noisy = episode(gym.make(ARM), 0, steps=290), episode(arm(observation_noise=sigma), 0, steps=290)
    difference = noisy - plain
    spread = difference.std(axis=0)
    assert spread[15] == pytest.approx(0.01, rel=0.2)
    assert spread[3] == pytest.approx(0.002, rel=0.2)
    assert abs(difference[:, 15].mean()) < 0.002
    others = np.delete(spread, [3, 15])
    assert (others == 0).all()
    wild = arm(observation_noise=10.0)
    assert all(row in wild.observation_space for row in episode(wild, 0))


def test_payload_is_drawn_from_its_range_and_felt_by_the_arm() -> None:
    env = arm(payload=(1.0, 4.0))
    drawn = [env.reset(seed=seed)[1]["randomization"]["payload"] for seed in range(40)]
    assert min(drawn) >= 1.0
    assert max(drawn) <= 4.0
    assert np.ptp(drawn) > 1.5
    plain, loaded = episode(gym.make(ARM), 5), episode(arm(payload=(4.0, 4.0)), 5)
    assert 1e-4 < np.abs(plain[:, 3:9] - loaded[:, 3:9]).max() < 0.05


def test_same_seed_gives_the_same_episode_and_another_draws_anew() -> None:
    arguments: dict[str, Any] = {
        "action_latency": (0, 3), "observation_latency": (0, 2), "observation_noise": 0.01, "payload": (0.0, 3.0),
    }  # fmt: skip
    env = arm(**arguments)
    first = episode(env, 8)
    assert (episode(env, 8) == first).all()
    assert (episode(arm(**arguments), 8) == first).all()
    seen = {str(env.reset(seed=seed)[1]["randomization"]) for seed in range(10)}
    assert len(seen) == 10
    env.reset(seed=8)
    assert len({str(env.reset()[1]["randomization"]["payload"]) for _ in range(5)}) == 5


def test_rewards_and_endings_are_of_what_really_happened() -> None:
    plain, noisy = gym.make(ARM), arm(observation_noise=1.0)
    for env in (plain, noisy):
        env.reset(seed=4)
    for _ in range(20):
        action = np.zeros(5, np.float32)
        assert plain.step(action)[1:4] == noisy.step(action)[1:4]


@pytest.mark.parametrize(
    ("env_id", "arguments", "message"),
    [
        (ARM, {"action_latency": (2, 1)}, r"action_latency is \(2, 1\): expected \(low, high\) with 0 <= low <= high"),
        (ARM, {"observation_latency": (0, 1.5)}, "expected whole control cycles"),
        (ARM, {"observation_noise": -0.1}, "negative or infinite standard deviation"),
        (ARM, {"observation_noise": [0.1, 0.2]}, r"observation_noise has shape \(2,\), expected one number or 27"),
        (ARM, {"observation_noise": {"elbow": 0.1}}, "observation_noise names elbow: expected some of target_r, "),
        (ARM, {"payload": (0.0, float("inf"))}, "payload is"),
        (BASE, {"payload": (0.0, 1.0)}, "NoObstacleNavigationMir100Sim has no simulation that carries one"),
    ],
)
def test_impossible_randomisation_is_refused(env_id: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DomainRandomization(gym.make(env_id), **arguments)


def test_randomization_by_id_is_the_wrapper_around_the_named_environment() -> None:
    by_id = gym.make("rlservo/Randomized-v0", env_id=ARM, action_latency=(3, 3), rs_state_to_info=False)
    wrapped = DomainRandomization(gym.make(ARM, rs_state_to_info=False), action_latency=(3, 3))
    for env in (by_id, wrapped):
        _, info = env.reset(seed=3)
        assert info["randomization"]["action_latency"] == 3
    action = np.full(5, 0.1, np.float32)
    for _ in range(5):
        np.testing.assert_array_equal(by_id.step(action)[0], wrapped.step(action)[0])
    with pytest.raises(ValueError, match="expected whole control cycles"):
        gym.make("rlservo/Randomized-v0", env_id=ARM, action_latency=(0, 0.5))


AVOIDANCE, ROOM = "rlservo/BasicAvoidanceURSim-v0", "rlservo/ObstacleAvoidanceMir100Sim-v0"
EVERYTHING: dict[str, Any] = {
    "action_latency": (0, 2), "observation_latency": (0, 2), "late_observations": (0, 2),
    "dropped_observations": (0.0, 0.3), "observation_noise": "real", "observation_bias": "2*real",
    "model_error": 0.05, "base_offset": (0.0, 0.03), "stuck_sensor": "any",
}  # fmt: skip


class Counter(gym.Env[Any, Any]):
    """Observes the steps done, in a buffer that it writes into again; counts the actions that reach it."""

    observation_space = gym.spaces.Dict({"count": gym.spaces.Box(0.0, 1000.0, (1,))})
    action_space = gym.spaces.Discrete(100)

    def __init__(self) -> None:
        self.actions: list[int] = []
        self._buffer = {"count": np.zeros(1, np.float32)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.actions.clear()
        self._buffer["count"][0] = 0
        return self._buffer, {}

    def step(self, action: Any) -> Any:
        self.actions.append(action)
        self._buffer["count"][0] += 1
        return self._buffer, 0.0, False, False, {}


def seen(env: gym.Env, steps: int) -> list[int]:
    return [int(env.step(step)[0]["count"][0]) for step in range(steps)]


def test_delays_and_losses_need_nothing_of_an_environment() -> None:
    late = DomainRandomization(Counter(), action_latency=(2, 2), observation_latency=(1, 1))
    late.reset(seed=0)
    assert seen(late, 5) == [0, 1, 2, 3, 4]
    assert late.unwrapped.actions == [0, 0, 0, 1, 2]  # type: ignore[attr-defined]


def test_dropped_observations_repeat_the_last_one_at_the_drawn_share() -> None:
    env = DomainRandomization(Counter(), dropped_observations=(0.3, 0.3))
    _, info = env.reset(seed=0)
    assert info["randomization"]["dropped_observations"] == 0.3
    counts = np.array(seen(env, 900))
    is_fresh = counts == np.arange(1, 901)
    assert 0.65 < is_fresh.mean() < 0.75
    assert (np.diff(counts) >= 0).all()  # what was lost stays lost, nothing goes back in time


def test_late_observations_arrive_in_order_and_within_their_bound() -> None:
    env = DomainRandomization(Counter(), late_observations=(0, 3))
    env.reset(seed=1)
    ages = np.arange(1, 301) - np.array(seen(env, 300))
    assert set(ages.tolist()) == {0, 1, 2, 3}
    assert (np.diff(ages) <= 1).all()


def test_real_noise_is_by_element_in_its_own_unit_and_a_multiple_of_it_more() -> None:
    plain = episode(gym.make(ARM), 0, steps=290)
    for name, factor in (("real", 1.0), ("3*real", 3.0)):
        spread = (episode(arm(observation_noise=name), 0, steps=290) - plain).std(axis=0)
        assert spread[15] == pytest.approx(factor * 0.005, rel=0.2)  # [m], a camera's target
        assert spread[9] == pytest.approx(factor * 0.0069, rel=0.2)  # [rad/s], differences of encoder readings
        assert 0 < spread[3] < factor * 2e-5  # an encoder, over 2 pi
        assert (spread[21:] == 0).all()  # the policy knows its own actions


@pytest.mark.parametrize("env_id", [ARM, AVOIDANCE, BASE, ROOM])
def test_sensor_errors_name_elements_of_the_observation(env_id: str) -> None:
    env = gym.make(env_id, disable_env_checker=True).unwrapped
    names = [element["name"] for element in env.describe()["observation"]]  # type: ignore[attr-defined]
    errors = env.sensor_errors()  # type: ignore[attr-defined]
    assert set(errors) <= set(names)
    assert all(error.noise >= 0 and error.bias >= 0 for error in errors.values())
    assert len(errors) >= len(names) - 6 and max(error.noise for error in errors.values()) > 0


def test_bias_is_constant_in_an_episode_and_another_in_the_next() -> None:
    env = arm(observation_bias={"target_x": 0.02})
    plain = episode(gym.make(ARM), 4)
    difference = (episode(env, 4) - plain)[:, 15]
    assert np.ptp(difference) < 1e-6 and 0 < abs(difference[0]) <= 0.02
    drawn = {env.reset(seed=seed)[1]["randomization"]["observation_bias"][15] for seed in range(5)}
    assert len(drawn) == 5


def test_a_stuck_sensor_keeps_its_first_value_and_the_others_go_on() -> None:
    rows = episode(arm(stuck_sensor="ee_x"), 6)
    assert (rows[:, 18] == rows[0, 18]).all() and np.ptp(rows[:, 19]) > 0
    env = arm(stuck_sensor="any")
    assert len({env.reset(seed=seed)[1]["randomization"]["stuck_sensor"] for seed in range(20)}) > 5


@pytest.mark.parametrize(("env_id", "element"), [(ARM, slice(3, 15)), (AVOIDANCE, slice(3, 9)), (BASE, slice(2, 4))])
def test_model_error_changes_the_motion_and_its_absence_restores_the_data_sheet(env_id: str, element: slice) -> None:
    env = gym.make(env_id, disable_env_checker=True)
    plain = episode(gym.make(env_id, disable_env_checker=True), 5)
    wrong = DomainRandomization(env, model_error=0.1)
    moved = episode(wrong, 5)
    assert np.abs(moved[:, element] - plain[:, element]).max() > 1e-4
    draws = wrong.reset(seed=5)[1]["randomization"]["model_error"]
    assert all(0.9 <= factor <= 1.1 for factor in draws["gains"])
    assert (episode(DomainRandomization(env), 5) == plain).all()


def test_an_arm_of_wrong_mass_compensates_for_the_gravity_of_the_data_sheet() -> None:
    env = gym.make(ARM).unwrapped
    sim = env.simulation  # type: ignore[attr-defined]
    sim.draw_model_error(0.3, np.random.default_rng(0))
    sim.model.dof_frictionloss[:] = 0.0
    sim.place([0.0, -0.5, 0.5, 0.0, 0.0, 0.0])
    for _ in range(20):
        sim.advance()
    assert np.abs(sim.joint_positions - [0.0, -0.5, 0.5, 0.0, 0.0, 0.0]).max() > 1e-3


@pytest.mark.parametrize("env_id", [ARM, BASE])
def test_a_misplaced_base_is_told_the_target_wrong_and_judged_by_where_it_is(env_id: str) -> None:
    env = DomainRandomization(gym.make(env_id), base_offset=(0.05, 0.05))
    plain = gym.make(env_id)
    told, info = env.reset(seed=2)
    true, _ = plain.reset(seed=2)
    dx, dy = info["randomization"]["base_offset"]
    assert np.hypot(dx, dy) == pytest.approx(0.05)
    if env_id == ARM:
        np.testing.assert_allclose(told[15:18] - true[15:18], [dx, dy, 0.0], atol=1e-6)
        assert told[0] == pytest.approx(np.linalg.norm(told[15:18] - told[18:21]), abs=1e-5)
    assert abs(told[0] - true[0]) <= 0.05 + 1e-6 and told[0] != true[0]
    action = np.zeros(env.action_space.shape, np.float32)  # type: ignore[arg-type]
    for _ in range(3):
        assert env.step(action)[1] == pytest.approx(plain.step(action)[1], abs=1e-6)


def test_each_episode_is_of_a_drawn_robot_that_is_disturbed_as_when_it_is_alone() -> None:
    disturbances: dict[str, Any] = {"payload": (1.0, 2.0), "model_error": 0.1, "observation_noise": "real"}
    models = ("ur3", "ur10e")
    drawn = arm(robot_models=models, **disturbances)
    alone = {model: DomainRandomization(gym.make(ARM, ur_model=model), **disturbances) for model in models}
    seen = []
    for seed in range(4):
        model = drawn.reset(seed=seed)[1]["randomization"]["robot_model"]
        assert (episode(drawn, seed, steps=5) == episode(alone[model], seed, steps=5)).all()
        seen.append(model)
    assert set(seen) == set(models)
    drawn.reset(seed=0)
    assert {drawn.reset()[1]["randomization"]["robot_model"] for _ in range(10)} == set(models)
    # What one wrapper did to any of the robots is undone by the next.
    plain = gym.make(ARM, ur_model=seen[0])
    undisturbed = DomainRandomization(drawn.env, robot_models=models)
    assert (episode(undisturbed, 0, steps=5) == episode(plain, 0, steps=5)).all()


def test_extreme_targets_are_out_of_reach_and_extreme_starts_are_clear_of_collisions() -> None:
    far = arm(extreme="target")
    for seed in range(3):
        observation, info = far.reset(seed=seed)
        assert np.linalg.norm(observation[15:18]) > 1.2 and info["randomization"]["extreme"] == "target"
    folded = arm(extreme="start")
    for seed in range(3):
        x, y, z = folded.reset(seed=seed)[0][18:21]
        assert np.hypot(x, y) < 0.25 or z < 0.15
    for extreme in ("target", "start"):
        room = DomainRandomization(gym.make(ROOM), extreme=extreme)  # type: ignore[arg-type]
        for seed in range(10):
            room.reset(seed=seed)  # raises where the start collides
        x, y, _ = room.unwrapped.simulation.target if extreme == "target" else room.unwrapped.simulation.pose  # type: ignore[attr-defined]
        assert abs(y) > (4.0 if extreme == "target" else 2.9)


def test_everything_at_once_repeats_by_seed_and_leaves_the_older_draws_alone() -> None:
    for env_id in (ARM, ROOM):
        env = DomainRandomization(gym.make(env_id), **EVERYTHING)
        first = episode(env, 8)
        assert (episode(env, 8) == first).all()
        assert not (episode(env, 9) == first).all()
        assert all(row in env.observation_space for row in first)
    older = {"action_latency": (0, 9), "observation_latency": (0, 9), "payload": (0.0, 3.0)}
    more = {**EVERYTHING, **older}
    for seed in range(3):
        draws = arm(**older).reset(seed=seed)[1]["randomization"]
        assert draws.items() <= arm(**more).reset(seed=seed)[1]["randomization"].items()
        assert set(draws) == set(older)  # nothing is told that was not asked for


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dropped_observations": (0.0, 1.0)}, "expected shares below 1"),
        ({"late_observations": (0, 0.5)}, "expected whole control cycles"),
        ({"model_error": 0.6}, "model_error is 0.6: expected 0 to 0.5"),
        ({"model_error": float("nan")}, "model_error is nan"),
        ({"base_offset": (0.1, 0.05)}, "base_offset is"),
        ({"stuck_sensor": "elbow"}, "stuck_sensor is 'elbow': expected any or one of target_r, "),
        ({"observation_noise": "reel"}, "observation_noise is 'reel': expected numbers, 'real' or a multiple"),
        ({"observation_bias": "-1*real"}, "observation_bias is '-1\\*real'"),
        ({"extreme": "sideways"}, "extreme is 'sideways': expected target or start"),
        ({"robot_models": ["ur3", "ur7"]}, "'ur7' does not exist: expected one of ur3, ur3e"),
        ({"robot_models": "ur3"}, "robot_models is 'ur3': expected a list of names"),
    ],
)
def test_impossible_disturbances_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        arm(**arguments)


@pytest.mark.parametrize(
    ("arguments", "lack"),
    [
        ({"payload": (1.0, 1.0)}, "no simulation that carries one"),
        ({"model_error": 0.05}, "no simulation with draw_model_error"),
        ({"base_offset": (0.0, 0.02)}, "no set_base_offset"),
        ({"extreme": "start"}, "no extreme_options"),
        ({"robot_models": ["ur3"]}, "no set_robot_model"),
        ({"observation_noise": 0.1}, "expected a one-dimensional Box"),
        ({"stuck_sensor": "any"}, "expected a one-dimensional Box"),
    ],
)
def test_what_an_environment_cannot_do_is_named(arguments: dict[str, Any], lack: str) -> None:
    with pytest.raises(ValueError, match=lack):
        DomainRandomization(Counter(), **arguments)
    with pytest.raises(ValueError, match="CartPoleEnv does not state its sensors' errors \\(sensor_errors\\)"):
        DomainRandomization(gym.make("CartPole-v1"), observation_noise="real")


def test_by_id_it_names_the_elements_of_the_environment_that_it_wraps() -> None:
    inner = {"ur_model": "ur10e", "fix_wrist_2": True}
    config = {"env_id": "rlservo/EndEffectorPositioningURSim-v0", "payload": [0, 3], "robot_models": ["ur3"], **inner}
    assert wrapped_env("rlservo/Randomized-v0", config) == (config["env_id"], inner)
    assert wrapped_env("other/Env-v0", config) == ("other/Env-v0", config)
    describe = make_randomized.describe  # type: ignore[attr-defined]
    assert describe(**config) == gym.make(config["env_id"]).unwrapped.describe(**inner)  # type: ignore[attr-defined]
    assert describe(env_id="CartPole-v1") == {}
