"""Train one of the policies in examples/checkpoints again, from the settings next to it.

    python examples/train_shipped.py mir100_obstacle_avoidance

`examples/checkpoints/NAME/training.yaml` defines the training and its end; `--seed`, `--set` and `--settings` change
that for one run. The run goes to `runs/NAME`: the best checkpoint so far (by the mean of the last episodes or, if the
settings have `validation`, by episodes of the exported policy, without exploration), `curve.csv` and `curve.png`.
`--install` then puts the pruned checkpoint and the curve next to the settings. One process, one thread: RLlib samples
in the driver, so that a run gives the same numbers again. `evaluate_shipped.py` then measures the policy on other
seeds.
"""

from __future__ import annotations

import argparse
import csv
import functools
import math
import resource
import shutil
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import evaluate_shipped
import gymnasium
import numpy as np
import shared.failures as failures
import torch
import yaml
from ray import cloudpickle
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.connectors.learner import AddNextObservationsFromEpisodesToTrainBatch
from ray.rllib.core.columns import Columns
from ray.rllib.utils.filter import RunningStat
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.schedules.scheduler import Scheduler
from ray.tune.registry import ENV_CREATOR, _global_registry, get_trainable_cls, register_env
from shared.imitation import Imitation, fit_to_solution
from shared.training_run import build, iterate, main_with_sentences, ray_session, sigterm_as_ctrl_c

from rlservo import Policy, errors, export_checkpoint
from rlservo.drive.success import success_of
from rlservo.export.rllib.batched_connectors import use_batched_connectors
from rlservo.robots.disturbable import HasExtremes

assert ray_settings
SHIPPED = Path(__file__).resolve().parent / "checkpoints"
FILTER = "env_to_module_connector"
MODULE = "learner_group/learner/rl_module/default_policy"  # path of the network in a checkpoint
MILESTONE = 0.95  # the success rate whose time is printed
GAINS = {"encoder": 2**0.5, "pi": 0.01, "vf": 1.0}  # of orthogonal weights, by the network's parts
NEEDED = ("env", "algorithm", "seed", "envs", "filter", "stop")  # of training.yaml
SHAPING = ("bounds_loss_coeff", "smoothness_loss_coeff", "largest_std")  # settings of ActionPenaltyLearner
FAILED_KEPT = 16  # episodes, by each environment
CURVE = ("env_steps", "episodes", "mean_return", "mean_length", "success", "wall_s", "cpu_s")  # a Row's, in the file
SUMS = ("episodes", "judged", "return", "length", "success")


@dataclass(frozen=True)
class Row:
    """One line of the curve; return, length and success are means over the last episodes, with exploration."""

    env_steps: int
    episodes: int
    mean_return: float
    mean_length: float
    success: float
    wall_s: float
    cpu_s: float
    trained_steps: float  # steps that the learner has seen, repetitions counted


