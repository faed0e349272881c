"""A recording as a Minari dataset, Farama's format for offline reinforcement learning."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.bundle.contract import Provenance
from rlservo.bundle.environment_id import importing_id
from rlservo.bundle.nested import build_action
from rlservo.errors import UsageError
from rlservo.extras import optional_package
from rlservo.recording.conversion.common import episodes_of_one, gym_space, new_path
from rlservo.recording.episodes import RecordedEpisode
from rlservo.recording.reader import Recording

PATH_VARIABLE = "MINARI_DATASETS_PATH"


def export_minari(recording: Recording, out: str | Path, *, name: str | None = None) -> tuple[str, int, str | None]:
    """Write a dataset into the new folder `out` and return (its id, episodes, the id of its environment).

    `MINARI_DATASETS_PATH=out`, an absolute path, lets minari load it by that id. The environment for minari's
    `recover_environment` is the one that the policy was trained in; None if it is not installed here with the policy's
    observations and actions. Minari's episodes need every reward, an end and the observation after the last action:
    others are left out. Raises UsageError if nothing is left, and RecordingError.
    """
    minari = optional_package("minari", "an export to Minari")
    collector = optional_package("minari.data_collector", "an export to Minari")
    optional_package("pyarrow", "an export to Minari")
    buffers: list[Any] = []
    last: RecordedEpisode | None = None
    for episode in episodes_of_one(recording, name):
        if not _is_whole(episode):
            continue
        last = episode
        final = episode.final_obs
        assert final is not None
        contract = episode.policy.contract
        observations = {key: np.concatenate([leaf, final[key]]) for key, leaf in episode.obs.items()}
        ends = np.arange(len(episode)) == len(episode) - 1
        buffers.append(
            collector.EpisodeBuffer(
                id=len(buffers),
                observations=build_action(contract.observation_space, observations, "obs"),
                actions=build_action(contract.action_space, episode.executed, "action"),
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
    spaces = gym_space(contract.observation_space), gym_space(contract.action_space)
    env = _environment(contract.provenance, spaces)
    with new_path(Path(out)) as folder, _datasets_in(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that author or environment is missing
        folder.mkdir()
        minari.create_dataset_from_buffers(
            identity,
            buffers,
            env=env,
            observation_space=spaces[0],
            action_space=spaces[1],
            algorithm_name=contract.provenance.algorithm,
            description=f"Recorded with rlservo from {last.policy.title}",
            data_format="arrow",
        )
    return identity, len(buffers), None if env is None else env.id


def _environment(origin: Provenance, spaces: tuple[Any, Any]) -> Any:
    """Return the Gymnasium specification of the training environment, if it can be made and has these spaces."""
    import gymnasium as gym

    if ":" in (origin.env_id or ":"):  # a module, which a recording must not import
        return None
    try:
        env = gym.make(importing_id(str(origin.env_id)), disable_env_checker=True, **origin.env_config)
    except Exception:  # a constructor is third-party code
        return None
    env.close()
    return env.spec if (env.observation_space, env.action_space) == spaces else None


def _is_whole(episode: RecordedEpisode) -> bool:
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
    """Let minari keep its datasets in `folder`, which it reads only from the environment."""
    before = os.environ.get(PATH_VARIABLE)
    os.environ[PATH_VARIABLE] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[PATH_VARIABLE]
        else:
            os.environ[PATH_VARIABLE] = before
