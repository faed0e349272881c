"""Policies, application and background tasks of one server process, the same under every engine."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Sequence
from typing import Any

from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.metrics import keep_sampled
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import loader_and_plans
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
        self.control = PlanFollower(*loader_and_plans(places, settings))
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
        for task in self._tasks:  # none waits with `asyncio.wait_for`, which may lose a cancellation before Python 3.12
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.handler.close()
