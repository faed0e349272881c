"""A real arm's own kinematics: read as UR's guide to the primary interface has them, told, and used.

The parameters are a UR5e's, as UR's calibration tool printed them (issue 1047 of Universal_Robots_ROS2_Driver); its
axes are so near to parallel that the arm's links seem to be hundreds of metres away. The chain of frames is computed
here from the definition of Denavit and Hartenberg.
"""

from __future__ import annotations

import json
import re
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arms import LIMITS, RunningArm, run_arm
from command_line import rlservo
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_port import ArmReading, ServoSettings
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.following_error import FollowingBound
from rlservo.robots.limits import Limits
from rlservo.robots.servo_loop import ORDERS, REPORT, ServoLoop
from rlservo.robots.shared_block import make_file
from rlservo.robots.simulated.ros2_arm import description
from rlservo.robots.simulated.ur_controller.controller import DEVIATIONS
from rlservo.robots.ur.calibration import checked, data_sheet, deviation_m, frames_of, read_calibration
from rlservo.robots.ur.description import frames_of_description
from rlservo.robots.ur.simulation import URSimulation

UR5E = np.array(
    [
        [1.4910176998964e-07, -1.36660647780966, 1.04825235932089, 0.318363234964337, 4.02378880735854e-08,
         -3.86843341552103e-07],
        [0.000159694994835582, -0.0862491988383858, -0.372580390862978, 1.65704245972927e-05, 5.37906639089847e-06, 0],
        [0.16257063182108, 315.829375096859, -342.810589282497, 27.1153529744042, 0.0998816266727, 0.0995218985320186],
        [1.5700052415988, -0.00131879150548935, 0.00455096395056942, 1.57044157216112, -1.57135106820315, 0.0],
    ]
)  # fmt: skip
URDF_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint",
               "wrist_3_joint")  # fmt: skip
CHECKSUMS = (3042159723, 2825233598, 3038656413, 2837741972, 2836111355, 2833694156)


