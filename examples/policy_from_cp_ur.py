"""Run UR5 end-effector positioning with the policy of a checkpoint, or with its export.

python examples/policy_from_cp_ur.py examples/checkpoints/ur_positioning
python examples/policy_from_cp_ur.py --bundle policies/ur5
"""

from __future__ import annotations

import shared.policy_from_cp as policy_from_cp
from shared.training_run import main_with_sentences


def main() -> None:
    policy_from_cp.main(
        "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0",
        {"ur_model": "ur5", "rs_state_to_info": False},
        "Run UR5 end-effector positioning with the policy of a checkpoint, or with its export.",
    )


if __name__ == "__main__":
    main_with_sentences(main, __file__)
