"""Shadow versions: a candidate computes after the reply, and only its difference is kept.

No request waits for it: requests beyond a full queue are skipped and counted. Exploring actions are not compared, since
they differ by chance. The difference is the largest of |candidate - default| over an action's elements, in the action's
own units; for discrete actions it is 0 or the distance of their numbers.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import RlservoError
from rlservo.serve_app.versions.policy_store import Decision, Shadow

logger = logging.getLogger(__name__)

WAITING = 64  # requests at most, so that a slow candidate takes neither memory nor the default version's time

Record = Callable[[str, str, str, Iterable[float]], None]
"""Takes the differences between the actions of a policy's version and its shadow: (policy, version, shadow, ...)."""


class _Series:
    """Differences and counts of one candidate against one default version."""

    def __init__(self) -> None:
        self.compared = 0
        self.total = 0.0
        self.largest = 0.0
        self.failed = 0
        self.left_out = 0


class Shadows:
    """Compares the candidates' actions with those that were sent."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._waiting: queue.Queue[tuple[Shadow, Any, Decision]] = queue.Queue(WAITING)
        self._thread: threading.Thread | None = None
        self._series: dict[tuple[str, str, str], _Series] = {}

    def offer(self, shadow: Shadow, obs: Any, decision: Decision) -> None:
        """Queue `obs` for the candidate. Never waits.

        A stateful candidate is skipped: it would need a recurrent state of its own for every caller.
        """
        if shadow.policy.is_stateful:
            self._series_of(shadow, decision).left_out += 1
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="shadow", daemon=True)
            self._thread.start()
        try:
            self._waiting.put_nowait((shadow, obs, decision))
        except queue.Full:
            self._series_of(shadow, decision).left_out += 1

    def describe(self, policy: str, version: str, shadow: str) -> dict[str, Any]:
        """Return how the candidate compares so far, on this replica."""
        series = self._series.get((policy, version, shadow)) or _Series()
        return {
            "version": shadow,
            "compared": series.compared,
            "mean_difference": series.total / series.compared if series.compared else None,
            "largest_difference": series.largest if series.compared else None,
            "failed": series.failed,
            "left_out": series.left_out,
        }

    def missed(self) -> Iterator[tuple[str, str, str, str, int]]:
        """Yield (policy, version, shadow, reason, count) of the actions that were not compared."""
        for key, series in list(self._series.items()):
            yield (*key, "failed", series.failed)
            yield (*key, "left-out", series.left_out)

    def _run(self) -> None:
        while True:
            shadow, obs, decision = self._waiting.get()
            series = self._series_of(shadow, decision)
            try:
                differences = _differences(shadow.policy.act(obs), decision.action, batch=decision.batch)
            except RlservoError:  # for example its action left the space: a shadow is run to find that
                series.failed += 1
                continue
            except Exception:  # this thread serves every shadow and must survive a broken one
                logger.exception("shadow %s of policy '%s' failed", shadow.version, decision.name)
                series.failed += 1
                continue
            self._record(decision.name, decision.version, shadow.version, differences.tolist())
            series.compared += len(differences)
            series.total += float(differences.sum())
            series.largest = max(series.largest, float(differences.max(initial=0.0)))

    def _series_of(self, shadow: Shadow, decision: Decision) -> _Series:
        return self._series.setdefault((decision.name, decision.version, shadow.version), _Series())


def _differences(ours: Any, theirs: Any, *, batch: int | None) -> NDArray[np.float64]:
    """Return the largest difference of each observation's action; nested actions part by part."""
    if isinstance(ours, Mapping):
        return np.max([_differences(ours[key], theirs[key], batch=batch) for key in ours], axis=0)  # type: ignore[no-any-return]
    if isinstance(ours, tuple):
        return np.max([_differences(a, b, batch=batch) for a, b in zip(ours, theirs, strict=True)], axis=0)  # type: ignore[no-any-return]
    difference = np.abs(np.asarray(ours, np.float64) - np.asarray(theirs, np.float64))
    return difference.reshape(1 if batch is None else batch, -1).max(axis=1)  # type: ignore[no-any-return]
