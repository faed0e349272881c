"""The drive without a page: a policy drives a simulated robot, and requests take effect between cycles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arms import LIMITS, RunningArm
from bundles import write_leaky_policy
from cockpits import served_on
from rlservo.bundle.bundle import read_contract
from rlservo.deploy.cockpit.drive import Drive
from rlservo.deploy.cockpit.ghost import Ghost
from rlservo.deploy.cockpit.policies import BundledPolicies, Choice, PolicySource, ServedPolicies, ServerLink
from rlservo.deploy.cockpit.stage import Scene, Stage, StageDisturbance
from rlservo.errors import UnavailableError, UsageError
from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorder import Recorder
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn
from stores import control_of, load_store
from waiting import wait_for

ENV = "rlservo/EndEffectorPositioningURSim-v0"
FAST = 4.0
REACHABLE = np.array([0.35, 0.25, 0.6])  # [m], in MuJoCo's world


@pytest.fixture
def drives(two_versions: Path) -> Iterator[Callable[..., Drive]]:
    opened: list[Drive] = []

    def start(name: str = "ur5", **options: Any) -> Drive:
        drive = Drive(BundledPolicies(two_versions), Choice(name, "1"), seed=5, **options)
        opened.append(drive)
        drive.start()
        drive.do(lambda: drive.set_speed(FAST))
        return drive

    yield start
    for drive in opened:
        drive.close()


def test_the_arm_follows_its_target_and_waits_there(drives: Callable[..., Drive]) -> None:
    drive = drives()
    drive.drag_target(REACHABLE)
    wait_for(lambda: drive.view.phase == "arrived", "the arm arrives")
    view = drive.view
    assert view.after.target is not None and np.allclose(view.after.target, REACHABLE)
    assert np.linalg.norm(view.after.robot - REACHABLE) <= 0.1
    assert view.successes == view.episodes >= 1
    cycles = len(drive.history)
    drive.drag_target(REACHABLE + (0.0, -0.4, 0.0))
    wait_for(lambda: drive.view.phase == "driving", "it goes on")
    wait_for(lambda: len(drive.history) > cycles + 5, "it moves")
    distances = [cycle.distance for cycle in drive.history]
    assert distances[cycles] is not None and distances[-1] is not None and distances[cycles] > 0.2


def test_a_new_target_is_drawn_where_nobody_put_one(drives: Callable[..., Drive]) -> None:
    drive = drives()
    wait_for(lambda: drive.view.episodes >= 2, "two episodes")
    assert drive.view.successes >= 1 and drive.view.phase == "driving"


def test_paused_time_stands_still_but_for_a_step(drives: Callable[..., Drive]) -> None:
    drive = drives()
    wait_for(lambda: len(drive.history) > 2, "it drives")
    drive.do(drive.pause)
    wait_for(lambda: drive.view.phase == "paused", "it stands")
    cycles = drive.history[-1].number
    drive.do(drive.step)
    wait_for(lambda: drive.history[-1].number == cycles + 1, "one cycle")
    drive.drag_target(REACHABLE)
    wait_for(lambda: np.allclose(drive.view.after.target, REACHABLE), "the target moves nevertheless")
    assert drive.view.phase == "paused" and drive.history[-1].number == cycles + 1


def test_the_ghost_of_the_same_version_does_the_same_and_another_one_differs(drives: Callable[..., Drive]) -> None:
    drive = drives()
    drive.do(lambda: drive.choose_ghost(Choice("ur5", "1")))
    wait_for(lambda: drive.view.ghost is not None and drive.history[-1].difference is not None, "a ghost")
    start = len(drive.history)
    wait_for(lambda: len(drive.history) > start + 5, "both drive")
    assert max(np.abs(cycle.difference).max() for cycle in list(drive.history)[start:]) < 1e-5
    view = drive.view
    assert view.ghost is not None and np.allclose(view.ghost[1].robot, view.after.robot, atol=1e-3)
    drive.do(lambda: drive.choose_ghost(Choice("ur5", "2")))
    wait_for(lambda: drive.view.ghost_contract is not None and drive.view.ghost_contract.version == "2", "version 2")
    wait_for(lambda: np.abs(drive.history[-1].difference).max() > 1e-3, "another action")
    drive.do(lambda: drive.choose_ghost(None))
    wait_for(lambda: drive.view.ghost is None, "no ghost")


@pytest.mark.parametrize("model", ["ur3", "ur3e", "ur5", "ur5e", "ur10", "ur10e", "ur16e"])
def test_every_arm_can_be_driven(drives: Callable[..., Drive], model: str) -> None:
    drive = drives(env_arguments={"ur_model": model})
    wait_for(lambda: len(drive.history) > 3, "it drives")
    assert drive.view.trouble == ""


def test_a_policy_of_another_robot_brings_that_along(drives: Callable[..., Drive]) -> None:
    drive = drives()
    drive.do(lambda: drive.choose(Choice("mir100_obstacle_avoidance", "1")))
    wait_for(lambda: drive.view.contract.name == "mir100_obstacle_avoidance", "the MiR100")
    wait_for(lambda: len(drive.history) > 3, "it drives")
    assert drive.view.after.beams.shape == (1012, 2, 3) and len(drive.view.after.obstacles) == 3
    drive.do(drive.pause)
    drive.do(lambda: drive.move_obstacle(1, np.array([1.0, 3.0, 0.0])))
    wait_for(lambda: np.allclose(drive.view.after.obstacles[1, :2], (1.0, 3.0)), "the cube is there")


def test_what_does_not_fit_is_said_and_nothing_changes(drives: Callable[..., Drive], two_versions: Path) -> None:
    drive = drives()
    drive.do(lambda: drive.choose(Choice("nobody", "1")))
    wait_for(lambda: "no bundle nobody/1" in drive.view.refusal, "the sentence")
    cycles = drive.history[-1].number if drive.history else 0
    wait_for(lambda: len(drive.history) and drive.history[-1].number > cycles + 3, "it drives on")
    assert "no bundle nobody/1" in drive.view.refusal and drive.view.contract.name == "ur5"
    drive.do(lambda: drive.set_speed(1.0))
    wait_for(lambda: drive.view.refusal == "", "another command is followed")
    with pytest.raises(UsageError, match="does not fit rlservo/NoObstacle"):
        Drive(BundledPolicies(two_versions), Choice("ur5", "1"), env_id="rlservo/NoObstacleNavigationMir100Sim-v0")
    with pytest.raises(UsageError, match="CartPole-v1 is not one of them"):
        Drive(BundledPolicies(two_versions), Choice("ur5", "1"), env_id="CartPole-v1")


def test_disturbances_begin_with_an_episode_where_the_robot_stands(drives: Callable[..., Drive]) -> None:
    drive = drives()
    wait_for(lambda: len(drive.history) > 5, "it drives")
    drive.do(drive.pause)
    wait_for(lambda: drive.view.phase == "paused", "it stands")
    robot, target = drive.view.after.robot, drive.view.after.target
    drive.do(lambda: drive.disturb(StageDisturbance(action_latency=3, noise=0.05, payload=2.0)))
    drive.do(drive.step)
    cycles = drive.history[-1].number
    wait_for(lambda: drive.history[-1].number > cycles or drive.view.phase == "paused", "a step")
    assert np.allclose(drive.view.after.robot, robot, atol=0.05)
    assert target is not None and np.allclose(drive.view.after.target, target)
    drive.do(drive.play)
    wait_for(lambda: drive.history[-1].number > cycles + 3, "it drives")
    seen = np.array([cycle.obs[18:21] for cycle in list(drive.history)[-3:]])
    assert np.abs(seen[-1] + (0, 0, 0.1) - drive.view.after.robot).max() > 1e-4  # noisy, and not where it is


def in_the_table(_scene: Scene) -> Any:
    return (0.0, 0.1, 0.0)


def first_cube(scene: Scene) -> Any:
    return scene.obstacles[0]


@pytest.mark.parametrize(
    ("name", "there", "blocked"),
    [("ur5", REACHABLE, in_the_table), ("mir100_obstacle_avoidance", (1.0, 3.0, 0.0), first_cube)],
    ids=["ur5", "mir100"],
)
def test_the_robot_is_dragged_and_drives_on_from_there(
    drives: Callable[..., Drive], name: str, there: Any, blocked: Callable[[Scene], Any]
) -> None:
    """And from where it was, when it cannot stand where it was dragged to."""
    drive = drives(name)
    drive.do(drive.pause)
    wait_for(lambda: drive.view.phase == "paused", "it stands")
    target = drive.view.after.target
    for _ in range(3):  # of many positions the last one counts
        drive.drag_robot(np.asarray(there) + (0.0, 0.1, 0.0))
        drive.drag_robot(np.asarray(there))
    wait_for(lambda: np.allclose(drive.view.after.robot, there, atol=5e-3), "the robot is where it was dragged to")
    drive.drag_robot(np.asarray(blocked(drive.view.after)))
    drive.do(lambda: drive.set_speed(1.0))
    wait_for(lambda: drive.view.period_s > 0.09, "both were done")
    assert np.allclose(drive.view.after.robot, there, atol=5e-3) and np.allclose(drive.view.after.target, target)
    drive.do(drive.play)
    wait_for(lambda: np.linalg.norm(drive.view.after.robot - there) > 0.05, "it drives on from there")


@pytest.mark.parametrize("served", [False, True])
def test_a_ghost_with_a_memory_has_one_of_its_own(two_versions: Path, tmp_path: Path, served: bool) -> None:
    """The same recurrent version beside itself does the same, from the first step of an episode to the next one's."""
    write_leaky_policy(tmp_path, name="ur5", like=read_contract(two_versions / "ur5" / "1"))
    with ExitStack() as cleanup:
        source: PolicySource = BundledPolicies(tmp_path)
        if served:
            store = load_store(tmp_path)
            port = cleanup.enter_context(over_uvicorn(create_app(control_of(store), ServerSettings())))
            source = ServedPolicies(f"http://127.0.0.1:{port}")
        cleanup.callback(source.close)
        policy, choice = source.open(Choice("ur5", "1"), ServerLink()), Choice("ur5", "1")
        cleanup.callback(policy.close)
        stage = Stage(ENV, {}, policy.contract)
        cleanup.callback(stage.close)
        ghost = Ghost(source.open(choice, ServerLink()), stage)
        cleanup.callback(ghost.close)
        seen = []
        for _ in range(2):
            obs = stage.begin(seed=5)
            policy.reset()
            ghost.begin(stage)
            actions = []
            for _ in range(4):
                action = policy.act(obs)
                difference = ghost.step(obs, action)
                assert np.abs(difference).max() < 1e-6
                obs = stage.step(action)[0]
                actions.append(action)
            assert np.allclose(ghost.scenes[1].robot, stage.scene().robot, atol=1e-6)
            seen.append(actions)
        assert np.array_equal(seen[0], seen[1])  # an episode begins without a memory
        fresh = source.open(choice, ServerLink())
        cleanup.callback(fresh.close)
        assert np.abs(fresh.act(obs) - policy.act(obs)).max() > 1e-3  # there is one