def algorithm_config(settings: dict[str, Any], seed: int) -> AlgorithmConfig:
    """Return the RLlib configuration that `training.yaml` describes. Raises UsageError."""
    config: AlgorithmConfig = get_trainable_cls(settings["algorithm"]).get_default_config()
    config.environment(
        settings["env"],
        env_config=settings.get("env_config", {}),
        clip_rewards=False,
        normalize_actions=settings.get("normalize_actions", True),
    )
    chosen = _chosen_episodes(settings)
    # Under the environment's own name, which checkpoints keep: elsewhere they are restored without the wrapper.
    if chosen["failed_share"] or chosen["out_of_reach_share"]:
        register_env(settings["env"], functools.partial(_make_chosen, settings["env"], chosen))
    else:  # registered by an earlier training in the same process
        _global_registry.unregister(ENV_CREATOR, settings["env"])
    config.env_runners(
        num_env_runners=0,
        num_envs_per_env_runner=settings["envs"],
        rollout_fragment_length=settings.get("rollout_fragment_length", "auto"),
    )
    if not settings.get("model", {}).get("use_lstm"):  # the same numbers, sooner
        of_elements: dict[str, Any] = {
            what: _columns(settings, tuple(settings[what]))[0]
            for what in ("logarithm_of", "sine_and_cosine_of")
            if settings.get(what)
        }
        use_batched_connectors(
            config,
            observation_filter=settings["filter"],
            **of_elements,
            **settings.get("frame_stacking", {}),  # num_frames and every
        )
    elif settings["filter"]:
        config.env_runners(env_to_module_connector=cast(Any, _mean_std_filter))
    config.learners(num_learners=0, num_gpus_per_learner=0)
    config.rl_module(model_config=settings.get("model", {}))
    config.training(**settings.get("training", {}))
    shaping = {name: settings[name] for name in SHAPING if settings.get(name)}
    if "largest_std" in shaping and not settings.get("model", {}).get("free_log_std"):
        raise errors.UsageError(
            "largest_std bounds a standard deviation that is not an output: set model.free_log_std=true"
        )
    if shaping:
        config.training(learner_class=ActionPenaltyLearner)
        config.learners(learner_config_dict=shaping)
    if "smoothness_loss_coeff" in shaping:
        config.training(learner_connector=lambda *_: AddNextObservationsFromEpisodesToTrainBatch())
    config.reporting(
        # By default off-policy algorithms report once a second, however many steps that is.
        min_time_s_per_iteration=0,
        min_sample_timesteps_per_iteration=settings.get("steps_per_iteration", 0),
    )
    config.callbacks(on_episode_end=log_episode)
    if settings.get("orthogonal_weights"):
        config.callbacks(on_algorithm_init=draw_orthogonal)
    config.debugging(seed=seed, log_level="ERROR")
    return config


