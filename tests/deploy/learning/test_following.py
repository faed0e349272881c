"""Recordings followed while they are written."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from rlservo.deploy.learning import followed_recordings as following
from rlservo.deploy.learning.followed_recordings import Ended, FollowedRecordings
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import Recorder
from rlservo.recording.records import DecisionRecord, OutcomeRecord

OBS = np.zeros(27, np.float32)


def act(policy: WithRecording, steps: int, *, ends: bool) -> None:
    for step in range(steps):
        policy.act(OBS, explore=True)
        last = ends and step == steps - 1
        policy.outcome(1.0, terminated=last, final_obs=OBS if last else None)


def record_cell(recorder: Recorder, ur5: Path) -> None:
    """Record two decisions of a robot that always has this id."""
    policy = recorder.policy(Policy.load(ur5).contract)
    for step, last in enumerate((False, True)):
        recorder.record(DecisionRecord(policy, OBS, np.zeros(6), "cell", step))
        recorder.record(OutcomeRecord(policy, "cell", step, 1.0, terminated=last, final_obs=OBS if last else None))


@pytest.fixture
def said() -> list[str]:
    return []


def polled(followed: FollowedRecordings, count: int) -> list[Ended]:
    """Poll until so many episodes have come: the writer flushes within a second."""
    found: list[Ended] = []
    deadline = time.monotonic() + 60
    while len(found) < count and time.monotonic() < deadline:
        found += followed.poll()
        time.sleep(0.1)
    return [*found, *followed.poll()]


def test_an_episode_comes_once_as_soon_as_it_has_ended(ur5: Path, tmp_path: Path, said: list[str]) -> None:
    followed = FollowedRecordings([tmp_path], said.append)
    assert list(followed.poll()) == []
    with Recorder(tmp_path) as recorder, WithRecording(Policy.load(ur5), recorder) as policy:
        act(policy, 3, ends=True)
        policy.reset()
        act(policy, 2, ends=False)  # continues below, in a file that was read in between
        first = polled(followed, 1)
        act(policy, 4, ends=True)
        second = polled(followed, 1)
    assert [len(one.episode) for one in first] == [3] and [len(one.episode) for one in second] == [6]
    assert second[0].episode.gap is None and second[0].episode.terminated
    assert first[0].key != second[0].key and followed.names() == {first[0].file}
    assert list(followed.poll()) == [] and said == []


def test_robots_that_use_an_id_again_have_episodes_of_their_own(ur5: Path, tmp_path: Path, said: list[str]) -> None:
    with Recorder(tmp_path) as one, Recorder(tmp_path) as other:  # two servers, one folder
        for recorder in (one, other, one):
            record_cell(recorder, ur5)
    found = polled(FollowedRecordings([tmp_path], said.append), 3)
    assert len(found) == 3 == len({(each.file, each.key) for each in found})
    assert [each.episode.gap for each in found] == [None] * 3


def test_a_file_that_is_no_recording_is_named_once_and_the_others_are_read(
    ur5: Path, tmp_path: Path, said: list[str]
) -> None:
    (tmp_path / "another.mcap").write_bytes(b"no recording at all, but long enough")
    with Recorder(tmp_path) as recorder, WithRecording(Policy.load(ur5), recorder) as policy:
        act(policy, 2, ends=True)
    followed = FollowedRecordings([tmp_path], said.append)
    assert len(polled(followed, 1)) == 1
    assert len(said) == 1 and "another.mcap is not an MCAP file: left out" in said[0]


def test_a_file_that_was_seen_before_its_first_byte_is_read_later(ur5: Path, tmp_path: Path, said: list[str]) -> None:
    recorded, followed = tmp_path / "recorded", FollowedRecordings([tmp_path], said.append)
    recorded.mkdir()
    with Recorder(recorded) as recorder, WithRecording(Policy.load(ur5), recorder) as policy:
        act(policy, 2, ends=True)
    (whole,) = recorded.iterdir()
    (growing := tmp_path / whole.name).touch()
    for end in (0, 3, None):
        growing.write_bytes(whole.read_bytes()[:end])
        found = list(followed.poll())
    assert len(found) == 1 and said == []


def test_the_clocks_of_servers_may_be_apart(
    ur5: Path, tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folders, now = [tmp_path / name for name in "abc"], time.time_ns
    for folder, days in zip(folders, (-3, 0, 400), strict=True):
        with monkeypatch.context() as patched:
            patched.setattr(time, "time_ns", lambda days=days: now() + days * 86_400_000_000_000)
            with Recorder(folder) as recorder:
                record_cell(recorder, ur5)
    found = polled(FollowedRecordings(folders, said.append), 3)
    assert [len(each.episode) for each in found] == [2] * 3 and len({each.key for each in found}) == 3
    assert [each.episode.gap for each in found] == [None] * 3 and said == []


def test_an_episode_that_no_one_ends_comes_when_it_has_been_silent(
    ur5: Path, tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "SILENT_NS", 0)
    with Recorder(tmp_path) as recorder:
        for _ in range(2):
            with WithRecording(Policy.load(ur5), recorder) as policy:
                for _ in range(3):
                    policy.act(OBS, explore=True)
    (found,) = polled(FollowedRecordings([tmp_path], said.append), 1)
    assert len(found.episode) == 3 and not found.episode.ended


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--recordings .*nowhere: expected the folder in which a server records"):
        FollowedRecordings([tmp_path / "nowhere"], str)
