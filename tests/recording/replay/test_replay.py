"""Replays of a recording: its own bundle reproduces it, another one's changes are reported."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bundles import write_box_policy, write_leaky_policy
from rlservo.bundle.spaces import Element
from rlservo.deploy.cli import main
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import Recorder
from rlservo.recording.replay.follower import OtherContractError
from rlservo.recording.replay.replay import replay


def record(policy: WithRecording, episodes: int, steps: int, *, explore: bool = False, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    space = policy.contract.observation_space
    for _ in range(episodes):
        policy.reset()
        for step in range(steps):
            obs: Any = rng.standard_normal(space.size).astype(np.float32) if space.kind == "box" else step % 5
            policy.act(obs, explore=explore)
            policy.outcome(1.0, terminated=step == steps - 1)


def recorded(bundle: Path, file: Path, *, explore: bool = False, **options: Any) -> Recording:
    with WithRecording(Policy.load(bundle, options=PolicyOptions(**options)), file) as policy:
        record(policy, 4, 25, explore=explore)
    return Recording(file)


@pytest.mark.parametrize("explore", [False, True])
def test_the_bundle_that_made_it_differs_in_nothing(ur5: Path, tmp_path: Path, explore: bool) -> None:
    report = replay(recorded(ur5, tmp_path / "run.mcap", explore=explore), ur5)
    assert (report.episodes, report.compared, report.identical, report.changed) == (4, 100, 100, 0)
    assert report.same_graph is True and report.worst == [] and report.explored == (100 if explore else 0)
    assert all(element.largest == 0 for element in report.elements)


@pytest.mark.parametrize("explore", [False, True])
def test_discrete_policy_replays(policies: Path, tmp_path: Path, explore: bool) -> None:
    bundle = policies / "gridworld"
    report = replay(recorded(bundle, tmp_path / "run.mcap", explore=explore), bundle)
    assert (report.compared, report.identical, report.changed) == (100, 100, 0)


def test_recurrent_state_and_step_limits_start_with_the_episode(ur5: Path, tmp_path: Path) -> None:
    bundle = write_leaky_policy(tmp_path / "policies")
    for file, options in (("free", {}), ("limited", {"max_action_step": 0.1})):
        recording = recorded(bundle, tmp_path / f"{file}.mcap", **options)
        report = replay(recording, bundle)
        assert (report.compared, report.identical) == (100, 100), file
    step = np.abs(np.diff(next(episodes(Recording(tmp_path / "limited.mcap"))).action["action"], axis=0))
    assert step.max() <= 0.1 + 1e-6
    report = replay(recorded(ur5, tmp_path / "arm.mcap", max_action_step=0.05), ur5)
    assert (report.compared, report.identical) == (100, 100)


def test_recurrent_policy_is_not_followed_over_a_gap(tmp_path: Path) -> None:
    bundle = write_leaky_policy(tmp_path / "policies")
    with Recorder(tmp_path / "run.mcap") as recorder:
        policy = WithRecording(Policy.load(bundle), recorder)
        kept, recorder.record = recorder.record, lambda record: record.step == 10 or kept(record)  # type: ignore
        record(policy, 1, 25)
    report = replay(Recording(tmp_path / "run.mcap"), bundle)
    assert (report.compared, report.identical, report.not_compared) == (10, 10, 14)


def test_long_episode_of_a_recurrent_policy_goes_on_from_piece_to_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rlservo.recording import episodes as module

    monkeypatch.setattr(module, "LONGEST_PIECE", 7)
    bundle = write_leaky_policy(tmp_path / "policies")
    report = replay(recorded(bundle, tmp_path / "run.mcap"), bundle)
    assert (report.episodes, report.compared, report.identical) == (4, 100, 100)


def test_another_version_differs_by_element_and_the_worst_moments_are_right(policies: Path, tmp_path: Path) -> None:
    recording = recorded(policies / "ur5" / "1", tmp_path / "run.mcap")
    report = replay(recording, policies / "ur5" / "2", tolerance=0.01)
    (one, two) = (Policy.load(policies / "ur5" / version) for version in ("1", "2"))
    seen = np.concatenate([episode.obs["obs"] for episode in episodes(recording)])
    difference = np.abs(np.stack([one.act(obs).astype(np.float64) - two.act(obs) for obs in seen]))
    assert report.same_graph is False and report.compared == 100
    assert report.changed == (difference > 0.01).any(axis=1).sum() > 50
    np.testing.assert_allclose([element.largest for element in report.elements], difference.max(axis=0), rtol=1e-6)
    np.testing.assert_allclose([element.mean for element in report.elements], difference.mean(axis=0), rtol=1e-6)
    span = 2 * np.array([1, 1, 1, 2, 1, 1])
    worst = report.worst[0]
    row, column = np.unravel_index(np.argmax(difference / span), difference.shape)
    assert (worst.step, worst.element) == (row % 25, f"joint_{column}")
    np.testing.assert_allclose(abs(worst.recorded - worst.replayed), difference[row, column], rtol=1e-6)


def test_fallback_actions_are_not_compared_and_limits_count_from_them(ur5: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        from rlservo.errors import ObservationError

        for step in range(10):
            obs = rng.standard_normal(27).astype(np.float32)
            if step == 4:
                with pytest.raises(ObservationError):
                    policy.act(np.zeros(5))
                policy.set_last_action(np.zeros(6, np.float32))
            policy.act(obs)
    report = replay(Recording(tmp_path / "run.mcap"), ur5)
    assert (report.compared, report.identical) == (10, 10)


def test_another_contract_is_refused_with_the_elements(policies: Path, tmp_path: Path) -> None:
    recording = recorded(policies / "ur5" / "1", tmp_path / "run.mcap")
    other = write_box_policy(tmp_path / "other")
    contract = Policy.load(other).contract
    space = contract.observation_space
    elements = (*space.elements[:3], Element(name="wrist_camera", unit="rad"), *space.elements[4:])
    renamed = contract.action_space.model_copy(update={"low": (-2.0, -1.0, -1.0, -2.0, -1.0, -1.0)})
    graph_contract = {"observation_space": space.model_copy(update={"elements": elements}), "action_space": renamed}
    from rlservo.recording.policy_format import element_differences

    found = list(element_differences(contract, contract.model_copy(update=graph_contract)))
    assert any("element 3 of the obs" in line and "'wrist_camera'" in line for line in found), found
    assert any("element 0 of the action has low -1" in line for line in found), found
    with pytest.raises(OtherContractError, match="has kind box in the recording and discrete"):
        replay(recording, policies / "gridworld", name="ur5")


def test_several_policies_in_one_file_are_told_apart(policies: Path, tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        for name in ("ur5", "gridworld"):
            record(WithRecording(Policy.load(policies / name), recorder), 2, 10)
    report = replay(Recording(tmp_path / "run.mcap"), policies / "gridworld")
    assert (report.policies, report.compared, report.identical) == (["gridworld/1"], 20, 20)
    assert report.other_policies == {"ur5/10": 20}


def run_cli(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, Any]:
    monkeypatch.setattr("sys.argv", ["rlservo", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), (json.loads(out) if out.startswith("{") else out) or err


def test_command_says_by_its_exit_code_what_it_found(
    policies: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "run.mcap")
    recorded(policies / "ur5" / "1", tmp_path / "run.mcap")
    (tmp_path / "text.mcap").write_text("no recording at all")
    code, report = run_cli(monkeypatch, capsys, "replay", file, "--bundle", str(policies / "ur5" / "1"), "--json")
    assert (code, report["identical"], report["changed_share"]) == (0, 100, 0.0)
    code, text = run_cli(monkeypatch, capsys, "replay", file, "--bundle", str(policies / "ur5" / "2"))
    assert code == 1 and "changed by more than 0: 100" in text and "joint_0: largest" in text
    code, text = run_cli(monkeypatch, capsys, "replay", file, "--bundle", str(policies / "gridworld"))
    assert code == 2 and "does not fit the bundle gridworld/1" in text and "Traceback" not in text
    code, text = run_cli(monkeypatch, capsys, "replay", str(tmp_path / "text.mcap"), "--bundle", str(policies / "ur5"))
    assert code == 1 and "is not an MCAP file" in text
    code, summary = run_cli(monkeypatch, capsys, "log", "info", file, "--json")
    assert code == 0 and summary["policies"][0]["decisions"] == 100
    code, text = run_cli(monkeypatch, capsys, "log", "info", file)
    assert code == 0 and re.search(r"4 episodes \(4 ended\), [\d.]+ s long together, 100 decisions", text)
