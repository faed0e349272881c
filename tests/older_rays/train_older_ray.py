"""Train small checkpoints with an older Ray, and record the actions that this Ray itself computes.

    python train_older_ray.py OUT [NAME...]

writes OUT/<version>.tar.xz: checkpoints `<name>/`, and `<name>.npz` with observations and the actions that reached
`env.step` for them in RLlib's own sampling, exploration off and the filter frozen. It is run by hand in an environment
of that Ray, and imports nothing of ours. With uv, for Ray 2.40 and later, for earlier ones, and for those before 2.4:

    uv venv -p 3.11 ray && uv pip install -p ray/bin/python 'ray[rllib]==2.40.0' torch==2.13.0 'setuptools<81'
    ... 'numpy<2' 'pyarrow<18' 'pandas<2.3'  # up to Ray 2.9 also 'setuptools<70', installed afterwards
    uv venv -p 3.10 ray && uv pip install -p ray/bin/python 'ray[rllib]==2.1.0' torch==1.12.1 'numpy<1.24' \\
        'setuptools<60' 'wheel<0.40' 'pyarrow<18' 'pandas<2' pygame
"""

from __future__ import annotations

import inspect
import shutil
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import older_ray_parts  # pyright: ignore[reportMissingImports]  # beside this script
import ray
from ray.rllib.algorithms.dqn import DQN, DQNConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.utils.filter import RunningStat
from ray.rllib.utils.from_config import from_config
from ray.rllib.utils.replay_buffers import ReplayBuffer
from ray.rllib.utils.typing import ActionConnectorDataType, AgentConnectorDataType

try:
    from gymnasium.envs.classic_control import CartPoleEnv, PendulumEnv
except ImportError:  # Ray before 2.3
    from gym.envs.classic_control import CartPoleEnv, PendulumEnv

VERSION = tuple(int(part) for part in ray.__version__.split(".")[:2])
SMALL = {"fcnet_hiddens": [8, 8]}
RECORDED = 24
CHECKPOINT_FILE = "rllib_checkpoint.json"


def takes(function: Any, name: str) -> bool:
    """Return whether this Ray's function has such a parameter: names have come and gone."""
    return name in inspect.signature(function).parameters


def base(config: Any, env: str, *, new: bool, fragment: int, before: str | None = None, connectors: bool = True) -> Any:
    """Configure what all of them have in common; `before` is a filter."""
    config.framework("torch").environment(env).debugging(seed=1)
    if hasattr(config, "api_stack"):
        config.api_stack(enable_rl_module_and_learner=new, enable_env_runner_and_connector_v2=new)
    runners = config.env_runners if hasattr(config, "env_runners") else config.rollouts
    number = "num_env_runners" if takes(runners, "num_env_runners") else "num_rollout_workers"
    runners(**{number: 0}, rollout_fragment_length=fragment)
    if new:
        runners(**({"env_to_module_connector": older_ray_parts.mean_std_filter} if before else {}))
    else:
        runners(observation_filter=before or "NoFilter")
        if VERSION < (2, 4):  # by default off
            runners(enable_connectors=connectors)
        number = (
            "evaluation_num_env_runners"
            if takes(config.evaluation, "evaluation_num_env_runners")
            else ("evaluation_num_workers")
        )
        config.evaluation(
            evaluation_interval=1000,  # never reached: evaluation happens when it is asked for
            evaluation_duration=2 * RECORDED, evaluation_duration_unit="timesteps",
            evaluation_config={"explore": False}, **{number: 0},
        )  # fmt: skip
    return config.reporting(min_time_s_per_iteration=0, min_sample_timesteps_per_iteration=fragment)


def small(config: Any, new: bool, *parts: str) -> Any:
    """Give a configuration small networks; `parts` are those of the old stack that have sizes of their own."""
    if new and takes(config.rl_module, "model_config"):
        return config.rl_module(model_config=SMALL)
    if new:
        return config.rl_module(model_config_dict=SMALL)
    return config.training(**dict.fromkeys(parts or ["model"], SMALL))


