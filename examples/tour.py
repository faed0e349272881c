"""The tour: everything in RLlib's getting-started guide and introduction notebook, on today's Ray, as one script.

    python examples/tour.py             # CartPole (PPO), FrozenLake (DQN) and the UR5 (the policy that ships)
    python examples/tour.py cartpole --quick

Environment check, random baseline, training with evaluation, best checkpoint, reload, action distribution, value
estimates, Q-values, policy and module state, export, and videos of the exported policies, into `tour/`.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import shared.training_run as training_run
from gymnasium.utils.env_checker import check_env
from shared.training_run import RETURN, STEPS, Run

from rlservo import Policy, rollout

UR5 = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
SHIPPED = Path(__file__).resolve().parent / "checkpoints" / "ur_positioning"
ARROWS = "←↓→↑"  # FrozenLake's actions
EXPLORATION_STEPS = 5_000  # steps on FrozenLake, after which it hardly explores any more


@dataclass(frozen=True)
class Settings:
    """Durations of the tour's parts."""

    out: Path
    quick: bool
    video: bool

    @property
    def baseline_episodes(self) -> int:
        return 20 if self.quick else 200


def main() -> None:
    parser = argparse.ArgumentParser(description="A tour of RLlib on current Ray, up to bundles and videos.")
    parser.add_argument("stops", nargs="*", metavar="STOP", help="cartpole, frozenlake, ur5 (default: all three)")
    parser.add_argument("--out", type=Path, default=Path("tour"), help="folder for runs, bundles and videos")
    parser.add_argument("--quick", action="store_true", help="train only briefly")
    parser.add_argument("--no-video", action="store_true", help="draw nothing, without OpenGL")
    args = parser.parse_args()
    stops: dict[str, Callable[[Settings], None]] = {"cartpole": cartpole, "frozenlake": frozen_lake, "ur5": ur5}
    if unknown := [stop for stop in args.stops if stop not in stops]:
        parser.error(f"{unknown[0]} is not a stop of the tour: expected {', '.join(stops)}")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame draws CartPole without a display
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # and looks for a sound card
    training_run.pickle_by_value(sys.modules[__name__])
    settings = Settings(args.out.resolve(), args.quick, not args.no_video)
    settings.out.mkdir(parents=True, exist_ok=True)
    try:
        for stop in args.stops or stops:
            stops[stop](settings)
    except training_run.InterruptError:
        raise KeyboardInterrupt from None  # a tour cannot be resumed


def heading(text: str) -> None:
    print(f"\n=== {text}", flush=True)


# Arguments of every environment.


def look_at(env_id: str, **arguments: Any) -> None:
    """Print an environment's description of itself, and check that it is true."""
    env = gym.make(env_id, **arguments)
    spec = env.spec
    assert spec is not None  # gym.make's always have one
    print(f"observation {env.observation_space}\naction      {env.action_space}")
    print(
        f"success from a mean return of {spec.reward_threshold}, episodes of at most {spec.max_episode_steps} steps, "
        f"arguments {spec.kwargs}"
    )
    check_env(env.unwrapped, skip_render_check=True)  # raises if it finds a fault
    print("the environment check passed")
    env.close()


def random_baseline(env_id: str, episodes: int, **arguments: Any) -> float:
    """Return and print the mean return of random actions."""
    env = gym.make(env_id, disable_env_checker=True, **arguments)
    env.action_space.seed(0)
    returns = []
    for episode in range(episodes):
        env.reset(seed=episode)
        total, is_over = 0.0, False
        while not is_over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, is_over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    print(f"random actions: mean return {np.mean(returns):.2f} over {episodes} episodes")
    return float(np.mean(returns))


def film(settings: Settings, bundle: Path, env_id: str, **arguments: Any) -> None:
    video = None
    with Policy.load(bundle) as policy:
        if settings.video:
            folder = settings.out / "videos" / policy.contract.name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            video = folder / "episode.mp4"
        (episode,) = rollout(policy, env_id, episodes=1, seed=10_000, env_kwargs=arguments, video=video).episodes
    print(f"the exported policy: return {episode.episode_return:.2f} in {episode.steps} steps")
    if video is not None:
        print(f"video: {video}")


# CartPole: PPO with Tune, as for a real training.


