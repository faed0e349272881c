"""The script that learns from recordings: what RLlib's learners see is what the recorded policy saw and did.

An algorithm with a learning rate of 0 shows it: BC's loss is the mean of the recorded log-probabilities, negated, and
the result acts as the recorded policy did.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from bundles import SHIPPED
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.replay.replay import replay
from trainings import OneRay

UR5 = Path(__file__).resolve().parents[2] / "examples" / "checkpoints" / SHIPPED["ur5"]
SCRIPT = "learn_from_recordings.py"
WHOLE = ("--epochs", "1", "--batch-size", "100000")  # one minibatch


def record(bundle: Path, file: Path, *, explore: bool, lengths: tuple[int, ...] = (7, 23, 41)) -> list[RecordedEpisode]:
    """Episodes of random observations, the last one cut off."""
    rng = np.random.default_rng(0)
    with WithRecording(Policy.load(bundle), file) as policy:
        size = policy.contract.observation_space.size
        for length in lengths:
            policy.reset()
            for step in range(length):
                action = policy.act(rng.standard_normal(size).astype(np.float32), explore=explore, seed=step)
                ends, cut = step == length - 1, length == lengths[-1]
                policy.outcome(
                    -float(np.square(action).sum()),
                    terminated=ends and not cut,
                    truncated=ends and cut,
                    final_status=("late" if cut else "success") if ends else None,
                    final_obs=rng.standard_normal(size).astype(np.float32) if ends else None,
                )
    return list(episodes(Recording(file)))


def losses(out: str, name: str) -> list[float]:
    return [float(value) for value in re.findall(rf"(?<!\w){name} (-?[\d.]+(?:e[+-]?\d+)?|nan|-?inf)", out)]


def test_bc_sees_what_the_policy_saw_and_drew(one_ray: OneRay, shipped: Path, tmp_path: Path) -> None:
    recorded = record(shipped / "ur5", tmp_path / "run.mcap", explore=True)
    done = one_ray.run(
        tmp_path / "at", SCRIPT, str(tmp_path / "run.mcap"), "--run", "BC", "--from", str(UR5), "--out", "learned",
        "--set", "lr=0.0", *WHOLE,
    )  # fmt: skip
    assert done.ended.code == 0, done.ended.out + done.ended.err
    assert "3 episodes, 71 decisions of ur5" in done.ended.out
    assert "own actions: 71 recorded, 0 computed" in done.ended.out
    mean = np.concatenate([one.logp for one in recorded]).mean()
    assert losses(done.ended.out, "policy_loss") == pytest.approx([-mean], rel=3e-5)
    bundle = export_checkpoint(done.folder / "learned", tmp_path, name="ur5", notify=lambda line: None)
    report = replay(Recording(tmp_path / "run.mcap"), bundle.path)
    assert (report.compared, report.changed) == (71, 0)
    with Policy.load(bundle.path) as policy:
        assert policy.contract.provenance.algorithm == "BC"


def test_marwil_values_whole_episodes(one_ray: OneRay, shipped: Path, tmp_path: Path) -> None:
    """Its first targets are returns of whole episodes, discounted, with the value of what follows one that was cut."""
    recorded = record(shipped / "ur5", tmp_path / "run.mcap", explore=True)
    done = one_ray.run(
        tmp_path / "at", SCRIPT, str(tmp_path / "run.mcap"), "--run", "MARWIL", "--from", str(UR5), "--out", "learned",
        "--set", "lr=0.0", "--set", "gamma=0.9", "--set", "lambda_=1.0", *WHOLE,
    )  # fmt: skip
    assert done.ended.code == 0, done.ended.out + done.ended.err
    graph = onnxruntime.InferenceSession(shipped / "ur5" / "1" / "policy.onnx")
    errors = [error for one in recorded for error in value_errors(graph, one, 0.9)]
    assert losses(done.ended.out, "vf_loss") == pytest.approx([0.5 * np.square(errors).mean()], rel=1e-4)


def value_errors(graph: onnxruntime.InferenceSession, episode: RecordedEpisode, gamma: float) -> list[float]:
    assert episode.final_obs is not None
    seen = np.concatenate([episode.obs["obs"], episode.final_obs["obs"]])
    *values, after = np.asarray(graph.run(["value"], {"obs": seen})[0]).reshape(-1)
    rest = 0.0 if episode.terminated else float(after)
    errors = []
    for value, reward in zip(reversed(values), reversed(episode.reward), strict=True):
        rest = float(reward) + gamma * rest
        errors.append(rest - float(value))
    return errors


def test_a_recurrent_module_remembers_whole_episodes(
    one_ray: OneRay, wide_zoo: Path, recurrent: Path, tmp_path: Path
) -> None:
    """They are longer than the module's own sequences, whose states RLlib begins with zeros."""
    recorded = record(recurrent / "lstm_box", tmp_path / "run.mcap", explore=True, lengths=(30, 45, 60))
    done = one_ray.run(
        tmp_path / "at", SCRIPT, str(tmp_path / "run.mcap"), "--run", "BC", "--from", str(wide_zoo / "lstm_box"),
        "--out", "learned", "--set", "lr=0.0", *WHOLE,
    )  # fmt: skip
    assert done.ended.code == 0, done.ended.out + done.ended.err
    mean = np.concatenate([one.logp for one in recorded]).mean()
    assert losses(done.ended.out, "policy_loss") == pytest.approx([-mean], rel=3e-5)