def ppo(new: bool, env: str = "Pendulum-v1", before: str | None = "MeanStdFilter", **more: Any) -> Any:
    config = base(PPOConfig(), env, new=new, before=before, fragment=256, **more)
    prefix = "sgd_" if takes(config.training, "sgd_minibatch_size") else ""
    return small(config.training(train_batch_size=256, **{f"{prefix}minibatch_size": 64}), new)


def lstm(new: bool) -> Any:
    config = ppo(new, "CartPole-v1", None)
    memory = {"fcnet_hiddens": [8], "use_lstm": True, "lstm_cell_size": 8, "max_seq_len": 8}
    if new:
        return config.rl_module(
            **{"model_config" if takes(config.rl_module, "model_config") else "model_config_dict": memory}
        )
    return config.training(model=memory)


def bare(new: bool) -> Any:
    """Policies without connectors, up to Ray 2.3 the default."""
    return ppo(new, connectors=False)


def off_policy(config: Any, env: str, new: bool) -> Any:
    base(config, env, new=new, fragment=16)
    start = "num_steps_sampled_before_learning_starts"
    waiting = {start: 16} if takes(config.training, start) else {}
    kind = "PrioritizedEpisodeReplayBuffer" if new else "MultiAgentPrioritizedReplayBuffer"
    buffer = {"type": kind, "capacity": 200, **({} if waiting else {"learning_starts": 16})}
    if new:
        buffer.update(alpha=0.6, beta=0.4)  # Ray 2.35 has no defaults for them
    return config.training(train_batch_size=16, replay_buffer_config=buffer, **waiting)


def dqn(new: bool) -> Any:
    return small(off_policy(DQNConfig(), "CartPole-v1", new).training(hiddens=[8]), new)


def sac(new: bool) -> Any:
    return small(off_policy(SACConfig(), "Pendulum-v1", new), new, "policy_model_config", "q_model_config")


def make_replay_buffer(self: Any, config: Any) -> Any:
    return from_config(ReplayBuffer, config["replay_buffer_config"])


class Recorder:
    """What goes in and out of the two environments, while it is switched on."""

    def __init__(self) -> None:
        self.on = False
        self.obs: Any = None
        self.restart = True
        self.steps: list[dict[str, Any]] = []
        for kind in (PendulumEnv, CartPoleEnv):
            self._wrap(kind)

    def _wrap(self, kind: Any) -> None:
        real_reset, real_step = kind.reset, kind.step

        def reset(env: Any, *args: Any, **kwargs: Any) -> Any:
            result = real_reset(env, *args, **kwargs)
            self.obs = np.copy(result[0] if isinstance(result, tuple) else result)
            self.restart = True
            return result

        def step(env: Any, action: Any) -> Any:
            if self.on:
                self.add(self.obs, action, self.restart)
            result = real_step(env, action)
            self.obs = np.copy(result[0])
            self.restart = False
            return result

        kind.reset, kind.step = reset, step

    def add(self, obs: Any, action: Any, restart: bool) -> None:
        self.steps.append({"obs": obs, "action": np.copy(action), "restart": restart})


def record(algorithm: Any, recorder: Recorder, new: bool) -> dict[str, Any]:
    """Return the first steps of RLlib's own sampling, exploration off, the filter frozen."""
    group = getattr(algorithm, "env_runner_group", None) or algorithm.workers
    runner = getattr(group, "local_env_runner", None) or group.local_worker()
    recorder.steps, recorder.on = [], True
    push, RunningStat.push = RunningStat.push, lambda stat, value: None
    try:
        if new:
            runner.sample(num_timesteps=RECORDED, explore=False, force_reset=True)
        elif (2, 5) <= VERSION <= (2, 8) and runner.policy_map["default_policy"].config["_enable_rl_module_api"]:
            act_by_connectors(runner.policy_map["default_policy"], recorder)
        else:
            group = getattr(algorithm, "eval_env_runner_group", None) or algorithm.evaluation_workers
            evaluator = getattr(group, "local_env_runner", None) or group.local_worker()
            # RLlib itself hands filters to remote workers only.
            trained = runner.policy_map["default_policy"].get_state()
            evaluator.foreach_policy(lambda policy, _: policy.restore_connectors(trained))
            evaluator.sync_filters(runner.get_filters())
            algorithm.evaluate()
    finally:
        recorder.on, RunningStat.push = False, push
    steps = recorder.steps[:RECORDED]
    assert len(steps) == RECORDED and steps[0]["restart"], len(steps)
    return {name: np.stack([step[name] for step in steps]) for name in steps[0]}


