"""The zoo of layouts: where a checkpoint holds its filter's statistics, by who acts in training and in evaluation.

python train_layout_zoo.py OUT [NAME...]

A runner that acts in training is recorded after RLlib has restored the checkpoint: what RLlib itself makes of it,
wherever it reads the statistics.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from ray import tune
from ray.rllib.algorithms.bc import BCConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core import COMPONENT_LEARNER, COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "app"), str(HERE)]
os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # of the remote runners
import zoo_spaces  # noqa: E402  # pyright: ignore[reportMissingImports]  # in app/, added to the path above
import zoo_team  # noqa: E402  # pyright: ignore[reportMissingImports]
from train_wide_zoo import (  # noqa: E402  # pyright: ignore[reportMissingImports]
    SMALL,
    filtered_each,
    offline,
    pieces,
    recorded,
    team_rollout,
)
from train_zoo import mean_std_filter, ppo, ray_for_training, rollout  # noqa: E402  # pyright: ignore[reportMissingImports]

REMOTE = {"num_env_runners": 1, "num_cpus_per_env_runner": 0}
NO_LOCAL = {**REMOTE, "create_local_env_runner": False}


def evaluated(config: Any, runners: int, **settings: Any) -> Any:
    """Evaluate after each iteration, by a local runner (0) or remote ones."""
    config.evaluation(evaluation_interval=1, evaluation_num_env_runners=runners, evaluation_duration=1)
    return config.evaluation(evaluation_config={"num_cpus_per_env_runner": 0, **settings})


def pendulum(**runners: Any) -> Any:
    return ppo("Pendulum-v1", before=mean_std_filter, steps=128).env_runners(**runners)


def arms() -> Any:
    """Two agents with a module each; RLlib merges statistics only of agents with observations of one shape."""
    specs = {f"{side}_arm": RLModuleSpec(model_config=SMALL) for side in ("left", "right")}
    config = PPOConfig().environment("team", env_config={"agents": ["left", "right"]})
    config.env_runners(env_to_module_connector=pieces(filtered_each), **NO_LOCAL)
    config.training(train_batch_size=32, minibatch_size=16, num_epochs=1)
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs))
    return config.multi_agent(policies=set(specs), policy_mapping_fn=zoo_team.module_of_its_own)


def configurations(out: Path) -> dict[str, Any]:
    imitation = offline(BCConfig(), recorded(out, "discrete"), "discrete")
    return {
        "local_evaluated": evaluated(pendulum(), 0),
        "remote_evaluated": evaluated(pendulum(**REMOTE), 0),
        "remote_evaluated_remotely": evaluated(pendulum(**REMOTE), 1),
        "no_local_evaluated": evaluated(pendulum(**NO_LOCAL), 0),
        "no_local_evaluated_remotely": evaluated(pendulum(**NO_LOCAL), 1),
        "no_local_team": evaluated(arms(), 0),
        "never_merged": evaluated(pendulum(**REMOTE, merge_env_runner_states=False), 0),
        "imitation": imitation.env_runners(env_to_module_connector=pieces(MeanStdFilter)),
    }  # fmt: skip


def main(out: Path, only: list[str]) -> None:
    tune.register_env("spaces", zoo_spaces.Spaces)
    tune.register_env("team", zoo_team.Team)
    with ray_for_training():
        for name, config in configurations(out).items():
            if only and name not in only:
                continue
            algorithm = config.build_algo()
            algorithm.train()
            algorithm.save_to_path(str(out / name))
            if config.is_online:  # RLlib restores no other (ray 2.60)
                algorithm.restore_from_path(str(out / name))
            record(algorithm, out, name)
            algorithm.stop()
            print(name, flush=True)


def record(algorithm: Any, out: Path, name: str) -> None:
    """Write down what a runner sees and does: one that acts in training, if any."""
    part = f"{COMPONENT_LEARNER}/{COMPONENT_RL_MODULE}"
    weights = algorithm.learner_group.get_state(part, inference_only=True)[COMPONENT_LEARNER][COMPONENT_RL_MODULE]
    roll_out = team_rollout if "team" in name else rollout

    def acting(runner: Any) -> Any:
        runner.set_state({COMPONENT_RL_MODULE: weights})  # RLlib lets a remote runner's lag behind the checkpoint's
        return roll_out(runner)

    group = algorithm.env_runner_group or algorithm.eval_env_runner_group
    seen = group.foreach_env_runner(acting, local_env_runner=group.num_remote_env_runners() == 0)[0]
    for agent, columns in (seen if "team" in name else {"": seen}).items():
        np.savez(out / "_".join(filter(None, (name, agent))), **columns)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
