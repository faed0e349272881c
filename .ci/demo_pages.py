"""Pages of shipped policies for the site: python .ci/demo_pages.py FOLDER.

Without a network, and JavaScript libraries from an earlier one, it leaves them out; in CI that is an error.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path

from rlservo.bundle.bundle import read_contract, write_contract
from rlservo.bundle.contract import Contract, Evaluation
from rlservo.deploy.page.npm_packages import libraries
from rlservo.deploy.page.static_site import write_site
from rlservo.errors import RlservoError
from rlservo.export.export_checkpoint import export_checkpoint

CHECKPOINTS = Path(__file__).parents[1] / "examples" / "checkpoints"
SHOWN = ("ur5_positioning", "ur10_isaac_reach", "mir100_obstacle_avoidance", "panda_positioning", "pendulum_sac")


def main(out: Path) -> None:
    try:
        libraries(print)
    except RlservoError as error:
        if os.environ.get("GITHUB_ACTIONS"):
            raise
        print(f"no pages of policies on this site: {error}")  # noqa: T201
        return
    with tempfile.TemporaryDirectory() as folder:
        made = [export_checkpoint(CHECKPOINTS / name, folder, name=name, notify=print).path for name in SHOWN]
        for name, bundle in zip(SHOWN, made, strict=True):
            contract = read_contract(bundle)
            write_contract(bundle, contract.model_copy(update={"evaluations": measured(name, contract)}))
        write_site(made, out, print)


def measured(name: str, contract: Contract) -> tuple[Evaluation, ...]:
    """Return what examples/evaluate_shipped.py measured of a policy, for its card."""
    file = CHECKPOINTS / name / "evaluation.json"
    return tuple(
        Evaluation(
            env_id=one["env_config"].get("env_id", contract.provenance.env_id),
            episodes=one["episodes"],
            first_seed=one["seed"],
            return_bundle=one["mean_return"],
            return_interval=one["return_interval"],
            success_rate_bundle=None if one["successes"] is None else one["successes"] / one["episodes"],
            success_interval=one["success_interval"],
            disturbance=f"from {one['start']}",
            endings=one["endings"],
            evaluated_at="",  # not recorded
        )
        for one in json.loads(file.read_text(encoding="utf-8"))
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
