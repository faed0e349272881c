"""Train UR5 end-effector positioning with RLlib, then run episodes with the result.

    python examples/training_inference_ur.py

It trains from starts drawn around the start pose, at robo-gym's speed (a tenth of the joint velocity limits); the
inference episodes start at the start pose itself.
The policy that ships in examples/checkpoints/ur5_positioning was made by this script; its README has the command.
"""

from __future__ import annotations

from training_inference import Task, argument_parser, run
from training_run import main_with_sentences

TASK = Task(
    env_id="rlservo/EndEffectorPositioningURSim-v0",
    # rs_state_to_info=False: robo-gym's own advice for RLlib, whose episodes would carry that dictionary along.
    env_config={"ur_model": "ur5", "rs_state_to_info": False, "randomize_start": True},
    stop_timesteps=2_621_440,
    stop_reward=2.0,
    gamma=0.99,
    training={
        "lr": [[0, 3e-4], [6_000_000, 5e-5]],
        "train_batch_size_per_learner": 8192,
        "minibatch_size": 512,
        "num_epochs": 8,
        "lambda_": 0.95,
        "clip_param": 0.2,
        "grad_clip": 0.5,
        "vf_clip_param": 100.0,
    },
)


def main() -> None:
    run(TASK, argument_parser(TASK, "Train UR5 end-effector positioning, then run episodes with the result."))


if __name__ == "__main__":
    main_with_sentences(main, __file__)
