"""Waiting for a condition, which passes on a slow machine as soon as it holds."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = float(os.environ.get("RLSERVO_PATIENCE_S", 180.0))  # a browser that draws in software on a busy machine


def wait_for(
    condition: Callable[[], Any], what: str = "a condition", timeout_s: float = PATIENCE_S, *, poll_s: float = 0.05
) -> Any:
    """Poll until something is true, and return it."""
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited {timeout_s:g} s for {what}"
        time.sleep(poll_s)
    return found


async def until(condition: Callable[[], Any], what: str = "a condition", timeout_s: float = 60.0) -> None:
    """Poll in an event loop until something is true."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout_s:g} s for {what}"
        await asyncio.sleep(0.02)
