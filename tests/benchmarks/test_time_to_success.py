"""The benchmark of training time: its end, its messages and files. Nothing is trained here."""

from __future__ import annotations

import json
from collections.abc import Generator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import time_to_success
import torch


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds whose training was ended; each gains a tenth of success in a second."""
    ended: list[int] = []

    def train(settings: dict[str, Any], seed: int) -> Generator[tuple[int, float, float], None, None]:
        try:
            for second in range(1, 100):
                yield 1000 * second, float(second), min(second / 10, settings["training"]["gamma"])
        finally:
            ended.append(seed)

    monkeypatch.setattr(time_to_success, "TRAINERS", {"rllib": train, "sb3": train, "sb3-processes": train})
    monkeypatch.setattr(time_to_success.importlib.util, "find_spec", lambda name: None)
    return ended


def run(monkeypatch: pytest.MonkeyPatch, out: Path, *words: str) -> list[Any]:
    monkeypatch.setattr("sys.argv", ["time_to_success.py", "--out", str(out), *words])
    time_to_success.main()
    runs: list[Any] = json.loads((out / "time_to_success.json").read_text())
    return runs


def test_it_ends_when_enough_succeed(
    closed: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = run(monkeypatch, tmp_path, "--seeds", "0", "7")
    assert [(each["trainer"], each["seed"], len(each["curve"])) for each in runs] == [
        ("rllib", 0, 10),
        ("rllib", 7, 10),
    ]
    said = capsys.readouterr().out
    assert "Stable-Baselines3 is not installed" in said
    assert "rllib, seed 7: 95% after 10,000 steps, 10 s (1,000 steps/s)" in said
    assert closed == [0, 7]


def test_or_after_the_settings_steps(
    closed: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, tmp_path, "--set", "training.gamma=0.9", "--set", "stop.env_steps=20000")
    assert "rllib, seed 0: 90% in the end, 20,000 steps, 20 s" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, tmp_path, "--set", "training.speed=1")
    assert stopped.value.code == 2 and "expected KEY=VALUE" in capsys.readouterr().err
    assert closed == [0]


def test_what_is_compared_is_what_both_can_train() -> None:
    names = time_to_success.comparable()
    assert {"ur5_positioning", "mir100_navigation"} <= set(names)
    assert not {"cartpole_dqn", "pendulum_sac", "ur_positioning", "mir100_sparse_fixes"} & set(names)


@pytest.mark.parametrize(("cores", "processes"), [(1, 1), (2, 2), (12, 8), (24, 16)])
def test_every_process_has_as_many_environments(cores: int, processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    assert time_to_success.sampling_processes(16) == processes


def test_variants_are_trained_in_turn(
    closed: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = run(monkeypatch, tmp_path, "--variants", "quick", "small, relu")
    assert [each["trainer"] for each in runs] == ["rllib small, relu", "rllib quick"]
    run(monkeypatch, tmp_path, "--variants", "quick", "--set", "training.gamma=0.5", "--set", "stop.env_steps=9000")
    assert "rllib quick, seed 0: 50% in the end, 9,000 steps" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        run(monkeypatch, tmp_path, "--variants", "slow")
    assert "--variants slow: expected all, or some of 'wide', 'wide, lr 1e-3', " in capsys.readouterr().err


def test_orthogonal_weights_reach_the_runners() -> None:
    parts = {"encoder": torch.nn.Linear(4, 8), "pi": torch.nn.Linear(8, 2), "vf": torch.nn.Linear(8, 1)}
    learner = SimpleNamespace(module={"default_policy": torch.nn.ModuleDict(parts)})
    learners = SimpleNamespace(foreach_learner=lambda function: function(learner))
    synced: list[Any] = []
    runners = SimpleNamespace(sync_weights=lambda **options: synced.append(options["from_worker_or_learner_group"]))
    time_to_success.train_shipped.draw_orthogonal(
        algorithm=SimpleNamespace(learner_group=learners, env_runner_group=runners)
    )
    for name, gain in (("encoder", 2**0.5), ("pi", 0.01), ("vf", 1.0)):
        sizes = torch.linalg.svdvals(parts[name].weight)
        assert torch.allclose(sizes, torch.full_like(sizes, gain), rtol=1e-4) and not parts[name].bias.any()
    assert synced == [learners]
