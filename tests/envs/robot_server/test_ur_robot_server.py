"""The arm's robot server on the wire, against robo-gym's contract."""

from __future__ import annotations

import math
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import grpc
import numpy as np
import pytest

from rlservo.envs.robot_server.robot_server_settings import URSettings
from rlservo.robots.ur.parameters import UR_PARAMETERS
from rlservo.robots.ur.simulation import URSimulation

JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
START = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)
FIXED = {"object_0_function": "fixed_position"}
AWAY = {"object_0_x": 0.1, "object_0_y": 0.9, "object_0_z": 0.8}

Serve = Callable[[Any], Any]


def named(joints: tuple[float, ...] = START) -> dict[str, float]:
    return {f"{joint}_joint_position": value for joint, value in zip(JOINTS, joints, strict=True)}


def ros(joints: Any) -> list[float]:
    base, shoulder, elbow, *wrists = (float(value) for value in joints)
    return [elbow, shoulder, base, *wrists]


def positions(state: Any) -> np.ndarray:
    return np.array([state.state_dict[f"{joint}_joint_position"] for joint in JOINTS])


def pose_keys(frame: str) -> list[str]:
    return [f"{frame}_to_ref_translation_{a}" for a in "xyz"] + [f"{frame}_to_ref_rotation_{a}" for a in "xyzw"]


MODES = {
    "only_robot": (["ee"], 20),
    "1object": (["object_0", "ee"], 27),
    "1moving2points": (["object_0", "ee", "forearm"], 34),
    "2objects2points": (["object_0", "object_1", "ee", "forearm"], 41),
}


@pytest.mark.parametrize("mode", list(MODES))
def test_state_has_exactly_the_modes_names_and_the_list_in_its_order(serve: Serve, mode: str) -> None:
    frames, length = MODES[mode]
    client = serve(URSettings(rs_mode=mode, action_cycle_rate=10))
    objects = {"object_0_function": "fixed_position", "object_1_function": "fixed_position"}
    where = {f"object_{i}_{axis}": 0.3 + 0.1 * i + 0.01 * n for i in range(2) for n, axis in enumerate("xyz")}
    assert client.set_state(state_dict=named(), string_params=objects, float_params=where)
    client.step(ros(np.array(START) + 0.2))
    state = client.state()
    values = state.state_dict
    expected = {f"{joint}_joint_{kind}" for joint in JOINTS for kind in ("position", "velocity")}
    expected |= {key for frame in frames for key in pose_keys(frame)} | {"in_collision"}
    assert set(values) == expected
    assert state.success
    assert len(state.state) == length

    in_order = [values[key] for frame in frames if frame.startswith("object") for key in pose_keys(frame)]
    for kind in ("position", "velocity"):
        in_order += ros([values[f"{joint}_joint_{kind}"] for joint in JOINTS])
    in_order += [values[key] for key in pose_keys("ee")] + [values["in_collision"]]
    in_order += [values[key] for key in pose_keys("forearm")] if "forearm" in frames else []
    assert list(state.state) == in_order
    for index in range(sum(frame.startswith("object") for frame in frames)):
        assert [values[key] for key in pose_keys(f"object_{index}")] == pytest.approx(
            [where[f"object_{index}_{axis}"] for axis in "xyz"] + [0, 0, 0, 1]
        )


@pytest.mark.parametrize("ur_model", list(UR_PARAMETERS))
def test_upright_every_arm_reports_its_own_kinematics(serve: Serve, ur_model: str) -> None:
    client = serve(URSettings(ur_model=ur_model, rs_mode="1moving2points"))
    assert client.set_state(state_dict=named((0.0, -math.pi / 2, 0.0, -math.pi / 2, 0.0, 0.0)))
    values = client.state().state_dict
    arm = UR_PARAMETERS[ur_model]
    ee = [values[key] for key in pose_keys("ee")[:3]]
    assert ee == pytest.approx([0.0, arm.d4 + arm.d6, arm.d1 - arm.a2 - arm.a3 + arm.d5], abs=1e-5)
    forearm = [values[key] for key in pose_keys("forearm")[:3]]
    assert forearm == pytest.approx([0.0, 0.0, arm.d1 - arm.a2], abs=1e-5)


