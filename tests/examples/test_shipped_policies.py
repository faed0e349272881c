"""The policies that ship: each exports, acts through Policy as well as its card says, and can be trained again.

Seeds here are neither those of training nor those of the cards. The required number of successes follows from the card:
a policy as good as the card's lower confidence bound falls below it once in ten thousand times.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
import yaml

from bundles import EXPORTED_WITH, PRODUCT
from cache import cached, versions
from rlservo import errors, export_checkpoint
from rlservo.bundle.environment_id import plain_id
from rlservo.policy.policy import Policy

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SHIPPED = EXAMPLES / "checkpoints"
NAMES = sorted(path.parent.name for path in SHIPPED.glob("*/training.yaml"))
SEED = 700_000
ONCE_IN = 10_000
RUN_WITH = f"{EXPORTED_WITH} {versions('mujoco')}"
LARGEST = 750_000  # bytes of a folder


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


evaluate_shipped = load("evaluate_shipped")


@pytest.fixture(scope="module")
def bundles(all_shipped: Path) -> dict[str, Path]:
    """Every shipped checkpoint, exported by today's code: that alone proves that the file acts as RLlib does."""
    return {name: all_shipped / name / "1" for name in NAMES}


def evaluated(name: str, bundle: Path, episodes: int, acting: Callable[[Policy], Any] | None = None) -> list[Any]:
    """Return what an evaluation of a policy came to, with `acting` of it: kept while nothing that it runs changes."""

    def evaluate(folder: Path) -> None:
        with Policy.load(bundle) as policy:
            settings = evaluate_shipped.load_settings(name)
            measured = evaluate_shipped.evaluate(acting(policy) if acting else policy, settings, episodes, SEED)
        (folder / "evaluation.json").write_text(json.dumps([dataclasses.asdict(one) for one in measured]))

    code = [EXAMPLES / "evaluate_shipped.py", EXAMPLES / "shared", Path(__file__), *PRODUCT, RUN_WITH]
    how = [SHIPPED / name, str(episodes), acting.__name__ if acting else "as it is"]
    kept = cached(f"evaluated-{name}", [*how, *code], evaluate) / "evaluation.json"
    return [evaluate_shipped.Evaluation(**one) for one in json.loads(kept.read_text())]


