"""Run MiR100 navigation with the policy of a checkpoint, or with its export.

python examples/policy_from_cp_mir.py examples/checkpoints/mir100_navigation
python examples/policy_from_cp_mir.py --bundle policies/mir100
"""

from __future__ import annotations

import shared.policy_from_cp as policy_from_cp
from shared.training_run import main_with_sentences


def main() -> None:
    policy_from_cp.main(
        "rlservo.envs:rlservo/NoObstacleNavigationMir100Sim-v0",
        {"rs_state_to_info": False},
        "Run MiR100 navigation with the policy of a checkpoint, or with its export.",
    )


if __name__ == "__main__":
    main_with_sentences(main, __file__)
