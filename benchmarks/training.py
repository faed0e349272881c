"""How fast training goes, and where its time goes: env runners x environments each, the learner included.

    python benchmarks/training.py                 # 1 and 2 runners, 1 to 16 environments, UR5
    python benchmarks/training.py --env CartPole-v1 --iterations 5

Prints a table and writes `bench/training.json` and `bench/training.png`. Each row is the median of `--iterations`
iterations after one of warm-up: PPO as the UR5 script trains it, a batch of `--batch` steps, 4 epochs. `--vectorised`
measures the same with Gymnasium's AsyncVectorEnv (a process per simulator), and MuJoCo alone: stepping substep by
substep (as our simulators do), in one call, and many robots on MuJoCo's own threads (`mujoco.rollout`).
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import training_run

UR5 = "rlservo/EndEffectorPositioningURSim-v0"


@dataclass(frozen=True)
class Row:
    """One configuration's medians per iteration; the parts of a runner are its means, and fit into `sample_s`."""

    runners: int
    envs: int
    vectorize: str
    steps_per_s: float
    steps_per_cpu_s: (
        float  # the driver's and the runners' processor time together: what a busy machine leaves comparable
    )
    iteration_s: float
    sample_s: float  # waiting for the runners (RLlib's own timer, smoothed over iterations, as the next ones)
    learn_s: float
    rest_s: float  # sending weights and filters, results, evaluation
    env_step_share: float  # of a runner's sampling: the simulators
    inference_share: float  # the network
    connectors_share: float  # RLlib's pipelines before and after the network


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default=UR5)
    parser.add_argument("--runners", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--batch", type=int, default=4096, help="environment steps an iteration")
    parser.add_argument("--vectorised", action="store_true", help="also the other ways to step several simulators")
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    print(f"PPO on {args.env}, {args.batch:,} steps an iteration, median of {args.iterations}\n{HEADER}")
    with training_run.ray_session(num_cpus=max(args.runners) + 1):
        for runners in args.runners:
            for envs in args.envs:
                rows.append(measure(args.env, runners, envs, "sync", args.iterations, args.batch))
                print(line(rows[-1]), flush=True)
        if args.vectorised:
            rows.append(measure(args.env, 1, 2, "async", args.iterations, args.batch))
            print(line(rows[-1]), flush=True)
    physics = measure_physics() if args.vectorised else []
    for name, rate in physics:
        print(f"{name:52} {rate:>10,.0f} substeps/s")
    document = {"env": args.env, "rows": [asdict(row) for row in rows], "physics": dict(physics)}
    (args.out / "training.json").write_text(json.dumps(document, indent=2) + "\n")
    plot(rows, args.env, args.out / "training.png")
    print(f"written: {args.out / 'training.json'}, {args.out / 'training.png'}")


COLUMNS = ("runners x envs", "steps/s", "per CPU s", "iteration", "sampling", "learning", "rest")
HEADER = " ".join(f"{column:>14}" for column in COLUMNS) + "   of sampling: env, network, connectors"


def line(row: Row) -> str:
    name = f"{row.runners} x {row.envs}" + (f" {row.vectorize}" if row.vectorize != "sync" else "")
    seconds = (row.iteration_s, row.sample_s, row.learn_s, row.rest_s)
    cells = [name, f"{row.steps_per_s:,.0f}", f"{row.steps_per_cpu_s:,.0f}", *(f"{one:.2f} s" for one in seconds)]
    shares = f"{row.env_step_share:.0%}, {row.inference_share:.0%}, {row.connectors_share:.0%}"
    return " ".join(f"{cell:>14}" for cell in cells) + f"   {shares}"


def measure(env: str, runners: int, envs: int, vectorize: str, iterations: int, batch: int) -> Row:
    """Train a few iterations and return the medians."""
    from ray.rllib.algorithms.ppo import PPOConfig

    config = training_run.default_config("PPO")
    assert isinstance(config, PPOConfig)
    config.environment(env, env_config={"rs_state_to_info": False} if env.startswith("rlservo/") else {})
    config.env_runners(
        num_env_runners=runners,
        num_envs_per_env_runner=envs,
        gym_env_vectorize_mode=cast(Any, vectorize),  # its annotation names the old strings only
    )
    config.training(train_batch_size_per_learner=batch, minibatch_size=512, num_epochs=4)
    config.rl_module(model_config={"fcnet_hiddens": [256, 256], "fcnet_activation": "tanh", "vf_share_layers": False})
    config.debugging(seed=0)
    with training_run.built(config.build_algo()) as algorithm:
        algorithm.train()
        taken: list[tuple[float, float, float, float, float]] = []
        shares: list[dict[str, float]] = []
        sampled = 0.0
        for _ in range(iterations):
            began, cpu = time.perf_counter(), cpu_seconds(algorithm)
            before = sampled
            result = algorithm.train()
            wall, cpu = time.perf_counter() - began, cpu_seconds(algorithm) - cpu
            sampled = float(result[training_run.STEPS])
            timers = result["timers"]
            steps = sampled - before if before else float(result["env_runners"]["num_env_steps_sampled"])
            taken.append(
                (steps / wall, steps / cpu, wall, timers["env_runner_sampling_timer"], timers["learner_update_timer"])
            )
            shares.append(parts(result))
    rate, per_cpu, wall, sample, learn = (statistics.median(column) for column in zip(*taken, strict=True))
    env_share, network, connectors = (statistics.median(one[name] for one in shares) for name in shares[0])
    rest = max(0.0, wall - sample - learn)
    return Row(runners, envs, vectorize, rate, per_cpu, wall, sample, learn, rest, env_share, network, connectors)


def cpu_seconds(algorithm: Any) -> float:
    """Return the processor time of the driver, which learns, and of its env runners so far."""
    runners = algorithm.env_runner_group.foreach_env_runner(lambda _: time.process_time(), local_env_runner=False)
    return time.process_time() + float(sum(runners))


def parts(result: dict[str, Any]) -> dict[str, float]:
    """Return the shares of a runner's own time: its simulators, network and pipelines."""
    runner = result["env_runners"]
    pipelines = sum(
        float(runner[name]["connector_pipeline_timer"])
        for name in ("env_to_module_connector", "module_to_env_connector")
    )
    each = {
        "env_step_timer": float(runner["env_step_timer"]),
        "rlmodule_inference_timer": float(runner["rlmodule_inference_timer"]),
        "connectors": pipelines,
    }
    total = sum(each.values())
    return {name: seconds / total for name, seconds in each.items()}


def measure_physics(seconds: float = 2.0) -> list[tuple[str, float]]:
    """Return substeps per second of the UR5's model, by way of stepping it."""
    import gymnasium as gym
    import mujoco
    import numpy as np
    from mujoco import rollout

    env = cast(Any, gym.make(UR5, disable_env_checker=True).unwrapped)
    env.reset(seed=0)
    model, data = env.simulation.model, env.simulation.data
    block = 200
    found = []

    def rate(work: Any, substeps: int) -> float:
        count, began = 0, time.perf_counter()
        while time.perf_counter() - began < seconds:
            work()
            count += substeps
        return count / (time.perf_counter() - began)

    def one_by_one() -> None:
        for _ in range(block):
            mujoco.mj_step(model, data)

    found.append(("mj_step, one at a time from Python", rate(one_by_one, block)))
    found.append(("mj_step, 200 in one call", rate(lambda: mujoco.mj_step(model, data, nstep=block), block)))
    robots = 8
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros(size)
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.tile(state, (robots, 1))
    control = np.zeros((robots, block, model.nu))
    for threads in (1, 2):
        datas = [mujoco.MjData(model) for _ in range(threads)]
        with rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
            many = rate(lambda pool=pool, datas=datas: pool.rollout(model, datas, states, control), robots * block)
        found.append((f"mujoco.rollout, 8 robots on {threads} thread{'s' if threads > 1 else ''}", many))
    env.close()
    return found


def plot(rows: list[Row], env: str, path: Path) -> None:
    """Draw steps/s over environments per runner, a line per number of runners."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    for runners in sorted({row.runners for row in rows}):
        own = [row for row in rows if row.runners == runners and row.vectorize == "sync"]
        axes.plot([row.envs for row in own], [row.steps_per_s for row in own], marker="o", label=f"{runners} runners")
    axes.set_xscale("log", base=2)
    axes.set(
        xlabel="environments per env runner", ylabel="environment steps/s, learner included", title=f"PPO on {env}"
    )
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
