"""Checks of a page's messages: a client may send any value, and viser passes most of them on."""

from __future__ import annotations

import contextlib
import logging
import traceback
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlservo.deploy.cockpit.stage import Vector

FARTHEST = 1e3  # [m]
LOGGERS = ("asyncio", "websockets.server")  # that report what viser raises


def number_of(slider: Any) -> float:
    """Return a slider's value within its range; its lower end if it is not a number."""
    value = slider.value
    return float(min(max(value, slider.min), slider.max) if value == value else slider.min)


def point_of(position: Any) -> Vector | None:
    """Return a handle's position [m] (3,), or None if it is not within a kilometre."""
    try:
        point = np.asarray(position, np.float64)
    except (TypeError, ValueError):
        return None
    return point if point.shape == (3,) and (np.abs(point) < FARTHEST).all() else None


@contextlib.contextmanager
def checked_messages() -> Iterator[None]:
    """Refuse messages of another shape than viser's; log unusable ones in one line, without a traceback."""
    loggers = [logging.getLogger(name) for name in LOGGERS]
    for logger in loggers:
        logger.addFilter(_shorten)
    try:
        with warnings.catch_warnings():
            # viser warns, and continues with a position of, for example, two numbers, which later ends the drawing.
            warnings.filterwarnings("error", message=r"\[viser\] .* does not match annotation")
            yield
    finally:
        for logger in loggers:
            logger.removeFilter(_shorten)


def _shorten(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    if error is not None and any("viser" in frame.filename for frame in traceback.extract_tb(error.__traceback__)):
        record.msg, record.args = "the cockpit cannot use what was sent to it: %s: %s", (type(error).__name__, error)
        record.exc_info = None
    return True
