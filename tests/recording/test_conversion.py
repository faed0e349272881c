"""Recordings convert to what pyarrow, LeRobot's layout and minari load; they are summarised and drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from command_line import rlservo_here
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording.conversion.lerobot import export_lerobot
from rlservo.recording.conversion.minari import PATH_VARIABLE, export_minari
from rlservo.recording.conversion.parquet import export_parquet
from rlservo.recording.episodes import episodes
from rlservo.recording.plot import plot_episode
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import Recorder
from rlservo.recording.summary import summarise_recording

UR5 = "rlservo/EndEffectorPositioningURSim-v0"


def record(policy: WithRecording, lengths: list[int], *, explore: bool = False) -> None:
    rng = np.random.default_rng(0)
    size = policy.contract.observation_space.size
    flat = policy.contract.observation_space.kind == "box"
    for length in lengths:
        policy.reset()
        for step in range(length):
            policy.act(rng.standard_normal(size).astype(np.float32) if flat else step % 5, explore=explore)
            last = step == length - 1
            final = (np.zeros(size, np.float32) if flat else 0) if last else None
            policy.outcome(1.0, terminated=last, final_status="success" if last else None, final_obs=final)


@pytest.fixture
def run(ur5: Path, tmp_path: Path) -> Path:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        record(policy, [5, 7, 3])
    return tmp_path / "run.mcap"


def test_parquet_has_every_decision_and_the_contract(run: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    assert export_parquet(Recording(run), tmp_path / "run.parquet") == 15
    table = parquet.read_table(tmp_path / "run.parquet")
    recorded = list(episodes(Recording(run)))
    obs = np.array(table.column("obs").to_pylist(), np.float32)
    assert obs.tobytes() == np.concatenate([one.obs["obs"] for one in recorded]).tobytes()
    actions = np.array(table.column("actions").to_pylist(), np.float32)
    assert actions.tobytes() == np.concatenate([one.action["action"] for one in recorded]).tobytes()
    assert table.column("rewards").to_pylist() == [1.0] * 15
    assert np.flatnonzero(table.column("terminateds").to_pylist()).tolist() == [4, 11, 14]
    assert len(set(table.column("eps_id").to_pylist())) == 3
    assert table.column("own_actions").null_count == 0
    assert table.column("action_logp").null_count == 15
    assert json.loads(table.schema.metadata[b"rlservo.contract"])["name"] == "ur5"
    with pytest.raises(UsageError, match="exists"):
        export_parquet(Recording(run), tmp_path / "run.parquet")


def test_parquet_keeps_what_exploring_needs(policies: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    with WithRecording(Policy.load(policies / "gridworld"), tmp_path / "run.mcap") as policy:
        record(policy, [20], explore=True)
    export_parquet(Recording(tmp_path / "run.mcap"), tmp_path / "run.parquet")
    table = parquet.read_table(tmp_path / "run.parquet")
    logits = np.array(table.column("action_dist_inputs").to_pylist())
    chosen = np.array(table.column("own_actions").to_pylist())
    expected = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(table.column("action_logp").to_pylist(), expected[np.arange(20), chosen], rtol=1e-6)


def test_lerobot_dataset_has_the_documented_layout(run: Path, tmp_path: Path) -> None:
    """huggingface.co/docs/lerobot/lerobot-dataset-v3 and lerobot's `dataset_metadata.py`."""
    parquet = pytest.importorskip("pyarrow.parquet")
    pandas = pytest.importorskip("pandas")
    assert export_lerobot(Recording(run), tmp_path / "set", task="reach") == (3, 15)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"], info["fps"]) == ("v3.0", 3, 15, 10)
    data = parquet.read_table(tmp_path / "set" / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(info["features"]) == set(data.column_names)
    needed = {"timestamp", "frame_index", "episode_index", "index", "task_index", "action", "observation.state"}
    assert needed <= set(data.column_names)
    for key, feature in info["features"].items():
        column = np.array(data.column(key).to_pylist())
        assert list(column.shape[1:]) == ([] if feature["shape"] == [1] else feature["shape"])
        assert feature["names"] is None or len(feature["names"]) == feature["shape"][0]
        kind = data.schema.field(key).type
        assert str(getattr(kind, "value_type", kind)) in (
            feature["dtype"].replace("float32", "float"),
            feature["dtype"],
        )
    assert data.column("index").to_pylist() == list(range(15))
    np.testing.assert_allclose(data.column("timestamp").to_pylist()[:5], np.arange(5) / 10, rtol=1e-6)
    listed = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in listed] == [5, 7, 3]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in listed] == [(0, 5), (5, 12), (12, 15)]
    assert listed[0]["tasks"] == ["reach"] and len(listed[0]["stats/action/mean"]) == 6
    tasks = pandas.read_parquet(tmp_path / "set/meta/tasks.parquet")
    assert tasks.loc["reach"].task_index == 0
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    assert stats["observation.state"]["count"] == [15] and len(stats["action"]["q99"]) == 6


@pytest.mark.parametrize("first_has_rewards", [True, False])
def test_lerobot_takes_no_episodes_with_and_without_rewards_and_leaves_nothing(
    ur5: Path, tmp_path: Path, first_has_rewards: bool
) -> None:
    pytest.importorskip("pyarrow")
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        for rewarded in (first_has_rewards, not first_has_rewards):
            policy.reset()
            policy.act(np.zeros(27, np.float32))
            policy.outcome(1.0 if rewarded else None, terminated=True)
    with pytest.raises(
        UsageError, match=r"episode '\S+' (has|lacks) rewards, and the one before it (has|lacks) them: "
    ):
        export_lerobot(Recording(tmp_path / "run.mcap"), tmp_path / "made" / "set")
    assert not list((tmp_path / "made").iterdir())


