"""Train MiR100 navigation with RLlib, then run episodes with the result.

    python examples/training_inference_mir.py

Without obstacles by default; `--obstacles` trains robo-gym's obstacle avoidance instead. The policy that ships in
examples/checkpoints/mir100_navigation was made by this script; its README has the command.
"""

from __future__ import annotations

import sys

from training_inference import Task, argument_parser, run
from training_run import main_with_sentences

PPO = {
    "train_batch_size_per_learner": 8192,
    "minibatch_size": 512,
    "num_epochs": 8,
    "lambda_": 0.95,
    "clip_param": 0.2,
    "grad_clip": 0.5,
    # Returns reach a few hundred here: RLlib's default of 10 would stop the value function from learning.
    "vf_clip_param": 100_000.0,
}

NAVIGATION = Task(
    env_id="rlservo/NoObstacleNavigationMir100Sim-v0",
    env_config={"rs_state_to_info": False},
    stop_timesteps=491_520,
    stop_reward=1_000.0,
    gamma=0.99,
    training={**PPO, "lr": [[0, 3e-4], [1_500_000, 5e-5]]},
)

OBSTACLES = Task(
    env_id="rlservo/ObstacleAvoidanceMir100Sim-v0",
    env_config={"rs_state_to_info": False},
    stop_timesteps=4_000_000,
    stop_reward=1_000.0,
    gamma=0.99,
    training={**PPO, "lr": [[0, 3e-4], [4_000_000, 5e-5]]},
)


def main() -> None:
    task = OBSTACLES if "--obstacles" in sys.argv[1:] else NAVIGATION  # before parsing: it sets the other defaults
    parser = argument_parser(task, "Train MiR100 navigation, then run episodes with the result.")
    parser.add_argument("--obstacles", action="store_true", help="train obstacle avoidance instead")
    run(task, parser)


if __name__ == "__main__":
    main_with_sentences(main, __file__)
