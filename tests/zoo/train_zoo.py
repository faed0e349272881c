"""Train the checkpoints the export tests read: one small RLlib iteration each, then record what the environment saw.

    python train_zoo.py OUT [NAME...]

writes OUT/<name>/ (a checkpoint) and OUT/<name>.npz (observations, and the actions RLlib sent to env.step for them with
exploration off and the filter frozen). It runs in a process of its own, so that the tests can show that an export
starts no Ray; it starts a cluster of its own, and stops it.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from ray import tune
from ray.rllib.algorithms.appo import APPOConfig
from ray.rllib.algorithms.dqn import DQNConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.connectors.env_to_module import FlattenObservations, MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

sys.path.insert(0, str(Path(__file__).resolve().parent / "app"))
import zoo_parts  # pyright: ignore[reportMissingImports]  # in app/, added to the path above

SMALL = DefaultModelConfig(fcnet_hiddens=[16, 16])


def mean_std_filter(env: Any = None, spaces: Any = None, device: Any = None) -> Any:
    return MeanStdFilter()


def flatten_and_filter(env: Any = None, spaces: Any = None, device: Any = None) -> Any:
    return [FlattenObservations(), MeanStdFilter()]


def doubler(env: Any = None, spaces: Any = None, device: Any = None) -> Any:
    return zoo_parts.Doubler()


def ppo(
    env: str, *, before: Any = None, spec: Any = None, model: Any = SMALL, steps: int = 64, **environment: Any
) -> Any:
    config = PPOConfig().environment(env, **environment)
    config.env_runners(num_env_runners=0, env_to_module_connector=before)
    config.training(train_batch_size=steps, minibatch_size=64, num_epochs=1)
    return config.rl_module(rl_module_spec=spec) if spec else config.rl_module(model_config=model)


def toy(spaces: str, **more: Any) -> Any:
    return ppo("toy", env_config={"spaces": spaces}, **more)


def off_policy(config: Any, env: str, **environment: Any) -> Any:
    config.environment(env, **environment).env_runners(num_env_runners=0, rollout_fragment_length=1)
    config.reporting(min_sample_timesteps_per_iteration=20, min_time_s_per_iteration=0)
    config.training(num_steps_sampled_before_learning_starts=8, train_batch_size_per_learner=8)
    return config.rl_module(model_config=SMALL)


def configurations() -> dict[str, Any]:
    appo = APPOConfig().environment("CartPole-v1").env_runners(num_env_runners=0).learners(num_learners=0)
    appo.reporting(min_time_s_per_iteration=0).rl_module(model_config=SMALL)  # by itself it goes on for ten seconds
    return {
        "pendulum": ppo("Pendulum-v1", before=mean_std_filter, steps=128),
        "cart_pole": ppo("CartPole-v1"),
        "clipped": ppo("Pendulum-v1", normalize_actions=False, clip_actions=True),
        "shared": ppo("Pendulum-v1", model=DefaultModelConfig(fcnet_hiddens=[16], vf_share_layers=True)),
        "free_std": ppo("Pendulum-v1", model=DefaultModelConfig(fcnet_hiddens=[16], free_log_std=True)),
        "relu": ppo("Pendulum-v1", model=DefaultModelConfig(fcnet_hiddens=[16], fcnet_activation="relu")),
        "unbounded": toy("unbounded", before=mean_std_filter),
        "mixed": toy("mixed"),
        "half_bounded": toy("half_bounded"),
        "double": toy("double", before=mean_std_filter),
        "started": toy("started"),
        "offset": toy("offset", before=mean_std_filter),
        "grid": toy("grid", before=flatten_and_filter),
        "sac": off_policy(SACConfig(), "Pendulum-v1"),
        "dqn": off_policy(DQNConfig(), "CartPole-v1"),
        "appo": appo.training(train_batch_size_per_learner=64),
        "user_module": ppo("CartPole-v1", spec=RLModuleSpec(module_class=zoo_parts.UserModule)),
        "batch_reader": ppo("CartPole-v1", spec=RLModuleSpec(module_class=zoo_parts.BatchReader)),
        "user_connector": ppo("CartPole-v1", before=doubler),
        "lstm": ppo("CartPole-v1", model=DefaultModelConfig(fcnet_hiddens=[8], use_lstm=True, lstm_cell_size=8)),
    }


def record(algorithm: Any, file: Path) -> None:
    """Let RLlib roll out by itself and write down what went in and out of the environment."""
    # An algorithm that trains from recorded data acts only when it is evaluated, after training.
    np.savez(file, **rollout(algorithm.env_runner or algorithm.eval_env_runner))


def rollout(runner: Any) -> dict[str, Any]:
    """Return what goes in and out of an environment runner's environment, exploration off and the filter frozen."""
    for piece in runner._env_to_module.connectors:
        if isinstance(piece, MeanStdFilter):
            piece._update_stats = False
    runner.sample(num_timesteps=1, explore=False, force_reset=True)  # drops observations filtered before the freeze
    env = runner.env.unwrapped.envs[0]
    seen: list[dict[str, Any]] = []
    last: dict[str, Any] = {}
    real_reset, real_step = env.reset, env.step

    def reset(**kwargs: Any) -> Any:
        obs, info = real_reset(**kwargs)
        last.update(obs=obs, reward=0.0, restart=True)
        return obs, info

    def step(action: Any) -> Any:
        if last:
            named = {**leaves(last["obs"], "obs"), **leaves(action, "action")}
            seen.append({**named, "reward": last["reward"], "restart": last["restart"]})
        result = real_step(action)
        last.update(obs=result[0], reward=result[1], restart=False)
        return result

    env.reset, env.step = reset, step
    runner.sample(num_timesteps=100, explore=False, force_reset=True)
    assert len(seen) >= 90, len(seen)
    return {name: np.stack([one[name] for one in seen]) for name in seen[0]}


def leaves(tree: Any, name: str) -> dict[str, Any]:
    """Return a copy of every part of a nested observation or action by its path."""
    if isinstance(tree, dict | tuple):
        inside = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return {path: leaf for key, child in inside for path, leaf in leaves(child, f"{name}.{key}").items()}
    return {name: np.copy(tree)}


@contextlib.contextmanager
def ray_for_training() -> Iterator[None]:
    """Start a cluster of one core with a folder of its own: a short path, a socket's may have 107 characters."""
    torch.set_num_threads(1)  # these networks are so small that a second thread only costs
    with tempfile.TemporaryDirectory(prefix="zoo-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        try:
            start_ray(folder)
            yield
        finally:
            ray.shutdown()


def start_ray(folder: str, attempts: int = 3) -> None:
    """Start Ray; on a busy machine it may miss its own 30 s (ray 2.60), so it is tried again."""
    for attempt in range(1, attempts + 1):
        try:
            ray.init(num_cpus=1, include_dashboard=False, _temp_dir=folder, configure_logging=False)
            return
        except Exception:  # Ray raises plain Exception, RuntimeError, and its own
            ray.shutdown()
            if attempt == attempts:
                raise


def main(out: Path, only: list[str]) -> None:
    tune.register_env("toy", zoo_parts.Toy)
    gym.register("zoo/Toy-v0", entry_point="zoo_parts:Toy")
    with ray_for_training():
        for name, config in configurations().items():
            if only and name not in only:
                continue
            algorithm = config.build_algo()
            algorithm.train()
            algorithm.save_to_path(str(out / name))
            # APPO's environment runner lags behind its learner, and the checkpoint holds the learner's weights.
            algorithm.restore_from_path(str(out / name))
            record(algorithm, out / f"{name}.npz")
            algorithm.stop()
            print(name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