def test_minari_loads_its_dataset(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    identity, count, env_id = export_minari(Recording(run), tmp_path / "sets")
    assert (count, env_id) == (3, None)
    monkeypatch.setenv(PATH_VARIABLE, str(tmp_path / "sets"))
    dataset = minari.load_dataset(identity)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 15)
    recorded = list(episodes(Recording(run)))
    for theirs, ours in zip(dataset.iterate_episodes(), recorded, strict=True):
        assert np.asarray(theirs.observations, np.float32)[:-1].tobytes() == ours.obs["obs"].tobytes()
        assert np.asarray(theirs.actions, np.float32).tobytes() == ours.action["action"].tobytes()
        assert len(theirs.observations) == len(ours) + 1 and theirs.terminations[-1]


@pytest.mark.slow  # it exports a policy that was trained
def test_minari_recovers_the_environment_of_the_training_and_combines_datasets(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    with WithRecording(Policy.load(shipped / "ur5"), tmp_path / "run.mcap") as policy:
        record(policy, [5, 7, 3])
    done = rlservo_here("log", "export", "run.mcap", "--to", "minari", "--out", "sets", cwd=tmp_path)
    place = f"{PATH_VARIABLE}={tmp_path}/sets, then minari.load_dataset('rlservo/ur5-v0')"
    # The shipped policy was trained in the arm's environment with disturbances.
    assert done.stdout == f"written sets: 3 episodes of rlservo/Randomized-v0; {place}\n", done.stderr
    monkeypatch.setenv(PATH_VARIABLE, str(tmp_path / "sets"))
    dataset = minari.load_dataset("rlservo/ur5-v0")
    env = dataset.recover_environment()
    assert env.spec is not None and env.spec.id == "rlservo/Randomized-v0" and env.spec.kwargs["env_id"] == UR5
    env.close()
    minari.combine_datasets([dataset, dataset], "rlservo/twice-v0")
    assert minari.load_dataset("rlservo/twice-v0").total_steps == 30


@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_a_repaired_recording_is_whole_to_every_reader(ur5: Path, tmp_path: Path, share: float) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        record(policy, [2000])
    whole = (tmp_path / "run.mcap").read_bytes()
    cut, repaired = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    cut.write_bytes(whole[: int(len(whole) * share)])
    assert rlservo_here("log", "repair", cut, "--out", repaired).returncode == 0
    before, after = Recording(cut), Recording(repaired)
    for theirs, ours in zip(before.entries(), after.entries(), strict=True):
        assert replace(theirs, policy=ours.policy) == ours and theirs.policy.key == ours.policy.key
    assert after.files[0].whole and repaired.stat().st_mode & 0o777 == 0o600
    with repaired.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == after.files[0].messages > 0
    assert cut.stat().st_size == int(len(whole) * share)


def test_a_recording_that_is_none_is_not_repaired(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello, this is not a recording")
    done = rlservo_here("log", "repair", "text.mcap", "--out", "whole.mcap", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "rlservo: text.mcap is not an MCAP file\n")
    assert [path.name for path in tmp_path.iterdir()] == ["text.mcap"]


def test_conversion_of_several_policies_wants_a_name(policies: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with Recorder(tmp_path / "run.mcap") as recorder:
        for name in ("ur5", "gridworld"):
            record(WithRecording(Policy.load(policies / name), recorder), [4])
    with pytest.raises(UsageError, match="name one with --policy"):
        export_parquet(Recording(tmp_path / "run.mcap"), tmp_path / "run.parquet")
    assert not list(tmp_path.glob(".*"))
    assert export_parquet(Recording(tmp_path / "run.mcap"), tmp_path / "run.parquet", name="ur5") == 4
    with pytest.raises(UsageError, match="no decisions of policy 'other'"):
        export_lerobot(Recording(tmp_path / "run.mcap"), tmp_path / "set", name="other")


def test_missing_package_is_said_in_a_sentence(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for name, convert in (("pyarrow", export_parquet), ("minari", export_minari)):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            convert_: Callable[..., object] = convert
            with pytest.raises(UsageError, match=f"pip install {name}"):
                convert_(Recording(run), tmp_path / "out")


def test_summary_counts_what_is_there(run: Path) -> None:
    (policy,) = summarise_recording(Recording(run)).policies
    assert (policy.episodes, policy.ended, policy.decisions, policy.gaps) == (3, 3, 15, 0)
    assert policy.return_mean == 5.0 and policy.endings == {"success": 3}
    assert policy.latency_p50_ms is not None and len(policy.graph_sha256) == 64


def test_plot_draws_an_episode(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from PIL import Image

    assert len(plot_episode(Recording(run), 1, tmp_path / "episode.png")) == 7
    with Image.open(tmp_path / "episode.png") as picture:
        assert picture.size[0] > 500 and len(picture.convert("RGB").getcolors(10**6) or []) > 10
    with pytest.raises(UsageError, match="no episode 3"):
        plot_episode(Recording(run), 3, tmp_path / "episode.png")
