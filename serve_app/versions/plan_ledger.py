"""Ledger of numbered plans that all replicas share."""

from __future__ import annotations

import asyncio
from typing import Protocol

from rlservo.export.contract.errors import UnavailableError
from rlservo.serve_app.versions.plan import Plan

ATTEMPTS = 10  # at a number in the ledger, before a change gives up


class Ledger(Protocol):
    """Numbered plans that all replicas see and only add to."""

    def newest(self) -> int:
        """Return the highest number, 0 when there is none."""
        ...

    def fetch(self, generation: int) -> bytes | None:
        """Return a plan; None when it is not there (any more)."""
        ...

    def append(self, generation: int, content: bytes) -> bool:
        """Write a plan under a number that is free; return False when it is not."""
        ...


class MemoryLedger:
    """The plans of one process."""

    def __init__(self) -> None:
        self._plans: dict[int, bytes] = {}

    def newest(self) -> int:
        return max(self._plans, default=0)

    def fetch(self, generation: int) -> bytes | None:
        return self._plans.get(generation)

    def append(self, generation: int, content: bytes) -> bool:
        return self._plans.setdefault(generation, content) is content


class PlanLedger:
    """Plans in a ledger, fetched and appended in a thread: a ledger may block."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    async def newest_generation(self) -> int:
        """Return the highest number, 0 when there is no plan."""
        return await asyncio.to_thread(self._ledger.newest)

    async def newest(self) -> Plan | None:
        """Return the newest plan, if there is one. Raises UnavailableError."""
        for _ in range(ATTEMPTS):  # it may be gone by the time it is fetched, when many follow at once
            generation = await self.newest_generation()
            if generation == 0:
                return None
            content = await asyncio.to_thread(self._ledger.fetch, generation)
            if content is not None:
                return Plan.model_validate_json(content)
        raise UnavailableError("the ledger of policies changes faster than it can be read")

    async def append(self, plan: Plan) -> bool:
        """Write a plan under its number; return False when that is taken."""
        return await asyncio.to_thread(self._ledger.append, plan.generation, plan.model_dump_json().encode())
