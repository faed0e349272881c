"""The sweep's trainings, judgements and files. Nothing is trained here."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
import sweep
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

SWEPT = sorted(path.stem for path in sweep.VARIANTS.glob("*.yaml"))


@pytest.mark.parametrize("name", SWEPT)
def test_variants_have_settings_that_rllib_and_the_training_know(name: str) -> None:
    known = sweep.evaluate_shipped.load_settings(name).keys() | {"orthogonal_weights", "out_of_reach"}
    for settings in sweep.variants_of(name, ["all"]).values():
        assert settings.keys() <= known
        PPOConfig().training(**settings["training"])  # it refuses what it does not know
        DefaultModelConfig(**settings["model"])


def test_a_variant_changes_what_it_names() -> None:
    settings = sweep.evaluate_shipped.load_settings("ur5_positioning")
    variants = sweep.variants_of("ur5_positioning", ["quick", "small"])
    assert list(variants) == ["small", "quick"]
    assert variants["small"]["model"] == {**settings["model"], "fcnet_hiddens": [64, 64]}
    assert variants["small"]["training"] == {**settings["training"], "lr": 0.0007, "use_kl_loss": False}
    assert variants["quick"]["orthogonal_weights"] is True
    assert sweep.variants_of("ur5_positioning", []) == {"": settings}


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[sweep.Trial]:
    """The trials that were trained; those of `small` fail, all others reach all targets and half of them."""
    every: list[sweep.Trial] = []

    def train(self: sweep.Trial, name: str) -> str:
        every.append(self)
        if self.variant == "small":
            raise subprocess.CalledProcessError(1, name)
        return "9000,80,1.5,60,0.9,70,65"

    def judge(self: sweep.Trial, _name: str, episodes: int, first_seed: int) -> list[Any]:
        return [
            sweep.evaluate_shipped.Evaluation(
                setting["start"], {}, episodes, first_seed, successes, None, 0.0, (0.0, 0.0), 0.0, 0.0, {}
            )
            for setting, successes in zip(self.settings["evaluation"], (episodes, episodes // 2), strict=True)
        ]

    monkeypatch.setattr(sweep.Trial, "train", train)
    monkeypatch.setattr(sweep.Trial, "judge", judge)
    return every


def run(monkeypatch: pytest.MonkeyPatch, out: Path, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["sweep.py", "ur5_positioning", "--out", str(out), "--jobs", "1", *words])
    sweep.main()


def test_each_variant_is_trained_for_each_seed_and_judged(
    trained: list[sweep.Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--variants", "wide", "quick", "--seeds", "3", "4", "--set", "stop.env_steps=5000", "--episodes", "8")
    run(monkeypatch, tmp_path, *words)
    assert [(trial.variant, trial.seed) for trial in trained] == [("wide", 3), ("quick", 3), ("wide", 4), ("quick", 4)]
    assert {trial.settings["stop"]["env_steps"] for trial in trained} == {5000}
    assert len({trial.folder for trial in trained}) == 4
    table = (tmp_path / "sweep-ur5_positioning.md").read_text().splitlines()
    assert len(table) == 6 and len({line.count("|") for line in table}) == 1
    assert "| wide | 3 | 9,000 | 65 | 100.0% | 50.0% | 75.0% | " in "\n".join(table)
    assert "4 trainings, 1 at a time" in capsys.readouterr().out


def test_a_training_that_fails_does_not_end_the_others(
    trained: list[sweep.Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="error: 1 of 2 trainings failed: small, seed 0"):
        run(monkeypatch, tmp_path, "--variants", "small", "quick")
    assert "small, seed 0: failed, see " in capsys.readouterr().out
    assert "| quick | 0 |" in (tmp_path / "sweep-ur5_positioning.md").read_text()


def test_it_says_how_far_the_trainings_are(tmp_path: Path) -> None:
    trial = sweep.Trial("wide", 3, {}, tmp_path)
    assert trial.how_far() == "wide, seed 3: begins"
    said = ("WARNING", "steps      8,192 of 20,000  return 1.0", "steps     16,384 of 20,000  return 2.0", "exported")
    (tmp_path / "log").write_text("\n".join(said))
    assert trial.how_far() == "wide, seed 3: steps 16,384 of 20,000"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--variants", "slow"), "--variants slow: expected all, or some of 'wide', 'wide, lr 1e-3', "),
        (("--set", "training.speed=1"), "--set training.speed=1: expected KEY=VALUE"),
        (("--episodes", "1"), "expected at least 2 --episodes"),
    ],
)
def test_a_wrong_argument_is_a_sentence(
    words: tuple[str, ...], sentence: str, trained: list[sweep.Trial], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, tmp_path, *words)
    assert stopped.value.code == 2 and sentence in capsys.readouterr().err and not trained
