"""Control loop: drive a Gymnasium environment with a policy, report success, return and latency.

The policy is anything that acts: in process or over HTTP. gymnasium is imported when a rollout starts. Success is what
the environment's `info` says at an episode's end.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rlservo.export.contract.contract import REWARD
from rlservo.export.contract.errors import RlservoError, UsageError
from rlservo.serve_app.interface import ActingPolicy
from rlservo.serve_app.recording.start import record_policy
from rlservo.serve_app.rollout.environment import check_fit, control_rate_of, make_env
from rlservo.serve_app.rollout.fallback import LinkCounts, StoppedError, WithFallback
from rlservo.serve_app.rollout.report import EpisodeRow, Link, Rate, RolloutReport, summarise
from rlservo.serve_app.rollout.video import VideoFile, rgb_frame

if TYPE_CHECKING:
    import gymnasium as gym

    from rlservo.serve_app.recording.recorded_policy import WithRecording
    from rlservo.serve_app.recording.recorder import Recorder

OnEpisode = Callable[[EpisodeRow], None]


def rollout(
    policy: ActingPolicy,
    env_id: str,
    *,
    episodes: int,
    seed: int | None = None,
    rate: Rate = "max",
    explore: bool = False,
    env_kwargs: Mapping[str, Any] | None = None,
    video: str | Path | None = None,
    video_episodes: int = 1,
    record: str | Path | Recorder | None = None,
    on_episode: OnEpisode | None = None,
) -> RolloutReport:
    """Run `episodes` episodes of `env_id` with `policy` and return what came of it.

    Episode i (from 0) is reset with seed + i, so that any one can be repeated alone; with `explore` its draws follow
    from the same number. With rate 'real' the loop keeps the control rate on an absolute schedule, as on a robot: a
    period that is missed is counted and skipped, never caught up in a burst. `video` receives the frames of the first
    `video_episodes` episodes at the control rate; drawing happens inside the loop, so it counts as its time.
    `record` receives every decision with its reward and end: a new .mcap file, a folder, or a Recorder.
    `on_episode` is called after each episode. Ctrl-C returns what was finished, with `interrupted` set; so does a
    fallback (`WithFallback`) that is to stop, with `stopped`.

    Raises UsageError when the environment cannot be made, does not fit the policy's contract or fails, and whatever
    `policy.act` raises, with the episode and the step in front. The environment is always closed, the policy never.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be 1 or more, got {episodes}")
    if seed is not None and seed < 0:
        raise UsageError(f"seed must be 0 or more, got {seed}: Gymnasium refuses negative ones")
    if rate not in ("max", "real"):
        raise UsageError(f"rate {rate!r} does not exist: expected 'max' or 'real'")
    if video is not None and video_episodes < 1:
        raise UsageError(f"video_episodes must be 1 or more, got {video_episodes}")
    arguments = dict(env_kwargs or {})
    contract = policy.contract
    with ExitStack() as cleanup:
        env = make_env(env_id, arguments, render=video is not None)
        cleanup.callback(env.close)
        check_fit(contract, env, arguments)
        control_rate_hz = control_rate_of(env, arguments, contract)
        if control_rate_hz is None and (rate == "real" or video is not None):
            wanted = "rate 'real'" if rate == "real" else "a video"
            raise UsageError(
                f"{wanted} needs a control rate, and neither {env_id} (describe(), render_fps) nor the policy's "
                "contract states one"
            )
        recorded = None if record is None else record_policy(policy, record, wait=rate == "max")
        if recorded is not None:
            cleanup.callback(recorded.end)
        loop = _Loop(
            recorded or policy,
            env,
            recorded=recorded,
            pacer=_Pacer(control_rate_hz if rate == "real" else None),
            explore=explore,
        )
        if video is not None and control_rate_hz is not None:
            loop.video = cleanup.enter_context(VideoFile(video, fps=control_rate_hz))
        rows: list[EpisodeRow] = []
        interrupted, stopped = False, None
        began = time.perf_counter()
        try:
            for index in range(episodes):
                filmed = video is not None and index < video_episodes
                row = loop.run(index, None if seed is None else seed + index, filmed=filmed)
                rows.append(row)
                if on_episode is not None:
                    on_episode(row)
        except KeyboardInterrupt:
            interrupted = True
        except StoppedError as error:
            stopped = error.message
        wall_s = time.perf_counter() - began
    return summarise(
        rows,
        loop.latencies_s,
        env_id=env_id,
        policy=contract.name,
        version=contract.version,
        rate=rate,
        seed=seed,
        requested_episodes=episodes,
        interrupted=interrupted,
        wall_s=wall_s,
        control_rate_hz=control_rate_hz,
        overruns=loop.pacer.overruns,
        video=str(video) if loop.video is not None and loop.video.frames else None,
        link=_link_of(policy),
        stopped=stopped,
    )


