"""Recordings are exact, complete to the last second, bounded, and open with mcap's own reader."""

from __future__ import annotations

import itertools
import json
import logging
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from bundles import write_box_policy
from command_line import rlservo_here
from rlservo.bundle.contract import Distribution
from rlservo.bundle.log_probability import log_probability
from rlservo.bundle.spaces import BoxSpec, DictSpec, DiscreteSpec, MultiDiscreteSpec, TupleSpec
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording import recorder as recorder_module
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.log_file import LogFile
from rlservo.recording.reader import Recording, RecordingError
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import MIB, Recorder
from rlservo.recording.records import DecisionRecord, OutcomeRecord
from waiting import wait_for

Rng = np.random.Generator


@pytest.fixture
def rng() -> Rng:
    return np.random.default_rng(0)


def record_episode(policy: WithRecording, rng: Rng, steps: int, *, explore: bool = False) -> list[Any]:
    """Act on random observations; return [(obs, action)]."""
    policy.reset()
    done = []
    for step in range(steps):
        obs = rng.standard_normal(27).astype(np.float32)
        done.append((obs.copy(), policy.act(obs, explore=explore)))
        obs[:] = 0  # what an environment may do with its buffer
        last = step == steps - 1
        final = np.full(27, 7, np.float32) if last else None
        policy.outcome(float(step), terminated=last, final_status="success" if last else None, final_obs=final)
    return done


def only(path: Path) -> RecordedEpisode:
    (episode,) = episodes(Recording(path))
    return episode


def test_recorded_numbers_come_back_bit_for_bit(ur5: Path, tmp_path: Path, rng: Rng) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        done = record_episode(policy, rng, 20)
    episode = only(tmp_path / "run.mcap")
    seen, sent = (np.stack(column) for column in zip(*done, strict=True))
    assert episode.obs["obs"].tobytes() == seen.tobytes()
    assert episode.action["action"].tobytes() == sent.tobytes()
    assert episode.obs["obs"].dtype == np.float32
    assert episode.reward.tolist() == list(range(20))
    assert (episode.begins, episode.gap, episode.ended, episode.terminated) == (True, None, True, True)
    assert episode.final_status == "success"
    assert episode.final_obs is not None and (episode.final_obs["obs"] == 7).all()
    assert np.isfinite(episode.latency_ms).all() and (np.diff(episode.time_s) > 0).all()