def test_actions_are_in_ros_order_and_arrive(serve: Serve) -> None:
    client = serve(URSettings(action_cycle_rate=10, max_velocity_scale_factor=1.0))
    client.set_state(state_dict=named())
    goal = np.array(START) + [0.3, 0.2, -0.25, 0.15, -0.1, 0.4]
    for _ in range(40):  # each replaces the one before, which would have taken 0.5 s
        assert client.send(ros(goal))
    assert positions(client.state()) == pytest.approx(goal, abs=3e-3)


def test_trajectory_is_the_simulation_cores(serve: Serve) -> None:
    client = serve(URSettings(action_cycle_rate=20, max_velocity_scale_factor=0.2))
    sim = URSimulation("ur5", max_velocity_scale=0.2, cycle_s=0.05, objects=())
    client.set_state(state_dict=named())
    sim.place(START)
    rng = np.random.default_rng(0)
    for _ in range(60):
        goal = np.float32(START + rng.uniform(-0.5, 0.5, 6)).astype(np.float64)
        state = client.step(ros(goal))
        sim.command(goal)
        sim.advance()
        assert positions(state) == pytest.approx(sim.joint_positions, abs=1e-6)


def test_delta_actions_are_offsets_from_where_the_arm_is(serve: Serve) -> None:
    client = serve(URSettings(action_mode="delta_pos", action_cycle_rate=2, max_velocity_scale_factor=1.0))
    client.set_state(state_dict=named())
    before = positions(client.state())
    delta = np.array([0.2, 0.1, -0.1, 0.05, 0.15, -0.2])
    after = positions(client.step(ros(delta)))  # a cycle of 0.5 s is the whole trajectory
    assert after - before == pytest.approx(delta, abs=0.01)


def test_object_follows_its_function_at_100_hz_from_setstate_on(serve: Serve) -> None:
    client = serve(URSettings(rs_mode="1object", action_cycle_rate=20))
    wave = {"object_0_x": 0.12, "object_0_y": 0.9, "object_0_z_amplitude": 0.2, "object_0_z_frequency": 0.5}
    wave["object_0_z_offset"] = 0.6
    client.set_state(state_dict=named(), string_params={"object_0_function": "triangle_wave"}, float_params=wave)
    heights = 0.6 + 0.2 * (1 - np.abs(2 - 4 * np.linspace(0, 1, 200)))
    for cycle in range(20, 80):
        height = client.state().state_dict["object_0_to_ref_translation_z"]
        assert height == pytest.approx(heights[5 * cycle % 200], abs=1e-5)
        client.send(ros(START))


def test_objects_are_parked_out_of_the_way_until_they_have_a_function(serve: Serve) -> None:
    client = serve(URSettings(rs_mode="2objects2points"))
    for _ in range(2):
        values = client.state().state_dict
        for index in range(2):
            where = [values[key] for key in pose_keys(f"object_{index}")[:3]]
            assert where == pytest.approx([index, 0.0, 3.0])
        assert client.set_state(state_dict=named())


def test_parameters_stay_from_one_setstate_to_the_next(serve: Serve) -> None:
    client = serve(URSettings(rs_mode="1object"))
    client.set_state(state_dict=named(), string_params=FIXED, float_params=AWAY)
    client.set_state(state_dict=named(), float_params={"object_0_z": 0.4})
    values = client.state().state_dict
    assert [values[key] for key in pose_keys("object_0")[:3]] == pytest.approx([0.1, 0.9, 0.4])


def test_seeded_splines_repeat_and_others_differ(serve: Serve) -> None:
    box = {f"object_0_{axis}_{end}": value for axis in "xyz" for end, value in (("min", -1.0), ("max", 1.0))}
    box |= {"object_0_z_min": 0.1, "object_0_n_points": 10.0, "object_0_n_sampling_points": 2000.0}
    places = []
    for seed in (1, 1, None, None):
        client = serve(URSettings(rs_mode="1moving2points", seed=seed))
        spline = {"object_0_function": "3d_spline_ur5_workspace"}
        assert client.set_state(state_dict=named(), string_params=spline, float_params=box)
        places.append([client.state().state_dict[key] for key in pose_keys("object_0")])
    assert places[0] == places[1]
    assert places[2] != places[3]