def test_a_new_network_learns_ahead_of_the_latency(one_ray: OneRay, ur5: Path, tmp_path: Path) -> None:
    """Without a checkpoint, its filter has the recorded observations' statistics; only one way to end is chosen."""
    recorded = record(ur5, tmp_path / "run.mcap", explore=False, lengths=(200, 300, 50))
    done = one_ray.run(
        tmp_path / "at", SCRIPT, str(tmp_path / "run.mcap"), "--run", "BC", "--out", "learned", "--status", "success",
        "--ahead", "2", "--hidden", "32", "--set", "lr=3e-3", "--epochs", "20", "--batch-size", "50",
    )  # fmt: skip
    assert done.ended.code == 0, done.ended.out + done.ended.err
    assert "not used: 1 episodes that did not end in 'success'" in done.ended.out
    assert "0 recorded, 500 computed" in done.ended.out
    first, *_, last = losses(done.ended.out, "policy_loss")
    assert last < first - 0.5
    bundle = export_checkpoint(done.folder / "learned", tmp_path, name="ur5", notify=lambda line: None)
    baked = {step.step: step.values for step in bundle.contract.baked_in}
    ends = [one.final_obs["obs"] for one in recorded[:2] if one.final_obs is not None]
    seen = np.concatenate([one.obs["obs"] for one in recorded[:2]] + ends)
    np.testing.assert_allclose(baked["mean_std_filter"]["mean"], seen.mean(axis=0), atol=1e-5)
    assert baked["mean_std_filter"]["count"] == 502


@pytest.mark.parametrize("algorithm", ["CQL", "IQL"])
def test_q_learners_go_on_from_sac(algorithm: str, one_ray: OneRay, zoo: Path, tmp_path: Path) -> None:
    bundle = export_checkpoint(zoo / "sac", tmp_path, name="pendulum", notify=lambda line: None)
    record(bundle.path, tmp_path / "run.mcap", explore=True)
    done = one_ray.run(
        tmp_path / "at", SCRIPT, str(tmp_path / "run.mcap"), "--run", algorithm, "--from", str(zoo / "sac"),
        "--out", "learned", "--epochs", "2", "--batch-size", "32",
    )  # fmt: skip
    assert done.ended.code == 0, done.ended.out + done.ended.err
    assert "from the weights of" in done.ended.out
    assert np.isfinite(losses(done.ended.out, "total_loss")).all()
    learned = export_checkpoint(done.folder / "learned", tmp_path, name="pendulum", notify=lambda line: None)
    report = replay(Recording(tmp_path / "run.mcap"), learned.path)
    assert report.compared == 71
    assert 0.0 < report.largest_distribution_difference < 1.0  # it has learned, and began where SAC was


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--run", "MARWIL", "--ahead", "2"), "--modes and --ahead are BC's"),
        (("--run", "BC", "--status", "happy"), "no recorded episode can be learned from: 3 that did not end in"),
        (("--run", "BC", "--out", "."), "--out . exists"),
        (("--run", "BC", "--epochs", "0"), "--epochs is 0"),
        (("--run", "BC", "--set", "num_learners=1"), "--set num_learners: one learner in this process"),
        (("--run", "BC", "--from", "nowhere"), "nowhere does not exist"),
        (
            ("--run", "BC", "--from", str(UR5)),
            "its actions are Box(-1.0, 1.0, (5,), float32), the recordings have Box(",
        ),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(
    words: tuple[str, ...], sentence: str, one_ray: OneRay, ur5: Path, tmp_path: Path
) -> None:
    record(ur5, tmp_path / "run.mcap", explore=False)
    out = () if "--out" in words else ("--out", "learned")
    done = one_ray.run(tmp_path / "refused", SCRIPT, str(tmp_path / "run.mcap"), *words, *out)
    assert done.ended.code in (1, 2)
    assert sentence in done.ended.err
    assert "Traceback" not in done.ended.err