def episodes_of(name: str) -> int:
    """An episode of CartPole is 500 steps; a card of many rows gets few in each, which are judged together too."""
    rows = len(evaluate_shipped.load_settings(name)["evaluation"])
    return 20 if name == "cartpole_dqn" else min(40, 120 // rows)


def fewest_successes(rate: float, episodes: int) -> int:
    """The fewest successes that a policy of this rate stays below less than once in `ONCE_IN` times."""
    below = 0.0
    for successes in range(episodes + 1):
        below += math.comb(episodes, successes) * rate**successes * (1.0 - rate) ** (episodes - successes)
        if below > 1.0 / ONCE_IN:
            return successes
    return episodes


def card_figures(name: str) -> list[dict[str, Any]]:
    figures: list[dict[str, Any]] = json.loads((SHIPPED / name / "evaluation.json").read_text(encoding="utf-8"))
    return figures


def test_these_policies_ship() -> None:
    assert NAMES == [
        "cartpole_dqn",
        "mir100_navigation",
        "mir100_obstacle_avoidance",
        "mir100_obstacle_avoidance_waiting",
        "mir100_sparse_fixes",
        "panda_positioning",
        "pendulum_sac",
        "ur10_isaac_reach",
        "ur10e_isaac_deploy_reach",
        "ur5_positioning",
        "ur5_positioning_disturbed",
        "ur_positioning",
    ]


@pytest.mark.parametrize(
    ("rate", "episodes", "expected"),
    [(1.0, 40, 40), (0.5, 1, 0), (0.9, 40, 28), (0.93, 100, 82)],  # the last two: scipy.stats.binom.ppf(1e-4, ...)
)
def test_threshold_is_the_binomial_quantile(rate: float, episodes: int, expected: int) -> None:
    assert fewest_successes(rate, episodes) == expected


@pytest.mark.parametrize("name", NAMES)
def test_each_acts_as_well_as_its_card_says(name: str, bundles: dict[str, Path]) -> None:
    episodes = episodes_of(name)
    measured = evaluated(name, bundles[name], episodes)
    for ours, card in zip(measured, card_figures(name), strict=True):
        if card["successes"] is not None:
            assert ours.successes >= fewest_successes(card["success_interval"][0], episodes), ours
        else:
            low, high = card["return_interval"]
            deviation = (high - low) / (2 * 1.96) * math.sqrt(card["episodes"])
            assert ours.mean_return >= low - 3.72 * deviation / math.sqrt(episodes), ours  # 1e-4 of a normal
    bounds = [card["success_interval"][0] for card in card_figures(name) if card["successes"] is not None]
    if bounds:
        successes = sum(ours.successes for ours in measured)
        assert successes >= fewest_successes(sum(bounds) / len(bounds), episodes * len(bounds)), measured


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # RLlib registers all its algorithms, with environments of theirs
def test_each_can_be_trained_from_its_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

    monkeypatch.syspath_prepend(EXAMPLES)
    train_shipped = load("train_shipped")
    for name in NAMES:
        settings = evaluate_shipped.load_settings(name) | {"envs": 1}
        if "trainer" in settings:
            continue
        runner = SingleAgentEnvRunner(config=train_shipped.algorithm_config(settings, 0), worker_index=0)
        assert sum(map(len, runner.sample(num_timesteps=2, explore=False))) == 2, name
        runner.stop()


@pytest.mark.slow
def test_a_training_with_rsl_rl_leaves_a_run_that_exports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("rsl_rl")
    monkeypatch.syspath_prepend(EXAMPLES)
    name = "ur10e_isaac_deploy_reach"
    few = {"episodes": 4, "updates": 300, "rate": 0.002, "gain": 8.0, "largest": 1.5}
    settings = evaluate_shipped.load_settings(name) | {"envs": 1, "imitate": few}
    training = importlib.import_module("shared.rsl_rl_training")
    monkeypatch.setattr(training, "NORMALIZED", 5000)
    run = training.RslRlRun(settings, SHIPPED / name)
    steps, *_ = next(run.iterations(1))
    run.save_to_path(str(tmp_path / "run"))
    run.stop()
    exported = export_checkpoint(tmp_path / "run", tmp_path, name="reach", notify=lambda line: None)
    assert exported.contract.provenance.env_steps == steps == 128
    with Policy.load(exported.path) as policy:
        start = np.array([math.pi, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0, *[0.0] * 6])
        seen = [*start, 0.9, -0.2, 0.2, 0.7, -0.7, 0.0, 0.0]
        assert 0.0 < np.abs(policy.act(np.array(seen, np.float32)) - start[:6]).max() < 1.0


def test_the_recurrent_policy_needs_its_memory(bundles: dict[str, Path]) -> None:
    class Forgetful:
        """The same policy, its state thrown away before every action."""

        def __init__(self, policy: Policy) -> None:
            self.policy, self.contract = policy, policy.contract

        def reset(self) -> None:
            self.policy.reset()

        def act(self, obs: Any, **arguments: Any) -> Any:
            self.policy.reset()
            return self.policy.act(obs, **arguments)

    name = "mir100_sparse_fixes"
    (remembering,) = evaluated(name, bundles[name], episodes_of(name))  # the card's test has it, too
    (forgetting,) = evaluated(name, bundles[name], 20, Forgetful)
    assert remembering.successes / remembering.episodes > (forgetting.successes + 5) / forgetting.episodes
    assert remembering.mean_return > forgetting.mean_return


@pytest.mark.parametrize("name", NAMES)
def test_each_card_states_what_was_measured(name: str) -> None:
    folder = SHIPPED / name
    card = (folder / "README.md").read_text(encoding="utf-8")
    figures = [evaluate_shipped.Evaluation(**one) for one in card_figures(name)]
    table = card.partition(evaluate_shipped.BEGIN)[2].partition(evaluate_shipped.END)[0].strip()
    assert table == evaluate_shipped.render(figures)
    ((episodes, seed),) = {(one.episodes, one.seed) for one in figures}
    assert episodes == evaluate_shipped.EPISODES
    assert f"seeds {seed} to {seed + episodes - 1}" in card
    assert seed == evaluate_shipped.SEED or f"python examples/evaluate_shipped.py {name} --seed {seed}" in card
    for part in ("## Training", "## Failure modes", "](curve.png)", "```sh\npython examples/"):
        assert part in card, part


@pytest.mark.parametrize("name", NAMES)
def test_each_folder_is_small_and_complete(name: str) -> None:
    folder = SHIPPED / name
    assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) < LARGEST
    facts = json.loads((folder / "rlservo_facts.json").read_text(encoding="utf-8"))
    settings = yaml.safe_load((folder / "training.yaml").read_text(encoding="utf-8"))
    assert (facts["algorithm"], facts["env_id"]) == (settings["algorithm"], plain_id(settings["env"]))
    curve = (folder / "curve.csv").read_text(encoding="utf-8").splitlines()
    assert curve[0] == "env_steps,episodes,mean_return,mean_length,success,wall_s,cpu_s"
    steps = [int(line.split(",")[0]) for line in curve[1:]]
    assert steps == sorted(steps)
    assert facts["env_steps"] in steps  # the checkpoint is of this run
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_training_again_leaves_a_curve_and_a_checkpoint_that_exports(
    trained: Any, run_here: Any, tmp_path: Path
) -> None:
    done = trained("again").ended
    assert done.code == 0, done.out + done.err
    run = trained("again").folder / "runs" / "cartpole_dqn"
    assert len((run / "curve.csv").read_text().splitlines()) == 3  # 300 steps an iteration
    assert (run / "curve.png").exists()
    arguments = ("cartpole_dqn", "--checkpoint", str(run / "checkpoint"), "--episodes", "3")
    measured = run_here("evaluate_shipped.py", *arguments, home=tmp_path)
    assert measured.code == 0, measured.err
    assert "| anywhere | 3 |" in measured.out


