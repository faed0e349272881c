"""Shadow versions: a candidate computes after the reply, and only its difference is kept.

No request waits for it: requests beyond a full queue are skipped and counted. Exploratory actions are not compared,
since they differ by chance. The difference is the largest of |candidate - default| over an action's elements, in the
action's own units; for discrete actions it is 0 or the distance of their numbers.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import RlservoError
from rlservo.policy.policy import Policy
from rlservo.serve_app.versions.computing import Computing
from rlservo.serve_app.versions.policy_store import Decision

logger = logging.getLogger(__name__)

WAITING = 64  # requests at most, so that a slow candidate takes neither memory nor the default version's time

Record = Callable[[str, str, str, Iterable[float]], None]
"""Takes the differences between the actions of a policy's version and its shadow: (policy, version, shadow, ...)."""


class Shadows:
    """Compares the candidates' actions with those that were sent."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self.waiting: queue.Queue[tuple[Policy, Any, Decision]] = queue.Queue(WAITING)
        self._thread: threading.Thread | None = None
        self.missed: Counter[tuple[tuple[str, str, str], str]] = Counter()
        """Actions that were not compared, by ((policy, version, shadow), reason)."""

    def offer(self, shadow: Policy, obs: Any, decision: Decision) -> None:
        """Queue `obs` for the candidate. Never waits.

        A stateful candidate is skipped: it would need a recurrent state of its own for every caller.
        """
        series = (decision.name, decision.version, shadow.contract.version)
        self.missed.setdefault((series, "failed"), 0)  # counted in the other thread
        if shadow.is_stateful:
            self.missed[series, "left-out"] += 1
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="shadow", daemon=True)
            self._thread.start()
        try:
            self.waiting.put_nowait((shadow, obs, decision))
        except queue.Full:
            self.missed[series, "left-out"] += 1

    def _run(self) -> None:
        while True:
            shadow, obs, decision = self.waiting.get()
            series = (decision.name, decision.version, shadow.contract.version)
            try:
                with Computing(decision.name, shadow.contract.version):
                    differences = _differences(shadow.act(obs), decision.action, batch=decision.batch)
            except Exception as error:  # this thread serves every shadow and must survive a broken one
                if not isinstance(error, RlservoError):  # as if its action left the space: a shadow is run to find that
                    logger.exception("shadow %s of policy '%s' failed", shadow.contract.version, decision.name)
                self.missed[series, "failed"] += 1
            else:
                self._record(*series, differences.tolist())


def _differences(ours: Any, theirs: Any, *, batch: int | None) -> NDArray[np.float64]:
    """Return the largest difference of each observation's action; nested actions part by part."""
    if isinstance(ours, Mapping):
        return np.max([_differences(ours[key], theirs[key], batch=batch) for key in ours], axis=0)  # type: ignore[no-any-return]
    if isinstance(ours, tuple):
        return np.max([_differences(a, b, batch=batch) for a, b in zip(ours, theirs, strict=True)], axis=0)  # type: ignore[no-any-return]
    difference = np.abs(np.asarray(ours, np.float64) - np.asarray(theirs, np.float64))
    return difference.reshape(1 if batch is None else batch, -1).max(axis=1)  # type: ignore[no-any-return]
