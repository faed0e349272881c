"""A real arm's environment and command stream against the simulated controller."""

from __future__ import annotations

import itertools
import re
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from arms import LIMITS, PATIENCE_S, RunningArm, run_arm
from rlservo.drive.control_loop import rollout
from rlservo.envs.randomization import DomainRandomization
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.limits import Limits
from rlservo.robots.simulated.ur_controller.controller import START_JOINTS
from rlservo.robots.simulated.ur_controller.motion import Servo
from rlservo.robots.ur.parameters import POSITION_LIMITS
from servers import free_ports

pytest.importorskip("rtde_control")

ENV = "rlservo/EndEffectorPositioningURRob-v0"
START = np.array(START_JOINTS)
LIMIT = np.array(POSITION_LIMITS)


@contextmanager
def real_env(arm: RunningArm, **arguments: Any) -> Iterator[gym.Env[Any, Any]]:
    env = gym.make(
        f"rlservo.envs:{ENV}", robot=f"rtde://{arm.host}", ur_model="ur5", confirm=False, disable_env_checker=True,
        **{"limits": LIMITS, **arguments},
    )  # fmt: skip
    try:
        yield env
    finally:
        env.close()


def test_nothing_that_is_for_simulations_reaches_a_real_arm(arm: RunningArm) -> None:
    with real_env(arm) as env:
        observation, _ = env.reset(options={"ee_target_pose": [0.3, 0.1, 0.6, 0.0, 0.0, 0.0]})
        before, elsewhere = arm.controller.simulation.joint_positions.copy(), observation[None].copy()
        elsewhere[0, 3] += 0.1
        env.unwrapped.show_observations(elsewhere, 0)  # type: ignore[attr-defined]
        env.unwrapped.extreme_options("start", np.random.default_rng(0))  # type: ignore[attr-defined]
        assert abs(arm.controller.simulation.joint_positions - before).max() < 0.01
        for disturbance in ({"payload": (1.0, 1.0)}, {"model_error": 0.1}):
            with pytest.raises(ValueError, match="EndEffectorPositioningURRob has no simulation"):
                DomainRandomization(env, **disturbance)


def test_env_drives_the_arm_to_its_target_within_the_limits(arm: RunningArm) -> None:
    goal = START + np.array([0.5, 0.6, 0.0, 0.0, 0.0, 0.0])
    with real_env(arm) as env:
        target, _ = env.unwrapped.simulation.tool_at(goal)  # type: ignore[attr-defined]
        observation, _ = env.reset(options={"ee_target_pose": [*target, 0.0, 0.0, 0.0]})
        assert observation[0] > 0.15
        action = goal / LIMIT
        action[3] = (goal[3] + 3.48) / (3.48 + 0.31) * 2.0 - 1.0
        states, over = set(), False
        while not over:
            observation, _, terminated, truncated, info = env.step(action[:5].astype(np.float32))
            states.add(info["robot"]["state"])
            over = terminated or truncated
        assert info["final_status"] == "success"
        assert states <= {"blend_in", "run", "hold"}
    assert [why for _, why in arm.controller.stop_reasons] == ["it reached its end"]


LAGGING = """
import sys, time, rtde_receive
from rlservo.robots.arm_port import ServoSettings
from rlservo.robots.servo_loop import connect
from rlservo.robots.limits import Limits

class Lagging(rtde_receive.RTDEReceiveInterface):
    seen_s = float("inf")
    def getRobotStatus(self):
        status = super().getRobotStatus()
        if status & 2:
            self.seen_s = min(self.seen_s, time.monotonic())
        return status if time.monotonic() > self.seen_s + 0.3 else status & ~2

rtde_receive.RTDEReceiveInterface = Lagging
connection = connect(ServoSettings(sys.argv[1], "ur5", 0.1, 0.25, Limits(watchdog_hz=1.0), 0, 0))
print("runs", connection.read().is_program_running)
connection.close()
"""