@pytest.mark.parametrize("dtype", ["float32", "float64", "uint8", "int64"])
def test_any_number_of_a_type_comes_back(dtype: str, rng: Rng) -> None:
    from rlservo.recording.policy_format import SpaceFormat

    kind = np.dtype(dtype)
    bits = rng.integers(0, 256, 4000 * kind.itemsize, dtype=np.uint8).view(kind)
    values = bits[np.isfinite(bits)][:3999] if kind.kind == "f" else bits[:3999]
    space = SpaceFormat(BoxSpec(shape=(3,), dtype=dtype, low=None, high=None), "obs")
    rows = values[: len(values) // 3 * 3].reshape(-1, 3)
    back = space.columns([json.loads(text) for text in space.encode_rows(rows)])["obs"]
    assert back.tobytes() == rows.tobytes()


def test_nested_spaces_come_back(rng: Rng) -> None:
    from rlservo.recording.policy_format import SpaceFormat

    space = DictSpec(
        spaces={
            "arm": BoxSpec(shape=(2, 2), dtype="float32", low=None, high=None),
            "more": TupleSpec(
                spaces=(DiscreteSpec(n=4, start=2), MultiDiscreteSpec(shape=(2,), nvec=(3, 4), start=(0, 0)))
            ),
        }
    )
    format_ = SpaceFormat(space, "obs")
    value = {"arm": rng.standard_normal((2, 2)), "more": (3, np.array([1, 2]))}
    (text,) = format_.encode_rows(value)
    document = json.loads(text)
    jsonschema.validate(document, format_.schema())
    back = format_.columns([document, document])
    assert {name: column[1].tolist() for name, column in back.items()} == {
        "obs.arm": value["arm"].astype(np.float32).tolist(), "obs.more.0": 3, "obs.more.1": [1, 2],
    }  # fmt: skip
    batch = format_.encode_rows({"arm": np.zeros((5, 2, 2)), "more": (np.zeros(5), np.zeros((5, 2)))})
    assert len(batch) == 5


def test_file_opens_with_mcaps_own_reader_and_every_message_fits_its_schema(
    ur5: Path, tmp_path: Path, rng: Rng
) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        record_episode(policy, rng, 5, explore=True)
    with (tmp_path / "run.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        topics = set()
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            described = json.loads(schema.data)
            jsonschema.Draft202012Validator.check_schema(described)
            assert_viewers_can_read(described)
            document = json.loads(message.data)
            jsonschema.validate(document, {**described, "additionalProperties": False})
            topics.add(channel.topic)
            if channel.topic.endswith("decision"):
                assert list(document["obs"])[:2] == ["element_0", "element_1"]
                assert described["properties"]["obs"]["properties"]["element_0"]["unit"] == "rad"
        assert topics == {"/ur5/10/decision", "/ur5/10/outcome"}
        (attachment,) = reader.iter_attachments()
    assert json.loads(attachment.data)["name"] == "ur5"
    mode = stat.S_IMODE((tmp_path / "run.mcap").stat().st_mode)
    assert mode == 0o600


def assert_viewers_can_read(schema: dict[str, Any]) -> None:
    """Foxglove: an object has `properties`, an array one kind of `items`, everything has a type."""
    assert schema["type"] in ("object", "array", "number", "integer", "string", "boolean")
    if schema["type"] == "object":
        for child in schema["properties"].values():
            assert_viewers_can_read(child)
    if schema["type"] == "array":
        assert_viewers_can_read(schema["items"])


def test_exploring_decision_keeps_the_modules_own_action_and_its_log_probability(
    ur5: Path, tmp_path: Path, rng: Rng
) -> None:
    loaded = Policy.load(ur5)
    with WithRecording(loaded, tmp_path / "run.mcap") as policy:
        record_episode(policy, rng, 30, explore=True)
    episode = only(tmp_path / "run.mcap")
    assert episode.explored.all()
    mean, log_std = np.split(episode.dist_inputs, 2, axis=1)
    own = episode.own_action["action"].astype(np.float64)
    normal = -0.5 * ((own - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(episode.logp, normal.sum(axis=1), rtol=1e-6, atol=1e-6)  # terms of float32 cancel
    low, high = loaded.contract.action_space.bounds()
    np.testing.assert_allclose(
        episode.action["action"], np.clip(low + (own + 1) * (high - low) / 2, low, high), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("kind", ["diag_gaussian", "squashed_gaussian", "categorical", "multi_categorical"])
def test_log_probability_is_rllibs(kind: str, rng: Rng) -> None:
    torch = pytest.importorskip("torch")
    rllib = pytest.importorskip("ray.rllib.core.distribution.torch.torch_distribution")

    box = BoxSpec(shape=(3,), dtype="float32", low=-1.0, high=1.0)
    multi = MultiDiscreteSpec(shape=(2,), nvec=(3, 4), start=(5, 0))
    distribution = Distribution(kind=kind, transform="none")  # type: ignore[arg-type]
    width = {"categorical": 4, "multi_categorical": 7}.get(kind, 6)
    inputs = rng.standard_normal((50, width)).astype(np.float32)
    tensor = torch.from_numpy(inputs)
    if kind == "categorical":
        own: Any = rng.integers(0, 4, 50)
        expected = rllib.TorchCategorical.from_logits(tensor).logp(torch.from_numpy(own))
        ours = log_probability(inputs, {"action": own}, distribution, DiscreteSpec(n=4, start=-2))
    elif kind == "multi_categorical":
        own = np.stack([rng.integers(0, 3, 50), rng.integers(0, 4, 50)], axis=1)
        theirs = rllib.TorchMultiCategorical.from_logits(tensor, input_lens=[3, 4])
        expected = theirs.logp(torch.from_numpy(own))
        ours = log_probability(inputs, {"action": own}, distribution, multi)
    else:
        class_ = rllib.TorchDiagGaussian if kind == "diag_gaussian" else rllib.TorchSquashedGaussian
        theirs = class_.from_logits(tensor.double())  # float32's own rounding near 1 is a per cent
        sampled = theirs.sample()
        expected = theirs.logp(sampled)
        ours = log_probability(inputs, {"action": sampled.numpy()}, distribution, box)
    np.testing.assert_allclose(ours, expected.numpy(), rtol=2e-4, atol=2e-4)


def test_batch_is_so_many_episodes(ur5: Path, tmp_path: Path, rng: Rng) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        for _ in range(3):
            policy.act(rng.standard_normal((4, 27)).astype(np.float32))
    found = list(episodes(Recording(tmp_path / "run.mcap")))
    assert [len(episode) for episode in found] == [3] * 4
    assert len({episode.id for episode in found}) == 4


def test_warnings_and_errors_are_recorded(ur5: Path, tmp_path: Path) -> None:
    from rlservo.errors import ObservationError

    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        policy.act(np.zeros(27, np.float32))
        with pytest.raises(ObservationError):
            policy.act(np.full(27, np.nan, np.float32))
        policy.set_last_action(np.full(6, 0.5, np.float32))
        policy.act(np.zeros(27, np.float32))
    episode = only(tmp_path / "run.mcap")
    assert episode.errors == [None, "bad-observation", None]
    assert episode.acted.tolist() == [True, False, True] and episode.fell_back.tolist() == [False, True, False]
    assert np.isnan(episode.obs["obs"][1]).all()
    assert (episode.executed["action"][1] == 0.5).all()


def test_record_costs_microseconds_and_raises_nothing(
    ur5: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder, caplog.at_level(logging.WARNING):
        policy = recorder.policy(Policy.load(ur5).contract)
        for _ in range(10):
            assert recorder.record(DecisionRecord(policy, np.zeros(3), np.zeros(6)))  # not of the policy's space
        assert recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6)))
    assert (recorder.dropped, recorder.written) == (10, 1)
    assert len(caplog.records) == 1 and "shape (3,), expected (27,)" in caplog.text
    recording = Recording(tmp_path / "run.mcap")
    assert sum(1 for _ in recording.entries()) == 1 and recording.files[0].dropped == 10


def test_full_buffer_drops_counts_and_marks_the_place(
    ur5: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "BUFFER_RECORDS", 100)
    monkeypatch.setattr(recorder_module, "DRAIN_S", 2.0)
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        took = [recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6), "e", i)) for i in range(150)]
    assert sum(took) == 100 and recorder.dropped == 50
    recording = Recording(tmp_path / "run.mcap")
    assert sum(1 for _ in recording.entries()) == 100
    assert recording.files[0].dropped == 50


