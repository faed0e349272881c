"""Train MiR100 navigation with RLlib, then run episodes with the result.

    python examples/training_inference_mir.py

Without obstacles by default; `--obstacles` trains robo-gym's obstacle avoidance instead. The policy that ships in
examples/checkpoints/mir100_navigation was made by this script; its training.yaml holds the settings, its README the
command.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from training_inference import argument_parser, run, shipped_task
from training_run import main_with_sentences

NAVIGATION = shipped_task("mir100_navigation")
OBSTACLES = replace(
    NAVIGATION,
    env_id="rlservo/ObstacleAvoidanceMir100Sim-v0",
    stop_timesteps=4_000_000,
    training=NAVIGATION.training | {"lr": [[0, 3e-4], [4_000_000, 5e-5]]},
)


def main() -> None:
    task = OBSTACLES if "--obstacles" in sys.argv[1:] else NAVIGATION  # before parsing: it sets the other defaults
    parser = argument_parser(task, "Train MiR100 navigation, then run episodes with the result.")
    parser.add_argument("--obstacles", action="store_true", help="train obstacle avoidance instead")
    run(task, parser)


if __name__ == "__main__":
    main_with_sentences(main, __file__)
