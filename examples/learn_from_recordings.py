"""Learn the next version of a policy from recordings of the last one, with RLlib's offline learners.

    python examples/learn_from_recordings.py recordings --from examples/checkpoints/ur5_positioning --out runs/learned

Recordings (`rlservo rollout --record`, `WithRecording`, clients) become RLlib's episodes: actions as the module gave
them, before unsquash and clip; observations through the checkpoint's own connectors, filters as they stand. BC, MARWIL,
CQL and IQL learn from whole episodes, starting at the checkpoint's weights if the algorithm has such a network. The
result is a checkpoint that `rlservo export` takes. Without `--from` the network is new, and its observation filter is
computed from the recorded observations. docs/how-to/learn.md has the whole path.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, cast

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import numpy as np
import shared.failures as failures
import shared.recorded_episodes as recorded_episodes
import shared.search_space as search_space
import shared.training_run as training_run
import torch
from gymnasium.spaces import Box
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.sac.default_sac_rl_module import DefaultSACRLModule
from ray.rllib.connectors.env_to_module import EnvToModulePipeline, FlattenObservations, MeanStdFilter
from ray.rllib.connectors.module_to_env import ModuleToEnvPipeline
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModule, RLModuleSpec
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from shared.help_text import DefaultsFormatter
from shared.recorded_episodes import Choice, Recorded, RecordedEpisodes, read_recordings

from rlservo import errors
from rlservo.deploy.learning.rllib_episodes import through_connectors
from rlservo.deploy.terminal import status
from rlservo.export.checkpoints.location import (
    ENV_TO_MODULE,
    MODULE_TO_ENV,
    TRAINING_RUNNER,
    CheckpointFiles,
    locate_checkpoint,
)
from rlservo.export.rllib import private_names
from rlservo.recording.conversion.common import gym_space
from rlservo.recording.reader import Recording

assert ray_settings
ALGORITHMS = ("BC", "MARWIL", "CQL", "IQL")


@dataclass(frozen=True)
class Start:
    """Parts that the next version takes from the last one, or a new one's initial ones."""

    env_to_module: Any
    module_to_env: Any
    module: RLModule | None
    weights: Path | None


