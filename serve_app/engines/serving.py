"""Policies, application and background tasks of one server process, the same under every engine."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Sequence
from typing import Any

from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.sampled_metrics import keep_sampled
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import plan_files, version_loader
from rlservo.serve_app.versions.plan_follower import PlanFollower


class Serving:
    """Application, policies and gRPC of one process; an engine starts and stops them in its event loop."""

    def __init__(
        self,
        places: Sequence[str],
        settings: ServerSettings,
        *,
        replica: str,
        host: str,
        is_alone: bool,
        is_behind_serve: bool = False,
    ) -> None:
        """Take the folders and URIs of policies, this process's name and the address that it listens on.

        `is_alone` says whether every request reaches this process. Nothing is loaded yet. Raises UsageError.
        """
        self.settings = settings
        loader, files = version_loader(places, settings), plan_files(places, settings)
        self.control = PlanFollower(loader, files, replica=replica)
        self.app = create_app(
            lambda: self.control.store,
            settings,
            replica=replica,
            control=self.control,
            host=host,
            is_alone=is_alone,
            is_behind_serve=is_behind_serve,
        )
        self.handler = self.app.handler
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self, served: Any) -> None:
        """Load and prove the plan's versions or, without a plan, those of `served` (ServedConfig).

        Raises UsageError, BundleError and UnavailableError.
        """
        await self.control.configure(served)
        self.handler.admission.start_clock()
        self._tasks.append(asyncio.create_task(self.control.poll_plan()))
        if self.handler.metrics.is_shared:
            self._tasks.append(asyncio.create_task(keep_sampled(self.handler)))
        if self.settings.poll_s is not None:
            self._tasks.append(asyncio.create_task(self.control.poll_repository(self.settings.poll_s)))
        # Objects loaded by now stay alive: a garbage collection that walks them would delay requests.
        gc.collect()
        gc.freeze()

    async def stop(self) -> None:
        """End the background tasks, close connections and complete the recording."""
        await cancel_all(self._tasks)
        await self.handler.close()


async def cancel_all(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancel tasks until they have ended: `asyncio.wait_for` before Python 3.12 may lose a cancellation."""
    left = set(tasks)
    while left:
        for task in left:
            task.cancel()
        _, left = await asyncio.wait(left, timeout=1.0)
