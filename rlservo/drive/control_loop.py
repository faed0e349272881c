"""Control loop: drive a Gymnasium environment with a policy; report success, return and latency.

The policy may be any object that acts, in process or over HTTP. gymnasium is imported when a rollout starts.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rlservo.bundle.contract import Contract
from rlservo.drive.disturbance import disturb_env, parse_disturbance
from rlservo.drive.driven_episode import DrivenEpisode, EpisodeEnv, report_step, run_episode
from rlservo.drive.environment_fit import check_fit, control_rate_of
from rlservo.drive.fallback import LinkCounts, StoppedError, WithFallback
from rlservo.drive.make_environment import make_env
from rlservo.drive.real_robot_gate import check_proven
from rlservo.drive.report import ConnectionCounts, EpisodeRow, Rate, RolloutReport, latency_of
from rlservo.drive.smoothness import MeasuredEnv
from rlservo.drive.success import success_rates
from rlservo.drive.video import FilmedEnv, VideoFile
from rlservo.errors import UsageError
from rlservo.policy.acting_policy import ActingPolicy, Observation
from rlservo.recording.start import record_policy

if TYPE_CHECKING:
    from rlservo.recording.recorder import Recorder

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
    disturb: str | None = None,
    unproven: bool = False,
) -> RolloutReport:
    """Run `episodes` episodes of `env_id` with `policy` and return the report.

    Episode i (from 0) is reset with seed + i, so that each can be repeated alone; with `explore` the same number seeds
    its draws. With rate 'real' the loop keeps the control rate on an absolute schedule, as on a robot: a period that is
    missed is counted and skipped, never caught up in a burst. `video` receives the frames of the first `video_episodes`
    episodes at the control rate; rendering happens inside the loop, so its time counts. A policy on a server gets
    rewards and episode ends, for recording and promotion by success. `record` receives every decision with its reward
    and end: a new .mcap file, a folder, or a Recorder. `disturb` applies disturbances to environment and robot
    (`latency=3,noise=real`; `disturbance.py` has the kinds). A real robot accepts a policy only if evaluations in its
    contract prove it under latency, or with `unproven`. `on_episode` is called after each episode. Ctrl-C returns the
    finished episodes, with `interrupted` set; so does the fallback 'stop' (`WithFallback`), with `stopped`.

    Raises UsageError when the environment cannot be made, does not fit the policy's contract or fails, and whatever
    `policy.act` raises, preceded by the episode and the step. The environment is always closed, the policy never.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be 1 or more, got {episodes}")
    if seed is not None and seed < 0:
        raise UsageError(f"seed must be 0 or more, got {seed}: Gymnasium refuses negative ones")
    if rate not in ("max", "real"):
        raise UsageError(f"rate {rate!r} does not exist: expected 'max' or 'real'")
    if video is not None and video_episodes < 1:
        raise UsageError(f"video_episodes must be 1 or more, got {video_episodes}")
    disturbance = None if disturb is None else parse_disturbance(disturb)
    arguments = dict(env_kwargs or {})
    contract = policy.contract
    with ExitStack() as cleanup:
        env = make_env(env_id, arguments, render=video is not None)
        cleanup.callback(env.close)
        check_fit(contract, env, arguments)
        if not unproven:
            check_proven(contract, env)
        control_rate_hz = control_rate_of(env, arguments, contract)
        if control_rate_hz is None and (rate == "real" or video is not None):
            purpose = "rate 'real'" if rate == "real" else "a video"
            raise UsageError(
                f"{purpose} needs a control rate, and neither {env_id} (describe(), render_fps) nor the policy's "
                "contract states one"
            )
        pacer = _Pacer(control_rate_hz if rate == "real" else None)
        video_file = None
        if video is not None and control_rate_hz is not None:
            video_file = cleanup.enter_context(VideoFile(video, fps=control_rate_hz))
        recording = None
        if record is not None:
            recording = record_policy(policy, record, wait=rate == "max")
            cleanup.callback(recording.end)
        paced = _PacedPolicy(recording or policy, pacer)
        acted = env if disturbance is None else disturb_env(env, disturbance)
        measured = MeasuredEnv(acted, env.unwrapped)
        rows: list[EpisodeRow] = []
        versions = [contract.version]
        interrupted, stopped = False, None
        began = time.perf_counter()
        try:
            for index in range(episodes):
                first = len(paced.latencies_s)
                measured.env = acted
                if video_file is not None and index < video_episodes:
                    measured.env = FilmedEnv(acted, video_file.add)
                episode = run_episode(
                    _ReportedEnv(measured, paced.policy),
                    paced,
                    index=index,
                    seed=None if seed is None else seed + index,
                    explore=explore,
                )
                row = _row(episode, paced.latencies_s[first:])
                rows.append(row)
                versions.append(policy.contract.version)
                if on_episode is not None:
                    on_episode(row)
        except KeyboardInterrupt:
            interrupted = True
        except StoppedError as error:
            stopped = error.message
        wall_s = time.perf_counter() - began
        limited: Callable[[], dict[str, int] | None] = getattr(env.unwrapped, "limited", lambda: None)
        robot = limited()
        rehearsal = getattr(getattr(env.unwrapped, "robot", None), "rehearsal", None)
    latencies_s = paced.latencies_s
    (success,) = success_rates([row.success for row in rows])
    returns = np.array([row.episode_return for row in rows])
    deadline_s = None if control_rate_hz is None else 1 / control_rate_hz
    return RolloutReport(
        env_id=env_id,
        policy=contract.name,
        version=", ".join(dict.fromkeys(versions[1:] or versions)),
        rate=rate,
        seed=seed,
        requested_episodes=episodes,
        interrupted=interrupted,
        episodes=tuple(rows),
        successes=success and success.successes,
        success_rate=success and success.rate,
        success_interval=success and success.interval,
        return_mean=float(returns.mean()) if rows else None,
        return_std=float(returns.std(ddof=1)) if len(rows) > 1 else None,
        length_mean=float(np.mean([row.steps for row in rows])) if rows else None,
        final_status=dict(Counter(row.final_status for row in rows if row.final_status is not None).most_common()),
        steps=len(latencies_s),
        wall_s=wall_s,
        steps_per_s=len(latencies_s) / wall_s if wall_s > 0 else 0.0,
        latency_ms=latency_of(latencies_s),
        control_rate_hz=control_rate_hz,
        deadline_ms=None if deadline_s is None else 1e3 * deadline_s,
        deadline_misses=None if deadline_s is None else sum(latency > deadline_s for latency in latencies_s),
        overruns=pacer.overruns if rate == "real" else None,
        video=str(video_file.path) if video_file is not None and video_file.frames else None,
        link=_link_of(policy),
        stopped=stopped,
        disturbance=disturb,
        step_sizes=measured.sizes(),
        robot=robot,
        rehearsal=rehearsal,
    )