def test_state_that_lags_behind_the_program_is_waited_for(arm: RunningArm) -> None:
    """The program is started through one connection, and its state comes through another."""
    command = [sys.executable, "-c", LAGGING, arm.host]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert "runs True" in done.stdout, done.stderr


def test_slow_policy_holds_the_arm_and_its_action_for_an_old_observation_is_not_taken(arm: RunningArm) -> None:
    address = f"127.0.0.1:{free_ports(1)[0]}"
    with real_env(arm, metrics=address) as env:
        env.reset(seed=1)
        action = np.array([0.2, -0.4, 0.5, 0.0, -0.2], dtype=np.float32)
        for _ in range(8):
            env.step(action)
        time.sleep(1.0)
        assert abs(arm.controller.simulation.joint_velocities).max() < 0.02
        _, _, _, _, info = env.step(action)
        robot = env.unwrapped.robot  # type: ignore[attr-defined]
        assert robot.stale_actions >= 1
        states = [change["state"] for change in info["robot"].get("changes", [])]
        assert "hold" in states
        for _ in range(10):
            _, _, _, _, info = env.step(action)
        assert info["robot"]["state"] in ("run", "blend_in")
        with urllib.request.urlopen(f"http://{address}/metrics") as reply:
            lines = reply.read().decode().splitlines()
        labels = f'robot="{arm.host}"'
        assert f'rlservo_robot_limited_total{{element="late_setpoint",{labels}}} 1.0' in lines
        assert f'rlservo_robot_state{{{labels},state="{info["robot"]["state"]}"}} 1.0' in lines

    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(RobotError, match=rf"cannot listen on {taken}"), real_env(arm, metrics=taken):
            pass


def test_state_that_the_link_delivers_late_is_not_acted_on(arm: RunningArm) -> None:
    with real_env(arm, limits={**LIMITS, "watchdog_hz": 1.0}) as env:
        env.reset(seed=1)
        action = np.array([0.2, -0.4, 0.5, 0.0, -0.2], dtype=np.float32)
        for _ in range(4):
            env.step(action)
        arm.server.link.latency_s = 0.3  # too late to act on, and too soon for the watchdog
        terminated = False
        while not terminated:
            _, _, terminated, _, info = env.step(action)
        assert info["final_status"] == "stale_observation"
        assert abs(arm.controller.simulation.joint_velocities).max() < 0.02
        assert arm.controller.is_program_running


def test_reset_while_the_speed_blends_in_returns_to_the_start_and_blends_in_again(arm: RunningArm) -> None:
    blend_s = 2.0
    with real_env(arm, limits={**LIMITS, "blend_s": blend_s}, max_velocity_scale_factor=0.5) as env:
        env.reset(options={"joint_positions": START})
        action = np.array([0.2, -0.4, 0.5, 0.0, -0.2], dtype=np.float32)
        began = time.monotonic()
        while time.monotonic() - began < blend_s / 2.0:
            _, _, _, _, info = env.step(action)
        assert info["robot"]["state"] != "run"
        assert abs(arm.controller.simulation.joint_positions - START).max() > 0.1

        began = time.monotonic()
        env.reset(options={"joint_positions": START})
        assert abs(arm.controller.simulation.joint_positions - START).max() < 0.03
        _, _, _, _, info = env.step(action)
        assert [change["state"] for change in info["robot"]["changes"]][:3] == ["go_to_start", "ready", "blend_in"]
        while info["robot"]["state"] != "run":
            _, _, _, _, info = env.step(action)
            assert time.monotonic() - began < PATIENCE_S
        assert time.monotonic() - began >= blend_s


@pytest.mark.slow
def test_start_is_reached_with_a_slow_slider(arm: RunningArm) -> None:
    arm.do(lambda: setattr(arm.controller, "speed_fraction", 0.03))
    real = ArmProcess(arm.host, "ur5", limits=Limits.of({**LIMITS, "start_speed": 0.02}))
    try:
        real.go_to(START + 0.04)  # 50 s at 0.0006 rad/s
    finally:
        real.close()


