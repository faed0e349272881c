"""Start, background steps and end of one server process, the same under every engine."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

from rlservo.errors import RlservoError
from rlservo.serve_app.server import current_keys, metrics, sampled_metrics
from rlservo.serve_app.server.request_handler import RequestHandler

logger = logging.getLogger(__name__)

LOOK_S = 30.0  # [s] between looks for bundles that are not served


@contextlib.asynccontextmanager
async def running(handler: RequestHandler, served: Any, server_folder: Path | None = None) -> AsyncIterator[None]:
    """Load and prove the plan's versions or, without a plan, those of `served` (ServedConfig), and follow changes.

    `server_folder`: see `PlanFollower.configure`. Raises UsageError, BundleError and UnavailableError.
    """
    control, settings = handler.control, handler.settings
    await control.configure(served, server_folder)
    handler.admission.start_clock()
    sample = partial(sampled_metrics.sample, handler) if handler.metrics.folder is not None else None
    if sample is not None:  # for the other workers to read
        await sample()
    background = [
        repeat(control.files.poll_s, control.follow, "the plan cannot be followed"),
        repeat(LOOK_S, control.look, "looking for bundles that are not served", at_once=True),
    ]
    if settings.poll_s is not None:
        background.append(repeat(settings.poll_s, control.load_newer, "looking for new versions failed"))
    if settings.api_keys_file is not None:
        background.append(repeat(current_keys.PERIOD_S, handler.keys.refresh, "the API keys cannot be reread"))
    if sample is not None:
        background.append(repeat(metrics.EVERY_S, sample, "the metrics cannot be sampled"))
    tasks = [asyncio.create_task(each) for each in background]
    # Objects loaded by now stay alive: a garbage collection that walks them would delay requests.
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        for task in tasks:  # none waits with `asyncio.wait_for`, which may lose a cancellation before Python 3.12
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def repeat(
    period_s: float, step: Callable[[], Awaitable[set[str] | None]], fault: str, *, at_once: bool = False
) -> None:
    """Repeat a step until cancelled; log what it returns or raises, each sentence once until it is gone."""
    logged: set[str] = set()
    for number in itertools.count():
        await asyncio.sleep(0.0 if at_once and number == 0 else period_s)
        bug = None
        try:
            wrong = await step() or set()
        except Exception as error:  # it may be out of reach for a while
            wrong, bug = {str(error)}, None if isinstance(error, RlservoError) else error
        for sentence in sorted(wrong - logged):
            logger.warning("%s, serving continues unchanged: %s", fault, sentence, exc_info=bug)
        logged = wrong