def _link_of(policy: ActingPolicy) -> ConnectionCounts | None:
    """Return the counts of a policy behind a network; None for one in process."""
    counts, fallback, inner = LinkCounts(), None, policy
    while (wrapped := getattr(inner, "policy", None)) is not None:  # in a fallback, a recording, or both
        if isinstance(inner, WithFallback):
            counts, fallback = inner.counts, inner.name
        inner = wrapped
    reconnects = getattr(inner, "reconnects", None)
    if reconnects is None and fallback is None:
        return None
    return ConnectionCounts(
        fallback=fallback,
        late=counts.late,
        unavailable=counts.unavailable,
        lost=counts.lost,
        fallback_steps=counts.fallback,
        stale=getattr(inner, "stale", 0),
        reconnects=reconnects or 0,
    )


class _Pacer:
    """Keeps a loop at `rate_hz`; None lets it run as fast as it can."""

    def __init__(self, rate_hz: float | None) -> None:
        self.rate_hz = rate_hz
        self.overruns = 0
        self._due: float | None = None

    def restart(self) -> None:
        """Restart the schedule: the next step runs at once, and the others follow from it."""
        self._due = None

    def wait(self) -> None:
        """Sleep until the step is due. When it already was, count an overrun and return at once."""
        if self.rate_hz is None:
            return
        now = time.perf_counter()
        if self._due is None:
            self._due = now
        delay_s = now - self._due
        periods = 1
        if delay_s < 0:
            time.sleep(-delay_s)
        elif delay_s > 0:
            self.overruns += 1
            periods += int(delay_s * self.rate_hz)  # whole periods gone by are skipped, never caught up in a burst
        self._due += periods / self.rate_hz  # from the schedule, not from now: that would drift


@dataclass
class _PacedPolicy:
    """A policy whose `act` waits for its time, and the time every `act` took [s]."""

    policy: ActingPolicy
    pacer: _Pacer
    latencies_s: list[float] = field(default_factory=list)

    @property
    def contract(self) -> Contract:
        return self.policy.contract

    def act(self, obs: Observation, **options: Any) -> Any:
        self.pacer.wait()
        began = time.perf_counter()
        action = self.policy.act(obs, **options)
        self.latencies_s.append(time.perf_counter() - began)
        return action

    def reset(self) -> None:
        self.policy.reset()
        self.pacer.restart()


@dataclass
class _ReportedEnv:
    """An environment whose rewards and ends are reported as the last action's outcome."""

    env: EpisodeEnv
    policy: ActingPolicy

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=seed)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        report_step(self.policy, result)
        return result


def _row(episode: DrivenEpisode, latencies_s: Sequence[float]) -> EpisodeRow:
    latencies = 1e3 * np.array(latencies_s)
    return EpisodeRow(
        **vars(episode), latency_p50_ms=float(np.median(latencies)), latency_max_ms=float(latencies.max())
    )
