"""Online learning: episodes of served robots train the next version, which is proven before a robot gets it.

episodes of recordings -> admission -> learner -> every K updates: checkpoint, gate, publication, alias
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rlservo.export.contract.errors import BundleError, CheckpointError, ParityError, UnsupportedError, UsageError
from rlservo.serve_app.learning.admission import Admission, Admitted, KnownVersion
from rlservo.serve_app.learning.following import FollowedRecordings
from rlservo.serve_app.learning.release import Release
from rlservo.serve_app.learning.rllib_episodes import single_agent_episode
from rlservo.serve_app.learning.rllib_learner import OnlineLearner
from rlservo.serve_app.learning.run_folder import RunFolder
from rlservo.serve_app.recording.episodes import Episode

POLL_S = 0.5
KEPT_LOADED = 3  # versions kept besides those that may be learned from: robots finish their episodes with them
GATE = (ParityError, CheckpointError, UnsupportedError, BundleError)
"""The errors with which an export refuses a version."""


@dataclass
class _Batch:
    """The episodes of one update."""

    admitted: list[Admitted] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)
    steps: int = 0

    @property
    def dropped_text(self) -> str:
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.dropped.items())
        return f"{self.dropped.total()} ({reasons})" if reasons else "0"


class OnlineLearning:
    """One run, new or resumed from its folder."""

    def __init__(
        self,
        learner: OnlineLearner,
        run: RunFolder,
        recordings: FollowedRecordings,
        admission: Admission,
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
            self._keep(self._release.publish(self._learner.save))
            self._say(f"version {state.versions[-1].version} is the checkpoint itself")
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
        """Release the learned version; return whether robots get it. If not, continue from the last version."""
        try:
            known = self._release.publish(self._learner.save)
        except GATE as error:
            self._refuse(f"the gate refused it: {error.message}")
            return False
        if not self._keep(known):
            return False
        self._say(f"version {known.version} is proven, published and loaded after {self._run.state.updates} updates")
        return True

    def _keep(self, known: KnownVersion) -> bool:
        """Record a version, and serve it to robots; return whether they get it."""
        state = self._run.state
        state.versions.append(known)
        self._run.commit(self._recordings.names())
        if not self._serve_newest():
            return False
        self._forget_unproven()
        too_old = len(state.versions) - self._admission.max_age - KEPT_LOADED
        if too_old > 0:
            old = state.versions[too_old - 1].version
            self._learner.forget(self._run.checkpoint(old))
            self._release.unload(old)
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
            raise UsageError(f"robots do not get version {newest}, the checkpoint itself: {reason}")
        versions.pop()
        self._refuse(f"robots do not get version {newest}: {reason}")
        self._release.unload(newest)
        return False

    def _refuse(self, why: str) -> None:
        """Continue from the last version, discarding the updates since."""
        state = self._run.state
        newest = state.versions[-1].version
        self._say(f"no version was released: {why}")
        self._learner.restore(self._run.checkpoint(newest), forget=self._fresh)
        state.unproven += self._unproven
        self._forget_unproven()
        state.refused += 1
        self._run.commit(self._recordings.names())
        self._say(f"learning continues from version {newest}")

    def _forget_unproven(self) -> None:
        self._unproven.clear()
        self._fresh = 0

    # Updates.

    def _update(self) -> None:
        state = self._run.state
        batch = self._draw()
        raw, seen = [], []
        for number, one in enumerate(batch.admitted):
            made = _made(one, f"{state.episodes + number}")
            raw.append(made)
            seen += self._learner.seen([made], self._run.checkpoint(one.version.version))
        losses = self._learner.update(raw, seen, state.steps)
        state.updates += 1
        state.episodes += len(batch.admitted)
        self._fresh += len(batch.admitted)
        state.steps += batch.steps
        acted = Counter(one.version.version for one in batch.admitted)
        returns, ages = [one.rewards.sum() for one in batch.admitted], [one.age for one in batch.admitted]
        self._say(
            f"update {state.updates:>4}  episodes {len(batch.admitted):>3}  steps {batch.steps:>5}  "
            f"return {np.mean(returns):>9.2f}  acted {' '.join(f'{v}:{n}' for v, n in sorted(acted.items()))}  "
            f"age {np.mean(ages):.1f}  kl {losses.get('mean_kl_loss', float('nan')):.2g}  "
            f"dropped {batch.dropped_text}"
        )

    def _draw(self) -> _Batch:
        """Wait for the episodes of the next update and return them."""
        batch = _Batch()
        wanted = self._learner.steps_wanted
        while batch.steps < wanted:
            one = next(self._source)
            if isinstance(one, Admitted):
                batch.admitted.append(one)
                batch.steps += len(one.episode)
            elif one is not None:
                batch.dropped[one] += 1
                self._run.state.dropped[one] += 1
            else:
                self._progress(
                    f"waiting for exploring episodes: {batch.steps} of {wanted} steps, dropped {batch.dropped_text}"
                )
                self._sleep(POLL_S)
        return batch

    def _admitted(self) -> Iterator[Admitted | str | None]:
        """Yield an episode, or the reason to drop it; None if no more have ended yet."""
        state = self._run.state
        while True:
            for ended in self._recordings.poll():
                place, parts = (ended.file, ended.key), self._admission.parts(ended.episode)
                if place in self._used:
                    self._remember(ended.key, parts)
                    continue
                verdicts = [self._admission.judge(part, state.versions) for part in parts]
                if not any(verdicts):  # another policy's
                    continue
                self._used.add(place)
                state.used.setdefault(ended.file, []).append(ended.key)
                if any(isinstance(verdict, Admitted) for verdict in verdicts):
                    self._unproven.append(ended.key)
                yield from verdicts
            yield None

    def _remember(self, key: str, parts: Sequence[Episode]) -> None:
        """Return an episode from before a restart to a learner that replays."""
        state = self._run.state
        if not self._learner.replays or key in state.unproven:
            return
        for number, part in enumerate(parts):
            one = self._admission.judge(part, state.versions, any_age=True)
            if isinstance(one, Admitted):
                made = _made(one, f"{key}.{number}")
                self._learner.remember(self._learner.seen([made], self._run.checkpoint(one.version.version)))


def _made(one: Admitted, id_: str) -> Any:
    return single_agent_episode(one.episode, one.episode.own_action, one.rewards, id_=id_, with_distribution=True)


def why_interrupted(run: RunFolder) -> str:
    """Return the message about a stopped run."""
    versions = run.state.versions
    after = f"with version {versions[-1].version}" if versions else "before its first version"
    return f"stopped {after}; the same command resumes it"