def test_protective_stop_ends_the_episode_and_the_next_reset_says_what_to_do(arm: RunningArm) -> None:
    with real_env(arm) as env:
        env.reset(seed=1)
        action = np.zeros(5, dtype=np.float32)
        env.step(action)
        arm.do(lambda: arm.controller.stop_protectively("a test"))
        terminated = False
        while not terminated:
            _, _, terminated, _, info = env.step(action)
        assert info["final_status"] == "protective_stop"
        assert info["robot"]["state"] == "fault"
        operator = env.unwrapped.robot.operator  # type: ignore[attr-defined]
        operator.allow_restart()
        with pytest.raises(RobotError, match="in protective stop: find the cause"):
            env.reset(seed=2)
        arm.do(lambda: setattr(arm.controller, "ticks", arm.controller.ticks + 2600))
        arm.do(arm.controller.unlock_protective_stop)
        with pytest.raises(RobotError, match="a person must look at it: start the run again"):
            env.reset(seed=2)
        operator.allow_restart()
        env.reset(seed=2)
        env.step(action)


def test_person_takes_the_arm_over_leads_it_and_gives_it_back(arm: RunningArm) -> None:
    with real_env(arm) as env:
        env.reset(seed=1)
        robot = env.unwrapped.robot  # type: ignore[attr-defined]
        action = np.array([0.3, -0.4, 0.5, 0.0, -0.2], dtype=np.float32)
        env.step(action)
        robot.operator.toggle()
        limit = time.monotonic() + PATIENCE_S
        while not arm.controller.is_free:
            _, _, _, _, info = env.step(action)
            assert time.monotonic() < limit
        assert info["robot"]["state"] == "human"
        before = arm.controller.simulation.joint_positions.copy()
        arm.do(lambda: arm.controller.simulation.data.qfrc_applied.__setitem__(0, 20.0))
        while abs(arm.controller.simulation.joint_positions[0] - before[0]) < 0.02:
            env.step(action)
            assert time.monotonic() < limit
        arm.do(lambda: arm.controller.simulation.data.qfrc_applied.__setitem__(0, 0.0))
        robot.hold()  # an episode's end, or a late answer of the policy's server, takes nothing from the person
        env.reset(options={"joint_positions": START + 0.5})
        for _ in range(5):
            _, _, _, _, info = env.step(action)
        assert arm.controller.is_free and info["robot"]["state"] == "human"
        robot.operator.toggle()
        states = []
        for _ in range(30):
            _, _, terminated, _, info = env.step(action)
            states.append(info["robot"]["state"])
            if "run" in states or terminated:
                break
        assert "blend_in" in states

        robot.operator.toggle()
        env.reset(options={"joint_positions": START + 1.0})  # on the way to a start, too
        while not arm.controller.is_free:
            env.step(action)
            assert time.monotonic() < limit
        assert abs(arm.controller.simulation.joint_positions - START - 1.0).max() > 0.1
        assert arm.controller.safety_mode.name == "NORMAL"


def test_person_is_asked_to_lead_the_arm_only_when_it_stands(arm: RunningArm) -> None:
    with real_env(arm, limits={**LIMITS, "acceleration": 0.3}) as env:
        env.reset(seed=1)
        robot = env.unwrapped.robot  # type: ignore[attr-defined]
        action = np.array([1.0, 0.0, 0.0, 0.0, 0.0], dtype=np.float32)
        speed = lambda: float(abs(arm.controller.simulation.joint_velocities).max())  # noqa: E731
        limit = time.monotonic() + PATIENCE_S
        while speed() < 0.15:
            env.step(action)
            assert time.monotonic() < limit
        robot.operator.toggle()
        states = []
        while "human" not in states:
            states.append(env.step(action)[-1]["robot"]["state"])
            now = speed()
            assert time.monotonic() < limit
        assert now < 0.02 and arm.controller.is_free
        assert set(states[1:-1]) == {"hold"}

        robot.operator.toggle()
        while speed() < 0.15:
            env.step(action)
            assert time.monotonic() < limit
        robot.operator.toggle()  # and back before it stands
        for _ in range(2):
            assert env.step(action)[-1]["robot"]["state"] != "human"
        robot.operator.toggle()
        states = []
        while "run" not in states:
            states.append(env.step(action)[-1]["robot"]["state"])
            assert not arm.controller.is_free and time.monotonic() < limit
        assert "blend_in" in states


