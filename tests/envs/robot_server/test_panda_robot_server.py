"""The Panda's robot server on the wire, against robo-gym's contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rlservo.envs.panda.end_effector_positioning import EndEffectorPositioningPandaSim
from rlservo.envs.robot_server.robot_server_settings import PandaSettings
from rlservo.envs.robot_server.robots.robot import RobotState
from rlservo.envs.robot_server.state_reader import env_of, quantities, show_state

START = [-0.018, -0.76, 0.02, -2.342, 0.03, 1.541, 0.753]
NAMES = [f"joint{number}" for number in range(1, 8)]

Serve = Callable[[Any], Any]


def named(joints: Any = START) -> dict[str, float]:
    return {f"{name}_position": value for name, value in zip(NAMES, joints, strict=True)}


def read(state: Any, quantity: str) -> np.ndarray:
    return np.array([state.state_dict[f"{name}_{quantity}"] for name in NAMES])


def pose_keys(frame: str) -> list[str]:
    return [f"{frame}_to_ref_translation_{a}" for a in "xyz"] + [f"{frame}_to_ref_rotation_{a}" for a in "xyzw"]


@pytest.mark.parametrize("mode", ["only_robot", "1object"])
def test_state_has_exactly_the_modes_names_and_the_list_in_its_order(serve: Serve, mode: str) -> None:
    client = serve(PandaSettings(rs_mode=mode, action_cycle_rate=30, max_velocity_scale_factor=0.2))
    where = {f"object_0_{axis}": 0.3 + 0.1 * n for n, axis in enumerate("xyz")}
    assert client.set_state(
        state_dict=named(), string_params={"object_0_function": "fixed_position"}, float_params=where
    )
    state = client.step([value + 0.05 for value in START])
    objects = pose_keys("object_0") if mode == "1object" else []
    order = [
        *objects, *(f"{name}_{kind}" for kind in ("position", "velocity", "effort") for name in NAMES),
        *pose_keys("ee"), "in_collision",
    ]  # fmt: skip
    assert list(state.state) == [state.state_dict[name] for name in order]
    assert set(state.state_dict) == set(order)
    if objects:
        assert [state.state_dict[key] for key in objects] == pytest.approx([*where.values(), 0, 0, 0, 1])
    assert (read(state, "velocity") > 0).all() and np.abs(read(state, "effort")).max() > 1.0


def test_positions_arrive_and_offsets_add_up(serve: Serve) -> None:
    absolute, offset = (
        serve(PandaSettings(action_mode=mode, action_cycle_rate=30)) for mode in ("abs_pos", "delta_pos")
    )
    goal = np.array(START) + 0.1
    for client in (absolute, offset):
        assert client.set_state(state_dict=named())
    for _ in range(60):
        arrived = read(absolute.step(goal.tolist()), "position")
    assert arrived == pytest.approx(goal, abs=2e-3)
    moved = read(offset.step([0.1] * 7), "position") - START
    assert (moved > 0.001).all() and (moved < 0.1).all()


def test_velocities_are_kept_within_the_scaled_limits(serve: Serve) -> None:
    client = serve(PandaSettings(action_mode="abs_vel", action_cycle_rate=30, max_velocity_scale_factor=0.1))
    assert client.set_state(state_dict=named())
    for _ in range(15):
        state = client.step([0.1, 9.0, -9.0, 0.0, 0.05, 0.0, 9.0])
    limit = 0.1 * 2.175
    assert read(state, "velocity") == pytest.approx([0.1, limit, -limit, 0.0, 0.05, 0.0, 0.261], abs=0.01)
    adding = serve(PandaSettings(action_mode="delta_vel", action_cycle_rate=30, max_velocity_scale_factor=0.1))
    assert adding.set_state(state_dict=named())
    for _ in range(10):
        state = adding.step([0.02] + [0.0] * 6)
    assert 0.05 < read(state, "velocity")[0] <= limit * 1.05


def test_a_viewer_shows_the_arm_where_a_state_has_it(serve: Serve) -> None:
    client = serve(PandaSettings(rs_mode="1object", action_cycle_rate=30))
    where = {"object_0_x": 0.4, "object_0_y": 0.1, "object_0_z": 0.3}
    assert client.set_state(
        state_dict=named(), string_params={"object_0_function": "fixed_position"}, float_params=where
    )
    message = client.state()
    state = RobotState(list(message.state), dict(message.state_dict))
    assert env_of(state) == "rlservo/EndEffectorPositioningPandaSim-v0"
    env = EndEffectorPositioningPandaSim()
    show_state(env, state)
    assert env.simulation.joint_positions == pytest.approx(START, abs=1e-5)
    assert env.target_position() == pytest.approx([0.4, 0.1, 0.3], abs=1e-6)
    assert quantities(state)["joint1_effort"][1] == "Nm" and quantities(state)["joint2_velocity"][1] == "rad/s"


def test_what_cannot_be_honoured_is_answered_with_success_false(serve: Serve, caplog: pytest.LogCaptureFixture) -> None:
    client = serve(PandaSettings())
    assert not client.set_state(state_dict=named([0.0, 0.0, 0.0, 0.5, 0.0, 1.0, 0.0]))
    assert "panda_joint4 is 0.5 rad: expected within -3.0718 .. -0.0698 rad" in caplog.text
    assert not client.set_state(state=[0.0] * 5)
    assert "the state has 5 elements: expected 29, those of rs_mode 'only_robot'" in caplog.text
    assert not client.step([0.0] * 6).success
    assert "the action has 6 elements, expected 7: panda_joint1" in caplog.text
    with pytest.raises(ValueError, match="rs_mode '1moving2points' does not exist: expected one of only_robot, 1obj"):
        PandaSettings(rs_mode="1moving2points")
