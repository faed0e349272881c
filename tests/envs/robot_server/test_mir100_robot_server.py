"""The MiR100's robot server on the wire, against robo-gym's contract."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rlservo.envs.robot_server.robot_server_settings import Mir100Settings
from rlservo.robots.mir100.simulation import Mir100Simulation

CUBES = [-2.0, 0.5, 0.3, 0.1, -0.2, 0.0, 2.0, 0.4, -1.0]

Serve = Callable[[Any], Any]


def state_with(robot: list[float], target: list[float] | None = None, cubes: list[float] | None = None) -> list[float]:
    state = np.zeros(1030)
    state[0:3] = target or [1.0, 2.0, 0.5]
    state[3:6] = robot
    state[1021:1030] = cubes or [0.0] * 9
    return state.tolist()


def test_state_has_everything_in_its_place(serve: Serve) -> None:
    client = serve(Mir100Settings(world="lab_6x8.world"))
    assert client.set_state(state=state_with([0.5, -2.5, 0.7], cubes=CUBES))
    state = client.state()
    values = np.array(state.state)
    assert state.success
    assert len(values) == 3 + 3 + 2 + 501 + 511 + 1 + 9
    assert values[0:3] == pytest.approx([1.0, 2.0, 0.5])
    assert values[3:6] == pytest.approx([0.5, -2.5, 0.7])
    assert values[6:8] == pytest.approx([0.0, 0.0])
    assert values[1020] == 0.0
    assert values[1021:1030] == pytest.approx(CUBES)
    exact = Mir100Simulation("lab_6x8", laser_noise=0.0)
    exact.place([0.5, -2.5, 0.7], cubes=np.reshape(CUBES, (3, 3)))
    noise = values[8:1020] - exact.scan
    assert np.abs(noise).max() < 0.06
    assert noise.std() == pytest.approx(0.01, rel=0.15)


def test_trajectory_is_the_simulation_cores(serve: Serve) -> None:
    client = serve(Mir100Settings())
    sim = Mir100Simulation("empty")
    client.set_state(state=state_with([0.2, -0.4, 2.0]))
    sim.place([0.2, -0.4, 2.0])
    rng = np.random.default_rng(0)
    for _ in range(60):
        linear, angular = np.float32(rng.uniform(-1, 1, 2) * [0.5, 0.7]).astype(float)
        assert client.send([linear, angular])
        sim.command(linear, angular)
        sim.advance()
        values = client.state().state
        assert list(values[3:6]) == pytest.approx(sim.pose, abs=1e-5)
        assert list(values[6:8]) == pytest.approx(sim.velocity, abs=1e-5)


def test_collision_is_told_and_over_once_the_robot_is_free(serve: Serve) -> None:
    client = serve(Mir100Settings(world="lab_6x8"))
    client.set_state(state=state_with([0.0, 3.0, math.pi / 2], cubes=CUBES))
    assert client.state().state[1020] == 0.0
    for _ in range(20):
        assert client.send([0.5, 0.0])
    assert client.state().state[1020] == 1.0
    for _ in range(5):
        assert client.send([-0.5, 0.0])
    assert client.state().state[1020] == 0.0  # the flag is of the last cycle: the original's does not latch either
    client.set_state(state=state_with([0.0, 3.5, math.pi / 2], cubes=CUBES))
    values = client.state().state
    assert list(values[3:6]) == pytest.approx([0.0, 3.5, math.pi / 2])
    assert values[1020] == 1.0


def test_robot_refuses_to_move_while_a_beam_reads_too_near(serve: Serve) -> None:
    client = serve(Mir100Settings(world="lab_6x8"))
    turned = {}
    for name, gap in (("blocked", 0.03), ("free", 0.5)):
        cube = [0.4288 + gap + 0.25, 2.2358, 0.0]  # its face at `gap` from the front scanner
        client.set_state(state=state_with([0.0, 2.0, 0.0], cubes=cube + CUBES[3:]))
        assert client.send([0.0, 0.7])  # answered with success either way, as the original does
        turned[name] = client.state().state[5]
    assert turned["free"] > 0.01
    assert abs(turned["blocked"]) < 0.001


def test_short_state_leaves_the_cubes_and_empty_world_has_none(serve: Serve) -> None:
    client = serve(Mir100Settings(world="lab_6x8"))
    client.set_state(state=state_with([0.0, 2.0, 0.0], cubes=CUBES))
    assert client.set_state(state=[0.0, 0.0, 0.0, 1.0, 2.0, 0.0])
    values = client.state().state
    assert list(values[3:6]) == pytest.approx([1.0, 2.0, 0.0])
    assert list(values[1021:]) == pytest.approx(CUBES)
    bare = serve(Mir100Settings())
    assert bare.set_state(state=state_with([0.0, 2.0, 0.0], cubes=CUBES))
    assert list(bare.state().state[1021:]) == [0.0] * 9
    assert list(bare.state().state[8:1020]) == pytest.approx([29.0] * 1012)


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        ([], "the state has 0 elements: expected 1030, or 6 to 1021"),
        ([0.0] * 1025, "the state has 1025 elements"),
        ([0.0] * 3 + [math.nan] * 3, "the pose of the robot is .*nan"),
        ([math.inf] * 3 + [0.0] * 3, "the pose of the target is .*inf"),
    ],
)
def test_impossible_setstate_is_answered_with_false_and_changes_nothing(
    serve: Serve, caplog: pytest.LogCaptureFixture, state: list[float], reason: str
) -> None:
    client = serve(Mir100Settings())
    client.set_state(state=state_with([1.0, 1.0, 1.0]))
    before = client.state()
    assert not client.set_state(state=state)
    assert client.state() == before
    assert re.search(reason, caplog.text)


@pytest.mark.parametrize("action", [[], [0.1], [0.1, 0.1, 0.1], [math.nan, 0.0], [0.0, math.inf]])
def test_impossible_action_is_answered_with_false(serve: Serve, action: list[float]) -> None:
    client = serve(Mir100Settings())
    client.set_state(state=state_with([1.0, 1.0, 1.0]))
    before = client.state()
    assert not client.send(action)
    assert not client.step(action).success
    assert client.state() == before


def test_seeded_laser_noise_repeats(serve: Serve) -> None:
    scans = []
    for seed in (1, 1, 2):
        client = serve(Mir100Settings(world="lab_6x8", seed=seed))
        client.set_state(state=state_with([0.0, 2.0, 0.0], cubes=CUBES))
        scans.append(list(client.state().state[8:1020]))
    assert scans[0] == scans[1]
    assert scans[0] != scans[2]
