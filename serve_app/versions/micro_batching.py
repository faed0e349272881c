"""Micro-batching: one run of a network for all the observations that wait for it.

Nobody waits for others to come. What arrived while the event loop was busy is read in one turn of it, and what has been
read by the end of the turn is run together. A single caller does not even wait for the end of the turn: observations
are gathered only when there were several in the turn before. What that saves grows with the network, whose weights are
read from memory once instead of once per observation (`micro_batch` in `runtime/options.py`).
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Tensors = dict[str, NDArray[np.generic]]
Check = Callable[[], None]


@dataclass(frozen=True, slots=True)
class RunResult:
    """The network's outputs for one request."""

    outputs: Tensors  # `[1, ...]`
    milliseconds: float  # that the run took, for all that were in it
    requests: int  # whose observations were in it


@dataclass(frozen=True, slots=True)
class _Pending:
    feed: Mapping[str, NDArray[np.generic]]
    check: Check | None
    future: asyncio.Future[RunResult]

    def admit(self) -> bool:
        """Return whether to compute it. A failed check is set on the caller's future."""
        if self.future.done():  # its caller has gone
            return False
        try:
            if self.check is not None:
                self.check()
        except Exception as error:
            self.future.set_exception(error)
            return False
        return True


class Batcher:
    """Gathers single observations; one event loop's."""

    def __init__(self, run: Callable[[Tensors], Tensors], most: int) -> None:
        """`run` computes a batch, `most` is the largest."""
        self._run = run
        self._most = most
        self._pending: list[_Pending] = []
        self._arrived = 0  # in this turn
        self._several = False  # in the turn before
        self.runs = 0  # since the start
        self.observations = 0

    async def compute(self, feed: Mapping[str, NDArray[np.generic]], check: Check | None = None) -> RunResult:
        """Compute `feed`, a batch of one; `check` is called right before.

        Raises what `run` and `check` raise.
        """
        loop = asyncio.get_running_loop()
        if self._arrived == 0:
            # The tasks of this turn are before it in the loop's queue.
            loop.call_soon(self._end_turn)
        self._arrived += 1
        if not self._several:
            (alone,) = self._compute([feed])
            return alone
        mine: asyncio.Future[RunResult] = loop.create_future()
        self._pending.append(_Pending(feed, check, mine))
        if len(self._pending) == self._most:
            self._compute_all()
        return await mine

    def compute_now(self, feed: Tensors) -> RunResult:
        """Compute a batch that came as one, without waiting. Raises what `run` raises."""
        started = time.perf_counter()
        outputs = self._run(feed)
        return RunResult(outputs, (time.perf_counter() - started) * 1e3, 1)  # one run, whatever is in it

    def _end_turn(self) -> None:
        self._compute_all()
        self._several = self._arrived > 1
        self._arrived = 0

    def _compute_all(self) -> None:
        pending = [each for each in self._pending if each.admit()]
        self._pending = []
        if not pending:
            return
        try:
            computed = self._compute([each.feed for each in pending])
        except Exception as error:
            for each in pending:
                each.future.set_exception(error)
            return
        for each, one in zip(pending, computed, strict=True):
            each.future.set_result(one)

    def _compute(self, feeds: Sequence[Mapping[str, NDArray[np.generic]]]) -> list[RunResult]:
        rows = len(feeds)
        started = time.perf_counter()
        outputs = self._run({name: np.concatenate([feed[name] for feed in feeds]) for name in feeds[0]})
        milliseconds = (time.perf_counter() - started) * 1e3
        for name, output in outputs.items():
            if output.shape[:1] != (rows,):
                raise ValueError(f"'{name}' came in shape {output.shape} for {rows} observations")
        self.runs += 1
        self.observations += rows
        return [
            RunResult({name: output[row : row + 1] for name, output in outputs.items()}, milliseconds, rows)
            for row in range(rows)
        ]