class ChosenEpisodes(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Choose how episodes begin: some as one that failed, some with a target that is out of reach.

    When 19 of 20 episodes succeed, only one in twenty shows what is missing: so a share of episodes begins like a
    failed one, until that succeeds or 16 others have failed since. (After Jiang et al., Prioritized level replay, 2021;
    the score here is a failure.) Of the others a share has its target out of reach, by the environment's
    `extreme_options`: the policy can only wait until the time is over.

    The same seed gives the same episode. `info["is_ordinary"]` marks those that are neither.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], *, failed_share: float = 0.0, out_of_reach_share: float = 0.0
    ) -> None:
        """Raise UsageError for an environment without targets out of reach, if a share of episodes needs one."""
        super().__init__(env)
        if out_of_reach_share and not isinstance(env.unwrapped, HasExtremes):
            raise errors.UsageError(f"out_of_reach is {out_of_reach_share}: {env.unwrapped} has no extreme_options")
        self._failed_share, self._out_of_reach_share = failed_share, out_of_reach_share
        self._failed: deque[int] = deque(maxlen=FAILED_KEPT)
        self._rng = np.random.default_rng()
        self._episode, self._is_out_of_reach, self._is_ordinary = 0, False, True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])
            self._failed.clear()
        is_again = bool(self._failed) and self._rng.random() < self._failed_share
        self._episode = self._failed.popleft() if is_again else int(self._rng.integers(2**31))
        share = 0.0 if is_again else self._out_of_reach_share
        self._is_out_of_reach = share > 0 and self._rng.random() < share
        self._is_ordinary = not is_again and not self._is_out_of_reach
        if self._is_out_of_reach:
            env: Any = self.env.unwrapped
            extreme = env.extreme_options("target", np.random.default_rng([self._episode, 1, 1]))
            options = {**extreme, **(options or {})}
        return super().reset(seed=self._episode, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        has_failed = (terminated or truncated) and success_of(info) is False
        if has_failed and not self._is_out_of_reach:  # in which no policy succeeds
            self._failed.append(self._episode)
        return observation, reward, terminated, truncated, {**info, "is_ordinary": self._is_ordinary}


def _chosen_episodes(settings: dict[str, Any]) -> dict[str, float]:
    """Return the shares for ChosenEpisodes. Raises UsageError."""
    shares = {}
    for name, argument in (("failed_again", "failed_share"), ("out_of_reach", "out_of_reach_share")):
        share = shares[argument] = settings.get(name) or 0
        if not isinstance(share, int | float) or not 0 <= share <= 1:
            raise errors.UsageError(f"{name} is {share!r}: expected a share of the episodes, 0 to 1")
    return shares


def _make_chosen(env_id: str, shares: dict[str, float], env_config: dict[str, Any]) -> ChosenEpisodes:
    return ChosenEpisodes(gymnasium.make(env_id, disable_env_checker=True, **env_config), **shares)


class ActionPenaltyLearner(PPOTorchLearner):
    """PPO that also shapes the Gaussian it draws actions from, by these entries of `learner_config_dict`:

    `bounds_loss_coeff`: cost of a mean outside the action's bounds, by the square of its distance. Actions are clipped
    there: with a mean of -2 every draw is clipped to -1, so the policy cannot learn to drive slower. rl_games, which
    trained Isaac Gym's robots, calls it `bounds_loss_coef`.

    `smoothness_loss_coeff`: cost of the mean's step from one observation to the next, by its square. Source: Mysore
    et al., Regularizing action policies for smooth control with reinforcement learning, 2021 (their temporal term).

    `largest_std`: the standard deviations' upper bound over environment steps, `[[0, 1.0], [1000000, 0.2]]`, of a
    network with `free_log_std`. The last part is then trained near the actions that are taken later.
    """

    def build(self) -> None:
        super().build()
        schedule = self.config.learner_config_dict.get("largest_std")
        self._largest_std = None if schedule is None else Scheduler(schedule, framework="torch")

    def compute_loss_for_module(self, *, module_id: str, config: Any, batch: dict[str, Any], fwd_out: Any) -> Any:
        loss = super().compute_loss_for_module(module_id=module_id, config=config, batch=batch, fwd_out=fwd_out)
        mean = _means(fwd_out)
        if coefficient := config.learner_config_dict.get("bounds_loss_coeff"):
            outside = torch.relu(mean.abs() - 1.0)
            loss = loss + coefficient * outside.square().sum(dim=-1).mean()
        if coefficient := config.learner_config_dict.get("smoothness_loss_coeff"):
            after = self.module[module_id].forward_train({Columns.OBS: batch[Columns.NEXT_OBS]})
            step = (_means(after).clamp(-1.0, 1.0) - mean.clamp(-1.0, 1.0))[batch[Columns.LOSS_MASK]]
            loss = loss + coefficient * step.square().sum(dim=-1).mean()
        return loss

    def after_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        super().after_gradient_based_update(timesteps=timesteps)
        if self._largest_std is not None:
            largest = self._largest_std.update(timestep=timesteps[NUM_ENV_STEPS_SAMPLED_LIFETIME])
            network: Any = self.module["default_policy"]
            for name, parameter in network.named_parameters():
                if name.endswith("log_std"):
                    with torch.no_grad():
                        parameter.clamp_(max=math.log(largest))


def _means(outputs: Any) -> torch.Tensor:
    means: torch.Tensor = outputs[Columns.ACTION_DIST_INPUTS].chunk(2, dim=-1)[0]
    return means


def _mean_std_filter(*_: Any) -> MeanStdFilter:
    return MeanStdFilter()


def draw_orthogonal(*, algorithm: Algorithm, **_: Any) -> None:
    """Draw the weights as Stable-Baselines3's PPO does: orthogonal, the policy's last layer small.

    The first actions are then noise around 0, whatever is observed. RLlib (2.60) has no setting for the weights of its
    heads. Source: Andrychowicz et al., What matters for on-policy deep actor-critic methods, 2021, section 3.2.
    """

    def draw(learner: Any, *_: Any) -> None:
        for name, layer in learner.module["default_policy"].named_modules():
            if isinstance(layer, torch.nn.Linear):
                torch.nn.init.orthogonal_(layer.weight, GAINS[name.partition(".")[0]])
                torch.nn.init.zeros_(layer.bias)

    learners, runners = algorithm.learner_group, algorithm.env_runner_group
    assert learners is not None and runners is not None
    learners.foreach_learner(draw)
    runners.sync_weights(from_worker_or_learner_group=learners, inference_only=True)


def log_episode(*, episode: Any, metrics_logger: Any, prev_episode_chunks: Any = None, **_: Any) -> None:
    # Sums: RLlib's own means and windows cover one iteration's episodes, which may be few or many.
    chunks = [*(prev_episode_chunks or ()), episode]  # an episode is cut at the end of a sampling phase
    total, length = sum(chunk.get_return() for chunk in chunks), sum(map(len, chunks))
    info = episode.get_infos(-1) or {}
    if not info.get("is_ordinary", True):
        return  # the curve counts only the episodes that the environment draws
    outcome = success_of(info)
    for key, value in zip(SUMS, (1, outcome is not None, total, length, bool(outcome)), strict=True):
        metrics_logger.log_value(("shipped", key), float(value), reduce="sum")


@dataclass
class Validation:
    """Choice of the best checkpoint, judged as in the cards: exported, without exploration, on its own seeds."""

    episodes: int
    seed: int
    env_steps: int  # from one to the next
    above: float  # training success below which validation is not worth the time
    _next: int = 0

    def is_due(self, row: Row) -> bool:
        if row.env_steps < self._next or row.success < self.above:
            return False
        self._next = row.env_steps + self.env_steps
        return True

    def success(self, algorithm: Training, settings: dict[str, Any]) -> float:
        """Return the share of successes, over all that the settings evaluate."""
        with tempfile.TemporaryDirectory() as folder:
            checkpoint = Path(folder) / "checkpoint"
            algorithm.save_to_path(str(checkpoint))
            bundle = export_checkpoint(checkpoint, Path(folder), name="candidate", notify=lambda line: None)
            with Policy.load(bundle.path) as policy:
                evaluations = evaluate_shipped.evaluate(policy, settings, self.episodes, self.seed)
        for one in evaluations:
            endings = ", ".join(f"{count} {status}" for status, count in sorted(one.endings.items()))
            succeeded = f"{one.successes} of {one.episodes} episodes succeeded"
            print(f"exported, {one.start}: {succeeded} ({endings})", flush=True)
        return sum(one.successes or 0 for one in evaluations) / sum(one.episodes for one in evaluations)


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a YAML file. Raises UsageError for a file that has none."""
    try:
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise errors.UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise errors.UsageError(f"{path}: not YAML: {error}") from error
    missing = [name for name in NEEDED if not isinstance(settings, dict) or name not in settings]
    if missing:
        raise errors.UsageError(f"{path}: has no {missing[0]}; {SHIPPED}/*/training.yaml are examples")
    return cast("dict[str, Any]", settings)


def change_settings(settings: dict[str, Any], changes: list[str]) -> None:
    """Apply each `a.b=value` (YAML) to the settings. Raises ValueError for a setting that does not exist."""
    for change in changes:
        key, equals, value = change.partition("=")
        *parents, last = key.split(".")
        where: Any = settings
        for parent in parents:
            where = where.get(parent) if isinstance(where, dict) else None
        if not equals or not isinstance(where, dict) or last not in where:
            raise ValueError(
                f"--set {change}: expected KEY=VALUE with a key that training.yaml has, such as stop.env_steps=20000"
            )
        where[last] = yaml.safe_load(value)


def cpu_seconds() -> float:
    """Return the processor time of this process and of those it started that have ended [s]."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def iterations(algorithm: Algorithm, window: int) -> Iterator[Row]:
    """Train without end, one row after each iteration; means are of the last `window` episodes or a few more."""
    began, cpu_before, episodes = time.monotonic(), cpu_seconds(), 0
    recent: deque[dict[str, float]] = deque()
    while True:
        result = iterate(algorithm)
        sums = {key: float(value) for key, value in result["env_runners"].get("shipped", {}).items()}
        if sums.get("episodes", 0.0) > 0.0:  # RLlib gives NaN if no episode ended
            episodes += int(sums["episodes"])
            recent.append(sums)
            while sum(one["episodes"] for one in recent) - recent[0]["episodes"] >= window:
                recent.popleft()
        count, judgements, total, length, successes = (sum(one[key] for one in recent) for key in SUMS)
        yield Row(
            env_steps=int(result["num_env_steps_sampled_lifetime"]),
            episodes=episodes,
            mean_return=total / count if count else float("nan"),
            mean_length=length / count if count else float("nan"),
            success=successes / judgements if judgements else float("nan"),
            wall_s=time.monotonic() - began,
            cpu_s=cpu_seconds() - cpu_before,
            trained_steps=failures.metric(result, failures.TRAINED),
        )


@dataclass(frozen=True)
class Beginning:
    """The network that training begins with, and the observed elements that it must forget."""

    checkpoint: Path
    forgotten: tuple[str, ...] = ()

    def apply(self, algorithm: Algorithm, settings: dict[str, Any]) -> None:
        """Load the network and its observation filter.

        An element that never moved in the first training (a fixed joint's velocity) was divided by next to nothing: the
        network's weights on it mean nothing, and disturb it as soon as the element moves. A forgotten element begins
        with weights of 0 and a spread of 1. Raises UsageError for an element that the environment does not have.
        """
        learners, runners = algorithm.learner_group, algorithm.env_runner_group
        assert learners is not None and runners is not None
        runner: Any = algorithm.env_runner  # its pipeline has no public name, and EnvRunner does not declare it
        root = self.checkpoint.resolve()
        learners.restore_from_path(str(root / MODULE), component=MODULE.removeprefix("learner_group/"))
        runner.restore_from_path(str(root / "env_runner" / FILTER), component=FILTER)
        if self.forgotten:
            columns, count = _columns(settings, self.forgotten)
            learners.foreach_learner(lambda learner, *_: _forget(learner, columns, count))
            for connector in runner._env_to_module:
                if isinstance(connector, MeanStdFilter):
                    connector.set_state(_with_spread_of_one(connector.get_state(), columns))
        runners.sync_weights(from_worker_or_learner_group=learners, inference_only=True)


def _with_spread_of_one(state: dict[str, Any], columns: list[int]) -> dict[str, Any]:
    for agent in state.values():
        stats = [RunningStat.from_state(one) for one in agent["running_stats"]]
        for one in stats:
            one.mean_array[columns] = 0.0
            one.sum_sq_diff_array[columns] = one.num_pushes
        agent["running_stats"] = [one.to_state() for one in stats]
    return state


def _columns(settings: dict[str, Any], names: tuple[str, ...]) -> tuple[list[int], int]:
    env: Any = gymnasium.make(settings["env"], disable_env_checker=True, **settings.get("env_config", {}))
    known = [element["name"] for element in env.unwrapped.describe()["observation"]]
    env.close()
    unknown = [name for name in names if name not in known]
    if unknown:
        raise errors.UsageError(f"observed element {unknown[0]}: expected some of {', '.join(known)}")
    return [known.index(name) for name in names], len(known)


def _forget(learner: Any, columns: list[int], count: int) -> None:
    with torch.no_grad():
        for name, weight in learner.module["default_policy"].named_parameters():
            if name.endswith("mlp.0.weight") and weight.ndim == 2 and weight.shape[1] == count:
                weight[:, columns] = 0.0


def _imitate(algorithm: Algorithm, settings: dict[str, Any]) -> None:
    """Fit the policy to its environment's solution, from the elements that decide it alone. Raises UsageError."""
    learners, runners = algorithm.learner_group, algorithm.env_runner_group
    assert learners is not None and runners is not None
    began, imitation = time.monotonic(), Imitation(**settings["imitate"])
    seen, count = _columns(settings, tuple(imitation.of))
    unseen = [column for column in range(count) if column not in seen]

    def fit(learner: Any, *_: Any) -> None:
        _forget(learner, unseen, count)
        error = fit_to_solution(learner.module["default_policy"], imitation, settings, seen)
        print(
            f"the solution imitated to {error:.4f} (root mean square) in {time.monotonic() - began:.0f} s", flush=True
        )

    learners.foreach_learner(fit)
    runners.sync_weights(from_worker_or_learner_group=learners, inference_only=True)


class Training(Protocol):
    """What trains: RLlib's Algorithm, or an `RslRlRun`."""

    def save_to_path(self, path: str) -> Any: ...
    def stop(self) -> None: ...


def train(algorithm: Training, lines: Iterator[Row], settings: dict[str, Any], folder: Path) -> list[Row]:
    """Train until the stop metric or the steps are reached; leave `folder/checkpoint` (the best) and `curve.csv`."""
    stop = settings["stop"]
    validation = Validation(**settings["validation"]) if "validation" in settings else None
    rows: list[Row] = []
    best, reached_milestone = float("-inf"), False
    checkpoint = folder / "checkpoint"
    try:
        with (folder / "curve.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(CURVE)
            for row in lines:
                rows.append(row)
                writer.writerow(
                    [row.env_steps, row.episodes, f"{row.mean_return:.4g}", f"{row.mean_length:.1f}",
                     f"{row.success:.4f}", f"{row.wall_s:.0f}", f"{row.cpu_s:.0f}"]
                )  # fmt: skip
                file.flush()
                print(
                    f"steps {row.env_steps:>10,} of {stop['env_steps']:,}  return {row.mean_return:9.3f}  "
                    f"length {row.mean_length:6.1f}  success {row.success:6.1%}  "
                    f"wall {row.wall_s:6.0f} s  CPU {row.cpu_s:6.0f} s",
                    flush=True,
                )
                is_full = row.episodes >= stop["episodes"]
                if is_full and not reached_milestone and row.success >= MILESTONE:
                    reached_milestone = True
                    print(
                        f"{MILESTONE:.0%} success over {stop['episodes']} training episodes after {row.env_steps:,} "
                        f"steps, {row.wall_s:.0f} s ({row.cpu_s:.0f} s of processor time)"
                    )
                value = getattr(row, stop["metric"])
                if validation is not None:
                    if not is_full or not validation.is_due(row):
                        value = float("-inf")
                    else:
                        value = validation.success(algorithm, settings)
                if is_full and value > best and row.trained_steps > 0:
                    best = value
                    algorithm.save_to_path(str(checkpoint.resolve()))
                if (is_full and value >= stop["value"]) or row.env_steps >= stop["env_steps"]:
                    break
    except KeyboardInterrupt:
        print("interrupted: the results so far are kept")
    finally:
        has_learned = bool(rows) and rows[-1].trained_steps > 0
        if best == float("-inf") and has_learned:  # too short for a first mean: a checkpoint nevertheless
            algorithm.save_to_path(str(checkpoint.resolve()))
        algorithm.stop()
    if not has_learned:
        steps = rows[-1].env_steps if rows else 0
        raise errors.RlservoError(f"nothing was learned: {failures.nothing_learned(steps)}")
    return rows


def train_rllib(settings: dict[str, Any], folder: Path, beginning: Beginning | None) -> list[Row]:
    # Checkpoints hold functions of this file. Pickled by value, they load without it.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    config = algorithm_config(settings, settings["seed"])  # wrong settings are reported before Ray starts
    with ray_session(num_cpus=1):
        algorithm = build(config)
        if beginning is not None:
            beginning.apply(algorithm, settings)
        if "imitate" in settings:
            _imitate(algorithm, settings)
        return train(algorithm, iterations(algorithm, settings["stop"]["episodes"]), settings, folder)


def draw(rows: list[Row], title: str, path: Path) -> None:
    """Draw return, and success if the environment reports it, over environment steps."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, left = pyplot.subplots(figsize=(5, 2.8), layout="constrained")
    steps = [row.env_steps for row in rows]
    left.plot(steps, [row.mean_return for row in rows], color="tab:blue", linewidth=1)
    left.set_xlabel("environment steps")
    left.set_ylabel("mean return", color="tab:blue")
    if any(row.success == row.success for row in rows):
        right = left.twinx()
        right.plot(steps, [100 * row.success for row in rows], color="tab:orange", linewidth=1)
        right.set_ylabel("success [%]", color="tab:orange")
        right.set_ylim(0, 102)
    left.set_title(title, fontsize=9)
    figure.savefig(path, dpi=80)
    pyplot.close(figure)


def install(name: str, folder: Path) -> None:
    """Replace the shipped checkpoint and curve with those of `folder`."""
    from rlservo.export.prune_checkpoint import prune_checkpoint

    small = folder / "pruned"
    shutil.rmtree(small, ignore_errors=True)
    if (folder / "checkpoint" / "params").is_dir():  # rsl_rl's, of which only the actor was saved
        shutil.copytree(folder / "checkpoint", small)
        for old in (SHIPPED / name).glob("model_*.pt"):
            old.unlink()
    else:
        prune_checkpoint(folder / "checkpoint", small, notify=print)
    shutil.copytree(small, SHIPPED / name, dirs_exist_ok=True)
    for curve in ("curve.csv", "curve.png"):
        shutil.copyfile(folder / curve, SHIPPED / name / curve)


def main() -> None:
    names = sorted(path.parent.name for path in SHIPPED.glob("*/training.yaml"))
    parser = argparse.ArgumentParser(description="Retrain one of the shipped policies.")
    parser.add_argument("name", choices=names)
    parser.add_argument("--seed", type=int, help="seed, instead of the one in training.yaml")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="changes",
        help="change a setting of training.yaml for this run, such as stop.env_steps=20000 or model.use_lstm=false",
    )  # fmt: skip
    parser.add_argument("--settings", type=Path, help="a file of your own instead of the policy's training.yaml")
    parser.add_argument("--storage", type=Path, default=Path("runs"), help="folder for checkpoint and curve")
    parser.add_argument("--install", action="store_true", help="replace the shipped checkpoint and curve")
    args = parser.parse_args()
    settings = read_settings(args.settings or SHIPPED / args.name / "training.yaml")
    try:
        change_settings(settings, args.changes)
    except ValueError as error:
        parser.error(str(error))
    begin = settings.get("begin")  # {with: the name of a policy that ships, forget: [observed elements]}
    beginning = None if begin is None else Beginning(SHIPPED / begin["with"], tuple(begin.get("forget", ())))
    seed = settings["seed"] = settings["seed"] if args.seed is None else args.seed
    folder = args.storage / args.name
    folder.mkdir(parents=True, exist_ok=True)

    torch.set_num_threads(1)
    if settings.get("trainer") == "rsl_rl":
        from shared.rsl_rl_training import RslRlRun

        run = RslRlRun(settings, SHIPPED / args.name)
        with sigterm_as_ctrl_c():
            rows = train(run, (Row(*line) for line in run.iterations(settings["stop"]["episodes"])), settings, folder)
    else:
        rows = train_rllib(settings, folder, beginning)
    draw(rows, f"{args.name}, {settings['algorithm']}, seed {seed}", folder / "curve.png")
    print(f"best checkpoint: {folder / 'checkpoint'}")
    if args.install:
        install(args.name, folder)


if __name__ == "__main__":
    main_with_sentences(main, __file__)