def test_a_server_that_goes_away_is_waited_for_and_driven_on_with(two_versions: Path, free_port: int) -> None:
    store = load_store(two_versions)
    app = create_app(control_of(store), ServerSettings())
    source = ServedPolicies(f"http://127.0.0.1:{free_port}")
    with pytest.raises(UnavailableError):
        source.versions()
    with served_on(app, free_port):
        versions = source.versions()["ur5"]
        assert {"production", "2", "1"} == set(versions) and versions.index("2") < versions.index("1")
        drive = Drive(source, Choice("ur5", "production"), seed=5)
        drive.start()
        wait_for(lambda: len(drive.history) > 3, "it drives")
        assert drive.view.contract.version == "2" and drive.view.trouble == ""
    try:
        wait_for(lambda: drive.view.trouble.startswith("waiting for the policy"), "it is said")
        cycles = drive.history[-1].number
        drive.do(lambda: drive.begin("own"))  # from now on the alias is to be looked up again
        drive.do(lambda: drive.set_speed(2.0))
        period_s = drive.view.period_s
        wait_for(lambda: drive.view.period_s < period_s, "a view that is twice as fast")
        drive.do(lambda: drive.set_speed(1.0))
        assert drive.history[-1].number <= cycles + 1
        with served_on(app, free_port):
            wait_for(lambda: drive.view.trouble == "" and drive.history[-1].number > cycles + 3, "it drives on")
            drive.do(lambda: drive.choose(Choice("ur5", "1"), ServerLink(deadline_ms=500.0, fallback="hold")))
            wait_for(lambda: drive.view.contract.version == "1", "version 1")
            cycles = drive.history[-1].number
            wait_for(lambda: drive.history[-1].number > cycles + 3, "it drives")
        cycles = drive.history[-1].number
        wait_for(lambda: drive.view.fallbacks > 2, "the last action is held")
        assert drive.history[-1].number > cycles and drive.history[-1].is_late and drive.history[-1].fallback
    finally:
        drive.close()
        source.close()


