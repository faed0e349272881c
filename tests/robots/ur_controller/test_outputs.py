"""RTDE outputs against what follows from the others: speeds are differences of poses, as UR's RTDE guide defines them.

Nothing here knows the arm's kinematics but the length from one published pose to the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from outside_arm import OutsideArm, outside_arm, recorded

rtde_control = pytest.importorskip("rtde_control")
rtde_io = pytest.importorskip("rtde_io")
rtde_receive = pytest.importorskip("rtde_receive")

Vector = NDArray[np.float64]

HOME = [0.0, -2.5, 1.5, -1.5, -1.4, 0.0]  # [rad]
AWAY = [0.6, -2.2, 1.2, -1.9, -1.1, 0.5]
TCP = [0.02, -0.05, 0.15, 0.3, -0.2, 0.4]  # [m], rotation vector [rad], in the flange's frame
POSES = dict.fromkeys(
    ("target_qdd", "actual_TCP_pose", "actual_TCP_speed", "target_TCP_pose", "target_TCP_speed", "tcp_offset"), "6d"
)


@pytest.fixture(scope="module")
def arm() -> Iterator[OutsideArm]:
    with outside_arm("ur5e", 500.0) as arm:
        yield arm


def rotation(vector: Vector) -> Vector:
    """Return the matrix (3, 3) of a rotation vector by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle else vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def pose_speeds(time_s: Vector, poses: Vector) -> Vector:
    """Return central differences of poses: [m/s] and [rad/s], in the base's frame, (n - 2, 6)."""
    took = (time_s[2:] - time_s[:-2])[:, None]
    linear = (poses[2:, :3] - poses[:-2, :3]) / took
    turns = []
    for before, after in zip(poses[:-2, 3:], poses[2:, 3:], strict=True):
        turn = rotation(after) @ rotation(before).T
        turns.append([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.hstack([linear, 0.5 * np.array(turns) / took])


@pytest.mark.parametrize("offset", [[0.0] * 6, TCP], ids=["flange", "tool"])
def test_speeds_are_the_differences_of_poses(arm: OutsideArm, offset: list[float]) -> None:
    control = rtde_control.RTDEControlInterface(arm.host, 500.0)
    try:
        assert control.setTcp(offset)
        with recorded(arm.host, 500.0, POSES) as recorder:
            recorder.now_s()
            assert control.moveJ(AWAY, 1.0, 2.0)
            assert control.moveJ(HOME, 1.0, 2.0)
            recorder.watch(0.2)
    finally:
        control.stopScript()
        control.disconnect()
    motion, found = recorder.motion(), {name: recorder.column(name) for name in POSES}
    actual, target = (pose_speeds(motion.time_s, found[f"{kind}_TCP_pose"]) for kind in ("actual", "target"))
    assert np.abs(actual[:, :3]).max() > 0.2 and np.abs(actual[:, 3:]).max() > 0.5  # it moved
    assert found["actual_TCP_speed"][1:-1] == pytest.approx(actual, abs=0.03)
    assert found["target_TCP_speed"][1:-1] == pytest.approx(target, abs=0.03)
    assert np.abs(target - actual).max() > 1e-3  # the target leads: they are not one and the same
    gained = np.cumsum(found["target_qdd"], axis=0) * 0.002
    assert gained - gained[0] == pytest.approx(motion.setpoint_velocities - motion.setpoint_velocities[0], abs=1e-6)
    assert found["tcp_offset"][-1] == pytest.approx(offset)


def test_tool_is_where_the_offset_puts_it(arm: OutsideArm) -> None:
    control = rtde_control.RTDEControlInterface(arm.host, 500.0)
    receive = rtde_receive.RTDEReceiveInterface(arm.host, 100.0)
    try:
        assert control.setTcp([0.0] * 6)
        flange = np.array(control.getForwardKinematics())
        assert control.setTcp(TCP)
        assert control.getTCPOffset() == pytest.approx(TCP)
        expected = flange[:3] + rotation(flange[3:]) @ TCP[:3]
        tool = np.array(control.getForwardKinematics())
        assert tool[:3] == pytest.approx(expected, abs=1e-5)
        assert rotation(tool[3:]) == pytest.approx(rotation(flange[3:]) @ rotation(np.array(TCP[3:])), abs=1e-5)
        control.getActualToolFlangePose()  # ur_rtde reads this answer before the script gives it
        arm.recorder.watch(0.1)
        assert control.getActualToolFlangePose() == pytest.approx(flange, abs=1e-5)
        assert control.getForwardKinematics(receive.getActualQ(), TCP) == pytest.approx(tool, abs=1e-4)
        assert receive.getActualTCPPose()[:3] == pytest.approx(expected, abs=1e-4)
        for mass, call in ((1.5, control.setPayload), (2.5, partial(control.setTargetPayload, inertia=[0.01] * 6))):
            assert call(mass, [0.01, 0.02, 0.03])
            arm.recorder.watch(0.1)
            assert (receive.getPayload(), receive.getPayloadCog()) == (mass, pytest.approx([0.01, 0.02, 0.03]))
    finally:
        control.stopScript()
        control.disconnect()
        receive.disconnect()


def test_script_queries_answer_as_the_script_does(arm: OutsideArm) -> None:
    control = rtde_control.RTDEControlInterface(arm.host, 500.0)
    try:
        control.getStepTime()
        arm.recorder.watch(0.1)
        assert control.getStepTime() == pytest.approx(0.002)
        control.getJointTorques()
        arm.recorder.watch(0.1)
        assert control.getJointTorques() == [0.0] * 6  # corrected by what moves the arm itself: nothing pushes it
        assert control.isProgramRunning()
        assert not control.forceModeSetDamping(0.5)  # there is no force mode
        assert not control.isProgramRunning()
    finally:
        control.disconnect()


def test_outputs_that_are_switched_are_reported(arm: OutsideArm) -> None:
    switch = rtde_io.RTDEIOInterface(arm.host)
    receive = rtde_receive.RTDEReceiveInterface(arm.host, 100.0)
    try:
        assert switch.setStandardDigitalOut(3, True) and switch.setConfigurableDigitalOut(1, True)
        assert switch.setToolDigitalOut(1, True) and switch.setStandardDigitalOut(5, True)
        assert switch.setAnalogOutputVoltage(0, 0.25) and switch.setAnalogOutputCurrent(1, 0.5)
        bits = 1 << 5 | 1 << 9 | 1 << 17
        arm.recorder.wait_until(lambda _: receive.getActualDigitalOutputBits() == bits | 1 << 3)
        arm.recorder.watch(0.1)
        assert receive.getStandardAnalogOutput0() == pytest.approx(2.5)  # [V] of 0 to 10
        assert receive.getStandardAnalogOutput1() == pytest.approx(0.012)  # [A] of 0.004 to 0.020
        assert switch.setStandardDigitalOut(3, False)
        arm.recorder.wait_until(lambda _: receive.getActualDigitalOutputBits() == bits)
    finally:
        switch.disconnect()
        receive.disconnect()