@pytest.mark.slow
def test_checkpoints_are_judged_as_the_cards_do_where_the_settings_ask_for_it(trained: Any) -> None:
    done = trained("judged").ended
    assert done.code == 0, done.out + done.err
    judged = [line.partition(":")[0] for line in done.out.splitlines() if " of 2 episodes succeeded" in line]
    assert judged == ["exported, anywhere", "exported, anywhere, disturbed"]  # once: next in 80,000 steps
    run = trained("judged").folder / "runs" / "mir100_obstacle_avoidance"
    assert len((run / "curve.csv").read_text().splitlines()) == 4  # 1,024 steps an iteration
    assert (run / "checkpoint" / "rllib_checkpoint.json").exists()


@pytest.mark.slow
def test_what_becomes_of_distances_and_direction_is_part_of_the_checkpoint(trained: Any, tmp_path: Path) -> None:
    checkpoint = trained("judged").folder / "runs" / "mir100_obstacle_avoidance" / "checkpoint"
    contract = export_checkpoint(checkpoint, tmp_path, name="mir", notify=lambda line: None).contract
    assert [step.step for step in contract.baked_in][:3] == ["logarithm", "sine_and_cosine", "mean_std_filter"]
    assert contract.baked_in[0].values["elements"] == list(range(4, 20))
    assert contract.baked_in[1].values["elements"] == [1]