def test_a_real_arm_taken_over_by_the_button_is_tagged_in_the_recording(
    arm: RunningArm, two_versions: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rtde_control")
    options: dict[str, Any] = {
        "env_id": "rlservo/EndEffectorPositioningURRob-v0",
        "env_arguments": {"robot": f"rtde://{arm.host}", "ur_model": "ur5", "confirm": False, "limits": LIMITS},
    }
    source, choice = BundledPolicies(two_versions), Choice("ur5", "1")
    with pytest.raises(UsageError, match="was never evaluated under latency"):
        Drive(source, choice, **options)
    arm.wait_until(lambda: not arm.controller.is_program_running)
    with Recorder(tmp_path / "run.mcap") as recorder:
        drive = Drive(source, choice, recorder=recorder, unproven=True, **options)
        try:
            drive.start()
            wait_for(lambda: "robot: run" in drive.view.sentence, "the policy drives")
            drive.do(drive.take_over)
            wait_for(lambda: arm.controller.is_free, "a person can lead the arm")
            drive.do(drive.take_over)
            wait_for(lambda: not arm.controller.is_free and "robot: run" in drive.view.sentence, "the policy drives on")
            arm.do(lambda: arm.controller.stop_protectively("a test"))
            wait_for(lambda: drive.view.phase == "paused", "the drive waits for a person")
        finally:
            drive.close()
    driven = [one for episode in episodes(Recording(tmp_path / "run.mcap")) for one in episode.robot]
    assert {one["state"] for one in driven} >= {"run", "human", "fault"}
    assert driven[-1]["state"] == "fault"
