"""Online learning from end to end: robots over HTTP, a server that records, RLlib's learner, the gate, the alias.

The robots act while the learner waits, in its thread, so that every run is the same one.
"""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModule

from bundles import controlled
from rlservo.bundle.bundle import read_contract
from rlservo.client.admin_client import AdminClient
from rlservo.client.policy_client import PolicyClient
from rlservo.client.promotion import Terms
from rlservo.client.promotion_evidence import PromotionLimits
from rlservo.deploy.learning.episode_filter import EpisodeFilter
from rlservo.deploy.learning.followed_recordings import FollowedRecordings, ServerRecordings
from rlservo.deploy.learning.online import OnlineLearning
from rlservo.deploy.learning.release import Release, Target
from rlservo.deploy.learning.rllib_episodes import single_agent_episode
from rlservo.deploy.learning.rllib_learner import OnlineLearner
from rlservo.deploy.learning.run_folder import RunFolder
from rlservo.errors import ConflictError, UsageError
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint, silent
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn

ROBOT, ROBOT_LINE = new_key("robot", explore=True)
ADMIN, ADMIN_LINE = new_key("boss", admin=True)
OTHER, OTHER_LINE = new_key("screen")
LENGTH, BATCH = 8, 40  # steps of an episode, and of an update


@dataclass
class Cell:
    """A server that records, its robot, and the run that learns from it."""

    url: str
    folder: Path
    checkpoint: Path
    said: list[str] = field(default_factory=list)
    acted: list[str] = field(default_factory=list)
    """The version that acted in each episode."""
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    reward_from: tuple[str, ...] = ()
    size: int = 3
    """Of an observation."""

    def play(self, reward: float | None = 1.0, version: str | None = "learning") -> None:
        """Let the robot have an episode; without a `reward` it reports none."""
        with PolicyClient(self.url, "policy", version=version, api_key=ROBOT, timeout_s=60) as policy:
            self.size = policy.contract.observation_space.shape[0]  # type: ignore[union-attr]
            for step in range(LENGTH):
                policy.act(self._obs(), explore=True)
                ends = step == LENGTH - 1
                last = self._obs() if ends else None
                policy.outcome(reward if ends or reward is None else 0.0, truncated=ends, final_obs=last)
            self.acted.append(policy.contract.version)
        time.sleep(0.2)  # the server's recorder flushes within a second

    def _obs(self) -> NDArray[np.float32]:
        return self.rng.standard_normal(self.size).astype(np.float32)

    def learning(
        self,
        run: RunFolder,
        learner: OnlineLearner | None = None,
        *,
        canary: Terms | None = None,
        follow: bool = False,
        **more: Any,
    ) -> OnlineLearning:
        target = Target("policy", str(self.folder / "policies"), "learning", canary)
        learner = learner or OnlineLearner(self.checkpoint, batch_size=BATCH)
        folders = [] if follow else [self.folder / "recorded"]
        servers = [ServerRecordings(self.admin, run.path / "followed")] if follow else []
        release = Release(target, run, self.admin, app_dir=self.folder, progress=str)
        return OnlineLearning(
            learner, run, FollowedRecordings(folders, self.said.append, servers),
            EpisodeFilter("policy", max_age=learner.max_age, reward=release.named_reward(self.reward_from)), release,
            **{"every": 1, "say": self.said.append, "progress": str, "sleep": lambda s: self.play()}
            | more,
        )  # fmt: skip

    def run_folder(self, name: str = "run") -> RunFolder:
        return RunFolder(self.folder / name, {"policy": "policy"}, None)

    def admin(self) -> AdminClient:
        return AdminClient(self.url, api_key=ADMIN)

    def aliases(self) -> dict[str, str]:
        with self.admin() as client:
            aliases: dict[str, str] = client.listing()["policies"][0]["aliases"]
            return aliases


