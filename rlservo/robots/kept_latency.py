"""Latencies that `robot-latency` measured, kept for the gate of real robots, below `$XDG_STATE_HOME/rlservo/robots`."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path


def keep_latency_ms(robot: str, ur_model: str, worst_ms: float) -> Path:
    """Keep the worst latency of a robot; return the file."""
    path = _path(robot, ur_model)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"robot": robot, "ur_model": ur_model, "worst_ms": worst_ms}) + "\n")
    return path


def kept_latency_ms(robot: str, ur_model: str) -> float | None:
    """Return the worst latency of a robot as it was last measured; None if it never was."""
    try:
        kept = json.loads(_path(robot, ur_model).read_text())
        return float(kept["worst_ms"]) if (kept["robot"], kept["ur_model"]) == (robot, ur_model) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _path(robot: str, ur_model: str) -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    name = re.sub(r"[^\w.-]+", "_", f"{robot}_{ur_model}")
    return Path(state, "rlservo", "robots", f"{name}.json")