def cartpole(settings: Settings) -> None:
    """Train with evaluation, find the best checkpoint, look inside, export, film."""
    from ray.rllib.algorithms.ppo import PPOConfig

    env_id = "CartPole-v1"
    heading("CartPole: the environment, and a random baseline")
    look_at(env_id)
    baseline = random_baseline(env_id, settings.baseline_episodes)

    heading("CartPole: PPO, trained with Tune, evaluated on the way")
    config = training_run.default_config("PPO")
    assert isinstance(config, PPOConfig)
    config.environment(env_id)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=4)
    config.training(lr=1e-3, train_batch_size_per_learner=500 if settings.quick else 2000, num_epochs=10)
    config.rl_module(model_config={"fcnet_hiddens": [64, 64], "vf_share_layers": False})
    config.evaluation(evaluation_interval=1, evaluation_duration=5, evaluation_config={"explore": False})
    config.callbacks(on_train_result=training_run.fill_return(RETURN, "max"))
    config.debugging(seed=415)
    run = Run("PPO", env_id, {}, 1)
    with training_run.ray_session(num_cpus=1):
        outcome = training_run.train(
            config,
            run,
            storage=settings.out / "runs",
            stop={RETURN: 400, STEPS: 60_000, "training_iteration": 2 if settings.quick else 40},
            checkpoint_frequency=1,
            resumable=False,
        )
        training_run.report(outcome, run)
        checkpoint = training_run.best_checkpoint_of(outcome)
        print(f"best checkpoint: {checkpoint}")
        print(
            f"{outcome.best.best_score:.1f} after {outcome.best.env_steps:,} steps; random actions had {baseline:.1f}"
        )

        heading("CartPole: reload the algorithm, access its policy's state")
        algorithm_state(checkpoint)

    heading("CartPole: the module alone: action distribution and value estimates")
    bundle = training_run.export_and_run(
        checkpoint, settings.out / "bundles", env_id=env_id, env_config={}, episodes=5 if settings.quick else 20
    )
    distribution_and_value(checkpoint, bundle, np.array([0.01, 0.2, 0.05, -0.3], np.float32))

    heading("CartPole: a video of the exported policy")
    film(settings, bundle, env_id)


def algorithm_state(checkpoint: Path) -> None:
    """Rebuild the whole algorithm, read its weights here and in every env runner, and set them again."""
    from ray.rllib.algorithms.algorithm import Algorithm

    with training_run.stopping(Algorithm.from_checkpoint(str(checkpoint))) as algorithm:
        weights = algorithm.get_module().get_state()
        for name, array in weights.items():
            print(f"  {name:40} {np.shape(array)}")
        # The same in each env runner; if there are several, a list with one entry each.
        steps = algorithm.env_runner_group.foreach_env_runner(lambda runner: type(runner.module).__name__)
        print(f"env runners hold: {steps}")
        before = {name: np.array(array) for name, array in weights.items()}
        algorithm.get_module().set_state({name: array * 0.5 for name, array in before.items()})
        state = algorithm.get_module().get_state()
        name = next(iter(before))
        print(f"{name} halved: {np.allclose(state[name], before[name] * 0.5)}")
        algorithm.get_module().set_state(before)
        mean_return = algorithm.evaluate()["env_runners"]["episode_return_mean"]
        print(f"algorithm.evaluate(): mean return {mean_return:.1f}")


def distribution_and_value(checkpoint: Path, bundle: Path, obs: Any) -> None:
    """Compare the RLModule, which needs no Ray, with the exported graph."""
    import torch
    from ray.rllib.core.columns import Columns
    from ray.rllib.core.rl_module.rl_module import RLModule

    module = cast(
        Any, RLModule.from_checkpoint(str(checkpoint / "learner_group" / "learner" / "rl_module" / "default_policy"))
    )
    batch = {Columns.OBS: torch.from_numpy(obs[None])}
    with torch.no_grad():
        inputs = module.forward_exploration(batch)[Columns.ACTION_DIST_INPUTS]
        distribution = module.get_exploration_action_dist_cls().from_logits(inputs)
        value = module.compute_values(batch).item()
    torch.manual_seed(0)
    print(f"{type(module).__name__}: inputs {inputs.numpy()[0].round(4)}, a sample {distribution.sample().item()}")
    print(f"log-probabilities {[round(distribution.logp(torch.tensor([a])).item(), 4) for a in range(2)]}")
    out = graph_outputs(bundle, obs)
    print(f"value estimate {value:.4f}")
    difference = max(
        float(np.abs(out["action_dist_inputs"][0] - inputs.numpy()[0]).max()), abs(float(out["value"][0]) - value)
    )
    print(f"the exported graph gives the same: largest difference {difference:.1e}")
    assert difference < 1e-3


def graph_outputs(bundle: Path, obs: Any) -> dict[str, Any]:
    """Return every output of the exported graph for one observation: action, distribution, value or Q-values."""
    import onnxruntime

    ort_session = onnxruntime.InferenceSession(str(bundle / "policy.onnx"), providers=["CPUExecutionProvider"])
    names = [output.name for output in ort_session.get_outputs()]
    return dict(zip(names, ort_session.run(names, {"obs": np.asarray(obs)[None]}), strict=True))


# FrozenLake: DQN with RLlib's own Python API, for its Q-values.


