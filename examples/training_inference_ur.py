"""Train UR5 end-effector positioning with RLlib, then run episodes with the result.

    python examples/training_inference_ur.py

It trains at robo-gym's speed (a tenth of the joint velocity limits), from starts drawn around the start pose; the
inference episodes start at that pose itself. The policy that ships in examples/checkpoints/ur5_positioning was
made by this script; its training.yaml holds the settings, its README the command.
"""

from __future__ import annotations

from shared.training_inference import argument_parser, run, shipped_task
from shared.training_run import main_with_sentences

TASK = shipped_task("ur5_positioning")


def main() -> None:
    run(TASK, argument_parser(TASK, "Train UR5 end-effector positioning, then run episodes with the result."))


if __name__ == "__main__":
    main_with_sentences(main, __file__)