def test_what_comes_after_the_end_is_counted_and_not_kept(ur5: Path, tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
    assert not recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6)))
    assert recorder.dropped == 1


def test_a_number_that_no_type_holds_drops_its_record_alone(ur5: Path, tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        recorder.record(DecisionRecord(policy, [10**400] * 27, np.zeros(6)))
        recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6)))
    assert (recorder.failure, recorder.dropped, recorder.written) == (None, 1, 1)


def test_a_policy_under_other_options_is_another_one(ur5: Path, tmp_path: Path) -> None:
    contract = Policy.load(ur5).contract
    with Recorder(tmp_path / "run.mcap") as recorder:
        for step in (0.1, 0.2, 0.1):
            policy = recorder.policy(contract, options={"max_action_step": step})
            recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6)))
    found = [entry.policy.options["max_action_step"] for entry in Recording(tmp_path / "run.mcap").entries()]
    assert found == [0.1, 0.2, 0.1]


@pytest.mark.parametrize("what", ["file", "folder"])
def test_deleted_recording_is_noticed(ur5: Path, tmp_path: Path, what: str) -> None:
    folder, deadline = tmp_path / "run", time.monotonic() + 30
    with Recorder(folder) as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        record = DecisionRecord(policy, np.zeros(27), np.zeros(6))
        recorder.record(record)
        while not (begun := list(folder.iterdir())):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        if what == "folder":
            shutil.rmtree(folder)
        else:
            begun[0].unlink()
        while recorder.failure is None and not (folder.exists() and list(folder.iterdir())):
            assert time.monotonic() < deadline
            recorder.record(record)
            time.sleep(0.01)
    assert (recorder.failure is None) == (what == "file")


def test_dropped_decisions_are_a_gap(ur5: Path, tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        for step in (0, 1, 2, 5, 6):
            recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6), "e", step))
    assert only(tmp_path / "run.mcap").gap == 3


KILLED = """
import sys, time
import numpy as np
from rlservo.recording.recorder import Recorder
from rlservo.recording.records import DecisionRecord
from rlservo.policy.policy import Policy

recorder = Recorder(sys.argv[2])
policy = recorder.policy(Policy.load(sys.argv[1], check_golden=False).contract)
step = 0
while True:
    recorder.record(DecisionRecord(policy, np.full(27, step, np.float32), np.zeros(6, np.float32), "e", step))
    print(step, time.monotonic_ns(), flush=True)
    step += 1
    time.sleep(0.01)
"""


