"""Common parts of conversions: episodes of one policy, a new folder, Gymnasium's spaces."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.bundle.spaces import (
    BoxSpec,
    DictSpec,
    DiscreteSpec,
    MultiBinarySpec,
    MultiDiscreteSpec,
    SpaceSpec,
    TupleSpec,
)
from rlservo.errors import UsageError
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.reader import Recording


@contextmanager
def new_path(out: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes `out` at the end, and is removed on failure.

    Raises UsageError if `out` exists, unless it is an empty folder.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} exists: give a new path")
    part = out.with_name(f".{out.name}.part")
    _remove(part)  # left by a conversion that was killed
    part.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield part
        if out.is_dir():
            out.rmdir()
        part.replace(out)
    finally:
        _remove(part)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def episodes_of_one(recording: Recording, name: str | None) -> Iterator[RecordedEpisode]:
    """Yield the episodes of one policy: `name`, or the only one.

    Raises UsageError if the recording has several policies, or versions with different observations or actions.
    """
    chosen: RecordedEpisode | None = None
    for episode in episodes(recording):
        if name is not None and episode.policy.contract.name != name:
            continue
        first = chosen or episode
        spaces = [(one.policy.contract.observation_space, one.policy.contract.action_space) for one in (first, episode)]
        if episode.policy.contract.name != first.policy.contract.name:
            raise UsageError(
                f"the recording has several policies ({first.policy.contract.name}, {episode.policy.contract.name}): "
                "name one with --policy"
            )
        if spaces[0] != spaces[1]:
            raise UsageError(
                f"{first.policy.title} and {episode.policy.title} have different observations or actions: convert "
                "their files separately"
            )
        chosen = first
        yield episode
    if chosen is None:
        raise UsageError(f"the recording has no decisions of {'any policy' if name is None else f'policy {name!r}'}")


def gym_space(spec: SpaceSpec) -> Any:
    """Return the contract's space as Gymnasium's."""
    from gymnasium import spaces

    if isinstance(spec, DictSpec):
        return spaces.Dict({key: gym_space(child) for key, child in spec.spaces.items()})
    if isinstance(spec, TupleSpec):
        return spaces.Tuple([gym_space(child) for child in spec.spaces])
    if isinstance(spec, DiscreteSpec):
        return spaces.Discrete(spec.n, start=spec.start)
    if isinstance(spec, MultiDiscreteSpec):
        return spaces.MultiDiscrete(np.reshape(spec.nvec, spec.shape), start=np.reshape(spec.start, spec.shape))
    if isinstance(spec, MultiBinarySpec):
        return spaces.MultiBinary(list(spec.shape))
    assert isinstance(spec, BoxSpec)
    low, high = spec.bounds()
    kind = np.dtype(spec.dtype)
    return spaces.Box(low.astype(kind), high.astype(kind), spec.shape, kind.type)
