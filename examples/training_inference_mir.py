"""Train MiR100 navigation with RLlib, then run episodes with the result.

    python examples/training_inference_mir.py

Without obstacles by default; `--obstacles` trains robo-gym's obstacle avoidance instead. The settings are those in
examples/checkpoints/mir100_navigation/training.yaml and mir100_obstacle_avoidance/training.yaml, as far as RLlib itself
knows them. The two policies come from train_shipped.py, which gives the network the logarithm of distances and the sine
and cosine of directions, lets the action's steps cost something (navigation), keeps its mean within the action's
bounds, lets a collision cost more, and judges checkpoints without exploration (obstacle avoidance).
"""

from __future__ import annotations

import sys
from dataclasses import replace

from shared.training_inference import argument_parser, run, shipped_task
from shared.training_run import main_with_sentences

NAVIGATION = shipped_task("mir100_navigation")
# The file stops at a success rate, which this script does not know; no return reaches this value.
OBSTACLES = replace(
    shipped_task("mir100_obstacle_avoidance"),
    env_id="rlservo.envs:rlservo/ObstacleAvoidanceMir100Sim-v0",
    env_config=NAVIGATION.env_config,
    stop_reward=1000.0,
)


def main() -> None:
    task = OBSTACLES if "--obstacles" in sys.argv[1:] else NAVIGATION  # before parsing: it sets the other defaults
    parser = argument_parser(task, "Train MiR100 navigation, then run episodes with the result.")
    parser.add_argument("--obstacles", action="store_true", help="train obstacle avoidance instead")
    run(task, parser)


if __name__ == "__main__":
    main_with_sentences(main, __file__)