@pytest.fixture
def cell(
    zoo: Path, exported: Callable[..., ExportResult], tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Cell]:
    name, _, reward = getattr(request, "param", "pendulum").partition("+")
    checkpoint, policies = zoo / name, tmp_path / "policies"
    if reward:
        export_checkpoint(checkpoint, policies, name="policy", reward=reward, notify=silent, untrained_filter=True)
    else:
        shutil.copytree(exported(checkpoint).path, policies / "policy" / "1")
    settings = ServerSettings(record=str(tmp_path / "recorded"), api_keys=f"{ROBOT_LINE},{ADMIN_LINE},{OTHER_LINE}")
    with (
        controlled(tmp_path / "policies") as control,
        over_uvicorn(create_app(control, settings)) as port,
    ):
        yield Cell(f"http://127.0.0.1:{port}", tmp_path, checkpoint)


def test_robots_train_versions_that_reach_them_by_the_alias(cell: Cell) -> None:
    with cell.run_folder() as run:
        cell.learning(run).run(versions=2)
        first, second, third = (known.version for known in run.state.versions)
        assert (first, second, third) == ("2", "3", "4")
        assert cell.aliases() == {"production": "1", "learning": "4"}
        cell.play()
    assert cell.acted[0] == "2" and "3" in cell.acted and cell.acted[-1] == "4"
    graphs = {(cell.folder / "policies/policy" / v / "policy.onnx").read_bytes() for v in (first, second, third)}
    assert len(graphs) == 3  # it did learn
    assert "learning continues" not in "".join(cell.said)


def test_poisoned_episodes_teach_nothing_and_stop_nothing(cell: Cell) -> None:
    rewards = iter([float("nan"), float("inf")] + [1.0] * 50)
    with cell.run_folder() as run:
        cell.learning(run, sleep=lambda s: cell.play(next(rewards))).run(versions=1)
        assert run.state.dropped == {"without every reward": 2}
        assert run.state.steps == run.state.episodes * LENGTH >= BATCH


def test_a_killed_learner_goes_on_and_uses_every_episode_once(cell: Cell) -> None:
    def kill_after(updates: int) -> Callable[[str], None]:
        def say(line: str) -> None:
            cell.said.append(line)
            if line.startswith(f"update {updates:>4}"):
                raise KeyboardInterrupt  # between an update and its version

        return say

    with cell.run_folder() as run, pytest.raises(KeyboardInterrupt):
        cell.learning(run, say=kill_after(2)).run()
    before = json.loads((cell.folder / "run" / "learn.json").read_text())
    assert before["updates"] == 1 and [known["version"] for known in before["versions"]] == ["2", "3"]
    again = [line for line in cell.said if line.startswith("update    2")]
    with cell.run_folder() as run:
        cell.learning(run).run(versions=1)
        state = run.state
        used = [key for keys in state.used.values() for key in keys]
        assert (state.updates, len(used), len(set(used))) == (2, state.episodes, state.episodes)
    # The same episodes from the same weights and filter: the same numbers again.
    assert [line for line in cell.said if line.startswith("update    2")] == again * 2
    assert cell.aliases()["learning"] == "4"


class BrokenOnce(OnlineLearner):
    """Its second checkpoint has weights that are not numbers, as after an update that diverged."""

    saved = 0

    def save(self, folder: Path) -> None:
        super().save(folder)
        self.saved += 1
        if self.saved == 2:
            place = folder / "learner_group" / "learner" / "rl_module" / "default_policy"
            module = RLModule.from_checkpoint(str(place))
            with torch.no_grad():
                for parameter in module.parameters():  # type: ignore[attr-defined]
                    parameter.fill_(float("nan"))
            module.save_to_path(str(place))


def test_a_version_that_the_gate_refuses_reaches_no_robot(cell: Cell) -> None:
    with cell.run_folder() as run:
        cell.learning(run, BrokenOnce(cell.checkpoint, batch_size=BATCH)).run(versions=1)
        assert run.state.refused == 1 and [known.version for known in run.state.versions] == ["2", "3"]
    refusals = [line for line in cell.said if "the gate refused it" in line]
    assert len(refusals) == 1 and "learning continues from version 2" in cell.said
    assert set(cell.acted) == {"2"} and cell.aliases()["learning"] == "3"


