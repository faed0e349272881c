"""Success rates against environments whose outcomes are written down here, episode by episode."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from gymnasium.envs.registration import register, registry
from rich.console import Console

from command_line import rlservo_here
from rlservo.bundle.bundle import read_contract
from rlservo.drive.control_loop import rollout
from rlservo.drive.disturbance_table import evaluations_of, measure_disturbances
from rlservo.drive.report import RolloutReport, render_report
from rlservo.policy.policy import Policy
from rlservo.recording.reader import Recording
from rlservo.recording.summary import summarise_recording

if TYPE_CHECKING:  # needs torch, which `make newest` does not install
    from rlservo.export.export_checkpoint import ExportResult

ENV = "rollout-tests/Outcomes-v0"
STEPS = 5
SILENT: dict[str, Any] = {}
REACHED = {"final_status": "success"}
# The last infos of ten episodes in four environments, with the successes that a person counts in each.
ONLY_SUCCESSES = [SILENT] * 3 + [REACHED] + [SILENT] * 6
BOTH = [{"is_success": np.bool_(index == 3)} for index in range(10)]
METAWORLD = [{"success": float(index in (0, 9))} for index in range(10)]
CONFLICT = [{"is_success": False, "final_status": "success"}] * 8 + [{"success": 1.0, "final_status": "docked"}] * 2
NEVER = [SILENT] * 10


class Outcomes(PendulumEnv):
    """Pendulum, cut off after five steps. The last info of an episode with seed i is `infos[i]`, if it is not lost."""

    def __init__(self, infos: list[dict[str, Any]], **options: Any) -> None:
        super().__init__(**options)
        self.infos = infos

    def extreme_options(self, what: str, rng: np.random.Generator) -> dict[str, Any]:
        return {"is_lost": True}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        is_lost = (options or {}).get("is_lost", False)
        self.last, self.done = {} if is_lost or seed is None else self.infos[seed], 0
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        obs, reward, _, _, _ = super().step(action)
        self.done += 1
        is_over = self.done == STEPS
        return obs, reward, False, is_over, self.last if is_over else {}


@pytest.fixture(autouse=True)
def outcomes() -> Iterator[None]:
    register(id=ENV, entry_point=Outcomes)
    yield
    del registry[ENV]


@pytest.fixture
def bundle(zoo: Path, exported: Callable[[Path], ExportResult], tmp_path: Path) -> Path:
    return Path(shutil.copytree(exported(zoo / "pendulum").path, tmp_path / "pendulum" / "1"))


@pytest.fixture
def policy(bundle: Path) -> Iterator[Policy]:
    with Policy.load(bundle) as loaded:
        yield loaded


def shown(report: RolloutReport) -> str:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(render_report(report))
    return next(line for line in console.export_text().splitlines() if line.strip(" │┃|").startswith("success"))


@pytest.mark.parametrize(
    ("infos", "by_hand", "line"),
    [
        (ONLY_SUCCESSES, 1, "10.0%"),
        (BOTH, 1, "10.0%"),
        (METAWORLD, 2, "20.0%"),
        (CONFLICT, 2, "20.0%"),
        (NEVER, None, "no rate"),
    ],
)
def test_rate_is_the_one_counted_by_hand(
    policy: Policy, tmp_path: Path, infos: list[dict[str, Any]], by_hand: int | None, line: str
) -> None:
    report = rollout(policy, ENV, episodes=10, seed=0, env_kwargs={"infos": infos}, record=tmp_path / "run.mcap")
    assert report.successes == by_hand
    assert report.success_rate == (None if by_hand is None else by_hand / 10)
    assert (report.success_interval is None) is (by_hand is None)
    assert line in shown(report)
    (recorded,) = summarise_recording(Recording(tmp_path / "run.mcap")).policies
    assert recorded.endings.get("success", 0) == (by_hand or 0)
    assert sum(recorded.endings.values()) == 10


def test_a_run_of_failures_alone_has_no_rate_beside_one_with_a_success_it_has(policy: Policy) -> None:
    """Under the disturbance every episode fails, so this environment says nothing in that row: 0 of 10, not none."""
    table = measure_disturbances(
        policy, ENV, ["target=outside"], episodes=10, seed=0, progress=lambda _: None,
        env_kwargs={"infos": ONLY_SUCCESSES},
    )  # fmt: skip
    assert [(row.successes, row.success_rate) for row in table.rows] == [(1, 0.1), (0, 0.0)]
    assert [one.success_rate_bundle for one in evaluations_of(table, "2026-01-01")] == [0.1, 0.0]


def test_a_table_of_an_environment_that_never_reports_has_no_rates(policy: Policy) -> None:
    table = measure_disturbances(
        policy, ENV, ["latency=1"], episodes=3, seed=0, progress=lambda _: None, env_kwargs={"infos": NEVER}
    )
    assert [row.success_rate for row in table.rows] == [None, None]


def test_rates_of_bundle_and_checkpoint_in_the_contract_are_the_ones_counted_by_hand(zoo: Path, bundle: Path) -> None:
    from rlservo.export.verify_bundle import verify_bundle

    verify_bundle(
        bundle, zoo / "pendulum", env_id=ENV, env_config={"infos": ONLY_SUCCESSES}, episodes=10, notify=lambda _: None
    )
    (evaluation,) = read_contract(bundle).evaluations
    assert (evaluation.success_rate_bundle, evaluation.success_rate_checkpoint) == (0.1, 0.1)


def test_verify_writes_the_rate_counted_by_hand_into_the_contract(
    bundle: Path,
) -> None:
    done = rlservo_here(
        "verify", bundle, "--env", ENV, "--env-arg", f"infos={json.dumps(ONLY_SUCCESSES)}", "--episodes", 10,
        "--disturb", "drop=0.1", "target=outside", "--write",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [one.success_rate_bundle for one in read_contract(bundle).evaluations] == [0.1, 0.1, 0.0]