def _link_of(policy: ActingPolicy) -> Link | None:
    """Return what a policy behind a network counted; None for one in process."""
    counts, fallback, inner = LinkCounts(), None, policy
    if isinstance(policy, WithFallback):
        counts, fallback, inner = policy.counts, policy.name, policy.policy
    reconnects = getattr(inner, "reconnects", None)
    if reconnects is None and fallback is None:
        return None
    return Link(
        fallback=fallback,
        late=counts.late,
        unavailable=counts.unavailable,
        lost=counts.lost,
        fallback_steps=counts.fallback,
        stale=getattr(inner, "stale", 0),
        reconnects=reconnects or 0,
    )


@dataclass
class _Pacer:
    """Keeps a loop at `rate_hz`; None lets it run as fast as it can."""

    rate_hz: float | None
    overruns: int = 0
    _due: float = 0.0

    def start(self) -> None:
        """Begin the schedule: the first step runs now, the second is due one period from now."""
        if self.rate_hz is not None:
            self._due = time.perf_counter() + 1 / self.rate_hz

    def wait(self) -> None:
        """Sleep until the next step is due. When it already was, count an overrun and return at once."""
        if self.rate_hz is None:
            return
        late = time.perf_counter() - self._due
        periods = 1
        if late <= 0:
            time.sleep(-late)
        else:
            self.overruns += 1
            periods += int(late * self.rate_hz)  # whole periods gone by are skipped, never caught up in a burst
        self._due += periods / self.rate_hz  # from the schedule, not from now: that would drift


@dataclass
class _Loop:
    """The parts of a run, and the time every `act` took [s]."""

    policy: ActingPolicy
    env: gym.Env[Any, Any]
    pacer: _Pacer
    explore: bool
    recorded: WithRecording | None = None
    video: VideoFile | None = None
    latencies_s: list[float] = field(default_factory=list)

    def run(self, index: int, seed: int | None, *, filmed: bool) -> EpisodeRow:
        """Run one episode: observe, act, step, until the environment ends it."""
        rewarded = any(tensor.name == REWARD for tensor in self.policy.contract.inputs)
        draws = np.random.default_rng(seed)  # one seed per exploring action; unused otherwise
        self.policy.reset()
        obs = self._in_env(index, 0, self.env.reset, seed=seed)[0]
        self._film(filmed)
        steps, total, reward = 0, 0.0, 0.0
        first = len(self.latencies_s)
        self.pacer.start()
        while True:
            seeded = int(draws.integers(2**31)) if self.explore else None
            action = self._act(obs, index, steps, seeded, {REWARD: float(reward)} if rewarded else {})
            command = _command(action)
            obs, reward, terminated, truncated, info = self._in_env(index, steps, self.env.step, command)
            self._film(filmed)
            steps, total = steps + 1, total + float(reward)
            if self.recorded is not None:
                ends = bool(terminated or truncated)
                self.recorded.outcome(
                    reward,
                    terminated=terminated,
                    truncated=truncated,
                    final_status=_final_status(info) if ends else None,
                    final_obs=obs if ends else None,
                )
            if terminated or truncated:
                break
            self.pacer.wait()
        latencies = 1e3 * np.array(self.latencies_s[first:])
        return EpisodeRow(
            index=index,
            seed=seed,
            steps=steps,
            episode_return=total,
            success=success_of(info),
            final_status=_final_status(info),
            latency_p50_ms=float(np.median(latencies)),
            latency_max_ms=float(latencies.max()),
        )

    def _act(self, obs: Any, index: int, step: int, seed: int | None, earned: Mapping[str, float]) -> Any:
        began = time.perf_counter()
        try:
            # Only a policy that was trained to see its reward takes one.
            action = self.policy.act(obs, explore=self.explore, seed=seed, **earned)
        except RlservoError as error:
            raise type(error)(f"episode {index}, step {step}: {error.message}", error.details) from error
        self.latencies_s.append(time.perf_counter() - began)
        return action

    def _in_env(self, index: int, step: int, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        try:
            return call(*arguments, **named)
        except Exception as error:  # an environment is anyone's code
            raise UsageError(
                f"episode {index}, step {step}: the environment failed with {type(error).__name__}: {error}"
            ) from error

    def _film(self, filmed: bool) -> None:
        if filmed and self.video is not None:
            self.video.add(rgb_frame(self.env))


def _command(action: Any) -> Any:
    """A choice is a plain number to most environments; a nested action has such parts."""
    if isinstance(action, dict):
        return {key: _command(part) for key, part in action.items()}
    if isinstance(action, tuple):
        return tuple(_command(part) for part in action)
    return int(action) if action.ndim == 0 and action.dtype.kind in "iu" else action


def _final_status(info: Mapping[str, Any]) -> str | None:
    return None if info.get("final_status") is None else str(info["final_status"])


def success_of(info: Mapping[str, Any]) -> bool | None:
    """Return what an episode's last `info` says of success: `is_success`, else `final_status`, else None."""
    if info.get("is_success") is not None:
        return bool(info["is_success"])
    status = info.get("final_status")
    return None if status is None else status == "success"