@pytest.mark.parametrize("target", ["run.mcap", "folder"])
def test_kill_9_loses_at_most_the_last_second(ur5: Path, tmp_path: Path, target: str) -> None:
    command = [sys.executable, "-c", KILLED, str(ur5), str(tmp_path / target)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        times: list[int] = []
        began = time.monotonic()
        for line in process.stdout:
            times.append(int(line.split()[1]))
            if times[-1] - times[0] > 2.5e9 or time.monotonic() - began > 60:
                break
        recording = Recording(tmp_path / target)
        seen = sum(1 for _ in recording.entries())  # while it is being written
        assert seen > 0 and recording.files[0].being_written and not recording.files[0].whole
        os.kill(process.pid, signal.SIGKILL)
        times += [int(line.split()[1]) for line in process.stdout]
    recording = Recording(tmp_path / target)
    (episode,) = episodes(recording)
    facts = recording.files[0]
    assert (facts.whole, facts.being_written, facts.damage) == (False, False, None)
    assert episode.steps.tolist() == list(range(len(episode)))
    assert len(episode) >= sum(when < times[-1] - 1.5e9 for when in times)  # a second, and a busy machine


def test_folder_rotates_by_size_and_keeps_under_its_ceiling(ur5: Path, tmp_path: Path, rng: Rng) -> None:
    (tmp_path / "mine.mcap").write_bytes(b"x" * 4 * MIB)  # not a recorder's: never deleted
    with Recorder(tmp_path, max_file_bytes=MIB, max_folder_bytes=3 * MIB) as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        for i in range(30_000):
            while i - recorder.written > 500:  # this test is not about dropping
                time.sleep(0.01)
            recorder.record(DecisionRecord(policy, rng.standard_normal(27), rng.uniform(-1, 1, 6), "e", i))
    assert recorder.dropped == 0
    (tmp_path / "mine.mcap").unlink()
    sizes = [path.stat().st_size for path in tmp_path.iterdir()]
    assert sizes and sum(sizes) <= 3.5 * MIB  # the last file may be over by what a flush holds
    steps = np.concatenate([episode.steps for episode in episodes(Recording(tmp_path))])
    assert steps.tolist() == list(range(steps[0], 30_000))
    assert steps[0] > 0  # it rotated, and deleted


def test_folder_rotates_by_time(ur5: Path, tmp_path: Path) -> None:
    with Recorder(tmp_path, max_file_s=0.1) as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)

        def rotates() -> bool:
            recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6), "e", next(steps)))
            return len(list(tmp_path.iterdir())) >= 2

        steps = itertools.count()
        wait_for(rotates, "a second file")
    (episode,) = episodes(Recording(tmp_path))
    assert episode.steps.tolist() == list(range(next(steps)))  # it continues from file to file


def test_two_writers_of_one_folder_do_not_meet(ur5: Path, tmp_path: Path) -> None:
    contract = Policy.load(ur5).contract
    with Recorder(tmp_path) as one, Recorder(tmp_path) as two:
        for step in range(10):
            for recorder, name in ((one, "one"), (two, "two")):
                policy = recorder.policy(contract)
                recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6), name, step))
    assert one.failure is None and two.failure is None
    assert sorted((episode.id, len(episode)) for episode in episodes(Recording(tmp_path))) == [("one", 10), ("two", 10)]


def test_file_is_a_recording_from_its_start(tmp_path: Path) -> None:
    """Whatever the size of Python's buffers: 128 KiB from 3.14 on."""
    file = LogFile(tmp_path / "one.mcap")
    try:
        assert list(episodes(Recording(file.path))) == []
    finally:
        file.close()


def test_file_being_written_is_not_deleted_by_another_writer(ur5: Path, tmp_path: Path) -> None:
    contract = Policy.load(ur5).contract

    def record_in_full_folder(oldest: Path) -> None:
        """Record where a younger file already takes more than the folder may."""
        oldest.with_name(oldest.name.replace("000001", "000002")).write_bytes(bytes(4 * MIB))
        os.utime(oldest, (1, 1))
        with Recorder(tmp_path, max_file_bytes=MIB, max_folder_bytes=2 * MIB) as other:
            other.record(DecisionRecord(other.policy(contract), np.zeros(27), np.zeros(6)))

    with Recorder(tmp_path) as first:
        first.record(DecisionRecord(first.policy(contract), np.zeros(27), np.zeros(6)))
        wait_for(lambda: first.written == 1)
        (file,) = tmp_path.iterdir()
        wait_for(lambda: list(episodes(Recording(file))) != [], "it is on the disk")
        record_in_full_folder(file)
        assert file.exists()
    record_in_full_folder(file)
    assert not file.exists()


