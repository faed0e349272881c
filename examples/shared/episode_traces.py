"""Write what environments and policy did during training, and read it again: one JSON line per piece of an episode.

RLlib's own recorder (`config.output`, ray 2.60) needs cores for Ray Data besides the env runners', and without a
row limit writes every earlier sample again into every file. This is a callback instead. Files are named as RLlib's
documentation shows them, `output-2026-02-23_12-02-03_worker-2_0.json`; a long episode has several lines, in order.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

MAX_BYTES = 64_000_000  # then the next file is begun


@dataclass
class Trace:
    """An episode: one more observation than actions; `ended` is None for one cut off before its end."""

    episode: str
    observations: list[Any] = field(default_factory=list)
    actions: list[Any] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    ended: str | None = None


def trace_writer(folder: Path) -> Callable[..., None]:
    """Return RLlib's callback for the end of sampling, which appends to the env runner's own file in `folder`."""
    target = str(folder)

    def on_sample_end(*, env_runner: Any, samples: list[Any], **_: Any) -> None:
        # Pickled by value into other processes, so whatever changes is kept on the runner.
        state = env_runner.__dict__.setdefault("_trace_file", {"number": -1, "path": None})
        path = state["path"]
        if path is None or (os.path.exists(path) and os.path.getsize(path) > MAX_BYTES):  # noqa: PTH110, PTH202
            state["number"] += 1
            os.makedirs(target, exist_ok=True)  # noqa: PTH103 - no import of this module's own there
            stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
            path = f"{target}/output-{stamp}_{os.getpid()}_worker-{env_runner.worker_index}_{state['number']}.json"
            state["path"] = path
        with open(path, "a", encoding="utf-8") as file:  # noqa: PTH123
            for piece in samples:
                file.write(json.dumps(_piece(piece)) + "\n")

    return on_sample_end


def _piece(episode: Any) -> dict[str, Any]:
    outputs = episode.extra_model_outputs
    # The action sent to the environment, if it differs from the network's (scaled or clipped).
    actions = (
        episode.get_extra_model_outputs("actions_for_env") if "actions_for_env" in outputs else episode.get_actions()
    )
    return {
        "episode": episode.id_,
        "t": episode.t_started,
        "observations": _plain(episode.get_observations()),
        "actions": _plain(actions),
        "rewards": _plain(episode.get_rewards()),
        "ended": "terminated" if episode.is_terminated else "truncated" if episode.is_truncated else None,
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def load_traces(folder: Path) -> Iterator[Trace]:
    """Yield the episodes of every file in `folder`, their pieces put together.

    Observations and actions are as `json` reads them; of a Dict space RLlib gives one map of arrays over time, and such
    a map is kept for each piece.
    """
    for path in sorted(folder.glob("output-*.json")):
        open_episodes: dict[str, Trace] = {}
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                piece = json.loads(line)
            except ValueError:  # the last line of a process that was killed
                continue
            trace = open_episodes.setdefault(piece["episode"], Trace(piece["episode"]))
            observations = piece["observations"]
            if isinstance(observations, list) and trace.observations:
                observations = observations[1:]  # a piece begins with the observation the one before ended with
            trace.observations += observations if isinstance(observations, list) else [observations]
            trace.actions += piece["actions"] if isinstance(piece["actions"], list) else [piece["actions"]]
            trace.rewards += piece["rewards"]
            trace.ended = piece["ended"]
            if trace.ended is not None:
                yield open_episodes.pop(piece["episode"])
        yield from open_episodes.values()