def test_reference_frame_base_is_base_link_turned_by_pi(serve: Serve) -> None:
    states = {}
    for frame in ("base_link", "base"):
        client = serve(URSettings(rs_mode="1moving2points", reference_frame=frame))
        sign = -1.0 if frame == "base" else 1.0
        where = {"object_0_x": sign * 0.1, "object_0_y": sign * 0.9, "object_0_z": 0.8}
        client.set_state(state_dict=named((0.4, -2.0, 1.2, -1.5, -1.4, 0.3)), string_params=FIXED, float_params=where)
        states[frame] = client.state().state_dict
    turn = np.diag([-1.0, -1.0, 1.0])
    for frame in ("object_0", "ee", "forearm"):
        link = np.array([states["base_link"][key] for key in pose_keys(frame)])
        base = np.array([states["base"][key] for key in pose_keys(frame)])
        assert base[:3] == pytest.approx(turn @ link[:3], abs=1e-6)
        if frame != "object_0":  # an object never turns in its reference frame
            assert rotation(base[3:]) == pytest.approx(turn @ rotation(link[3:]), abs=1e-5)


def rotation(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_collision_latches_until_the_next_setstate(serve: Serve) -> None:
    client = serve(URSettings(action_cycle_rate=10))
    client.set_state(state_dict=named())
    for _ in range(30):
        state = client.step(ros([0.0, 0.3, 0.0, -1.5, -1.4, 0.0]))  # down, into the table
    assert state.state_dict["in_collision"] == 1.0
    for _ in range(40):
        state = client.step(ros(START))
    assert positions(state) == pytest.approx(START, abs=0.01)  # long free again
    assert state.state_dict["in_collision"] == 1.0
    client.set_state(state_dict=named())
    assert client.state().state_dict["in_collision"] == 0.0


@pytest.mark.parametrize(("model", "collides"), [("sphere50", 1.0), ("sphere50_no_collision", 0.0)])
def test_solid_objects_collide_and_others_do_not(serve: Serve, model: str, collides: float) -> None:
    client = serve(URSettings(rs_mode="1object", objects=(model,)))
    client.set_state(state_dict=named(), string_params=FIXED, float_params=AWAY)
    values = client.state().state_dict
    assert values["in_collision"] == 0.0
    at_tool = {f"object_0_{axis}": values[f"ee_to_ref_translation_{axis}"] for axis in "xyz"}
    client.set_state(state_dict=named(), string_params=FIXED, float_params=at_tool)
    assert client.state().state_dict["in_collision"] == collides


def test_setstate_takes_a_list_as_getstate_gives_it_and_as_old_clients_send_it(serve: Serve) -> None:
    client = serve(URSettings(rs_mode="1object", action_cycle_rate=10))
    client.set_state(state_dict=named((0.3, -2.2, 1.1, -1.0, -1.2, 0.5)))
    there = list(client.state().state)
    client.set_state(state_dict=named())
    assert client.set_state(state=there)
    assert positions(client.state()) == pytest.approx([0.3, -2.2, 1.1, -1.0, -1.2, 0.5], abs=1e-5)
    assert client.set_state(state=[0.0] * 6 + ros(START))
    assert positions(client.state()) == pytest.approx(START, abs=1e-5)


ELBOW = "elbow_joint_position"


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, "state_dict lacks base_joint_position, .* and state is empty"),
        ({"state_dict": {k: v for k, v in named().items() if k != ELBOW}}, f"state_dict lacks {ELBOW}"),
        ({"state": [0.0] * 5}, "the state has 5 elements: expected 27"),
        ({"state_dict": named() | {ELBOW: 3.2}}, "the position of elbow is 3.2 rad: expected within"),
        ({"state_dict": named() | {ELBOW: math.nan}}, "the position of elbow is nan"),
        ({"state_dict": named(), "string_params": {"object_0_function": "zigzag"}}, "expected one of fixed_position"),
        ({"state_dict": named(), "string_params": {"object_0_function": "3d_spline"}}, "lacks 'object_0_x_min'"),
    ],
)
def test_impossible_setstate_is_answered_with_false_and_changes_nothing(
    serve: Serve, caplog: pytest.LogCaptureFixture, fields: dict[str, Any], reason: str
) -> None:
    client = serve(URSettings(rs_mode="1object"))
    assert client.set_state(state_dict=named(), string_params=FIXED, float_params=AWAY)
    before = client.state()
    assert not client.set_state(**fields)
    assert client.state() == before
    assert client.set_state(state_dict=named())  # the refused parameters did not stay
    assert re.search(reason, caplog.text)


