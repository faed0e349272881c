"""robo-gym's own environments, from PyPI, against our servers: whole episodes, and the same as in our environments."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.robot_server.manager import ServerManager
from rlservo.envs.robot_server.robot_server_settings import Mir100Settings, URSettings
from rlservo.robots.ur.parameters import UR_PARAMETERS
from rlservo.robots.ur.simulation import URSimulation

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:.*A Box observation space maximum and minimum values are equal"),
]

DRIVER = Path(__file__).with_name("robo_gym_driver.py")
POSITIONING, EMPTY, AVOIDANCE = "EndEffectorPositioningUR", "EmptyEnvironmentUR", "BasicAvoidanceUR"
ATOL = 2e-4  # of observations: robo-gym computes them from float32 states

Drive = Callable[..., list[dict[str, Any]]]


@pytest.fixture(scope="module")
def driver(robo_gym_python: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Path]]:
    """The driver in robo-gym's environment, whose imports take longer than most tests, and the file of its errors."""
    errors = tmp_path_factory.mktemp("driver") / "errors.txt"
    with errors.open("w") as stream:
        process = subprocess.Popen(
            [robo_gym_python, DRIVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True
        )
    try:
        yield process, errors
        process.communicate(timeout=60)  # the end of its input is its own
        assert process.returncode == 0, errors.read_text()
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def drive(driver: tuple[Any, Path], tmp_path: Path) -> Drive:
    """Run jobs in robo-gym's environment and return their results; `at_pause` is called where a job pauses.

    Jobs that follow each other with the same arguments are episodes of one simulator, which takes a second to start.
    """
    process, errors = driver

    def run(jobs: list[dict[str, Any]], at_pause: Callable[[], None] | None = None) -> list[dict[str, Any]]:
        asked, answered = tmp_path / "jobs.json", tmp_path / "results.json"
        made_with = [(job["env"], job["arguments"]) for job in jobs]
        keeps = [made == following for made, following in zip(made_with, [*made_with[1:], None], strict=True)]
        asked.write_text(json.dumps([{**job, "keep": keep} for job, keep in zip(jobs, keeps, strict=True)]))
        print(asked, answered, sep="\t", file=process.stdin, flush=True)
        while (said := process.stdout.readline()).strip() != "done":
            assert said, errors.read_text()  # it has ended
            if said.strip() == "paused":
                assert at_pause is not None
                at_pause()
                print(file=process.stdin, flush=True)
        results = json.loads(answered.read_text())
        for job, result in zip(jobs, results, strict=True):
            assert "error" not in result, f"{job['env']}: {result['error']}\n{errors.read_text()}"
        return results

    return run


def sim_arguments(manager: ServerManager, **more: Any) -> dict[str, Any]:
    return {"ip": "127.0.0.1", "lower_bound_port": manager.port, "upper_bound_port": manager.port + 1, **more}


def wandering(count: int, size: int, seed: int, scale: float = 0.4, hold: int = 15) -> list[list[float]]:
    """Actions that stay for a while and then change."""
    rng = np.random.default_rng(seed)
    targets = rng.uniform(-scale, scale, (count // hold + 1, size))
    return np.float32(np.repeat(targets, hold, axis=0)[:count]).tolist()


def assert_same(
    native: gym.Env, actions: list[list[float]], theirs: dict[str, Any], first: Any, reward_atol: float = 1e-5
) -> None:
    """Step our environment with the same actions; everything must be as robo-gym's class reported it."""
    assert theirs["observations"][0] == pytest.approx(first, abs=ATOL)
    status = None
    for index, action in enumerate(actions[: len(theirs["rewards"])]):
        observation, reward, terminated, truncated, info = native.step(np.array(action, dtype=np.float32))
        assert angles_unwrapped(theirs["observations"][index + 1], observation) == pytest.approx(observation, abs=ATOL)
        assert theirs["rewards"][index] == pytest.approx(float(reward), abs=reward_atol)
        assert (terminated or truncated) == (index == len(theirs["rewards"]) - 1 and theirs["status"] is not None)
        status = info.get("final_status")
    assert status == theirs["status"]


def angles_unwrapped(given: list[float], reference: np.ndarray) -> list[float]:
    """Undo a jump of 2 pi between two values of one angle: +pi and -pi are the same direction."""
    return [
        value - 2 * np.pi * np.sign(value - other) if abs(abs(value - other) - 2 * np.pi) < 0.01 else value
        for value, other in zip(given, reference.tolist(), strict=True)
    ]


@pytest.mark.parametrize("ur_model", ["ur3", "ur3e", "ur5", "ur5e", "ur10", "ur10e", "ur16e"])
def test_positioning_episodes_are_ours_for_every_arm(drive: Drive, manager: ServerManager, ur_model: str) -> None:
    rng = np.random.default_rng(7)
    native = gym.make(f"rlservo/{POSITIONING}Sim-v0", ur_model=ur_model, rs_state_to_info=False).unwrapped
    radius = UR_PARAMETERS[ur_model].workspace_radius
    episodes = []
    # A target on the way of the actions (it is reached), one far off (it is not), and one with a dive into the table.
    for kind in ("reached", "far", "table"):
        start = [0.0, -2.2, 1.4, -1.5, -1.4, 0.0]
        actions = wandering(300, 5, int(rng.integers(1000)))
        if kind == "reached":
            actions = [[0.15, -0.3, 0.35, 0.1, -0.2]] * 300
        if kind == "table":
            actions = [[0.0, 0.08, 0.0, 0.0, 0.0]] * 300
        native.reset(options={"joint_positions": start, "ee_target_pose": [0, 0, 5.0, 0, 0, 0]})
        for action in actions[:60]:
            native.step(np.array(action, dtype=np.float32))
        target = native.simulation.tool_position if kind == "reached" else np.array([0.0, -radius, 3.0])
        pose = [*np.float32(target).tolist(), 0.0, 0.0, 0.0]
        episodes.append(({"joint_positions": start, "ee_target_pose": pose}, actions))
    jobs = [
        {
            "env": f"{POSITIONING}Sim-v0",
            "arguments": sim_arguments(manager, ur_model=ur_model),
            "reset": {"options": options},
            "actions": actions,
        }
        for options, actions in episodes
    ]
    results = drive(jobs)
    for (options, actions), theirs in zip(episodes, results, strict=True):
        first, _ = native.reset(options=options)
        assert_same(native, actions, theirs, first)
    assert results[0]["status"] == "success"
    assert results[2]["status"] == "collision"
    assert len(results[1]["rewards"]) > 100
    assert manager.servers.running == {}  # robo-gym ended what it started


def test_positioning_works_with_random_starts_and_targets_of_its_own(drive: Drive, manager: ServerManager) -> None:
    results = drive(
        [
            {
                "env": f"{POSITIONING}Sim-v0",
                "arguments": sim_arguments(manager, ur_model="ur5e", fix_wrist_3=False),
                "reset": {"options": {"randomize_start": True}},
                "actions": wandering(300, 6, seed),
            }
            for seed in range(3)
        ]
    )
    for result in results:
        assert result["status"] in {"success", "collision", "max_steps_exceeded"}


def test_empty_environment_is_ours(drive: Drive, manager: ServerManager) -> None:
    native = gym.make(f"rlservo/{EMPTY}Sim-v0").unwrapped
    start = [0.1, -2.0, 1.2, -1.0, -1.2, 0.3]
    about_start = np.array(start[:5]) / np.array([2, 2, 1, 2, 2]) / np.pi + wandering(300, 5, 3, scale=0.08)
    episodes = [(np.float32(about_start).tolist(), start), ([[0.0, 0.06, 0.0, 0.0, 0.0]] * 300, None)]
    results = drive(
        [
            {
                "env": f"{EMPTY}Sim-v0",
                "arguments": sim_arguments(manager),
                "reset": {"options": {"joint_positions": joints} if joints else {}},
                "actions": actions,
            }
            for actions, joints in episodes
        ]
    )
    for (actions, joints), theirs in zip(episodes, results, strict=True):
        first, _ = native.reset(options={"joint_positions": joints} if joints else {})
        assert_same(native, actions, theirs, first)
    assert [result["status"] for result in results] == ["success", "collision"]


@pytest.mark.parametrize("ur_model", ["ur5", "ur10"])
def test_basic_avoidance_is_ours(drive: Drive, manager: ServerManager, ur_model: str) -> None:
    arguments = {"ur_model": ur_model, "include_polar_to_elbow": True}
    native = gym.make(f"rlservo/{AVOIDANCE}Sim-v0", **arguments).unwrapped
    calm, wild = wandering(1000, 5, 1, scale=0.05), wandering(1000, 5, 2, scale=1.0, hold=30)
    results = drive(
        [
            {
                "env": f"{AVOIDANCE}Sim-v0",
                "arguments": sim_arguments(manager, **arguments),
                "reset": reset,
                "actions": actions,
            }
            for actions, reset in (
                (calm, {"fixed_object_position": [0.1, 0.9, 1.0]}),
                (calm, {}),
                (wild, {}),
            )
        ]
    )
    for theirs, actions in zip(results, (calm, calm, wild), strict=True):
        params = theirs["params"][0]
        if "object_0_z_amplitude" in params:
            options = {name: params[f"object_0_{name}"] for name in ("z_amplitude", "z_offset")}
        else:
            options = {"fixed_object_position": [params[f"object_0_{axis}"] for axis in "xyz"]}
        try:
            first, _ = native.reset(options=options)
        except ValueError:  # the ball drawn by robo-gym is in the arm from the start: it ends with the first step
            assert theirs["status"] == "collision"
            assert len(theirs["rewards"]) == 1
            continue
        assert_same(native, actions, theirs, first)
    assert results[0]["status"] == "success"
    assert len(results[0]["rewards"]) == 1000


def test_avoidance_raad_2022_follows_its_trajectory_as_the_core_does(drive: Drive, manager: ServerManager) -> None:
    actions = [[0.0] * 5] * 1000
    results = drive(
        [
            {
                "env": "AvoidanceRaad2022URSim-v0",
                "arguments": sim_arguments(manager),
                "reset": reset,
                "actions": actions,
            }
            for reset in ({"options": {"fixed_object_position": [0.0, 1.5, 1.5]}}, {}, {})
        ]
    )
    undisturbed = results[0]
    assert undisturbed["status"] == "success"
    assert len(undisturbed["rewards"]) == 1000
    observations = np.array(undisturbed["observations"])
    assert observations.shape == (1001, 25)
    limits = np.array([2, 2, 1, 2, 2, 2]) * np.pi
    core = URSimulation("ur5", max_velocity_scale=0.2, cycle_s=0.05, objects=())
    core.place(observations[0, 3:9] * limits)
    for row, (elbow, shoulder, base, *wrists) in zip(observations[1:], undisturbed["sent"], strict=True):
        core.command([base, shoulder, elbow, *wrists])
        core.advance()
        assert row[3:9] * limits == pytest.approx(core.joint_positions, abs=1e-4)
    # The object is all that differs. robo-gym takes 0.002 for each step in which it is within 0.45 m of tool or elbow.
    for result in results[1:]:
        assert result["status"] in {"success", "collision"}
        steps = len(result["rewards"]) - (result["status"] == "collision")  # whose reward is another
        nearest = np.array(result["observations"])[1 : steps + 1, [0, 15]].min(axis=1)
        assert np.ptp(nearest) > 0.2 or steps < 50  # the object goes about
        charged = np.array(undisturbed["rewards"][:steps]) - np.array(result["rewards"][:steps])
        clear = np.abs(nearest - 0.45) > 1e-3  # of the limit itself
        assert charged[clear] == pytest.approx(np.where(nearest < 0.45, 0.002, 0.0)[clear], abs=1e-6)


def test_mir100_without_obstacles_is_ours(drive: Drive, manager: ServerManager) -> None:
    env = "NoObstacleNavigationMir100"
    native = gym.make(f"rlservo/{env}Sim-v0").unwrapped
    ahead = [[1.0, 0.0]] * 500
    episodes = [
        ({"start_pose": [-1.5, 0.5, 0.0], "target_pose": [0.8, 0.5, 0.0]}, ahead),  # straight there
        ({"start_pose": [-1.5, 0.5, 3.0], "target_pose": [0.8, 0.5, 0.0]}, ahead),  # and straight out of bounds
        ({"start_pose": [1.0, -0.5, 2.0], "target_pose": [0.5, 0.75, 0.0]}, wandering(500, 2, 5, scale=1.0)),
    ]
    results = drive(
        [
            {"env": f"{env}Sim-v0", "arguments": sim_arguments(manager), "reset": {"options": o}, "actions": actions}
            for o, actions in episodes
        ]
    )
    for (options, actions), theirs in zip(episodes, results, strict=True):
        first, _ = native.reset(options=options)
        assert_same(native, actions, theirs, first, reward_atol=2e-3)
    assert [result["status"] for result in results][:2] == ["success", "out of boundary"]


def test_mir100_among_obstacles_is_ours(drive: Drive, manager: ServerManager) -> None:
    env = "ObstacleAvoidanceMir100"
    native = gym.make(f"rlservo/{env}Sim-v0").unwrapped
    up = [0.0, -2.6, np.pi / 2]
    episodes = [
        ({"start_pose": up, "target_pose": [0.0, 2.6, 0.0]}, [[1.0, 0.0]] * 500),  # into the cube in the middle
        ({"start_pose": [-1.9, 2.6, 0.0], "target_pose": [1.5, 2.6, 0.0]}, [[1.0, 0.0]] * 500),  # along the wall
        ({"start_pose": [-1.5, 2.6, 0.2], "target_pose": [1.5, -2.6, 0.0]}, [[0.1, 0.3]] * 60),
    ]
    results = drive(
        [
            {"env": f"{env}Sim-v0", "arguments": sim_arguments(manager), "reset": o, "actions": actions, "seed": 11}
            for o, actions in episodes
        ]
    )
    for (options, actions), theirs in zip(episodes, results, strict=True):
        native.reset(options={**options, "cubes": theirs["obstacles"]})
        lasers = 0.09  # six standard deviations of the difference of two noisy readings
        for index, action in enumerate(actions[: len(theirs["rewards"])]):
            observation, reward, terminated, truncated, info = native.step(np.array(action, dtype=np.float32))
            row = theirs["observations"][index + 1]
            assert row[:4] == pytest.approx(observation[:4], abs=ATOL)
            assert row[4:] == pytest.approx(observation[4:], abs=lasers)
            assert theirs["rewards"][index] == pytest.approx(float(reward), abs=2e-3)
            ended = index == len(theirs["rewards"]) - 1 and theirs["status"] is not None
            assert (terminated or truncated) == ended
            assert info.get("final_status") == (theirs["status"] if ended else None)
    assert [result["status"] for result in results] == ["collision", "success", None]


def test_real_robot_classes_connect_by_address(drive: Drive, serve: Callable[[Any], Any]) -> None:
    """The Rob environments are what talks to the real server: the same protocol, an address instead of a manager."""
    arm = serve(URSettings(rs_mode="1object", action_cycle_rate=10, max_velocity_scale_factor=0.1))
    base = serve(Mir100Settings())
    start, target = [0.0, -2.2, 1.4, -1.5, -1.4, 0.0], [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]
    actions = wandering(80, 5, 0)
    results = drive(
        [
            {
                "env": f"{POSITIONING}Rob-v0",
                "arguments": {"rs_address": f"127.0.0.1:{arm.port}", "ur_model": "ur5"},
                "reset": {"options": {"joint_positions": start, "ee_target_pose": target}},
                "actions": actions,
            },
            {
                "env": "NoObstacleNavigationMir100Rob-v0",
                "arguments": {"rs_address": f"127.0.0.1:{base.port}"},
                "reset": {"options": {"target_pose": [2.0, 0.0, 0.0]}},
                "actions": [[1.0, 0.0]] * 100,
            },
        ]
    )
    native = gym.make(f"rlservo/{POSITIONING}Sim-v0").unwrapped
    first, _ = native.reset(options={"joint_positions": start, "ee_target_pose": target})
    assert_same(native, actions, results[0], first)
    assert results[1]["status"] == "success"


def test_kill_9_of_a_robot_server_mid_episode_is_survived(drive: Drive, manager: ServerManager) -> None:
    def kill_the_server() -> None:
        (pid,) = manager.servers.running.values()
        os.kill(pid, signal.SIGKILL)

    job = {"env": f"{POSITIONING}Sim-v0", "arguments": sim_arguments(manager), "crash": True}
    (result,) = drive([job], kill_the_server)
    assert result == {"exception": "_InactiveRpcError", "done": True, "goes_on": True}
    assert manager.servers.running == {}
