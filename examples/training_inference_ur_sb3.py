"""Train UR5 end-effector positioning with Stable-Baselines3, export it, then run episodes with the bundle.

    python examples/training_inference_ur_sb3.py
    rlservo serve runs/policies
    python examples/ur5_client.py --policy ur5-sb3

The counterpart of `training_inference_ur.py`, which uses RLlib: the same environment, network, batches, rates and steps
(examples/checkpoints/ur5_positioning/training.yaml), in one process. It leaves `model.zip` and `vecnormalize.pkl` in
`runs/ur5-sb3`, which is what `rlservo export` reads, and needs `pip install 'rlservo[sb3,sim]'`, no Ray.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import yaml
from shared.help_text import DefaultsFormatter
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import rlservo
from rlservo.drive.report import render_report

SETTINGS = Path(__file__).resolve().parent / "checkpoints" / "ur5_positioning" / "training.yaml"
NAME = "ur5-sb3"
ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}


def make_env(settings: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """Return the environment with Stable-Baselines3's record of returns and successes."""
    import rlservo.envs  # noqa: F401  # in a new process

    env: gymnasium.Env[Any, Any] = Monitor(
        gymnasium.make(settings["env"], disable_env_checker=True, **settings["env_config"]),
    )
    return env


def make_ppo(settings: dict[str, Any], vector: VecEnv, seed: int, rate_at: Callable[[float], float]) -> PPO:
    """Return PPO with a training.yaml's settings; `rate_at` gives the learning rate for the share that remains."""
    training, model = settings["training"], settings["model"]
    return PPO(
        "MlpPolicy",
        vector,
        learning_rate=rate_at,
        n_steps=training["train_batch_size_per_learner"] // vector.num_envs,
        batch_size=training["minibatch_size"],
        n_epochs=training["num_epochs"],
        gamma=training["gamma"],
        gae_lambda=training["lambda_"],
        clip_range=training["clip_param"],
        vf_coef=training.get("vf_loss_coeff", 1.0),
        max_grad_norm=training["grad_clip"],
        policy_kwargs={
            "net_arch": {"pi": model["fcnet_hiddens"], "vf": model["fcnet_hiddens"]},
            "activation_fn": ACTIVATIONS[model["fcnet_activation"]],
        },
        seed=seed,
        device="cpu",
    )


def rate_after(settings: dict[str, Any], steps: float) -> float:
    """Return the learning rate after environment steps, by the settings' schedule."""
    rate = settings["training"]["lr"]
    if not isinstance(rate, list):
        return float(rate)
    at, rates = zip(*rate, strict=True)
    return float(np.interp(steps, at, rates))


def train(settings: dict[str, Any], steps: int, seed: int, folder: Path) -> Path:
    """Train and return the model's zip; VecNormalize's statistics are beside it."""
    vector = VecNormalize(DummyVecEnv([lambda: make_env(settings)] * settings["envs"]), norm_reward=False)
    model = make_ppo(settings, vector, seed, lambda remaining: rate_after(settings, (1.0 - remaining) * steps))
    model.verbose = 1
    model.learn(steps)
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / "model")
    vector.save(str(folder / "vecnormalize.pkl"))
    vector.close()
    return folder / "model.zip"


def main() -> None:
    settings = yaml.safe_load(SETTINGS.read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(
        description="Train UR5 end-effector positioning with Stable-Baselines3.", formatter_class=DefaultsFormatter
    )
    parser.add_argument("--stop-timesteps", type=int, default=settings["stop"]["env_steps"], help="environment steps")
    parser.add_argument("--seed", type=int, default=settings["seed"], help="training seed; episodes use 10000 and up")
    parser.add_argument("--num-episodes-during-inference", type=int, default=100, help="episodes after training")
    parser.add_argument("--storage", type=Path, default=Path("runs"), help="folder for model and bundle")
    args = parser.parse_args()
    if args.stop_timesteps < 1 or args.num_episodes_during_inference < 0 or args.seed < 0:
        parser.error("--stop-timesteps must be at least 1, --num-episodes-during-inference and --seed at least 0")
    model = train(settings, args.stop_timesteps, args.seed, args.storage / NAME)
    bundle = rlservo.export_checkpoint(model, args.storage / "policies", name=NAME, notify=print)
    print(f"bundle: {bundle.path}", flush=True)
    if args.num_episodes_during_inference:
        with rlservo.Policy.load(bundle.path) as policy:
            report = rlservo.rollout(
                policy,
                settings["env"],
                episodes=args.num_episodes_during_inference,
                seed=10_000,
                env_kwargs={**settings["env_config"], "randomize_start": False},
            )
        print(render_report(report))


if __name__ == "__main__":
    try:
        main()
    except rlservo.errors.RlservoError as error:
        raise SystemExit(f"error: {error}") from None