def test_an_episode_that_another_key_ends_teaches_nothing(cell: Cell) -> None:
    """A key that may only act knows a robot's episode, and claims that it went well."""

    def claim(_seconds: float) -> None:
        if not cell.acted:
            post = {"content-type": "application/json", "x-session-id": "cell-1"}
            address = f"{cell.url}/v1/policies/policy/versions/2/act"
            for key, more in ((ROBOT, {"explore": True}), (OTHER, {"reward": 1e6, "final_status": "success"})):
                reply = httpx.post(
                    address, json={"obs": [0.0] * 3, **more}, headers={**post, "authorization": f"Bearer {key}"}
                )
                assert reply.status_code == 200
        cell.play()

    with cell.run_folder() as run:
        cell.learning(run, sleep=claim).run(versions=1)
        assert run.state.dropped == {"with reports from a key without the role explore": 1}
        assert run.state.episodes == BATCH // LENGTH


@pytest.mark.parametrize("cell", ["pendulum+cell_rewards:height"], indirect=True)
def test_the_contract_may_name_the_reward_function(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    (cell.folder / "cell_rewards.py").write_text("def height(obs, action, next_obs):\n    return float(next_obs[0])\n")
    monkeypatch.syspath_prepend(cell.folder)
    with cell.run_folder() as run:
        with pytest.raises(UsageError, match="if you trust it, add --reward-from cell_rewards"):
            cell.learning(run)
        cell.reward_from = ("cell_rewards",)
        cell.learning(run, sleep=lambda s: cell.play(reward=None)).run(versions=1)
        assert run.state.episodes == BATCH // LENGTH and not run.state.dropped
    assert read_contract(cell.folder / "policies/policy/3").reward == "cell_rewards:height"


@pytest.mark.parametrize("cell", ["appo"], indirect=True)
def test_appo_learns_from_what_robots_did(cell: Cell) -> None:
    with cell.run_folder() as run:
        cell.learning(run, follow=True).run(versions=1)  # copied from the server, by what was added
        assert run.state.episodes * LENGTH >= BATCH and not run.state.dropped
        copies = {path.name: path.stat().st_size for path in (run.path / "followed").iterdir()}
        assert copies and all((cell.folder / "recorded" / name).stat().st_size >= size for name, size in copies.items())
    assert cell.aliases()["learning"] == "3"
    graphs = {(cell.folder / "policies/policy" / v / "policy.onnx").read_bytes() for v in ("2", "3")}
    assert len(graphs) == 2


@pytest.mark.parametrize("cell", ["sac"], indirect=True)
def test_sac_replays_what_it_learned_from_before_a_restart_and_forgets_what_was_refused(cell: Cell) -> None:
    with cell.run_folder() as run:
        cell.learning(run, BrokenOnce(cell.checkpoint, batch_size=BATCH)).run(versions=1)
        assert run.state.refused == 1 and len(run.state.unproven) == BATCH // LENGTH
        learned = run.state.episodes - len(run.state.unproven)
    learner = Replayed(cell.checkpoint, batch_size=BATCH)
    with cell.run_folder() as run:
        cell.learning(run, learner).run(versions=1)
    assert learner.remembered == learned > 0
    assert cell.aliases()["learning"] == "4"


class Replayed(OnlineLearner):
    """Counts what is given back to it after a restart."""

    remembered = 0

    def remember(self, seen: Sequence[Any]) -> None:
        super().remember(seen)
        self.remembered += len(seen)


def test_a_version_goes_to_production_by_its_canary_or_learning_goes_on(cell: Cell) -> None:
    limits = PromotionLimits(error_rate=0.5, min_requests=1)
    playing = threading.Event()

    def play() -> None:
        while not playing.wait(0.05):
            cell.play(version=None)

    robot = threading.Thread(target=play)
    robot.start()
    try:
        with cell.run_folder() as run:
            canary = Terms((cell.url,), "policy", "", 1.0, 3.0, limits)
            cell.learning(run, canary=canary, sleep=time.sleep).run(versions=1)
            assert [known.version for known in run.state.versions] == ["2", "3"]
            assert cell.aliases() == {"production": "3"}
    finally:
        playing.set()
        robot.join()
    for _ in range(BATCH // LENGTH):
        cell.play(version=None)

    def stop(line: str) -> None:
        cell.said.append(line)
        if line.startswith("learning continues"):
            raise KeyboardInterrupt

    with cell.run_folder() as run, pytest.raises(KeyboardInterrupt):  # no robot acts while it is watched
        cell.learning(run, canary=canary, say=stop).run()
    assert cell.aliases() == {"production": "3"} and "learning continues from version 3" in cell.said
    assert any("the server does not serve version 4: " in line for line in cell.said)


def test_two_learners_do_not_share_a_folder_or_an_alias(cell: Cell) -> None:
    with cell.run_folder() as run:
        with pytest.raises(UsageError, match="another process is learning in it"):
            cell.run_folder()

        def play_and_move(_seconds: float) -> None:
            for _ in range(BATCH // LENGTH):
                cell.play()
            with cell.admin() as client:
                client.alias("policy", "learning", "1")

        with pytest.raises(ConflictError, match="points to version 1, but this run had moved it to 2"):
            cell.learning(run, sleep=play_and_move).run(versions=1)
    assert cell.aliases()["learning"] == "1"
    with (
        cell.run_folder("second") as run,
        pytest.raises(ConflictError, match=r"already points to version 1: .*policy alias policy learning='"),
    ):
        cell.learning(run).run(versions=1)
    assert not (cell.folder / "policies/policy/4").exists()


def test_a_folder_of_something_else_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "thesis.pdf").touch()
    with pytest.raises(UsageError, match=r"holds thesis\.pdf: expected a new folder, or the folder of a run"):
        RunFolder(tmp_path, {}, None)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.pdf"]
    with RunFolder(tmp_path / "run", {"policy": "a"}, "def reward(): ...") as run:
        run.commit(())
    assert (tmp_path / "run" / "reward.py").read_text() == "def reward(): ..."
    with pytest.raises(UsageError, match="is a run with policy 'a', not 'b'"):
        RunFolder(tmp_path / "run", {"policy": "b"}, "def reward(): ...")
    with pytest.raises(UsageError, match="--reward differs from this run's first one"):
        RunFolder(tmp_path / "run", {"policy": "a"}, None)


def test_the_learner_sees_what_the_acting_version_saw(
    zoo: Path, exported: Callable[..., ExportResult], tmp_path: Path
) -> None:
    """Through its filter's statistics; a module with its weights gives the recorded distributions."""
    rng = np.random.default_rng(1)
    with WithRecording(Policy.load(exported(zoo / "pendulum").path), tmp_path / "run.mcap") as policy:
        for step in range(LENGTH):
            policy.act(rng.standard_normal(3).astype(np.float32), explore=True)
            policy.outcome(1.0, terminated=step == LENGTH - 1)
    (episode,) = episodes(Recording(tmp_path / "run.mcap"))
    made = single_agent_episode(episode, episode.own_action, episode.reward, id_="0", with_distribution=True)
    learner = OnlineLearner(zoo / "pendulum")
    (seen,) = learner.seen([made], zoo / "pendulum")
    module = RLModule.from_checkpoint(str(zoo / "pendulum/learner_group/learner/rl_module/default_policy"))
    obs = torch.as_tensor(np.asarray(seen.get_observations())[:-1])
    given = module.forward_exploration({Columns.OBS: obs})[Columns.ACTION_DIST_INPUTS]
    assert np.asarray(seen.get_extra_model_outputs(Columns.ACTION_DIST_INPUTS)) == pytest.approx(
        given.detach().numpy(), abs=1e-5
    )
    assert not np.allclose(obs, np.asarray(made.get_observations())[:-1])
    assert np.asarray(seen.get_extra_model_outputs(Columns.ACTION_LOGP)) == pytest.approx(episode.logp, abs=1e-5)
