"""Online learning: episodes of served robots train the next version, which is proven before a robot gets it.

episodes of recordings -> admission -> learner -> every K updates: checkpoint, gate, publication, alias
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rlservo.deploy.learning.episode_filter import Admitted, EpisodeFilter
from rlservo.deploy.learning.followed_recordings import FollowedRecordings
from rlservo.deploy.learning.release import Release
from rlservo.deploy.learning.rllib_episodes import single_agent_episode
from rlservo.deploy.learning.rllib_learner import OnlineLearner
from rlservo.deploy.learning.run_folder import RunFolder
from rlservo.errors import BundleError, CheckpointError, ParityError, UnsupportedError, UsageError

POLL_S = 0.5
KEPT_LOADED = 3  # versions kept besides those that may be learned from: robots finish their episodes with them
GATE = (ParityError, CheckpointError, UnsupportedError, BundleError)
"""The errors with which an export refuses a version."""


class OnlineLearning:
    """One run, new or resumed from its folder."""

    def __init__(
        self,
        learner: OnlineLearner,
        run: RunFolder,
        recordings: FollowedRecordings,
        admission: EpisodeFilter,
        release: Release,
        *,
        every: int,
        say: Callable[[str], object],
        progress: Callable[[str], object],
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Release a version every `every` updates; `say` takes a line per event, `progress` the current activity."""
        self._learner, self._run, self._recordings = learner, run, recordings
        self._admission, self._release = admission, release
        self._every = every
        self._say, self._progress, self._sleep = say, progress, sleep
        self._used = {(file, key) for file, keys in run.state.used.items() for key in keys}
        self._unproven: list[str] = []
        """Episodes learned from since the newest version, by key."""
        self._fresh = 0
        """Their number: a recorded episode may be several."""
        self._source = self._admitted()

    def run(self, versions: int | None = None) -> None:
        """Learn until this number of further versions has been released, or until interrupted. Raises RlservoError."""
        state = self._run.state
        if self._run.is_new:
            self._release.check_unclaimed()
            self._make_version()  # the checkpoint itself
        else:
            self._learner.restore(self._run.checkpoint(state.versions[-1].version))
            self._serve_newest()
            newest = state.versions[-1].version
            self._say(f"continuing from version {newest}: {state.updates} updates, {state.episodes} episodes used")
        released = 0
        while versions is None or released < versions:
            for _ in range(self._every):
                self._update()
            released += self._make_version()

    # Versions.

    def _make_version(self) -> bool:
        """Release the learned version; return whether robots get it. If not, continue from the last version.

        Raises the gate's error or UsageError if it is the first.
        """
        state = self._run.state
        try:
            state.versions.append(self._release.publish(self._learner.save))
        except GATE as error:
            if not state.versions:
                raise
            self._refuse(f"the gate refused it: {error.message}")
            return False
        self._run.commit(self._recordings.names())
        if not self._serve_newest():
            return False
        self._unproven, self._fresh = [], 0
        too_old = len(state.versions) - self._admission.max_age - KEPT_LOADED
        if too_old > 0:
            self._release.unload(state.versions[too_old - 1].version)
        newest = state.versions[-1].version
        self._say(f"version {newest} is proven, published and loaded after {state.updates} updates")
        return True

    def _serve_newest(self) -> bool:
        """Serve the newest version to robots; continue without it if the server or its canary refused it.

        Raises UsageError if it is the first version, the checkpoint itself.
        """
        versions = self._run.state.versions
        newest = versions[-1].version
        reason = self._release.serve(newest, versions[-2].version if len(versions) > 1 else None)
        if reason is None:
            return True
        if len(versions) == 1:
            raise UsageError(f"the server does not serve version {newest}, the checkpoint itself: {reason}")
        versions.pop()
        self._refuse(f"the server does not serve version {newest}: {reason}")
        self._release.unload(newest)
        return False

    def _refuse(self, why: str) -> None:
        """Continue from the last version, discarding the updates since."""
        state = self._run.state
        newest = state.versions[-1].version
        self._say(f"no version was released: {why}")
        self._learner.restore(self._run.checkpoint(newest), forget=self._fresh)
        state.unproven += self._unproven
        self._unproven, self._fresh = [], 0
        state.refused += 1
        self._run.commit(self._recordings.names())
        self._say(f"learning continues from version {newest}")

    # Updates.

    def _update(self) -> None:
        state = self._run.state
        batch, dropped = self._draw()
        raw = [_made(one, f"{state.episodes + number}") for number, one in enumerate(batch)]
        seen = [self._seen(one, made) for one, made in zip(batch, raw, strict=True)]
        steps = sum(map(len, raw))
        losses = self._learner.update(raw, seen, state.steps)
        state.updates += 1
        state.episodes += len(batch)
        self._fresh += len(batch)
        state.steps += steps
        acted = Counter(one.version.version for one in batch)
        returns, ages = [one.rewards.sum() for one in batch], [one.age for one in batch]
        self._say(
            f"update {state.updates:>4}  episodes {len(batch):>3}  steps {steps:>5}  "
            f"return {np.mean(returns):>9.2f}  acted {' '.join(f'{v}:{n}' for v, n in sorted(acted.items()))}  "
            f"age {np.mean(ages):.1f}  kl {losses.get('mean_kl_loss', float('nan')):.2g}  "
            f"dropped {_counted(dropped)}"
        )

    def _draw(self) -> tuple[list[Admitted], Counter[str]]:
        """Wait for the episodes of the next update; return them, and those that were dropped meanwhile, by reason."""
        batch: list[Admitted] = []
        dropped: Counter[str] = Counter()
        wanted = self._learner.steps_wanted
        while (steps := sum(len(one.episode) for one in batch)) < wanted:
            one = next(self._source)
            if isinstance(one, Admitted):
                batch.append(one)
            elif one is not None:
                dropped[one] += 1
                self._run.state.dropped[one] += 1
            else:
                self._progress(
                    f"waiting for exploring episodes: {steps} of {wanted} steps, dropped {_counted(dropped)}"
                )
                self._sleep(POLL_S)
        return batch, dropped

    def _admitted(self) -> Iterator[Admitted | str | None]:
        """Yield an episode, or the reason to drop it; None if no more have ended yet."""
        state = self._run.state
        while True:
            for ended in self._recordings.poll():
                place = (ended.file, ended.key)
                is_used = place in self._used  # before a restart
                if is_used and (not self._learner.replays or ended.key in state.unproven):
                    continue
                verdicts = self._admission.judge(ended.episode, state.versions, any_age=is_used)
                admitted = [one for one in verdicts if isinstance(one, Admitted)]
                if is_used:
                    made = [_made(one, f"{ended.key}.{number}") for number, one in enumerate(admitted)]
                    self._learner.remember([self._seen(one, own) for one, own in zip(admitted, made, strict=True)])
                elif verdicts:
                    self._used.add(place)
                    state.used.setdefault(ended.file, []).append(ended.key)
                    self._unproven += [ended.key] if admitted else []
                    yield from verdicts
            yield None

    def _seen(self, one: Admitted, made: Any) -> Any:
        """Return an episode as the network of the version that acted saw it."""
        (seen,) = self._learner.seen([made], self._run.checkpoint(one.version.version))
        return seen


def _made(one: Admitted, id_: str) -> Any:
    return single_agent_episode(one.episode, one.episode.own_action, one.rewards, id_=id_, with_distribution=True)


def _counted(dropped: Counter[str]) -> str:
    reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
    return f"{dropped.total()} ({reasons})" if reasons else "0"


def why_interrupted(run: RunFolder) -> str:
    """Return the message about a stopped run."""
    versions = run.state.versions
    after = f"with version {versions[-1].version}" if versions else "before its first version"
    return f"stopped {after}; the same command resumes it"
