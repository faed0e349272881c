"""Training with rsl_rl, for `train_shipped.py`: an imitation of inverse kinematics, then PPO, into an Isaac Lab run.

The environment acts by joint targets; here, as in Isaac Lab, a policy's action is a step from the observed position.
"""

from __future__ import annotations

import json
import math
import resource
import shutil
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import yaml
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torch import Tensor

from rlservo.bundle.environment_id import plain_id
from rlservo.drive.success import success_of

BATCH = 512
NORMALIZED, TIMES = 100_000, 100  # observations, and how often they count: PPO's few then hardly change the normalizer
NEAR = 0.03  # [rad], standard deviation around a solution
FASTEST = 0.6  # [rad/s]
PARTS = ("params", "io_descriptors")  # of a run, which ship


class VectorEnv(VecEnv):  # type: ignore[misc]  # rsl_rl is not annotated
    """Copies of a Gymnasium environment, one after the other, whose actions are targets of the first observations."""

    device = "cpu"

    def __init__(self, settings: dict[str, Any], scale: float) -> None:
        self._envs: list[Any] = [
            gymnasium.make(settings["env"], disable_env_checker=True, **settings["env_config"])
            for _ in range(settings["envs"])
        ]
        self._scale = scale
        self._observed = np.stack([env.reset(seed=settings["seed"] + n)[0] for n, env in enumerate(self._envs)])
        self.num_envs, self.num_actions = len(self._envs), self._envs[0].action_space.shape[0]
        self.max_episode_length = 10**6  # the environment ends its episodes itself
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.cfg: dict[Any, Any] | object = {}
        self._returns = np.zeros(self.num_envs)
        self.ended: list[tuple[float, int, bool]] = []  # return, length and success of episodes

    def get_observations(self) -> TensorDict:
        return TensorDict({"policy": torch.from_numpy(self._observed.copy())}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Let a control cycle pass; an environment whose episode ends is reset."""
        targets = self._observed[:, : self.num_actions] + self._scale * actions.numpy()
        rewards, dones, time_outs = torch.zeros(self.num_envs), torch.zeros(self.num_envs), torch.zeros(self.num_envs)
        for n, env in enumerate(self._envs):
            self._observed[n], reward, terminated, truncated, info = env.step(targets[n])
            rewards[n], dones[n], time_outs[n] = reward, terminated or truncated, truncated
            self._returns[n] += reward
            self.episode_length_buf[n] += 1
            if terminated or truncated:
                self.ended.append((float(self._returns[n]), int(self.episode_length_buf[n]), bool(success_of(info))))
                self._observed[n], _ = env.reset()
                self._returns[n], self.episode_length_buf[n] = 0.0, 0
        return self.get_observations(), rewards, dones, {"time_outs": time_outs}

    def close(self) -> None:
        for env in self._envs:
            env.close()


class RslRlRun:
    """A training whose settings are a training.yaml, and the files that Isaac Lab writes into a run, in `described`."""

    def __init__(self, settings: dict[str, Any], described: Path) -> None:
        self._settings, self._described = settings, described
        torch.manual_seed(settings["seed"])
        agent = yaml.safe_load((described / "params" / "agent.yaml").read_text("utf-8"))
        term = yaml.safe_load((described / "params" / "env.yaml").read_text("utf-8"))["actions"]["arm_action"]
        self._scale = float(term["scale"])
        self._env = VectorEnv(settings, self._scale)
        self._runner = OnPolicyRunner(self._env, agent, None, "cpu")
        self._steps_per_iteration = agent["num_steps_per_env"] * settings["envs"]
        self._iteration = self._episodes = 0

    def iterations(self, episodes: int) -> Iterator[tuple[Any, ...]]:
        """Imitate, then learn; yield the fields of a line of the curve after each iteration."""
        began, kept = time.monotonic(), deque[tuple[float, int, bool]](maxlen=episodes)
        error = self._imitate(**self._settings["imitate"])
        print(f"the solution imitated to {error:.4f} of an action in {_cpu_s():.0f} s of processor time", flush=True)
        while True:
            self._runner.learn(1)
            self._iteration += 1
            kept.extend(self._env.ended)
            self._episodes += len(self._env.ended)
            self._env.ended.clear()
            means = np.mean(kept, axis=0).tolist() if kept else [float("nan")] * 3
            steps = self._iteration * self._steps_per_iteration
            yield steps, self._episodes, *means, time.monotonic() - began, _cpu_s(), steps

    def save_to_path(self, path: str) -> None:
        """Write a run with the actor's weights alone, which is what acts."""
        run = Path(path)
        shutil.rmtree(run, ignore_errors=True)
        for part in PARTS:
            shutil.copytree(self._described / part, run / part)
        weights = self._runner.alg.save()["actor_state_dict"]
        saved = {"actor_state_dict": weights, "iter": self._iteration, "infos": None}
        torch.save(saved, run / f"model_{self._iteration}.pt")
        facts = {
            "algorithm": self._settings["algorithm"], "env_id": plain_id(self._settings["env"]),
            "env_config": self._settings["env_config"], "training_iterations": self._iteration,
            "env_steps": self._iteration * self._steps_per_iteration,
        }  # fmt: skip
        (run / "rlservo_facts.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")

    def stop(self) -> None:
        self._env.close()

    def _imitate(self, *, episodes: int, updates: int, rate: float, gain: float, largest: float) -> float:
        """Fit the actor to steps towards the solution; return the root mean square error of the last batch.

        A step is proportional to the way, and at most `largest`. Half of the joints that it sees are near the solution,
        the others on the way from another one.
        """
        poses, solutions = self._solved(episodes)
        actor = self._runner.alg.get_policy()
        generator = torch.Generator().manual_seed(self._settings["seed"])

        def draw(count: int) -> tuple[TensorDict, Tensor]:
            goal, other = torch.randint(len(poses), (2, count), generator=generator)
            left = torch.rand(count, 1, generator=generator) * (torch.rand(count, 1, generator=generator) < 0.5)
            way = left * (solutions[other] - solutions[goal])
            joints = solutions[goal] + way + NEAR * torch.randn(way.shape, generator=generator)
            velocities = FASTEST * (2.0 * torch.rand(way.shape, generator=generator) - 1.0)
            seen = torch.cat([joints, velocities * torch.rand(count, 1, generator=generator), poses[goal]], dim=-1)
            action = largest * torch.tanh(gain * (solutions[goal] - joints) / largest)
            return TensorDict({"policy": seen}, batch_size=[count]), action

        actor.train()
        seen, _ = draw(NORMALIZED)
        for _ in range(TIMES):
            actor.update_normalization(seen)
        optimiser = torch.optim.Adam(actor.mlp.parameters(), lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates, eta_min=0.01 * rate)
        loss = torch.zeros(())
        for _ in range(updates):
            seen, action = draw(BATCH)
            loss = (actor(seen) - action).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        return math.sqrt(float(loss.detach()))

    def _solved(self, episodes: int) -> tuple[Tensor, Tensor]:
        """Return the observed poses (n, 7) of so many targets, and the joints [rad] (n, 6) that solve them."""
        config = self._settings["env_config"]
        plain = {key: value for key, value in config.items() if key in ("rs_state_to_info", "ur_model", "quaternion")}
        env: Any = gymnasium.make(f"rlservo.envs:{config['env_id']}", disable_env_checker=True, **plain)
        poses, solutions = [], []
        for n in range(episodes):
            observation, _ = env.reset(seed=self._settings["seed"] if n == 0 else None)
            poses.append(observation[-7:])
            solutions.append(env.unwrapped.solution())
        env.close()
        return torch.tensor(np.array(poses)), torch.tensor(np.array(solutions), dtype=torch.float32)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
