"""Training of a policy for `reach.py` with RLlib, in a few minutes: a checkpoint in runs/reach."""

from __future__ import annotations

from pathlib import Path

from ray.rllib.algorithms.ppo import PPOConfig
from reach import connectors

if __name__ == "__main__":
    config = PPOConfig().environment("reach:Reach-v0")
    config.env_runners(env_to_module_connector=connectors, num_env_runners=0)
    config.training(lr=3e-3, train_batch_size=1000, minibatch_size=250, num_epochs=5)
    algorithm = config.build_algo()
    for _ in range(10):
        print("mean return", algorithm.train()["env_runners"]["episode_return_mean"])
    algorithm.save_to_path(Path("runs/reach").resolve())