@pytest.fixture
def penalties(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Makes a learner with such settings, whose loss without them is 1, and whose network gives fixed outputs."""
    monkeypatch.syspath_prepend(EXAMPLES)
    train_shipped = load("train_shipped")
    base = train_shipped.PPOTorchLearner
    monkeypatch.setattr(base, "compute_loss_for_module", lambda *_, **__: torch.tensor(1.0))
    monkeypatch.setattr(base, "build", lambda self: None)
    monkeypatch.setattr(base, "after_gradient_based_update", lambda self, *, timesteps: None)

    def make(module: Any = None, **settings: Any) -> Any:
        learner = object.__new__(train_shipped.ActionPenaltyLearner)
        learner.config = SimpleNamespace(learner_config_dict=settings)
        monkeypatch.setattr(train_shipped.ActionPenaltyLearner, "module", {"default_policy": module})
        learner.build()
        return learner

    return make


def loss_of(learner: Any, inputs: list[list[float]], batch: dict[str, Any]) -> float:
    outputs = {"action_dist_inputs": torch.tensor(inputs)}
    loss = learner.compute_loss_for_module(
        module_id="default_policy", config=learner.config, batch=batch, fwd_out=outputs
    )
    return float(loss)


def test_means_outside_the_actions_bounds_cost_what_they_are_outside(penalties: Callable[..., Any]) -> None:
    inputs = [[0.5, -3.0, 9.0, 9.0], [1.5, 1.0, 9.0, 9.0]]  # two means, two log deviations
    learner = penalties(bounds_loss_coeff=0.1)
    assert loss_of(learner, inputs, {}) == pytest.approx(1.0 + 0.1 * (4.0 + 0.25) / 2)


def test_a_step_to_the_next_observations_mean_costs_its_square_within_the_bounds(
    penalties: Callable[..., Any],
) -> None:
    after = torch.tensor([[0.3, -5.0, 9.0, 9.0], [1.0, 1.0, 9.0, 9.0], [-1.0, -1.0, 9.0, 9.0]])
    network = SimpleNamespace(forward_train=lambda batch: {"action_dist_inputs": after + 0.0 * batch["obs"]})
    inputs = [[0.5, -3.0, 9.0, 9.0], [0.0, 1.0, 9.0, 9.0], [1.0, 1.0, 9.0, 9.0]]
    batch = {"new_obs": torch.zeros(3, 1), "loss_mask": torch.tensor([True, True, False])}
    learner = penalties(network, smoothness_loss_coeff=2.0)
    assert loss_of(learner, inputs, batch) == pytest.approx(1.0 + 2.0 * (0.04 + 1.0) / 2)


def test_standard_deviations_stay_below_their_bound_over_the_steps(penalties: Callable[..., Any]) -> None:
    network = torch.nn.Module()
    network.log_std = torch.nn.Parameter(torch.log(torch.tensor([0.9, 0.1])))
    learner = penalties(network, largest_std=[[0, 1.0], [1000, 1.0], [2000, 0.2]])
    for steps, largest in ((500, 0.9), (1500, 0.6), (3000, 0.2)):
        learner.after_gradient_based_update(timesteps={"num_env_steps_sampled_lifetime": steps})
        assert torch.allclose(network.log_std.exp(), torch.tensor([largest, 0.1]))


class OfOneStep(gymnasium.Env[Any, Any]):
    """Ends after a step: in a success but for the first two episodes of an even seed, and out of reach never in one.

    Of the failures those of a seed that 4 divides are collisions, the others have run out of time.
    """

    observation_space, action_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Discrete(2)

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.targets: list[float | None] = []  # of each episode, where it is out of reach

    def extreme_options(self, what: str, rng: np.random.Generator) -> dict[str, Any]:
        return {what: rng.random()}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        assert seed is not None
        self.seeds.append(seed)
        self.targets.append((options or {}).get("target"))
        return 0, {}

    def step(self, _action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
        seed = self.seeds[-1]
        succeeds = self.targets[-1] is None and (seed % 2 == 1 or self.seeds.count(seed) > 2)
        collides = succeeds or seed % 4 == 0
        return 0, 0.0, collides, not collides, {"is_success": succeeds}


def episodes(env: Any, seed: int, count: int = 500) -> tuple[list[int], list[float | None], list[bool]]:
    """Return the seeds of so many episodes, their targets out of reach, and which of them are ordinary."""
    begin = len(env.unwrapped.seeds)
    env.reset(seed=seed)
    ordinary = []
    for _ in range(count):
        ordinary.append(env.step(0)[-1]["is_ordinary"])
        env.reset()
    return env.unwrapped.seeds[begin:-1], env.unwrapped.targets[begin:-1], ordinary


def test_a_share_of_the_episodes_begins_as_one_that_failed_until_it_succeeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    chosen = load("train_shipped").ChosenEpisodes
    env = chosen(OfOneStep(), failed_share=0.3)
    seeds, targets, ordinary = episodes(env, 7)
    for number, (episode, is_ordinary) in enumerate(zip(seeds, ordinary, strict=True)):
        before = seeds[:number].count(episode)
        assert is_ordinary == (before == 0) and before <= (2 if episode % 2 == 0 else 0), number
    assert 300 <= sum(ordinary) <= 400 and max(map(seeds.count, seeds)) == 3
    again = {seed for seed in seeds if seeds.count(seed) > 1}
    assert {seed % 4 for seed in again} == {0, 2}  # those that ran out of time failed as well
    assert episodes(env, 8)[0] != seeds
    env.unwrapped.seeds.clear()
    env.unwrapped.targets.clear()
    assert episodes(env, 7) == (seeds, targets, ordinary)  # whatever was before
    assert all(episodes(chosen(OfOneStep()), 7)[2])


def test_a_share_of_the_others_has_its_target_out_of_reach_and_does_not_come_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    train_shipped = load("train_shipped")
    env = train_shipped.ChosenEpisodes(gymnasium.Wrapper(OfOneStep()), failed_share=0.3, out_of_reach_share=0.2)
    seeds, targets, ordinary = episodes(env, 7, 1000)
    far = [seed for seed, target in zip(seeds, targets, strict=True) if target is not None]
    assert 80 <= len(far) <= 200 and all(seeds.count(seed) == 1 for seed in far)
    assert any(seeds.count(seed) > 1 for seed in seeds)
    for number, (episode, target, is_ordinary) in enumerate(zip(seeds, targets, ordinary, strict=True)):
        assert is_ordinary == (target is None and episode not in seeds[:number])
    env.unwrapped.seeds.clear()
    env.unwrapped.targets.clear()
    assert episodes(env, 7, 1000) == (seeds, targets, ordinary)
    with pytest.raises(errors.UsageError, match=r"out_of_reach is 0\.2: .* has no extreme_options"):
        train_shipped.ChosenEpisodes(gymnasium.make("CartPole-v1"), out_of_reach_share=0.2)


def env_of(config: Any) -> Any:
    """Return the environment that a training with this configuration steps."""
    runner = config.env_runner_cls(config=config.env_runners(num_envs_per_env_runner=1), worker_index=0)
    return runner.env.unwrapped.envs[0]


def wrappers_of(env: Any) -> Iterator[type]:
    while isinstance(env, gymnasium.Wrapper):
        yield type(env)
        env = env.env


@pytest.mark.filterwarnings("ignore::UserWarning")  # of spaces in float64
def test_what_the_settings_say_of_episodes_reaches_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    train_shipped = load("train_shipped")
    settings = evaluate_shipped.load_settings("mir100_obstacle_avoidance")
    env = env_of(train_shipped.algorithm_config({**settings, "failed_again": 0.0, "out_of_reach": 1.0}, 0))
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert observation[0] > 1.0 and abs(env.unwrapped.simulation.target[1]) > 4.0
    with pytest.raises(errors.UsageError, match=r"out_of_reach is -0\.1: expected a share of the episodes, 0 to 1"):
        train_shipped.algorithm_config({**settings, "out_of_reach": -0.1}, 0)
    env = env_of(train_shipped.algorithm_config({**settings, "failed_again": 1.0, "out_of_reach": 0}, 0))
    env.reset(seed=0)
    assert abs(env.unwrapped.simulation.target[1]) < 4.0
    first, ended = env.unwrapped.simulation.target, False
    while not ended:  # it drives backwards until it touches something or runs out of time
        *_, terminated, truncated, info = env.step(np.array([-1.0, 0.3], np.float32))
        ended = terminated or truncated
    assert not info["is_success"] and info["is_ordinary"]
    env.reset()
    assert env.unwrapped.simulation.target == first and not env.step(np.zeros(2, np.float32))[-1]["is_ordinary"]
    env = env_of(train_shipped.algorithm_config({**settings, "failed_again": 0}, 0))  # nothing is left of it
    assert train_shipped.ChosenEpisodes not in wrappers_of(env)


@pytest.mark.parametrize("is_ordinary", [False, True])
def test_the_curve_is_of_the_episodes_that_the_environment_draws(
    monkeypatch: pytest.MonkeyPatch, is_ordinary: bool
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    logged: list[Any] = []
    logger = SimpleNamespace(log_value=lambda key, value, **_: logged.append((key[1], value)))
    info = {"is_success": True, "is_ordinary": is_ordinary}

    class Episode:
        def get_return(self) -> float:
            return 1.5

        def get_infos(self, _at: int) -> dict[str, bool]:
            return info

        def __len__(self) -> int:
            return 3

    load("train_shipped").log_episode(episode=Episode(), metrics_logger=logger)
    wanted = [("episodes", 1.0), ("judged", 1.0), ("return", 1.5), ("length", 3.0), ("success", 1.0)]
    assert logged == (wanted if is_ordinary else [])


@pytest.mark.filterwarnings("ignore::UserWarning")  # of spaces in float64
def test_failed_episodes_come_again_in_that_training_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    train_shipped = load("train_shipped")
    for name, comes_again in (("mir100_obstacle_avoidance", True), ("ur5_positioning_disturbed", False)):
        env = env_of(train_shipped.algorithm_config(evaluate_shipped.load_settings(name), 0))
        assert (train_shipped.ChosenEpisodes in wrappers_of(env)) == comes_again


@pytest.mark.parametrize("ctrl_c", [signal.SIG_IGN, signal.default_int_handler], ids=["ignored", "Python's"])
def test_sigterm_ends_a_training_also_where_a_shell_has_ctrl_c_ignored(
    monkeypatch: pytest.MonkeyPatch, ctrl_c: Any
) -> None:
    """As in a script's background job."""
    monkeypatch.syspath_prepend(EXAMPLES)
    training_run = importlib.import_module("shared.training_run")
    before = signal.signal(signal.SIGINT, ctrl_c)
    try:
        with training_run.sigterm_as_ctrl_c(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, before)


def test_training_begins_with_another_network_without_the_elements_it_shall_forget(trained: Any) -> None:
    done = trained("begun").ended
    assert done.code == 0, done.out + done.err
    weights = "learner_group/learner/rl_module/default_policy/module_state.pkl"
    run = trained("begun").folder / "runs" / "ur5_positioning_disturbed" / "checkpoint"
    before, after = (pickle.loads((root / weights).read_bytes()) for root in (SHIPPED / "ur5_positioning", run))
    wrist_3_velocity = 14
    for name in ("encoder.actor_encoder.net.mlp.0.weight", "encoder.critic_encoder.net.mlp.0.weight"):
        assert np.abs(before[name][:, wrist_3_velocity]).max() > 0.05
        assert np.abs(after[name][:, wrist_3_velocity]).max() < 0.01  # four steps of the optimizer
        others = np.arange(27) != wrist_3_velocity
        assert np.abs(after[name] - before[name])[:, others].max() < 0.01


@pytest.mark.parametrize(
    ("script", "arguments", "sentence"),
    [
        ("train_shipped.py", ("nobody",), "invalid choice: 'nobody'"),
        ("train_shipped.py", ("cartpole_dqn", "--set", "stop.env_step=1"), "expected KEY=VALUE with a key that"),
        ("train_shipped.py", ("cartpole_dqn", "--set", "stop"), "expected KEY=VALUE with a key that"),
        (
            "train_shipped.py",
            ("mir100_obstacle_avoidance", "--set", "logarithm_of=[laser_99]"),
            "observed element laser_99: expected some of target_r, target_theta, ",
        ),
        (
            "train_shipped.py",
            ("mir100_obstacle_avoidance", "--set", "failed_again=1.5"),
            "failed_again is 1.5: expected a share of the episodes, 0 to 1",
        ),
        (
            "train_shipped.py",
            ("mir100_obstacle_avoidance", "--set", "model.free_log_std=false"),
            "largest_std bounds a standard deviation that is not an output: set model.free_log_std=true",
        ),
        ("evaluate_shipped.py", ("nobody",), "no policy 'nobody' ships: expected some of cartpole_dqn"),
        ("evaluate_shipped.py", ("--episodes", "1"), "--episodes is 1 and --seed 20000: expected at least 2 and 0"),
        ("evaluate_shipped.py", ("--checkpoint", "x"), "--checkpoint needs one NAME and no --write"),
    ],
)
def test_wrong_argument_is_refused_in_a_sentence(
    script: str, arguments: tuple[str, ...], sentence: str, tmp_path: Path, run_here: Any
) -> None:
    done = run_here(script, *arguments, home=tmp_path)
    assert done.code == 2
    assert sentence in " ".join(done.err.split())
    assert "Traceback" not in done.err
