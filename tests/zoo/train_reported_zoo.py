"""The zoo of reports: checkpoints of the kinds that people brought and an export had refused.

python train_reported_zoo.py OUT [NAME...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from ray import tune
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import FlattenObservations, PrevActionsPrevRewards
from ray.rllib.connectors.env_to_module.observation_preprocessor import SingleAgentObservationPreprocessor
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.external.env_runner_server_for_external_inference import EnvRunnerServerForExternalInference
from ray.rllib.examples.rl_modules.classes.random_rlm import RandomRLModule

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "app"), str(HERE)]
import zoo_reported  # noqa: E402  # pyright: ignore[reportMissingImports]  # in app/, added to the path above
import zoo_team  # noqa: E402  # pyright: ignore[reportMissingImports]
from train_wide_zoo import SMALL, pieces, team, team_rollout  # noqa: E402  # pyright: ignore[reportMissingImports]
from train_zoo import ray_for_training, record  # noqa: E402  # pyright: ignore[reportMissingImports]

IMAGE_LSTM = DefaultModelConfig(
    conv_filters=[[16, 8, 4], [32, 4, 2], [64, 3, 1]], head_fcnet_hiddens=[64], use_lstm=True, lstm_cell_size=64,
    max_seq_len=10,
)  # fmt: skip


class TenTimes(SingleAgentObservationPreprocessor):
    """In `__main__`, so that the checkpoint holds the class itself and not its name."""

    def preprocess(self, observation: Any, episode: Any) -> Any:
        return observation * 10.0


def ppo(obs: str, action: str, *before: Any, model: Any = SMALL, module: Any = None) -> Any:
    config = PPOConfig().environment("reported", env_config={"obs": obs, "action": action})
    config.env_runners(num_env_runners=0, **({"env_to_module_connector": pieces(*before)} if before else {}))
    config.training(train_batch_size=64, minibatch_size=32, num_epochs=1)
    if module:
        return config.rl_module(rl_module_spec=RLModuleSpec(module_class=module))
    return config.rl_module(model_config=model)


def out_of_order(module: Any) -> Any:
    """One agent of an environment for several, whose observations reach the network as they are."""
    config = PPOConfig().environment("out_of_order").env_runners(num_env_runners=0)
    config.training(train_batch_size=32, minibatch_size=16, num_epochs=1)
    specs = {"robot": RLModuleSpec(module_class=module) if module else RLModuleSpec(model_config=SMALL)}
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs))
    if not module:
        config.env_runners(env_to_module_connector=pieces(lambda: FlattenObservations(multi_agent=True)))
    return config.multi_agent(policies=set(specs), policy_mapping_fn=robot_is_robot)


def robot_is_robot(*_: Any, **__: Any) -> str:
    return "robot"


def without_critic() -> Any:
    return FlattenObservations(zoo_reported.OBSERVATIONS["privileged"], keys_to_remove=["critic"])


def previous_actions() -> Any:
    return PrevActionsPrevRewards(n_prev_actions=2, n_prev_rewards=0)


def external() -> Any:
    """An algorithm whose environment runs elsewhere and sends episodes to a port."""
    space = zoo_reported.OBSERVATIONS["vector"]
    config = PPOConfig().environment(
        observation_space=space, action_space=zoo_reported.ACTIONS["box"], env_config={"port": 5733}
    )
    config.env_runners(num_env_runners=0, env_runner_cls=EnvRunnerServerForExternalInference)
    return config.rl_module(model_config=SMALL)


def self_play() -> Any:
    """Two arms; the second is played by a script, and later by what the first one was."""
    specs = {"main": RLModuleSpec(model_config=SMALL), "script": RLModuleSpec(module_class=RandomRLModule)}
    config = PPOConfig().environment("team", env_config={"agents": ["left", "right"]}).env_runners(num_env_runners=0)
    config.training(train_batch_size=32, minibatch_size=16, num_epochs=1)
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs))
    return config.multi_agent(policies=set(specs), policy_mapping_fn=left_is_main, policies_to_train=["main"])


def left_is_main(agent: str, *_: Any, **__: Any) -> str:
    return "main" if agent == "left" else "script"


def right_is_snapshot(agent: str, *_: Any, **__: Any) -> str:
    return "main" if agent == "left" else "main_v1"


def add_snapshot(algorithm: Any) -> None:
    """Add what RLlib's self-play callback does: a frozen copy of the module that learns."""
    main = algorithm.get_module("main")
    algorithm.add_module(
        module_id="main_v1",
        module_spec=RLModuleSpec.from_module(main),
        new_agent_to_module_mapping_fn=right_is_snapshot,
    )
    algorithm.set_state({"learner_group": {"learner": {"rl_module": {"main_v1": main.get_state()}}}})
    part = algorithm.learner_group.get_state("learner/rl_module", inference_only=True)["learner"]
    algorithm.env_runner.set_state({"rl_module": part["rl_module"]})  # RLlib lets it lag behind the checkpoint's


def configurations() -> dict[str, Any]:
    flat = FlattenObservations
    return {
        "asymmetric": ppo("privileged", "box", module=zoo_reported.Asymmetric),
        "trains_otherwise": ppo("vector", "discrete", module=zoo_reported.TrainsOtherwise),
        "takes_its_argument": ppo("vector", "discrete", module=zoo_reported.TakesItsArgument),
        "critic_in_training": ppo("vector", "discrete", module=zoo_reported.NeedsItsCritic),
        "partly_read": ppo("partly_read", "discrete", module=zoo_reported.PartReader),
        "removed_key": ppo("privileged", "box", without_critic),
        "previous_actions": ppo("vector", "discrete", previous_actions, flat),
        "in_order": ppo("unsorted", "discrete", module=zoo_reported.InOrder),
        "out_of_order": out_of_order(zoo_reported.InOrder),
        "out_of_order_flat": out_of_order(None),
        "infinite_buffers": ppo("vector", "discrete", module=zoo_reported.Masked),
        "image_lstm": ppo("image", "box", model=IMAGE_LSTM),
        "unusual": ppo("unusual", "box", flat),
        "uint32": ppo("uint32", "box", flat),
        "huge_obs": ppo("huge", "box"),
        "huge_action": ppo("vector", "huge"),
        "main_connector": ppo("vector", "box", TenTimes),
        "external": external(),
        "self_play": self_play(),
        "sees_the_base_team": team(zoo_reported.SeesTheBase),
    }


def main(out: Path, only: list[str]) -> None:
    tune.register_env("reported", zoo_reported.Reported)
    tune.register_env("team", zoo_team.Team)
    tune.register_env("out_of_order", zoo_reported.OutOfOrder)
    with ray_for_training():
        for name, config in configurations().items():
            if only and name not in only:
                continue
            algorithm = config.build_algo()
            if name != "external":  # whose episodes nothing sends: the checkpoint is of new weights
                algorithm.train()
            if name == "self_play":
                add_snapshot(algorithm)
            algorithm.save_to_path(str(out / name))
            if name.startswith(("self_play", "out_of_order", "sees_the_base")):
                for agent, seen in team_rollout(algorithm.env_runner).items():
                    np.savez(out / f"{name}_{agent}.npz", **seen)
            elif name != "external":
                record(algorithm, out / f"{name}.npz")
            algorithm.stop()
            print(name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