def flange_of(parameters: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the flange's pose (4, 4) in the controller's base frame."""
    pose = np.eye(4)
    for (theta, a, d, alpha), joint in zip(parameters.T, joints, strict=True):
        turn, tilt = np.eye(4), np.eye(4)
        c, s = np.cos(theta + joint), np.sin(theta + joint)
        turn[:2, :2], turn[2, 3] = [[c, -s], [s, c]], d
        c, s = np.cos(alpha), np.sin(alpha)
        tilt[1:3, 1:3], tilt[0, 3] = [[c, -s], [s, c]], a
        pose = pose @ turn @ tilt
    return pose


def in_base_link(pose: np.ndarray) -> np.ndarray:
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ pose


def package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(content), kind) + content


def robot_state(parameters: np.ndarray, state: int = 2) -> bytes:
    """Return a robot state with other parts around the kinematics."""
    info = struct.pack(">6I", *CHECKSUMS) + struct.pack(">24d", *parameters.ravel()) + struct.pack(">I", state)
    assert len(info) == 220
    return package(16, package(0, b"\x05" * 42) + package(5, info) + package(6, b"\x10" * 440))


@contextmanager
def primary(answer: bytes) -> Iterator[str]:
    """Serve on port 30001 of an address of its own, some bytes at a time, and keep the connection open."""
    with closing(socket.create_server(("127.4.4.6", 30001))) as server:
        done = threading.Event()

        def serve() -> None:
            client, _ = server.accept()
            with client:
                for start in range(0, len(answer), 100):
                    client.sendall(answer[start : start + 100])
                    done.wait(0.01)
                done.wait(60.0)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield "127.4.4.6"
        finally:
            done.set()
            thread.join()


def test_parameters_are_read_among_other_messages() -> None:
    version = package(20, b"\xff" * 8 + b"\xfe\x03\x09URControl\x05\x0d")
    states = package(16, package(0, b"\x10" * 42)) + robot_state(UR5E)
    with primary(version + states) as host:
        parameters, state = read_calibration(host)
    assert parameters.tolist() == UR5E.tolist() and state == "linearised"


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (b"", "timed out"),
        (package(20, b"\x10" * 30), "timed out"),
        (struct.pack(">iB", -1, 16), "a package of -1 bytes"),
        (package(16, struct.pack(">IB", 300, 5)), "a part of 300 bytes in 5"),
        (package(16, package(5, b"\0" * 12)), "buffer of at least 220 bytes"),
        (robot_state(np.full((4, 6), np.nan)), "nan"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(answer: bytes, why: str) -> None:
    with primary(answer) as host, pytest.raises(RobotError, match=rf"calibration of the arm at {host} .*30001.*{why}"):
        read_calibration(host)


def test_arm_of_other_kinematics_is_refused() -> None:
    with (
        primary(robot_state(data_sheet("ur10e"))) as host,
        pytest.raises(RobotError, match=r"a ur5e's: expected 0\.03"),
    ):
        checked(frames_of(read_calibration(host)[0]), "ur5e")
    with primary(robot_state(np.zeros((4, 6)))) as host, pytest.raises(RobotError, match="is the model right"):
        checked(frames_of(read_calibration(host)[0]), "ur5e")


@pytest.mark.parametrize("tool", ["tool0", "tool1"])
def test_model_with_an_arms_own_kinematics_has_its_flange_where_the_controller_has_it(tool: str) -> None:
    nominal, own = (URSimulation("ur5e", objects=(), tool=tool) for _ in range(2))
    own.calibrate(frames_of(UR5E))
    turn = (
        np.linalg.inv(nominal.tool_frame_at(np.zeros(6))[1])
        @ in_base_link(flange_of(data_sheet("ur5e"), np.zeros(6)))[:3, :3]
    )
    farthest = 0.0
    for joints in np.random.default_rng(3).uniform(-np.pi, np.pi, (100, 6)):
        position, axes, jacobian = own.tool_frame_at(joints)
        expected = in_base_link(flange_of(UR5E, joints))
        assert position == pytest.approx(expected[:3, 3], abs=1e-9)
        assert axes @ turn == pytest.approx(expected[:3, :3], abs=1e-9)
        ahead = own.tool_frame_at(joints + [0, 0, 1e-6, 0, 0, 0])[0]
        assert (ahead - position) / 1e-6 == pytest.approx(jacobian[:3, 2], abs=1e-5)
        farthest = max(farthest, float(np.linalg.norm(position - nominal.tool_at(joints)[0])))
    assert 0.001 < farthest < 0.004
    assert deviation_m("ur5e", frames_of(UR5E)) == pytest.approx(farthest, rel=0.3)
    links = nominal.model.body_pos - own.model.body_pos
    assert 0.0002 < np.abs(links).max() < 0.003  # the links stay where they are


def urdf_of(parameters: np.ndarray, prefix: str = "", joints: Sequence[str] = URDF_JOINTS) -> str:
    """Return a URDF as ur_description has it.

    Each link is drawn along its axis to where the last one is, as ur_calibration does, and turned about it: neither
    moves the flange. ros2_control names the same joints once more.
    """
    frames = [np.eye(4)]
    for number in range(6):
        frames.append(flange_of(parameters[:, : number + 1], np.zeros(number + 1)))
    frames[0][2, 3] = 0.16
    for number in range(1, 6):
        axis, (start, before) = frames[number][:3, 2], (frames[number][:3, 3], frames[number - 1][:3, 3])
        frames[number][:3, 3] = start - axis * (axis @ (start - before))
        frames[number][:3, :3] @= Rotation.from_euler("z", 0.3 * number).as_matrix()
    steps = [np.linalg.inv(a) @ b for a, b in zip([np.eye(4), *frames], [*frames, np.eye(4)], strict=True)][:7]
    links = ("base_link_inertia", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link",
             "wrist_3_link", "tool0")  # fmt: skip
    names = [*joints, "wrist_3-tool0"]
    turned = 'xyz="0 0 0" rpy="0 0 3.141592653589793"'
    text = "".join(
        f'<joint name="{p}{child}_fixed" type="fixed"><parent link="{p}base_link"/><child link="{p}{child}"/>'
        f"<origin {turned}/></joint>"
        for p in (prefix,) for child in ("base_link_inertia", "base")
    )  # fmt: skip
    for number, (name, step) in enumerate(zip(names, steps, strict=True)):
        xyz = " ".join(map(repr, step[:3, 3].tolist()))
        rpy = " ".join(map(repr, Rotation.from_matrix(step[:3, :3]).as_euler("xyz").tolist()))
        turns = '<axis xyz="0 0 1"/><limit lower="-6.3" upper="6.3" effort="1" velocity="1"/>' if number < 6 else ""
        text += (
            f'<joint name="{prefix}{name}" type="{"revolute" if number < 6 else "fixed"}">'
            f'<origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="{prefix}{links[number]}"/><child link="{prefix}{links[number + 1]}"/>{turns}</joint>'
        )
    bodies = "".join(f'<link name="{prefix}{link}"/>' for link in ("base_link", "base", *links))
    control = "".join(f'<joint name="{prefix}{name}"/>' for name in joints)
    return f'<robot name="ur"><ros2_control name="ur" type="system">{control}</ros2_control>{bodies}{text}</robot>'


def flanges_by_mujoco(text: str, poses: np.ndarray, prefix: str = "") -> Iterator[np.ndarray]:
    """Yield the flange's positions [m] in base_link by MuJoCo's own reader of URDF, which wants masses."""
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = re.sub(r'<link name="([^"]*)"/>', rf'<link name="\1">{mass}</link>', text)
    text = text.replace('<robot name="ur">', '<robot name="ur"><mujoco><compiler fusestatic="false"/></mujoco>')
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for angles in poses:
        for name, angle in zip(URDF_JOINTS, angles, strict=True):
            data.joint(prefix + name).qpos = angle
        mujoco.mj_kinematics(model, data)
        yield data.body(prefix + "tool0").xpos.copy()


@pytest.mark.parametrize("prefix", ["", "left_"])
def test_robot_description_has_the_flange_where_mujoco_and_the_controller_have_it(prefix: str) -> None:
    """MuJoCo reads the URDF by its own code; the controller's kinematics are those of Denavit and Hartenberg."""
    text, poses = urdf_of(UR5E, prefix), np.random.default_rng(4).uniform(-np.pi, np.pi, (50, 6))
    frames = frames_of_description(text, [prefix + name for name in URDF_JOINTS], prefix)
    assert deviation_m("ur5e", frames) == pytest.approx(deviation_m("ur5e", frames_of(UR5E)), abs=1e-9)
    ours = URSimulation("ur5e", objects=())
    ours.calibrate(frames)
    for angles, theirs in zip(poses, flanges_by_mujoco(text, poses, prefix), strict=True):
        expected = in_base_link(flange_of(UR5E, angles))[:3, 3]
        assert theirs == pytest.approx(expected, abs=1e-9)
        assert ours.tool_at(angles)[0] == pytest.approx(expected, abs=1e-9)


def test_simulated_arms_description_is_that_of_its_kinematics() -> None:
    text, poses = description(UR5E, URDF_JOINTS, ""), np.random.default_rng(5).uniform(-np.pi, np.pi, (50, 6))
    for angles, flange in zip(poses, flanges_by_mujoco(text, poses), strict=True):
        assert flange == pytest.approx(in_base_link(flange_of(UR5E, angles))[:3, 3], abs=1e-6)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<robot", "it is not XML"),
        ("<robot/>", "it has no link base"),
        (urdf_of(UR5E).replace('link="tool0"', 'link="hand"'), "it has no link tool0"),
        (urdf_of(UR5E, "left_"), "it has no link base"),
        (
            urdf_of(UR5E, joints=[*URDF_JOINTS[1:], URDF_JOINTS[0]]),
            "joints before tool0 are shoulder_lift_joint, elbow",
        ),
        (urdf_of(UR5E).replace('axis xyz="0 0 1"', 'axis xyz="0 1 0"', 1), "a joint does not turn about z"),
        (urdf_of(UR5E).replace('xyz="0.0 ', 'xyz="nan ', 1), "the origin of .* has xyz 'nan"),
        (urdf_of(UR5E).replace('xyz="0.0 ', 'xyz="', 1), "the origin of .* has xyz '"),
    ],
)
def test_description_of_another_robot_is_one_sentence(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        frames_of_description(text, URDF_JOINTS)


def test_every_models_data_sheet_leaves_its_model_as_it_is() -> None:
    for model in ("ur3", "ur5e", "ur18", "ur30"):
        nominal, own = URSimulation(model, objects=()), URSimulation(model, objects=())
        own.calibrate(frames_of(data_sheet(model)))
        assert own.model.body_pos == pytest.approx(nominal.model.body_pos, abs=1e-12)
        assert own.model.site_quat == pytest.approx(nominal.model.site_quat, abs=1e-12)


@pytest.fixture
def calibrated() -> Iterator[RunningArm]:
    pytest.importorskip("rtde_control")
    yield from run_arm("ur5e", kinematics=UR5E)


def test_real_arms_observations_are_of_its_own_kinematics(calibrated: RunningArm) -> None:
    """The tool's position in an environment is the controller's, not the data sheet's."""
    env: Any = gym.make(
        "rlservo.envs:rlservo/EndEffectorPositioningURRob-v0", robot=f"rtde://{calibrated.host}", ur_model="ur5e",
        confirm=False, disable_env_checker=True, limits=LIMITS,
    )  # fmt: skip
    with closing(env):
        env.reset(seed=1)
        simulation = env.unwrapped.robot.simulation
        joints, seen = simulation.joint_positions.copy(), simulation.tool_position
    expected = in_base_link(flange_of(UR5E, joints))
    assert seen == pytest.approx(expected[:3, 3], abs=1e-9)
    assert calibrated.controller.tool.pose(joints)[:3] == pytest.approx(expected[:3, 3] * (-1, -1, 1), abs=1e-9)
    assert np.linalg.norm(URSimulation("ur5e", objects=()).tool_at(joints)[0] - seen) > 3e-4


def test_command_stream_limits_the_arms_own_flange(calibrated: RunningArm) -> None:
    class Driver:
        rate_hz, following, hint, frames = 500.0, FollowingBound(0.005, 0.1), "", frames_of(UR5E)

        def read(self) -> ArmReading:
            zeros = np.zeros(6)
            return ArmReading(1.0, None, zeros, zeros, zeros, 1.0, True, False, 7, 1)

    settings = ServoSettings("", "ur5e", 0.1, 0.25, Limits(), make_file(ORDERS), make_file(REPORT))
    simulation = URSimulation("ur5e", objects=())
    ServoLoop(settings, Driver(), simulation)  # type: ignore[arg-type]  # what the constructor needs of a driver
    assert simulation.tool_at(np.ones(6))[0] == pytest.approx(in_base_link(flange_of(UR5E, np.ones(6)))[:3, 3])
    with closing(ArmProcess(calibrated.host, "ur5e")) as real:
        assert real.frames == pytest.approx(frames_of(UR5E))


def test_check_says_how_far_the_flange_is_off(calibrated: RunningArm) -> None:
    done = rlservo("robot-check", f"rtde://{calibrated.host}", "--limit", "watchdog_hz=1", "--json")
    found = {one["what"]: one for one in json.loads(done.stdout)["findings"]}
    assert done.returncode == 0, found
    off = 1e3 * deviation_m("ur5e", frames_of(UR5E))
    assert found["calibration"]["found"] == f"linearised: the flange is up to {off:.1f} mm from the data sheet's"
    assert found["calibration"]["numbers"] == UR5E.tolist()
    expected = in_base_link(flange_of(UR5E, np.array(found["joints"]["numbers"])))[:3, 3]
    assert found["flange"]["found"] == ", ".join(f"{value:z.2f}" for value in expected) + " m in base_link"


def test_calibrated_simulated_arms_are_off_as_real_ones_are() -> None:
    for model in ("ur3e", "ur5", "ur30"):
        assert 0.001 < deviation_m(model, frames_of(data_sheet(model) + DEVIATIONS)) < 0.015
