"""Launch lines of robo-gym 2.1, and its environments' own arithmetic on a server's states, against ours.

robo-gym 2.1 is not on PyPI: what its classes send, and how they make an observation of a state, is written out here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rlservo.envs.panda.end_effector_positioning import EndEffectorPositioningPandaSim
from rlservo.envs.robot_server.launch_line import parse_launch_line
from rlservo.envs.ur.isaac_reach import DEFAULT_JOINTS, IsaacReachURSim
from rlservo.robots.panda.model import HIGH, LOW

UR_JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
PANDA_JOINTS = tuple(f"joint{number}" for number in range(1, 8))
OBJECT = (
    "objects_controller:=true rs_mode:=1object n_objects:=1.0 object_0_model_name:=sphere50_no_collision "
    "object_0_frame:=target action_cycle_rate:=30.0 max_velocity_scale_factor:=0.2 rviz_gui:=True gazebo_gui:=True"
)
REACH = (
    "roslaunch ur_robot_server ur_robot_server.launch world_name:=isaactabletop_sphere50_no_collision.world "
    f"reference_frame:=base_link ee_frame:=tool1 z:=0.0 ur_model:=ur10 {OBJECT}"
)
PANDA = (
    "roslaunch panda_robot_server panda_robot_server.launch reference_frame:=world action_mode:=abs_pos "
    f"world_name:=tabletop_sphere50_no_collision_no_gravity.world {OBJECT}"
)
TARGET = [0.5, 0.1, 0.3]

Serve = Callable[[Any], Any]


def begin(client: Any, names: list[str], joints: Any) -> None:
    assert client.set_state(
        state_dict=dict(zip(names, map(float, joints), strict=True)),
        string_params={"object_0_function": "fixed_position"},
        float_params={f"object_0_{axis}": value for axis, value in zip("xyz", TARGET, strict=True)},
    )


def vector(state: Any, *names: str) -> np.ndarray:
    return np.array([state.state_dict[name] for name in names])


def place(state: Any, frame: str) -> np.ndarray:
    return vector(state, *(f"{frame}_to_ref_translation_{axis}" for axis in "xyz"))


def turned_back(state: Any, point: np.ndarray) -> np.ndarray:
    """Return a direction of the reference frame in the end effector's, by the state's quaternion."""
    x, y, z, w = vector(state, *(f"ee_to_ref_rotation_{part}" for part in "xyzw"))
    axis = -np.array([x, y, z])
    return point + 2.0 * np.cross(axis, np.cross(axis, point) + w * point)


def test_isaac_reach_sees_and_moves_the_same_arm(serve: Serve) -> None:
    client = serve(parse_launch_line(REACH))
    env = IsaacReachURSim(rs_state_to_info=False)
    pose = [*TARGET, 0.0, math.pi / 2, 1.0]
    env.reset(seed=0, options={"ee_target_pose": pose})
    begin(client, [f"{joint}_joint_position" for joint in UR_JOINTS], DEFAULT_JOINTS)
    cosine, sine = math.cos(0.5) / math.sqrt(2), math.sin(0.5) / math.sqrt(2)
    action = env.solution().astype(np.float32)
    for step in range(400):
        target = np.array(DEFAULT_JOINTS) + 0.5 * action.astype(np.float64)
        state = client.step(target[[2, 1, 0, 3, 4, 5]].tolist())
        ours, _, terminated, truncated, info = env.step(action)
        theirs = np.concatenate(
            [
                vector(state, *(f"{joint}_joint_position" for joint in UR_JOINTS)) - DEFAULT_JOINTS,
                vector(state, *(f"{joint}_joint_velocity" for joint in UR_JOINTS)),
                [*TARGET, cosine, -sine, cosine, sine],
                action,
            ]
        )
        assert ours == pytest.approx(theirs, abs=2e-4), step
        if terminated or truncated:
            break
    assert info["final_status"] == "success"
    assert math.dist(place(state, "ee"), place(state, "object_0")) <= 0.02
    assert turned_back(state, np.array([0.0, 0.0, -1.0])) == pytest.approx([1.0, 0.0, 0.0], abs=0.06)


def test_panda_positioning_sees_and_moves_the_same_arm(serve: Serve) -> None:
    client = serve(parse_launch_line(PANDA))
    env = EndEffectorPositioningPandaSim(rs_state_to_info=False)
    env.reset(seed=0, options={"ee_target_pose": [*TARGET, 0.0, 0.0, 0.0]})
    start = np.array(env.START_JOINTS)
    begin(client, [f"{joint}_position" for joint in PANDA_JOINTS], start)
    low, high = np.array(LOW), np.array(HIGH)
    action = env.solution().clip(-1, 1).astype(np.float32)
    for step in range(200):
        normalised = np.append(action, ((start - low) / (high - low) * 2 - 1)[6])
        state = client.step((low + (normalised + 1) / 2 * (high - low)).tolist())
        ours, _, terminated, truncated, info = env.step(action)
        x, y, z = turned_back(state, place(state, "object_0") - place(state, "ee"))
        distance = math.sqrt(x * x + y * y + z * z)
        positions = vector(state, *(f"{joint}_position" for joint in PANDA_JOINTS))
        theirs = np.concatenate(
            [
                [distance, math.acos(z / distance), math.atan2(y, x)],
                (positions - low) / (high - low) * 2 - 1,
                vector(state, *(f"{joint}_velocity" for joint in PANDA_JOINTS)),
                place(state, "object_0"),
                place(state, "ee"),
                action,
            ]
        )
        assert ours == pytest.approx(theirs, abs=2e-4), step
        if terminated or truncated:
            break
    assert info["final_status"] == "success"
