"""Online learning: served robots' episodes train the next version, and it is proven before any robot gets it.

episodes of recordings -> admission -> learner -> every K updates: checkpoint, gate, publication, alias
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from rlservo.export.contract.errors import BundleError, CheckpointError, ParityError, UnsupportedError
from rlservo.serve_app.learning.admission import Admission, Admitted, KnownVersion
from rlservo.serve_app.learning.following import FollowedRecordings
from rlservo.serve_app.learning.release import Release
from rlservo.serve_app.learning.rllib_episodes import single_agent_episode
from rlservo.serve_app.learning.rllib_learner import OnlineLearner
from rlservo.serve_app.learning.run_folder import RunFolder

POLL_S = 0.5
KEPT_LOADED = 3  # versions besides those that may be learned from: robots finish their episodes with them
GATE = (ParityError, CheckpointError, UnsupportedError, BundleError)
"""The errors by which an export refuses a version."""
NOT_PROVEN = "learned by a version that the gate refused"


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
    """One run, from its beginning or from where its folder stands."""

    def __init__(
        self,
        learner: OnlineLearner,
        run: RunFolder,
        recordings: FollowedRecordings,
        admission: Admission,
        release: Release,
        *,
        every: int,
        max_age: int,
        say: Callable[[str], object],
        progress: Callable[[str], object],
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Release a version every `every` updates; `say` takes a line per event, `progress` the current activity."""
        self._learner, self._run, self._recordings = learner, run, recordings
        self._admission, self._release = admission, release
        self._every, self._max_age = every, max_age
        self._say, self._progress, self._sleep = say, progress, sleep
        self._used = {(file, key) for file, keys in run.state.used.items() for key in keys}
        self._source = self._admitted()

    def run(self, versions: int | None = None) -> None:
        """Learn until this number of further versions was released, or interrupted. Raises RlservoError."""
        state = self._run.state
        if self._run.is_new:
            self._begin()
        else:
            newest = state.versions[-1].version
            self._learner.restore(self._run.checkpoint(newest))
            self._release.serve(newest, self._before(len(state.versions) - 1))
            self._say(f"continues from version {newest}: {state.updates} updates, {state.episodes} episodes used")
        released = 0
        while versions is None or released < versions:
            for _ in range(self._every):
                self._update()
            released += self._make_version()

    # Versions.

    def _begin(self) -> None:
        """Release the checkpoint itself: the version that robots begin with is one that this run knows."""
        known = self._release.publish(self._learner.save)
        self._keep(known)
        self._say(f"version {known.version} is the checkpoint itself")

    def _make_version(self) -> bool:
        """Release the learned version; return whether the gate passed it. If not, continue from the last version."""
        state = self._run.state
        try:
            known = self._release.publish(self._learner.save)
        except GATE as error:
            newest = state.versions[-1].version
            self._say(f"no version was released, the gate refused it: {error.message}")
            self._learner.restore(self._run.checkpoint(newest))
            state.refused += 1
            state.dropped[NOT_PROVEN] += self._every
            self._run.commit(self._recordings.names())
            self._say(f"learning continues from version {newest}")
            return False
        self._keep(known)
        self._say(f"version {known.version} is proven, published and loaded after {state.updates} updates")
        return True

    def _keep(self, known: KnownVersion) -> None:
        state = self._run.state
        state.versions.append(known)
        self._run.commit(self._recordings.names())
        self._release.serve(known.version, self._before(len(state.versions) - 1))
        too_old = len(state.versions) - self._max_age - KEPT_LOADED
        if too_old > 0:
            old = state.versions[too_old - 1].version
            self._learner.forget(self._run.checkpoint(old))
            self._release.unload(old)

    def _before(self, place: int) -> str | None:
        return self._run.state.versions[place - 1].version if place > 0 else None

    # Updates.

    def _update(self) -> None:
        state = self._run.state
        batch = self._draw()
        raw, seen = [], []
        for number, one in enumerate(batch.admitted):
            made = single_agent_episode(
                one.episode, one.episode.own_action, one.rewards, id_=f"{state.episodes + number}",
                with_distribution=True,
            )  # fmt: skip
            raw.append(made)
            seen += self._learner.seen([made], self._run.checkpoint(one.version.version))
        losses = self._learner.update(raw, seen, state.steps)
        state.updates += 1
        state.episodes += len(batch.admitted)
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
        """Return the episodes of the next update; wait for them."""
        batch = _Batch()
        while batch.steps < self._learner.batch_size:
            one = next(self._source)
            if isinstance(one, Admitted):
                batch.admitted.append(one)
                batch.steps += len(one.episode)
            elif one is not None:
                batch.dropped[one] += 1
                self._run.state.dropped[one] += 1
            else:
                self._progress(
                    f"waiting for exploring episodes: {batch.steps} of {self._learner.batch_size} steps, dropped "
                    f"{batch.dropped_text}"
                )
                self._sleep(POLL_S)
        return batch

    def _admitted(self) -> Iterator[Admitted | str | None]:
        """Yield an episode, or the reason against it; None if no more have ended yet."""
        state = self._run.state
        while True:
            for ended in self._recordings.poll():
                if (ended.file, ended.key) in self._used:
                    continue
                verdict = self._admission.judge(ended.episode, state.versions)
                if verdict is None:
                    continue
                self._used.add((ended.file, ended.key))
                state.used.setdefault(ended.file, []).append(ended.key)
                yield verdict
            yield None


def why_interrupted(run: RunFolder) -> str:
    """Return the sentence about a run that was stopped."""
    versions = run.state.versions
    after = f"with version {versions[-1].version}" if versions else "before its first version"
    return f"stopped {after}; the same command continues"
