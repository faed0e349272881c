"""A recording as one Parquet file: one row per decision and its outcome, a list column per tensor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.extras import optional_package
from rlservo.recording.conversion.common import episodes_of_one, new_path
from rlservo.recording.episodes import RecordedEpisode
from rlservo.recording.reader import Recording
from rlservo.recording.unsquashed_actions import own_actions


def export_parquet(recording: Recording, out: str | Path, *, name: str | None = None) -> int:
    """Write the new file `out` and return its number of rows; the contract is in the schema's metadata.

    Columns: eps_id, t, time, obs..., actions..., own_actions..., own_actions_clipped, action_logp, action_dist_inputs,
    rewards, terminateds, truncateds, explore, fell_back, error, latency_ms, version. `actions` are what the robot
    executed, `own_actions` what RLlib learns from (`own_actions.py`). Raises UsageError and RecordingError.
    """
    pa = optional_package("pyarrow", "an export to Parquet")
    pq = optional_package("pyarrow.parquet", "an export to Parquet")
    rows = 0
    with new_path(Path(out)) as part, ExitStack() as stack:
        writer: Any = None
        for episode in episodes_of_one(recording, name):
            table = pa.table(dict(_columns(pa, episode)))
            if writer is None:
                metadata = {"rlservo.contract": episode.policy.contract_document}
                writer = stack.enter_context(pq.ParquetWriter(part, table.schema.with_metadata(metadata)))
            writer.write_table(table.cast(writer.schema))
            rows += len(table)
    return rows


def _columns(pa: Any, episode: RecordedEpisode) -> Iterator[tuple[str, Any]]:
    rows = len(episode)
    last = np.arange(rows) == rows - 1
    yield "eps_id", pa.array([episode.id] * rows, pa.string())
    yield "t", pa.array(episode.steps)
    yield "time", pa.array(episode.wall_ns, pa.timestamp("ns", tz="UTC"))
    drawn = np.isfinite(episode.logp)
    own = own_actions(episode)
    for prefix, tensors, known in (
        ("obs", episode.obs, None),
        ("actions", episode.executed, episode.acted | episode.fell_back),
        ("own_actions", own.leaves, own.known),
    ):
        for tensor, leaf in tensors.items():
            yield prefix + tensor.removeprefix("obs").removeprefix("action"), _tensor(pa, leaf, known)
    yield "own_actions_clipped", pa.array(own.clipped)
    yield "action_logp", pa.array(episode.logp, pa.float64(), mask=~drawn)
    inputs = [row.tolist() if known else None for row, known in zip(episode.dist_inputs, drawn, strict=True)]
    yield "action_dist_inputs", pa.array(inputs, pa.list_(pa.float32()))
    yield "rewards", pa.array(episode.reward, pa.float64(), mask=~np.isfinite(episode.reward))
    yield "terminateds", pa.array(last & episode.terminated)
    yield "truncateds", pa.array(last & episode.truncated)
    yield "final_status", pa.array([episode.final_status if end else None for end in last], pa.string())
    yield "explore", pa.array(episode.explored)
    yield "fell_back", pa.array(episode.fell_back)
    yield "error", pa.array(episode.errors, pa.string())
    yield "latency_ms", pa.array(episode.latency_ms, pa.float64(), mask=~np.isfinite(episode.latency_ms))
    yield "version", pa.array([episode.policy.contract.version] * rows, pa.string())


def _tensor(pa: Any, leaf: np.ndarray[Any, Any], known: np.ndarray[Any, Any] | None) -> Any:
    """Return a column: numbers for a choice, else lists in row-major order; null where `known` is false."""
    kind = pa.from_numpy_dtype(leaf.dtype)
    if leaf.ndim == 1:
        return pa.array(leaf, kind, mask=None if known is None else ~known)
    size = int(np.prod(leaf.shape[1:]))
    values = pa.array(np.ascontiguousarray(leaf).reshape(-1), kind)
    if known is None or known.all():
        return pa.FixedSizeListArray.from_arrays(values, size)
    return pa.FixedSizeListArray.from_arrays(values, size, mask=pa.array(~known))
