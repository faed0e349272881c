"""A recording as a LeRobotDataset v3.0: data, episodes, tasks, info and statistics, written only with pyarrow.

The layout is LeRobot's documented one (huggingface.co/docs/lerobot/lerobot-dataset-v3): one file of frames, and one of
episodes with their statistics, whose columns are named `stats/<feature>/<figure>`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import UsageError
from rlservo.extras import optional_package
from rlservo.recording.conversion.common import episodes_of_one, new_path
from rlservo.recording.episodes import Columns, RecordedEpisode
from rlservo.recording.reader import Recording

DATA_FILE = "data/chunk-000/file-000.parquet"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
QUANTILES = {"q01": 1, "q10": 10, "q50": 50, "q90": 90, "q99": 99}
DEFAULT_FPS = 10
REWARD = "next.reward"
TASKS_FOR_PANDAS = {  # LeRobot looks up tasks by their sentence, the table's index
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
        for name, kind, numpy_kind in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
    "pandas_version": "2.0.0",
}


def export_lerobot(
    recording: Recording, out: str | Path, *, name: str | None = None, task: str | None = None
) -> tuple[int, int]:
    """Write the new folder `out` and return (episodes, frames).

    Observations are `observation.state`, the robot's command is `action`. Episodes with a gap, or with a step
    without an action, are left out. Raises UsageError if nothing is left, and RecordingError.
    """
    pa = optional_package("pyarrow", "an export to LeRobot")
    pq = optional_package("pyarrow.parquet", "an export to LeRobot")
    with new_path(Path(out)) as folder, ExitStack() as stack:
        return _write(pa, pq, stack, folder, episodes_of_one(recording, name), task)


def _write(
    pa: Any, pq: Any, stack: ExitStack, folder: Path, episodes: Iterator[RecordedEpisode], task: str | None
) -> tuple[int, int]:
    (folder / DATA_FILE).parent.mkdir(parents=True)
    (folder / EPISODES_FILE).parent.mkdir(parents=True)
    writer: Any = None
    rows: list[dict[str, Any]] = []
    frames, fps, features, sentence = 0, float(DEFAULT_FPS), {}, task or ""
    for episode in episodes:
        if not episode.id or not episode.begins or episode.goes_on or episode.gap is not None:
            continue
        if not (episode.acted | episode.fell_back).all():
            continue
        contract = episode.policy.contract
        fps = contract.control_rate_hz or fps
        sentence = task or contract.description or contract.name
        data = _frame_columns(episode, len(rows), frames, fps)
        features = _features(episode, data)
        table = pa.table({key: _column(pa, column) for key, column in data.items()})
        if writer is None:
            writer = stack.enter_context(pq.ParquetWriter(folder / DATA_FILE, table.schema))
        elif table.column_names != writer.schema.names:
            which, before = (
                ("lacks rewards", "has them") if REWARD in writer.schema.names else ("has rewards", "lacks them")
            )
            raise UsageError(
                f"episode {episode.id!r} {which}, and the one before it {before}: all frames of a LeRobotDataset need "
                "the same columns: convert recordings with and without rewards separately, or to parquet"
            )
        writer.write_table(table)
        row: dict[str, Any] = {
            "episode_index": len(rows),
            "tasks": [sentence],
            "length": len(episode),
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": frames,
            "dataset_to_index": frames + len(episode),
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for key, column in data.items():
            row |= {f"stats/{key}/{figure}": value for figure, value in _statistics(column).items()}
        rows.append(row)
        frames += len(episode)
    if writer is None:
        raise UsageError("the recording has no whole episode to convert")
    writer.close()
    pq.write_table(pa.Table.from_pylist(rows), folder / EPISODES_FILE)
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [sentence]})
    pq.write_table(
        tasks.replace_schema_metadata({"pandas": json.dumps(TASKS_FOR_PANDAS)}), folder / "meta/tasks.parquet"
    )
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(rows),
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(fps),
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
    whole = pq.read_table(folder / DATA_FILE)
    stats = {key: _statistics(np.array(whole.column(key).to_pylist(), np.float64)) for key in features}
    (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4))
    return len(rows), frames


def _frame_columns(episode: RecordedEpisode, number: int, first: int, fps: float) -> dict[str, NDArray[Any]]:
    steps = np.arange(len(episode), dtype=np.int64)
    columns: dict[str, NDArray[Any]] = {
        "observation.state": _flat(episode.obs),
        "action": _flat(episode.executed),
        "timestamp": (steps / fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(len(episode), number, np.int64),
        "index": first + steps,
        "task_index": np.zeros(len(episode), np.int64),
    }
    if np.isfinite(episode.reward).all():
        columns[REWARD] = episode.reward.astype(np.float32)
        columns["next.done"] = (steps == len(episode) - 1) & episode.ended
    return columns


def _features(episode: RecordedEpisode, data: dict[str, NDArray[Any]]) -> dict[str, Any]:
    names = {
        "observation.state": _labels(episode.policy.observations, episode.obs),
        "action": _labels(episode.policy.actions, episode.executed),
    }
    return {
        key: {
            "dtype": str(column.dtype),
            "shape": list(column.shape[1:]) or [1],
            "names": names.get(key),
        }
        for key, column in data.items()
    }


def _labels(space: Any, columns: Columns) -> list[str]:
    return [label for name in columns for label in space.labels(name)]


def _flat(columns: Columns) -> NDArray[np.float32]:
    return np.concatenate([leaf.reshape(len(leaf), -1).astype(np.float32) for leaf in columns.values()], axis=1)


def _column(pa: Any, column: NDArray[Any]) -> Any:
    if column.ndim == 1:
        return pa.array(column)
    values = pa.array(np.ascontiguousarray(column).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(values, column.shape[1])


def _statistics(column: NDArray[Any]) -> dict[str, list[float] | list[int]]:
    wide = column.reshape(len(column), -1).astype(np.float64)
    figures: dict[str, list[float] | list[int]] = {
        "min": wide.min(axis=0).tolist(),
        "max": wide.max(axis=0).tolist(),
        "mean": wide.mean(axis=0).tolist(),
        "std": wide.std(axis=0).tolist(),
        "count": [len(column)],
    }
    for figure, percent in QUANTILES.items():
        figures[figure] = np.percentile(wide, percent, axis=0).tolist()
    return figures