@pytest.mark.parametrize("action", [[], [0.0] * 5, [0.0] * 7, [0.0] * 5 + [math.inf], [math.nan] + [0.0] * 5])
def test_impossible_action_is_answered_with_false_and_time_stands_still(
    serve: Serve, caplog: pytest.LogCaptureFixture, action: list[float]
) -> None:
    client = serve(URSettings(rs_mode="1object"))
    client.set_state(state_dict=named())
    before = client.state()
    assert not client.send(action)
    assert not client.step(action).success
    assert client.state() == before
    assert "SendAction" in caplog.text
    assert "expected" in caplog.text


def test_action_beyond_a_limit_goes_to_the_limit(serve: Serve) -> None:
    client = serve(URSettings(action_cycle_rate=10, world="empty"))
    upright = (0.0, -1.57, 0.0, -1.57, 0.0, 0.0)
    client.set_state(state_dict=named(upright))
    for _ in range(60):
        state = client.step(ros([0.0, -1.57, 0.0, -1.57, 0.0, 1e30]))
    assert positions(state)[5] == pytest.approx(2 * math.pi, abs=0.02)


@pytest.mark.parametrize("name", ["GetState", "SetState", "SendAction", "SendActionGetState"])
def test_garbage_is_answered_with_false_and_the_server_goes_on(
    serve: Serve, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    client = serve(URSettings())
    client.set_state(state_dict=named())
    rng = np.random.default_rng(0)
    noise = bytes(rng.integers(0, 256, 5000, dtype=np.uint8))
    bad_utf8 = [b"\x22\x04\x0a\x02\xff\xfe"] if name == "SetState" else []  # elsewhere an unknown field, and fine
    for garbage in (b"\xff" * 9, b"\x0a\x05\x01", noise, *bad_utf8):
        answer = client.call(name, garbage)
        assert not answer.success
    assert "bytes that are not a valid message" in caplog.text
    assert client.state().success


def test_calls_that_do_not_exist_and_oversized_ones_are_grpc_errors(serve: Serve) -> None:
    client = serve(URSettings())
    with pytest.raises(grpc.RpcError) as caught:
        client.channel.unary_unary("/robot_server.RobotServer/Fly")(b"", timeout=5)
    assert caught.value.code() == grpc.StatusCode.UNIMPLEMENTED
    with pytest.raises(grpc.RpcError) as caught:
        client.call("SetState", b"\0" * 5_000_000)
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert client.state().success


def test_many_clients_at_once_get_whole_states_and_every_action_counts(serve: Serve) -> None:
    client = serve(URSettings(rs_mode="1object", action_cycle_rate=20))
    wave = {"object_0_x": 0.1, "object_0_y": 0.9, "object_0_z_amplitude": 0.2, "object_0_z_frequency": 0.0625}
    client.set_state(
        state_dict=named(),
        string_params={"object_0_function": "triangle_wave"},
        float_params=wave | {"object_0_z_offset": 0.8},
    )
    heights = 0.8 + 0.2 * (1 - np.abs(2 - 4 * np.linspace(0, 1, 1600)))
    failures: list[str] = []

    def work() -> None:
        for _ in range(20):
            state = client.step(ros(START))
            if not state.success or len(state.state_dict) != 27:
                failures.append(str(state))

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    # 20 cycles of SetState and 160 of the eight clients have passed, no more and no less.
    height = client.state().state_dict["object_0_to_ref_translation_z"]
    assert height == pytest.approx(heights[5 * 180 % 1600], abs=1e-5)


def test_window_that_cannot_be_opened_is_no_reason_not_to_serve(
    serve: Serve, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    client = serve(URSettings(gui=True))
    assert client.set_state(state_dict=named())
    assert client.send(ros(START))
    assert caplog.text.count("no window can be opened") == 1


def test_slow_client_does_not_hold_up_another(serve: Serve) -> None:
    """A connection that opened and says nothing, and one whose command waits for its cycle in real time."""
    client = serve(URSettings(clock="real", action_cycle_rate=1))
    with socket.create_connection(("127.0.0.1", client.port)) as silent:
        silent.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n")
        thread = threading.Thread(target=client.send, args=(ros(START),))
        thread.start()
        time.sleep(0.1)
        began = time.monotonic()
        assert client.state().success
        assert time.monotonic() - began < 0.5
        thread.join()