HOSTILE_PAUSES_S = {"random": 0.05, "extremes": 0.6, "jitter": 0.02, "silence": 0.4}  # the last: more than 0.25 s


@pytest.mark.parametrize("stream", HOSTILE_PAUSES_S)
def test_hostile_setpoints_never_make_the_arm_jump_or_pass_a_limit(arm: RunningArm, stream: str) -> None:
    rng, pause_s = np.random.default_rng(7), HOSTILE_PAUSES_S[stream]
    walls = {"box_low": [-2.0, -2.0, 0.62], "box_high": [2.0, 2.0, 0.78], "tool_speed": 0.15}
    real = ArmProcess(arm.host, "ur5", velocity_scale=0.1, limits=Limits.of({**LIMITS, **walls}))
    try:
        for step in range(int(3.0 / pause_s)):
            goals = {"random": rng.uniform(-6.0, 6.0, 6), "jitter": START + rng.normal(0.0, 0.5, 6)}
            real.command(goals.get(stream, np.full(6, 6.2 if step % 2 else -6.2)), float(rng.uniform(0.0, 1.0)))
            time.sleep(pause_s)
        for bad in (np.full(6, np.nan), np.full(5, 0.0)):
            with pytest.raises(ValueError, match="expected 6 finite joint positions"):
                real.command(bad)
        assert not real.fault
        counts = real.limited()
        assert counts and ("late_setpoint" in counts or stream != "silence")
    finally:
        real.close()
    controller = arm.controller
    assert controller.safety_mode.name == "NORMAL"
    samples = list(controller.trace)
    first = next(index for index, one in enumerate(samples) if one.setpoint_velocity.any())
    last = next(index for index, one in enumerate(samples) if one.commands == samples[-1].commands)
    # What servoj makes of commands at their arrival: 1 where they come once a cycle, as they are sent.
    pace, follower, followed = [], Servo(np.zeros(1), real.limits.lookahead_s), np.zeros(1)
    for one in samples:
        follower.retarget(np.array([float(one.commands)]), real.limits.lookahead_s)
        pace.append(float(follower.velocity(followed, followed, controller.dt, 1.0)[0]) * controller.dt)
        followed = followed + pace[-1]
    most = 0.1 * np.array(controller.simulation.parameters.velocity_limits)
    tools = [controller.simulation.tool_at(one.positions)[0] for one in samples]
    for index in range(first, last):
        one, bound = samples[index], max(1.0, *pace[max(index - 8, 0) : index + 1])  # the drives follow the pace late
        assert (abs(one.setpoint_velocity) <= most * pace[index] * 1.0001 + 1e-9).all()
        assert (abs(one.velocities) <= most * bound * 1.05).all()  # the simulated drives overshoot by a few percent
        assert np.linalg.norm(tools[index] - tools[index - 1]) / controller.dt <= 0.15 * bound
        assert 0.62 <= tools[index][2] <= 0.78
        assert (abs(one.positions) <= LIMIT).all()
    assert np.median(pace[first:last]) <= 1.01, "the commands came too seldom, or in bunches, to judge by"


