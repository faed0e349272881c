"""One run of a network for all the observations that are waiting for it: micro-batching, where a policy asks for it.

Nobody waits for others to come. What arrived while the event loop was busy is read in one turn of it, and what has been
read by the end of the turn is run together. For a small network a batch saves less than gathering it costs; for a large
one, whose weights are read from memory once instead of once per observation, it carries more (`micro_batch` in
`options.py`; `benchmarks/batching.py` measures it). It knows nothing of policies.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Tensors = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, slots=True)
class Computed:
    """What one observation came to."""

    outputs: Tensors  # `[1, ...]`
    milliseconds: float  # that the run took, for all that were in it
    together: int  # how many those were


class Batcher:
    """Gathers single observations; one event loop's."""

    def __init__(self, run: Callable[[Tensors], Tensors], most: int) -> None:
        """`run` computes a batch, `most` is the largest."""
        self._run = run
        self._most = most
        self._waiting: list[tuple[Mapping[str, NDArray[np.generic]], asyncio.Future[Computed]]] = []
        self.runs = 0  # since the start
        self.observations = 0

    async def compute(self, feed: Mapping[str, NDArray[np.generic]]) -> Computed:
        """Return what `feed`, a batch of one, comes to. Raises what `run` raises."""
        loop = asyncio.get_running_loop()
        mine: asyncio.Future[Computed] = loop.create_future()
        self._waiting.append((feed, mine))
        if len(self._waiting) == self._most:
            self._compute_all()
        elif len(self._waiting) == 1:
            # The tasks of this turn are before it in the loop's queue.
            loop.call_soon(self._compute_all)
        return await mine

    def compute_now(self, feed: Tensors) -> Computed:
        """Return what a batch that came as one comes to: it waits for nobody. Raises what `run` raises."""
        started = time.perf_counter()
        outputs = self._run(feed)
        rows = len(next(iter(feed.values())))
        return Computed(outputs, (time.perf_counter() - started) * 1e3, rows)

    def _compute_all(self) -> None:
        waiting = [(feed, future) for feed, future in self._waiting if not future.done()]  # some may have gone
        self._waiting = []
        if not waiting:
            return
        started = time.perf_counter()
        try:
            first = waiting[0][0]
            together = (
                {name: np.concatenate([feed[name] for feed, _ in waiting]) for name in first}
                if len(waiting) > 1
                else dict(first)
            )
            outputs = self._run(together)
        except Exception as error:
            for _, future in waiting:
                future.set_exception(error)
            return
        milliseconds = (time.perf_counter() - started) * 1e3
        self.runs += 1
        self.observations += len(waiting)
        for row, (_, future) in enumerate(waiting):
            mine = {name: output[row : row + 1] for name, output in outputs.items()}
            future.set_result(Computed(mine, milliseconds, len(waiting)))
