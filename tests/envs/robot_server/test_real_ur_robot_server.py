"""robo-gym's protocol in front of a real arm, which is a simulated controller here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from arms import RunningArm
from rlservo.envs.robot_server.robot_server_settings import URSettings

pytest.importorskip("rtde_control")

JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
START = (0.0, -2.4, 1.5, -1.5, -1.4, 0.0)


def test_client_sets_the_state_of_a_real_arm_and_drives_it_until_it_stops(
    arm: RunningArm, serve: Callable[..., Any]
) -> None:
    client = serve(
        URSettings(
            ur_model="ur5", robot=f"rtde://{arm.host}", confirm=False, rs_mode="1object", action_cycle_rate=10.0,
            max_velocity_scale_factor=0.1, limits={"watchdog_hz": 1.0, "blend_s": 0.1},
        )
    )  # fmt: skip
    assert client.set_state(
        state_dict={f"{joint}_joint_position": value for joint, value in zip(JOINTS, START, strict=True)},
        float_params={"object_0_x": 0.3, "object_0_y": 0.3, "object_0_z": 0.4},
        string_params={"object_0_function": "fixed_position"},
    )
    goal = (1.5, -2.4, 0.1, -1.5, -1.4, 0.0)  # elbow, shoulder, base, wrists
    for _ in range(15):
        state = client.step(list(goal))
        assert state.success
    assert state.state_dict["base_joint_position"] > 0.05
    assert state.state_dict["object_0_to_ref_translation_z"] == pytest.approx(0.4)
    assert arm.controller.simulation.joint_positions[0] > 0.05

    arm.do(lambda: arm.controller.stop_protectively("a test"))
    arm.wait_until(lambda: not client.step(list(goal)).success)
    assert not client.set_state(state_dict={f"{joint}_joint_position": 0.1 for joint in JOINTS})