def test_wrong_model_and_unreachable_host_are_one_sentence(arm: RunningArm) -> None:
    with pytest.raises(RobotError, match=r"is a ur5's, but ur_model is ur5e"):
        ArmProcess(arm.host, "ur5e")
    with pytest.raises(RobotError, match=r"no UR controller answers at 127\.0\.0\.250"):
        ArmProcess("127.0.0.250", "ur5")


def test_joint_outside_its_range_is_refused_before_anything_moves(arm: RunningArm) -> None:
    limits = Limits(watchdog_hz=1.0, position_low=(-6.0, -2.0, -3.0, -6.0, -6.0, -6.0))
    with pytest.raises(RobotError, match=r"shoulder is at -2\.5 rad, outside its limits of -2 to 6\.28 rad: move it"):
        ArmProcess(arm.host, "ur5", limits=limits)
    with pytest.raises(RobotError, match=r"rate_hz is 250: the controller takes at most 125"):
        ArmProcess(arm.host, "ur5", limits=Limits(rate_hz=250.0))
    assert not abs(arm.controller.target_velocity).any()


def test_e_series_in_local_control_says_where_to_enable_remote_control() -> None:
    for arm in run_arm("ur5e"):
        arm.controller.is_remote = False
        with pytest.raises(RobotError, match="enable remote control"):
            ArmProcess(arm.host, "ur5e")


def test_rollout_refuses_an_unproven_policy_and_records_what_the_robot_did(
    arm: RunningArm, shipped: Path, tmp_path: Path
) -> None:
    options: dict[str, Any] = {
        "episodes": 1,
        "seed": 1,
        "env_kwargs": {"robot": f"rtde://{arm.host}", "ur_model": "ur5", "confirm": False, "limits": LIMITS},
    }
    with Policy.load(shipped / "ur5" / "1") as policy:
        with pytest.raises(UsageError, match="was never evaluated under latency"):
            rollout(policy, ENV, **options)
        report = rollout(policy, ENV, unproven=True, record=tmp_path / "run.mcap", **options)
    assert report.success_rate == 1.0
    assert report.robot is not None
    (episode,) = episodes(Recording(tmp_path / "run.mcap"))
    states = [one["state"] for one in episode.robot]
    assert len(states) == report.steps and states[-1] == "run"
    assert "blend_in" in [change["state"] for change in episode.robot[0]["changes"]]


def test_registers_that_another_client_uses_are_named(arm: RunningArm) -> None:
    program = f"import rtde_control; one = rtde_control.RTDEControlInterface({arm.host!r}); print('up', flush=True); "
    other = subprocess.Popen([sys.executable, "-c", program + "input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None and other.stdout.readline()
        with pytest.raises(RobotError, match=r"already in use.*: end the other client or fieldbus adapter"):
            ArmProcess(arm.host, "ur5")
    finally:
        other.kill()
        other.communicate()


def test_foreign_program_that_takes_the_place_of_ours_is_named(arm: RunningArm) -> None:
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=30.0, limits=Limits.of(LIMITS))
    try:
        real.command(np.array(START_JOINTS) + np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 10.0)
        arm.wait_until(lambda: abs(arm.controller.simulation.joint_velocities[0]) > 0.25)
        arm.do(lambda: arm.controller.start_program(itertools.repeat(None)))  # it waits
        arm.wait_until(lambda: bool(real.fault))
        fault = re.fullmatch(
            r"not_following: base is (\d\.\d\d) rad behind: .* does another program command it", real.fault
        )
        assert fault is not None and float(fault[1]) > 0.01, real.fault
    finally:
        real.close()


def test_program_that_ended_for_another_one_says_so(arm: RunningArm) -> None:
    real = ArmProcess(arm.host, "ur5", limits=Limits.of(LIMITS))
    try:
        with socket.create_connection((arm.host, 30002), PATIENCE_S) as client:
            client.sendall(b"def other():\n  textmsg(1)\nend\n")
            arm.wait_until(lambda: bool(real.fault))
        assert re.match("program_stopped: .* or another program ended it", real.fault), real.fault
    finally:
        real.close()
