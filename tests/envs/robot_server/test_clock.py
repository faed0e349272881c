"""Real time and fast time: the same trajectory at another pace, and late clients."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rlservo.envs.robot_server.clock import GRACE_S, Clock
from rlservo.envs.robot_server.robot_server_settings import Mir100Settings, URSettings

JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
START = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)
NAMED = {f"{joint}_joint_position": value for joint, value in zip(JOINTS, START, strict=True)}
ROS_START = [1.5, -2.5, 0.0, -1.5, -1.4, 0.0]
WAVE = {
    "object_0_x": 0.1, "object_0_y": 0.9, "object_0_z_amplitude": 0.2, "object_0_z_frequency": 0.5,
    "object_0_z_offset": 0.8,
}  # fmt: skip

Serve = Callable[[Any], Any]


def ur(clock: str) -> URSettings:
    return URSettings(rs_mode="1moving2points", action_cycle_rate=10, clock=clock)


def test_both_clocks_give_the_same_ur_trajectory_and_only_one_takes_its_time(serve: Serve) -> None:
    runs, seconds = {}, {}
    for clock in ("fast", "real"):
        client = serve(ur(clock))
        function = {"object_0_function": "triangle_wave"}
        assert client.set_state(state_dict=NAMED, string_params=function, float_params=WAVE)
        rng = np.random.default_rng(0)
        states = [client.state()]
        began = time.monotonic()
        for _ in range(15):
            states.append(client.step((np.array(ROS_START) + rng.uniform(-1, 1, 6)).tolist()))
        seconds[clock] = time.monotonic() - began
        runs[clock] = states
    assert runs["fast"] == runs["real"]
    assert seconds["real"] > 1.45  # by how much a busy machine is late says nothing; the rate itself is tested below
    assert seconds["fast"] < seconds["real"] / 2


def test_both_clocks_give_the_same_mir100_trajectory(serve: Serve) -> None:
    runs, seconds = {}, {}
    for clock in ("fast", "real"):
        client = serve(Mir100Settings(world="lab_6x8", clock=clock, seed=4))
        assert client.set_state(state=[0.0] * 3 + [0.0, 2.0, 1.0])
        rng = np.random.default_rng(0)
        states = []
        began = time.monotonic()
        for _ in range(10):
            assert client.send(rng.uniform(-0.5, 0.5, 2).tolist())
            states.append(client.state())
        seconds[clock] = time.monotonic() - began
        runs[clock] = states
    assert runs["fast"] == runs["real"]
    assert seconds["real"] > 0.95


def test_setstate_takes_its_cycles_in_real_time(serve: Serve) -> None:
    client = serve(Mir100Settings(clock="real"))
    began = time.monotonic()
    assert client.set_state(state=[0.0] * 6)
    assert 0.15 < time.monotonic() - began < 1.0


def test_in_real_time_a_silent_client_finds_the_arm_stopped_and_the_object_moved_on(serve: Serve) -> None:
    client = serve(ur("real"))
    function = {"object_0_function": "triangle_wave"}
    client.set_state(state_dict=NAMED, string_params=function, float_params=WAVE)
    moving = client.step([1.5, -2.5, 2.0, -1.5, -1.4, 0.0])
    moving = client.step([1.5, -2.5, 2.0, -1.5, -1.4, 0.0])
    assert moving.state_dict["base_joint_velocity"] > 0.5
    time.sleep(GRACE_S + 0.5)
    stopped = client.state().state_dict
    assert abs(stopped["base_joint_velocity"]) < 1e-3
    assert 0.0 < stopped["base_joint_position"] < 1.5
    assert stopped["object_0_to_ref_translation_z"] != moving.state_dict["object_0_to_ref_translation_z"]
    time.sleep(0.2)  # within the grace: nothing moves while it is waited for
    assert client.state().state_dict == stopped


def test_in_fast_time_nothing_happens_between_calls(serve: Serve) -> None:
    client = serve(ur("fast"))
    client.set_state(state_dict=NAMED)
    client.step([1.5, -2.5, 2.0, -1.5, -1.4, 0.0])
    before = client.state()
    time.sleep(GRACE_S + 0.3)
    assert client.state() == before


class Wall:
    """Takes the place of the module `time`: only sleeping takes time."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_client_that_thinks_within_the_cycle_keeps_the_rate_and_late_one_is_not_punished(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = Wall()
    monkeypatch.setattr("rlservo.envs.robot_server.clock.time", wall)
    clock = Clock("real", 0.05)
    Clock.wait(clock.count_cycles(1))
    began = wall.monotonic()
    for _ in range(10):
        wall.sleep(0.03)
        Clock.wait(clock.count_cycles(1))
    assert wall.monotonic() - began == pytest.approx(0.5)
    wall.sleep(0.2)  # late: the next cycle is a whole one, not what is left of a schedule
    began = wall.monotonic()
    assert clock.count_missed_cycles() == 0
    Clock.wait(clock.count_cycles(1))
    assert wall.monotonic() - began == pytest.approx(0.05)


def test_long_silence_is_simulated_for_a_minute_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = Wall()
    monkeypatch.setattr("rlservo.envs.robot_server.clock.time", wall)
    clock = Clock("real", 0.1)
    assert clock.count_missed_cycles() == 0  # nothing has begun
    clock.count_cycles(1)
    for silence_s, cycles in ((3.05, 29), (3600.0, 600)):  # a cycle of 0.1 s had begun
        wall.sleep(silence_s)
        assert clock.count_missed_cycles() == cycles
        assert clock.count_missed_cycles() == 0  # counted once
