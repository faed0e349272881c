"""The zoo of connectors: a user's own, with arguments that RLlib records rightly or not, and with memories.

python train_connector_zoo.py OUT [NAME...]

What is recorded is what RLlib makes of the checkpoint: the runner of `Algorithm.from_checkpoint`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from ray import tune
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.connectors.env_to_module import FlattenObservations, MeanStdFilter

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "app"), str(HERE)]
import zoo_connectors as own  # noqa: E402  # pyright: ignore[reportMissingImports]  # in app/, added to the path above
import zoo_spaces  # noqa: E402  # pyright: ignore[reportMissingImports]
import zoo_team  # noqa: E402  # pyright: ignore[reportMissingImports]
from train_wide_zoo import ppo, team, team_rollout  # noqa: E402  # pyright: ignore[reportMissingImports]
from train_zoo import ray_for_training, record  # noqa: E402  # pyright: ignore[reportMissingImports]


def attribute_set(piece: Any, **attributes: Any) -> Any:
    for name, value in attributes.items():
        setattr(piece, name, value)
    return piece


def before(*makers: Any) -> Any:
    return ppo("vector", "box", *makers)


def after(maker: Any) -> Any:
    return ppo("vector", "box", after=maker)


def by_function(function: Any) -> Any:
    return before().env_runners(env_to_module_connector=function)


def with_gain(gain: float) -> Any:
    def function(env: Any, spaces: Any, device: Any) -> Any:
        return own.Gain(gain)

    return function


def of_the_spaces(env: Any, spaces: Any, device: Any) -> Any:
    return own.Gain(float(env.single_observation_space.shape[0]))


def of_the_environment(env: Any, spaces: Any, device: Any) -> Any:
    return own.Gain(len(env.unwrapped.envs) + 2.0)


def action_by_agent(env: Any) -> Any:
    return own.ActionByAgent()


def of_the_environment_or_not(env: Any, spaces: Any, device: Any) -> Any:
    piece = own.Gain(1.0)
    try:
        piece.gain = len(env.unwrapped.envs) + 2.0
    except Exception:
        piece.gain = 1.0
    return piece


def add_a_gain(algorithm: Any, **_: Any) -> None:
    algorithm.env_runner._env_to_module.prepend(own.Gain(3.0))


def configurations() -> dict[str, Any]:
    factor = 3.0
    return {
        "sound": before(lambda: own.Gain(3.0)),
        "sound_action": after(lambda: own.ActionGain(0.3)),
        "sound_team": team(lambda: own.Gain(3.0)),
        "closure": by_function(with_gain(3.0)),
        "applied": before(lambda: own.Applied(lambda obs: obs * factor)),
        "of_the_spaces": by_function(of_the_spaces),
        "in_the_middle": before(FlattenObservations, lambda: own.Gain(2.0), MeanStdFilter, lambda: own.Gain(0.5)),
        "inherited": before(lambda: own.Inherited(3.0)),
        "inherited_action": after(lambda: own.InheritedAction(0.3)),
        "inherited_team": team(lambda: own.Inherited(3.0)),
        "inherited_in_the_middle": before(FlattenObservations, lambda: own.Inherited(3.0), lambda: own.Gain(0.5)),
        "attribute": before(lambda: attribute_set(own.Gain(), gain=3.0)),
        "attribute_action": after(lambda: attribute_set(own.ActionGain(), gain=0.3)),
        "attribute_of_rllibs": before(lambda: attribute_set(MeanStdFilter(), clip_by_value=0.5)),
        "converted": before(lambda: own.Converted(3.0)),
        "converted_action": after(lambda: own.ConvertedAction(0.3)),
        "renamed": before(lambda: own.Renamed(3.0)),
        "added": before().callbacks(on_algorithm_init=add_a_gain),
        "of_the_environment": by_function(of_the_environment),
        "of_the_environment_or_not": by_function(of_the_environment_or_not),
        "by_agent_team": team(own.ByAgent),
        "action_by_agent_team": team().env_runners(module_to_env_connector=action_by_agent),
        "own_runner": before().env_runners(env_runner_cls=own.HalvingRunner),
        "called_back": before().callbacks(own.Callbacks),
        "difference": before(own.Difference),
        "difference_team": team(own.Difference),
        "steps": before(own.Steps),
        "rewarded": before(own.Rewarded),
        "last_action": before(own.LastAction),
        "beside": before(own.Beside),
        "shared": before(own.Shared),
        "counting": before(own.Counting),
        "informed": before(own.Informed),
        "action_steps": after(own.ActionSteps),
        "steps_later": before(own.StepsLater),
        "steps_later_team": team(own.StepsLater),
        "rewarded_later": before(own.RewardedLater),
        "shared_later": before(own.SharedLater),
        "in_itself_later": before(own.InItselfLater),
        "in_its_class_later": before(own.InItsClassLater),
        "in_a_global_later": before(own.InAGlobalLater),
        "in_a_closure_later": before(own.InAClosureLater),
        "action_steps_later": after(own.ActionStepsLater),
    }


def main(out: Path, only: list[str]) -> None:
    tune.register_env("spaces", zoo_spaces.Spaces)
    tune.register_env("team", zoo_team.Team)
    with ray_for_training():
        for name, config in configurations().items():
            if only and name not in only:
                continue
            algorithm = config.build_algo()
            if name in ("in_the_middle", "attribute_of_rllibs"):
                algorithm.train()  # for their statistics
            algorithm.save_to_path(str(out / name))
            algorithm.stop()
            restored = Algorithm.from_checkpoint(str(out / name))
            if "team" in name:
                for agent, seen in team_rollout(restored.env_runner).items():
                    np.savez(out / f"{name}_{agent}.npz", **seen)
            else:
                record(restored, out / f"{name}.npz")
            restored.stop()
            print(name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