def test_full_disk_ends_recording_with_one_line_and_the_file_still_opens(
    ur5: Path, tmp_path: Path, rng: Rng, caplog: pytest.LogCaptureFixture
) -> None:
    """A limit on the size of this process's files stands in for a full disk: both are an OSError of write."""
    script = f"""
import logging, resource, signal, sys, time
import numpy as np
from rlservo.recording.recorder import Recorder
from rlservo.recording.records import DecisionRecord
from rlservo.policy.policy import Policy
logging.basicConfig(level=logging.INFO)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
recorder = Recorder({str(tmp_path / "run.mcap")!r})
policy = recorder.policy(Policy.load({str(ur5)!r}).contract)
rng = np.random.default_rng(0)
until = time.monotonic() + 60
while recorder.failure is None and time.monotonic() < until:
    recorder.record(DecisionRecord(policy, rng.standard_normal(27), rng.uniform(-1, 1, 6)))
    time.sleep(0.0001)
assert recorder.failure is not None
assert not recorder.record(DecisionRecord(policy, rng.standard_normal(27), rng.uniform(-1, 1, 6)))
recorder.close()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1 and "recording to" in lines[0] and "File too large" in lines[0]
    recording = Recording(tmp_path / "run.mcap")
    assert sum(1 for _ in recording.entries()) > 500
    assert recording.files[0].damage is None and not recording.files[0].whole


@pytest.mark.parametrize("where", ["/proc/nothing/here", "run.mcap"])
def test_place_that_cannot_be_written_is_refused_at_the_start(tmp_path: Path, where: str) -> None:
    (tmp_path / "run.mcap").touch()
    with pytest.raises(UsageError, match=r"exists|nothing can be recorded"):
        Recorder(where if where.startswith("/") else tmp_path / where)


def test_foreign_damaged_and_missing_files_are_told_in_a_sentence(ur5: Path, tmp_path: Path, rng: Rng) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        record_episode(policy, rng, 2000)
    whole = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "text.mcap").write_text("hello, this is not a recording")
    (tmp_path / "empty.mcap").touch()
    with (tmp_path / "other.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_message(writer.register_channel("/camera", "json", 0), 1, b"{}", 1)
        writer.finish()
    for name, sentence in (
        ("text", "not an MCAP file"),
        ("empty", "not an MCAP file"),
        ("other", "its topics are /camera"),
        ("none", "not exist"),
    ):
        with pytest.raises(RecordingError, match=sentence):
            list(Recording(tmp_path / f"{name}.mcap").entries())
    for size in (len(whole) // 3, len(whole) * 2 // 3, len(whole) - 5):  # cut off anywhere
        (tmp_path / "cut.mcap").write_bytes(whole[:size])
        recording = Recording(tmp_path / "cut.mcap")
        assert sum(1 for _ in recording.entries()) > 0
        assert not recording.files[0].whole and recording.files[0].damage is None
    for place in rng.integers(8, len(whole), 40):  # one wrong byte anywhere: read up to there, or not harmed
        changed = bytearray(whole)
        changed[place] ^= 0xFF
        (tmp_path / "changed.mcap").write_bytes(changed)
        recording = Recording(tmp_path / "changed.mcap")
        try:
            for entry in recording.entries():
                assert "step" in entry.fields
        except RecordingError:
            pass


def test_clock_that_jumps_is_counted_and_leaves_the_order(ur5: Path, tmp_path: Path) -> None:
    now, monotonic = time.time_ns(), time.monotonic_ns()
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        for step in range(10):
            jump = -3600 * 10**9 if step >= 5 else 0  # the wall clock is set back by an hour
            tick = step * 10**8
            recorder.record(
                DecisionRecord(
                    policy, np.zeros(27), np.zeros(6), "e", step,
                    wall_ns=now + jump + tick, monotonic_ns=monotonic + tick,
                )
            )  # fmt: skip
    recording = Recording(tmp_path / "run.mcap")
    (episode,) = episodes(recording)
    np.testing.assert_allclose(np.diff(episode.time_s), 0.1, rtol=1e-3)
    assert recording.files[0].clock_jumps == 1
    assert (np.diff(episode.wall_ns) < 0).sum() == 1


def test_many_open_episodes_take_bounded_memory(ur5: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rlservo.recording import episodes as module

    monkeypatch.setattr(module, "MOST_OPEN", 50)
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        for i in range(1000):
            recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6), f"e{i}", 0))
            recorder.record(OutcomeRecord(policy, f"e{i}", 0, reward=1.0))  # none ever ends
    assembler, given_up = module.EpisodeAssembler(), []
    for entry in Recording(tmp_path / "run.mcap").entries():
        given_up += assembler.add(entry)
        assert len(assembler.opened) <= 50
    found = [*given_up, *assembler.opened.values()]
    assert [episode.id for episode in found] == [f"e{i}" for i in range(1000)]
    assert all(episode.reward.tolist() == [1.0] for episode in found)


def test_long_episode_comes_in_pieces(ur5: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rlservo.recording import episodes as module

    monkeypatch.setattr(module, "LONGEST_PIECE", 30)
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = recorder.policy(Policy.load(ur5).contract)
        for step in range(100):
            recorder.record(DecisionRecord(policy, np.zeros(27), np.zeros(6), "e", step))
    pieces = list(episodes(Recording(tmp_path / "run.mcap")))
    assert [len(piece) for piece in pieces] == [30, 30, 30, 10]
    assert [piece.begins for piece in pieces] == [True, False, False, False]
    assert [piece.goes_on for piece in pieces] == [True, True, True, False]
    assert [piece.gap for piece in pieces] == [None] * 4


def test_a_file_that_the_recorder_deletes_meanwhile_is_left_out(ur5: Path, tmp_path: Path, rng: Rng) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    first, second = (folder / f"rlservo-20260101T000000-here-1-00000{number}.mcap" for number in (1, 2))
    for file in (first, second):
        with WithRecording(Policy.load(ur5), file) as policy:
            record_episode(policy, rng, 5)
    copy = Path(shutil.copy(second, tmp_path / "copy.mcap"))
    of_folder, of_files = Recording(folder), Recording([copy, second])
    first.unlink()
    copy.unlink()
    assert [len(episode) for episode in episodes(of_folder)] == [5]
    assert [(facts.path, facts.deleted) for facts in of_folder.files] == [(first, True), (second, False)]
    with pytest.raises(RecordingError, match=f"{copy} was deleted before it was read"):  # it was named: it must be read
        list(episodes(of_files))
    first.symlink_to(tmp_path / "nowhere")  # as a folder shows a file that has just been deleted
    done = rlservo_here("log", "info", folder)
    assert done.returncode == 0, done.stderr
    assert f"{first}: deleted before it was read" in done.stdout and "5 decisions" in done.stdout
    first.unlink()
    first.touch()  # its recorder was killed before it wrote
    done = rlservo_here("log", "info", folder)
    assert done.returncode == 0, done.stderr
    assert f"{first}: 0 messages, without an end" in done.stdout and "5 decisions" in done.stdout


def test_a_simulated_episode_is_as_long_as_its_steps_and_numbered_as_in_an_export(
    ur5: Path, tmp_path: Path, rng: Rng
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    with Recorder(tmp_path / "run.mcap") as recorder:
        other = WithRecording(Policy.load(write_box_policy(tmp_path / "other", name="other")), recorder)
        policy = WithRecording(Policy.load(ur5), recorder)
        for acting, steps in ((policy, 31), (other, 7), (policy, 11)):
            record_episode(acting, rng, steps)
    info = rlservo_here("log", "info", tmp_path / "run.mcap")
    assert "2 episodes (2 ended), 4.0 s long together, 42 decisions recorded over 0." in info.stdout, info.stdout
    out = tmp_path / "episode.svg"
    words = ("log", "plot", tmp_path / "run.mcap", "--episode", 1, "--out", out)
    several = rlservo_here(*words)
    assert several.returncode == 2 and "name one with --policy" in several.stderr
    drawn = rlservo_here(*words, "--policy", "ur5")
    assert drawn.returncode == 0 and "11 decisions" in drawn.stdout, drawn.stderr
    table = tmp_path / "run.parquet"
    assert rlservo_here("log", "export", words[2], "--to", "parquet", "--policy", "ur5", "--out", table).returncode == 0
    ids = parquet.read_table(table)["eps_id"].to_pylist()
    assert [ids.count(each) for each in dict.fromkeys(ids)] == [31, 11]
    (longest, _) = [each for each in episodes(Recording(words[2])) if each.policy.contract.name == "ur5"]
    assert longest.episode_s[-1] == pytest.approx(3.0) and longest.time_s[-1] - longest.time_s[0] < 1.5
