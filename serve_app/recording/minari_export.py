"""A recording as a Minari dataset, Farama's format for offline reinforcement learning."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.nested import build_action
from rlservo.serve_app.recording.conversion import episodes_of_one, gym_space, new_folder, optional_package
from rlservo.serve_app.recording.episodes import Episode
from rlservo.serve_app.recording.reader import Recording

PATH_VARIABLE = "MINARI_DATASETS_PATH"


def export_minari(recording: Recording, out: str | Path, *, name: str | None = None) -> tuple[str, int]:
    """Write a dataset into the new folder `out` and return (its id, episodes).

    `MINARI_DATASETS_PATH=out` lets minari load it by that id. Minari's episodes need every reward, an end and the
    observation after the last action: others are left out. Raises UsageError where nothing is left, and RecordingError.
    """
    minari = optional_package("minari", "an export to Minari")
    collector = optional_package("minari.data_collector", "an export to Minari")
    optional_package("pyarrow", "an export to Minari")
    buffers: list[Any] = []
    last: Episode | None = None
    for episode in episodes_of_one(recording, name):
        if not _is_whole(episode):
            continue
        last = episode
        final = episode.final_obs
        assert final is not None
        spaces = episode.policy.contract
        observations = {key: np.concatenate([leaf, final[key]]) for key, leaf in episode.obs.items()}
        ends = np.arange(len(episode)) == len(episode) - 1
        buffers.append(
            collector.EpisodeBuffer(
                id=len(buffers),
                observations=build_action(spaces.observation_space, observations, "obs"),
                actions=build_action(spaces.action_space, episode.executed, "action"),
                rewards=episode.reward.tolist(),
                terminations=(ends & episode.terminated).tolist(),
                truncations=(ends & ~np.bool_(episode.terminated)).tolist(),
                infos={},
            )
        )
    if last is None:
        raise UsageError("the recording has no whole episode with rewards and its last observation to convert")
    contract = last.policy.contract
    identity = f"rlservo/{contract.name}-v0"
    with _datasets_in(new_folder(Path(out))), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that there is no author and no environment
        minari.create_dataset_from_buffers(
            identity,
            buffers,
            observation_space=gym_space(contract.observation_space),
            action_space=gym_space(contract.action_space),
            algorithm_name=contract.provenance.algorithm,
            description=f"Recorded with rlservo from {last.policy.title}",
            data_format="arrow",
        )
    return identity, len(buffers)


def _is_whole(episode: Episode) -> bool:
    return bool(
        episode.id
        and episode.begins
        and episode.gap is None
        and episode.ended
        and not episode.goes_on
        and episode.final_obs is not None
        and np.isfinite(episode.reward).all()
        and (episode.acted | episode.fell_back).all()
    )


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Let minari keep its datasets in `folder`: it reads the place from the environment alone."""
    before = os.environ.get(PATH_VARIABLE)
    os.environ[PATH_VARIABLE] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[PATH_VARIABLE]
        else:
            os.environ[PATH_VARIABLE] = before