def frozen_lake(settings: Settings) -> None:
    """Train with `algorithm.train()`, save, export, and print the Q-value of every field."""
    from ray.rllib.algorithms.dqn import DQNConfig
    from ray.rllib.connectors.env_to_module import FlattenObservations

    env_id, arguments = "FrozenLake-v1", {"is_slippery": False}
    heading("FrozenLake: the environment, a few steps by hand, and a random baseline")
    look_at(env_id, **arguments)
    env = gym.make(env_id, render_mode="ansi", **arguments)
    obs, _ = env.reset(seed=0)
    for action in (2, 1):  # right, down: into a hole
        obs, reward, terminated, _, _ = env.step(action)
        print(f"{ARROWS[action]} obs {obs}, reward {reward}, terminated {terminated}\n{env.render()}")
    env.close()
    baseline = random_baseline(env_id, settings.baseline_episodes, **arguments)

    heading("FrozenLake: DQN, trained with algorithm.train()")
    config = training_run.default_config("DQN")
    assert isinstance(config, DQNConfig)
    config.environment(env_id, env_config=arguments)
    # A field is a number; the network sees it one-hot. (RLlib's annotation is narrower than what it takes.)
    config.env_runners(
        env_to_module_connector=cast(Any, lambda env, spaces, device: FlattenObservations()),
        num_envs_per_env_runner=8,
        rollout_fragment_length=4,
    )
    config.training(
        gamma=0.9,  # nearer 1, a detour costs so little that some of the arrows point in circles
        n_step=1,
        lr=[[0, 2e-3], [5_000, 3e-4]],
        epsilon=[[0, 1.0], [4_000, 0.1]],
        num_steps_sampled_before_learning_starts=500,
        target_network_update_freq=100,
        dueling=False,
        double_q=True,
        train_batch_size_per_learner=64,
        training_intensity=16,  # one update every four steps
        replay_buffer_config={"type": "EpisodeReplayBuffer", "capacity": 20_000},
    )
    config.rl_module(model_config={"fcnet_hiddens": [64]})
    config.reporting(min_time_s_per_iteration=0, min_sample_timesteps_per_iteration=500)
    config.evaluation(evaluation_interval=1, evaluation_duration=1, evaluation_config={"explore": False})
    log = settings.out / "runs" / "DQN-FrozenLake-v1"
    shutil.rmtree(log, ignore_errors=True)
    log.mkdir(parents=True)
    config.debugging(seed=1)
    with training_run.ray_session(num_cpus=1), training_run.stopping(training_run.build(config)) as algorithm:
        steps, is_solved = 0, False  # one episode is enough: without slipping, every episode of a policy is the same
        while not (is_solved and (settings.quick or steps >= EXPLORATION_STEPS)) and steps < 4 * EXPLORATION_STEPS:
            result = training_run.iterate(algorithm)
            steps = result[STEPS]
            is_solved = result["evaluation"]["env_runners"]["episode_return_mean"] == 1.0
            mean = result["env_runners"].get("episode_return_mean", float("nan"))
            print(
                f"{steps:6,.0f} steps, mean return {mean:.2f} while exploring; "
                f"without, the goal is {'reached' if is_solved else 'not reached'}",
                flush=True,
            )
        checkpoint = Path(str(algorithm.save_to_path(str(log / "checkpoint"))))
    print(f"random actions had {baseline:.2f}")

    heading("FrozenLake: export, Q-values of every field, video")
    bundle = training_run.export_and_run(
        checkpoint, settings.out / "bundles", env_id=env_id, env_config=arguments, episodes=5
    )
    env = gym.make(env_id, **arguments)
    field = np.asarray(cast(Any, env.unwrapped).desc, dtype="U1")
    env.close()
    for row in range(4):
        cells = []
        for column in range(4):
            q = graph_outputs(bundle, np.int64(4 * row + column))["q_values"][0]
            cells.append(f"{field[row, column]} {ARROWS[int(q.argmax())]} {q.max():6.3f}")
        print("   ".join(cells))
    film(settings, bundle, env_id, **arguments)


# The UR5: the policy that ships for all UR arms, which took half an hour to train.


def ur5(settings: Settings) -> None:
    """Export the policy that ships, run it, look at its value estimates along an episode, film it."""
    arguments = {"ur_model": "ur5", "rs_state_to_info": False}
    heading("UR5: the environment, and a random baseline")
    look_at(UR5, **arguments)
    random_baseline(UR5, 2 if settings.quick else 10, **arguments)

    heading("UR5: export the policy that ships, run it (its training: train_shipped.py)")
    bundle = training_run.export_and_run(
        SHIPPED, settings.out / "bundles", env_id=UR5, env_config=arguments, episodes=5 if settings.quick else 20
    )

    heading("UR5: value estimates and action distribution along an episode")
    with Policy.load(bundle) as policy:
        env = gym.make(UR5, disable_env_checker=True, **cast(Any, arguments))
        obs, _ = env.reset(seed=10_000)
        is_over, step = False, 0
        while not is_over:
            if step % 10 == 0:
                out = graph_outputs(bundle, obs)
                mean, log_std = np.split(out["action_dist_inputs"][0], 2)
                print(
                    f"step {step:3}: value {float(out['value'][0]):6.3f}, action mean {mean.round(2)}, "
                    f"std {np.exp(log_std).round(2)}, sent {policy.act(obs).round(2)}"
                )
            obs, _, terminated, truncated, _ = env.step(policy.act(obs))
            is_over, step = terminated or truncated, step + 1
        env.close()
    film(settings, bundle, UR5, **arguments)


if __name__ == "__main__":
    training_run.main_with_sentences(main, __file__)