def argument_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description="Learn the next version of a policy from recordings.", formatter_class=DefaultsFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path, help="recordings (.mcap), or folders of them")
    parser.add_argument("--policy", help="name of the recorded policy; required if there are several")
    parser.add_argument("--run", choices=ALGORITHMS, default="MARWIL", help="RLlib's algorithm")
    parser.add_argument("--from", type=Path, dest="start", metavar="CHECKPOINT", help="checkpoint to continue from")
    parser.add_argument("--out", type=Path, required=True, help="new folder for the checkpoint")
    parser.add_argument("--status", help="learn only from episodes with this final status, such as success")
    parser.add_argument(
        "--modes", action="store_true",
        help="learn the recorded policy's most likely actions instead of those it drew (BC)",
    )  # fmt: skip
    parser.add_argument(
        "--ahead", type=int, default=0,
        help="for each observation learn the action of this many control cycles later (BC), against latency",
    )  # fmt: skip
    parser.add_argument("--epochs", type=int, default=20, help="passes over the recordings")
    parser.add_argument("--batch-size", type=int, default=1024, help="decisions in a minibatch")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="a setting of the algorithm's configuration, such as lr=3e-4 or beta=0.5",
    )  # fmt: skip
    parser.add_argument("--hidden", default="256,256", help="sizes of a new network's layers")
    parser.add_argument("--use-lstm", action="store_true", help="make the new network recurrent")
    parser.add_argument(
        "--observation-filter", choices=("NoFilter", "MeanStdFilter"), default="MeanStdFilter",
        help="seed of a new network",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    return parser


def start_from(checkpoint: Path, recorded: Recorded) -> Start:
    """Return a checkpoint's connectors and module.

    Raises CheckpointError, and UsageError for one without connectors or with other observations or actions.
    """
    files = locate_checkpoint(checkpoint)
    if not isinstance(files, CheckpointFiles) or not files.has_pipelines or files.is_one_of_several:
        raise errors.UsageError(
            f"--from {checkpoint}: expected a checkpoint of RLlib's new API stack, with one agent and its connectors"
        )
    env_to_module = EnvToModulePipeline.from_checkpoint(str(files.env_to_module))
    module_to_env = ModuleToEnvPipeline.from_checkpoint(str(files.module_to_env))
    seen, done = gym_space(recorded.contract.observation_space), gym_space(recorded.contract.action_space)
    ours = env_to_module.input_observation_space
    alike = ours == seen or (isinstance(ours, Box) and isinstance(seen, Box) and ours.shape == seen.shape)
    if not alike:
        raise errors.UsageError(f"--from {checkpoint}: it observes {ours}, the recordings have {seen}")
    if module_to_env.input_action_space != done:
        raise errors.UsageError(
            f"--from {checkpoint}: its actions are {module_to_env.input_action_space}, the recordings have {done}"
        )
    return Start(env_to_module, module_to_env, RLModule.from_checkpoint(str(files.module)), files.module)


def keep_connectors(config: AlgorithmConfig, start: Start) -> None:
    """Make the configuration build a checkpoint's connectors, as RLlib restores by the configuration alone."""

    def build(pipeline: Any) -> Callable[..., list[Any]]:
        pieces = [(type(piece), *piece.get_ctor_args_and_kwargs()) for piece in pipeline.connectors]
        return lambda *_: [kind(*args, **kwargs) for kind, args, kwargs in pieces]

    config.env_runners(
        env_to_module_connector=cast(Any, build(start.env_to_module)),
        module_to_env_connector=cast(Any, build(start.module_to_env)),
        add_default_connectors_to_env_to_module_pipeline=False,
        add_default_connectors_to_module_to_env_pipeline=False,
    )


def start_anew(config: AlgorithmConfig, recorded: Recorded, with_filter: bool) -> Start:
    """Return RLlib's connectors around the recorded spaces; the filter's statistics are the recordings'."""
    observations, actions = (
        gym_space(one) for one in (recorded.contract.observation_space, recorded.contract.action_space)
    )
    spaces = (observations, actions)
    wide = len(observations.shape or ()) != 1

    def build(*_: Any) -> list[Any]:
        return ([FlattenObservations()] if wide else []) + ([MeanStdFilter()] if with_filter else [])

    if wide or with_filter:
        config.env_runners(env_to_module_connector=cast(Any, build))
    given: dict[str, Any] = {INPUT_ENV_SINGLE_SPACES: spaces, INPUT_ENV_SPACES: spaces}
    env_to_module = config.build_env_to_module_connector(spaces=given)
    start = Start(env_to_module, config.build_module_to_env_connector(spaces=given), None, None)
    if with_filter:
        through_connectors(recorded.episodes, env_to_module, learn=True)
    return start


def module_spec(config: AlgorithmConfig, start: Start, longest: int) -> tuple[RLModuleSpec | None, str]:
    """Return the module that an algorithm learns, None for its own new one, and a sentence about it.

    BC and MARWIL continue with any network that has a value function, CQL and IQL with SAC's. A recurrent module learns
    from whole episodes: its sequences are as long as the longest.
    """
    module = start.module
    if module is None:
        return None, "a new network"
    actor_critic = type(config).__name__ in ("BCConfig", "MARWILConfig")
    fits = isinstance(module, ValueFunctionAPI) if actor_critic else isinstance(module, DefaultSACRLModule)
    if not fits:
        return None, f"a new network: {type(module).__name__} does not belong to this algorithm"
    spec = RLModuleSpec.from_module(module)
    spec.inference_only = False
    settings = (
        asdict(cast(Any, spec.model_config)) if is_dataclass(spec.model_config) else dict(spec.model_config or {})
    )
    if module.is_stateful():
        settings["max_seq_len"] = longest
    if not actor_critic:  # the learner's own class has more heads than SAC's; those start untrained
        default = cast(RLModuleSpec, config.get_default_rl_module_spec())
        spec.module_class, spec.catalog_class = default.module_class, default.catalog_class
    spec.model_config = settings
    spec.load_state_path = str(start.weights)
    return spec, f"the weights of {start.weights}"


def configure(args: argparse.Namespace, recorded: Recorded) -> tuple[AlgorithmConfig, Start, str]:
    """Return RLlib's configuration, the start, and a sentence about the network."""
    config = training_run.default_config(args.run)
    config.learners(num_learners=0, num_gpus_per_learner=0)
    config.env_runners(num_env_runners=0)
    config.debugging(seed=args.seed, log_level="ERROR")
    config.training(train_batch_size_per_learner=args.batch_size)
    config.offline_data(
        input_=cast(Any, [str(path) for path in args.recordings]),  # RLlib takes a list, its annotation does not
        offline_data_class=RecordedEpisodes,
        # An iteration is a pass; more than one minibatch, or RLlib asks for batches another way.
        dataset_num_iters_per_learner=max(2, round(recorded.decisions / args.batch_size)),
    )
    if args.run == "CQL":  # ray 2.60: its own default is refused by its own check, and it asks for an environment
        cast(Any, config).lr = None
        private_names.replace(config, "_is_online", False)
    if args.run == "MARWIL":
        # RLlib's 100 never changes at its rate of 1e-8: advantages of a hundredth then vanish, and those of a thousand
        # overflow. The variance of returns is their scale until the value function has learned.
        returns = [episode.get_return() for episode in recorded.episodes]
        cast(Any, config).training(
            moving_average_sqd_adv_norm_start=float(np.var(returns)) or 1.0,
            moving_average_sqd_adv_norm_update_rate=0.01,
        )
    if args.start:
        start = start_from(args.start, recorded)
        keep_connectors(config, start)
    else:
        start = start_anew(config, recorded, args.observation_filter == "MeanStdFilter")
    action_space = start.module_to_env.input_action_space or gym_space(recorded.contract.action_space)
    origin = recorded.contract.provenance  # no environment is made: an export names its elements by it
    config.environment(
        env=origin.env_id,
        env_config=dict(origin.env_config),
        observation_space=start.env_to_module.observation_space,
        action_space=action_space,
    )
    longest = max(map(len, recorded.episodes)) + 1  # RLlib appends a step to each, for the value of what follows
    spec, sentence = module_spec(config, start, longest)
    if spec is not None:
        config.rl_module(rl_module_spec=spec)
    else:
        sizes = [int(size) for size in args.hidden.split(",")]
        config.rl_module(
            model_config=DefaultModelConfig(fcnet_hiddens=sizes, use_lstm=args.use_lstm, max_seq_len=longest)
        )
    changes = {name: values[0] for name, values in search_space.parse_settings(args.set, "--set").items()}
    search_space.apply(config, changes, "--set")
    search_space.validate(config)
    if cast(Any, config).num_learners:
        raise errors.UsageError("--set num_learners: one learner in this process reads the recordings")
    return config, start, sentence


def learn(config: AlgorithmConfig, episodes: list[SingleAgentEpisode], epochs: int, folder: Path, start: Start) -> None:
    """Learn, and write the checkpoint."""
    with training_run.stopping(training_run.build(config)) as algorithm:
        algorithm.offline_data.episodes = episodes
        for epoch in range(epochs):
            result = training_run.iterate(algorithm)
            if not failures.metric(result, failures.TRAINED) > 0:
                raise errors.RlservoError("nothing was learned: the learner took no step on the recordings")
            results = result["learners"]["default_policy"]
            losses = "  ".join(f"{name} {float(results[name]):.6g}" for name in sorted(results) if "loss" in name)
            print(f"pass {epoch + 1:>3} of {epochs}  {losses}", flush=True)
        algorithm.save_to_path(str(folder.resolve()))
    # An offline algorithm has no environment runner, and so no connectors around its module.
    runner = folder.resolve() / TRAINING_RUNNER
    for pipeline, name in ((start.env_to_module, ENV_TO_MODULE), (start.module_to_env, MODULE_TO_ENV)):
        pipeline.save_to_path(str(runner / name), state=pipeline.get_state())  # else it misses pieces without a state


def report(recorded: Recorded) -> None:
    """Print what a learner can use of the recordings."""
    print(
        f"{len(recorded.episodes)} episodes, {recorded.decisions} decisions of {recorded.contract.name}, "
        f"mean return {recorded.mean_return:.4g}"
    )
    for reason, count in recorded.not_used.items():
        print(f"not used: {count} episodes {reason}")
    print(
        f"own actions: {recorded.own} recorded, {recorded.inverted} computed from the executed ones, of which "
        f"{recorded.clipped} at a bound (the true ones may lie beyond it)",
        flush=True,
    )


def main() -> None:
    args = argument_parser().parse_args()
    if args.out.exists():
        raise errors.UsageError(f"--out {args.out} exists: give a new folder")
    if args.epochs < 1 or args.batch_size < 1:
        raise errors.UsageError(f"--epochs is {args.epochs} and --batch-size {args.batch_size}: expected at least 1")
    if args.run != "BC" and (args.modes or args.ahead):
        raise errors.UsageError(
            "--modes and --ahead are BC's: rewards and values belong to the actions that were executed"
        )
    if args.ahead < 0:
        raise errors.UsageError(f"--ahead is {args.ahead}: expected 0 or more control cycles")
    training_run.pickle_by_value(sys.modules[__name__], recorded_episodes)
    torch.set_num_threads(1)
    choice = Choice(rewards=args.run != "BC", status=args.status, modes=args.modes, ahead=args.ahead)
    with status("reading the recordings"):
        recorded = read_recordings(Recording(args.recordings), choice, name=args.policy)
    report(recorded)
    with training_run.ray_session(num_cpus=1):
        config, start, sentence = configure(args, recorded)
        print(f"{args.run} from {sentence}", flush=True)
        learn(
            config,
            through_connectors(recorded.episodes, start.env_to_module),
            args.epochs,
            args.out,
            start,
        )
    print(f"checkpoint: {args.out}\nnext: rlservo export {args.out} --out policies --name {recorded.contract.name}")


if __name__ == "__main__":
    training_run.main_with_sentences(main, __file__)
