"""The cockpit on a robot server that another client drives: it shows, and changes nothing."""

from __future__ import annotations

from typing import Any

import grpc
import numpy as np
import pytest

pytest.importorskip("viser", reason="the cockpit draws with viser")

from cockpits import cockpit_of
from rlservo.deploy.cockpit.watch import WatchPanel
from rlservo.envs.robot_server.robo_gym_messages import ROBOT_SERVER, Action, State
from rlservo.envs.robot_server.robot_server import RobotServer
from rlservo.envs.robot_server.robot_server_settings import Mir100Settings, Settings, URSettings
from rlservo.envs.robot_server.state_reader import RobotServerError, StateReader, env_of, show_state
from rlservo.errors import UnavailableError
from waiting import wait_for

UR = URSettings(port=0, rs_mode="1object", action_cycle_rate=10.0, seed=1)
MIR100 = Mir100Settings(port=0, world="lab_6x8", seed=1)


def drive(port: int, actions: list[list[float]]) -> list[float]:
    """Send actions as robo-gym's environment does; return the last state."""
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = channel.unary_unary(f"/{ROBOT_SERVER}/SendActionGetState")
        for action in actions:
            state = State.FromString(call(Action(action=action).SerializeToString(), timeout=60))
            assert state.success
    return list(state.state)


def actions_of(settings: Settings) -> list[list[float]]:
    if isinstance(settings, URSettings):  # in ROS order: elbow, shoulder, base, wrists
        return [[1.5 - 0.02 * n, -2.5 + 0.03 * n, 0.05 * n, -1.5, -1.4, 0.0] for n in range(40)]
    return [[0.4, 0.2] for _ in range(40)]


@pytest.mark.parametrize("settings", [UR, MIR100], ids=["ur5", "mir100"])
def test_it_shows_what_the_simulation_does_and_does_not_disturb_it(settings: Settings) -> None:
    alone = RobotServer(settings)
    expected = drive(alone.port, actions_of(settings))
    alone.stop()
    server = RobotServer(settings)
    try:
        with cockpit_of(lambda page: WatchPanel(page, f"127.0.0.1:{server.port}", {})) as cockpit:
            first = cockpit.panel.scene.robot
            watched = drive(server.port, actions_of(settings))
            robot = server.robot.simulation
            wait_for(lambda: np.linalg.norm(cockpit.panel.scene.robot - first) > 0.1, "the robot is shown elsewhere")
            at = robot.tool_position if isinstance(settings, URSettings) else np.array([*robot.pose[:2], 0.0])  # type: ignore[union-attr]
            offset = (0.0, 0.0, 0.1) if isinstance(settings, URSettings) else (0.0, 0.0, 0.0)
            wait_for(lambda: np.allclose(cockpit.panel.scene.robot, at + offset, atol=1e-4), "it is where it is")
            assert cockpit.panel.trouble == ""
            assert len(cockpit.panel.scene.beams) == (0 if isinstance(settings, URSettings) else 1012)
    finally:
        server.stop()
    assert watched == expected  # bit for bit


def test_a_robot_server_that_ends_is_said_and_another_one_in_its_place_is_shown() -> None:
    server = RobotServer(UR)
    with cockpit_of(lambda page: WatchPanel(page, f"127.0.0.1:{server.port}", {})) as cockpit:
        server.stop()
        wait_for(lambda: "no robot server answers" in cockpit.panel.trouble, "it is said")
        again = RobotServer(URSettings(port=server.port, rs_mode="1object", action_cycle_rate=10.0))
        try:
            wait_for(lambda: cockpit.panel.trouble == "", "it is back")
        finally:
            again.stop()


def test_where_none_is_it_says_so_at_once() -> None:
    with (
        pytest.raises(UnavailableError, match=r"no robot server answers at 127\.0\.0\.1:1"),
        cockpit_of(lambda page: WatchPanel(page, "127.0.0.1:1", {})),
    ):
        pass


def test_a_state_of_another_robot_is_refused() -> None:
    arm, vehicle = RobotServer(UR), RobotServer(MIR100)
    readers = [StateReader(f"127.0.0.1:{server.port}") for server in (arm, vehicle)]
    try:
        states: list[Any] = [reader.read(60) for reader in readers]
        assert [env_of(state) for state in states] == [
            "rlservo/EndEffectorPositioningURSim-v0",
            "rlservo/ObstacleAvoidanceMir100Sim-v0",
        ]
        from rlservo.deploy.cockpit.stage import Stage

        stage = Stage(env_of(states[0]), {})
        with pytest.raises(RobotServerError, match="another robot"):
            show_state(stage.env, states[1])
        stage.close()
    finally:
        for part in readers:
            part.close()
        for server in (arm, vehicle):
            server.stop()
