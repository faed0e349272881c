"""Gymnasium's interface and the description of every simulated environment, whatever its task."""

from __future__ import annotations

import math
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rlservo.envs.registration import ENTRY_POINTS
from rlservo.robots.argument_checks import InvalidActionError
from rlservo.robots.ur.parameters import UR_PARAMETERS

# The bounds are robo-gym's and Isaac Lab's: infinite in places, and three elements of BasicAvoidance are always zero.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*A Box (observation|action) space (minimum|maximum) value is:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*A Box observation space maximum and minimum values are equal"),
    pytest.mark.filterwarnings("ignore:.*For Box action spaces, we recommend using a symmetric and normalized space"),
]

IDS = [f"rlservo/{name}" for name in ENTRY_POINTS if "Sim-" in name]
ROBO_GYMS = [name for name in IDS if "URSim" in name and "Isaac" not in name]
MADE = [
    *((name, {}) for name in IDS if name not in ROBO_GYMS),
    *((name, {"ur_model": model}) for name in ROBO_GYMS for model in UR_PARAMETERS),
]
ARGUMENTS = [
    *MADE, *((name, {"fix_base": True, "ur_model": "ur10e"}) for name in ROBO_GYMS),
    *((f"rlservo/{name}URSim-v0", {"fix_wrist_3": False, "action_cycle_rate": 10})
      for name in ("EmptyEnvironment", "BasicAvoidance")),
    *((name, fixed) for name in IDS if "Panda" in name for fixed in (
        {"fix_panda_joint1": True, "fix_panda_joint7": False}, {"fix_panda_joint2": True})),
]  # fmt: skip
RATES = {"Mir100": 10, "EndEffectorPositioningUR": 10, "Empty.*UR|Avoidance.*UR": 20, "IsaacReach|Panda": 30,
         "IsaacDeployReach": 60}  # [Hz]  # fmt: skip
EVERY = pytest.mark.parametrize("env_id", IDS)


def make(env_id: str, **arguments: Any) -> Any:
    return gym.make(env_id, **arguments).unwrapped


@pytest.mark.parametrize(("env_id", "arguments"), MADE)
def test_gymnasiums_check_passes(env_id: str, arguments: dict[str, Any]) -> None:
    check_env(make(env_id, **arguments), skip_render_check=True)


@pytest.mark.parametrize(("env_id", "arguments"), ARGUMENTS)
def test_the_description_names_every_element(env_id: str, arguments: dict[str, Any]) -> None:
    env = make(env_id, **arguments)
    described = type(env).describe(**arguments)
    for space, elements in ((env.observation_space, "observation"), (env.action_space, "action")):
        names = [element["name"] for element in described[elements]]
        assert space.shape == (len(names),) and len(set(names)) == len(names)
    (rate,) = (rate for pattern, rate in RATES.items() if re.search(pattern, env_id))
    rate = arguments.get("action_cycle_rate", rate)
    assert described["control_rate_hz"] == env.metadata["render_fps"] == rate


@pytest.mark.parametrize("env_id", [name for name in IDS if re.search("ObstacleAvoidance|NoObstacle|ioningUR", name)])
def test_rllib_env_runner_samples_it_with_every_check_on(env_id: str) -> None:
    # RLlib has no single-agent pre-check of its own any more: its env runner builds the environment with Gymnasium's
    # passive checker on, whose findings are warnings, and warnings are errors here.
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

    config = PPOConfig().environment(env_id).env_runners(num_envs_per_env_runner=2)
    runner = SingleAgentEnvRunner(config=config)
    try:
        episodes = runner.sample(num_timesteps=40)
        assert sum(len(episode) for episode in episodes) >= 40
        assert episodes[0].get_observations(0).dtype == np.float32
    finally:
        runner.stop()


@EVERY
def test_same_seed_gives_the_same_episode_to_the_bit(env_id: str) -> None:
    def episode(env: Any, seed: int) -> list[bytes]:
        options = {"randomize_start": True} if "EndEffectorPositioningUR" in env_id else None
        observation, _ = env.reset(seed=seed, options=options)
        env.action_space.seed(1)
        seen = [observation.tobytes()]
        for _ in range(30):
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            seen += [observation.tobytes(), np.float64(reward).tobytes()]
            if terminated or truncated:  # on to the next one, unseeded: it must follow from the seed too
                observation, _ = env.reset()
                seen.append(observation.tobytes())
        return seen

    first, second = make(env_id), make(env_id)
    expected = episode(first, 7)
    np.random.seed(0)  # the global generator plays no part
    assert episode(first, 7) == expected
    assert episode(second, 7) == expected
    if "EmptyEnvironment" not in env_id:  # which draws nothing
        assert episode(second, 8) != expected


@EVERY
def test_out_of_space_action_says_which_element_and_by_how_much(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=1)
    low, high = env.action_space.low, env.action_space.high
    names = [element["name"] for element in type(env).describe()["action"]]
    last = len(names) - 1
    bounds = rf"{re.escape(f'range [{low[last]:g}, {high[last]:g}]')}"
    for change, sentence in (
        (high[last] + 0.5, rf"is [\d.]+, 0.5\d* above its {bounds}"),
        (low[last] - 2.0, rf"is -[\d.]+, 2 below its {bounds}"),
        (math.nan, "is nan: expected a finite number"),
    ):
        if math.isinf(change):  # every finite action is in its space
            continue
        action = np.zeros(len(names))
        action[last] = change
        with pytest.raises(InvalidActionError, match=rf"action element {last} \({names[last]}\) {sentence}"):
            env.step(action)
    with pytest.raises(InvalidActionError, match=rf"shape \({last},\), expected \({last + 1},\): {', '.join(names)}"):
        env.step(np.zeros(last))
    with pytest.raises(InvalidActionError, match="not an array of numbers"):
        env.step("left")