def act_by_connectors(policy: Any, recorder: Recorder) -> None:
    """Let RLlib's connectors and policy act: with an RLModule in it, an evaluation without exploration fails (2.7)."""
    rng = np.random.default_rng(1)
    policy.agent_connectors.in_eval()
    filters = [piece for piece in policy.agent_connectors.connectors if "Obs" in type(piece).__name__]
    for _ in range(RECORDED):
        angle, speed = rng.uniform(-np.pi, np.pi), rng.uniform(-8, 8)
        obs = np.asarray([np.cos(angle), np.sin(angle), speed], np.float32)
        data = [AgentConnectorDataType("env", "agent", {"obs": obs.copy()})]
        for piece in filters:
            data = piece(data)
        actions, _, fetches = policy.compute_actions_from_input_dict({"obs": data[0].data["obs"][None]}, explore=False)
        raw = ActionConnectorDataType("env", "agent", {}, (actions[0], [], fetches))
        recorder.add(obs, policy.action_connectors(raw).output[0], True)


def stacks(build: Any) -> Iterator[bool]:
    """Yield which API stacks this Ray has for a policy: False for the old one, True for the new one."""
    if (build is bare and VERSION > (2, 3)) or (build is lstm and (2, 5) <= VERSION <= (2, 8)):
        return
    yield False
    # Wheels before Ray 2.35 lack the folder of DQN's torch module, on which SAC builds, too.
    needed = "ppo" if build in (ppo, lstm) else "dqn"
    if build is not bare and hasattr(PPOConfig, "api_stack") and find_spec(f"ray.rllib.algorithms.{needed}.torch"):
        yield True


def main(out: Path, only: list[str]) -> None:
    recorder = Recorder()
    if VERSION > (2, 40):  # DQN's validation turns the buffer's name into a class, in which it then looks for a word
        DQN._create_local_replay_buffer_if_necessary = make_replay_buffer
    with tempfile.TemporaryDirectory(prefix="older-", dir="/tmp", ignore_cleanup_errors=True) as work:
        made = Path(work) / ray.__version__
        made.mkdir()
        ray.init(num_cpus=1, include_dashboard=False, _temp_dir=work, configure_logging=False)
        try:
            for build in (ppo, lstm, bare, dqn, sac):
                for new in stacks(build):
                    name = f"{build.__name__}_{'new' if new else 'old'}"
                    if not only or name in only:
                        make(made / name, build(new), recorder, new)
        finally:
            ray.shutdown()
        with tarfile.open(out / f"{ray.__version__}.tar.xz", "w:xz") as archive:
            archive.add(made, ray.__version__)


def make(folder: Path, config: Any, recorder: Recorder, new: bool) -> None:
    """Train, save and record one policy."""
    algorithm = config.build_algo() if hasattr(config, "build_algo") else config.build()
    for _ in range(2):
        algorithm.train()
    scratch = folder.with_suffix(".saved")
    algorithm.save(str(scratch))
    # Ray before 2.7 saves into a folder of its own in there.
    saved = min((file.parent for file in scratch.rglob(CHECKPOINT_FILE)), key=lambda folder: len(folder.parts))
    shutil.move(str(saved), str(folder))
    shutil.rmtree(scratch, ignore_errors=True)
    np.savez(folder.with_suffix(".npz"), **record(algorithm, recorder, new))
    algorithm.stop()
    print(folder.name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
