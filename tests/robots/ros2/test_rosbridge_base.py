"""A base behind a rosbridge, without ROS: the simulated MiR100 and its bridge in a thread, roslibpy as the client."""

from __future__ import annotations

import json
import math
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from websockets.sync.client import connect

from command_line import rlservo
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.control_law import Phase
from rlservo.robots.ros2 import ros_messages as messages
from rlservo.robots.ros2.base_driver import AGE_BOUND_S, BaseLimits, RosBase
from rlservo.robots.ros2.link import Endpoint, Publish
from rlservo.robots.ros2.rosbridge_link import RosbridgeLink
from rlservo.robots.simulated.ros2_base import SimulatedBase
from rlservo.robots.simulated.ros2_loop import run
from rlservo.robots.simulated.rosbridge_server import RosbridgeServer
from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults as LinkFaults

PATIENCE_S = 60.0
TIMEOUT_S = 0.5  # of the base's own drive
STANDS, FAST = 0.01, 0.2  # [m/s]
BRAKING_S = 0.8  # from 0.5 m/s, and a busy machine


@dataclass
class RunningBase:
    """A base that is simulated in a thread of this process."""

    base: SimulatedBase
    bridge: RosbridgeServer
    seen: list[tuple[float, float, float]] = field(default_factory=list)  # time.monotonic(), x [m], speed [m/s]
    commands: list[float] = field(default_factory=list)  # [m/s], that came

    @property
    def robot(self) -> str:
        return f"rosbridge://127.0.0.1:{self.bridge.port}"

    @property
    def faults(self) -> LinkFaults:
        return self.base.messages.faults

    def watch(self) -> None:
        self.seen.append((time.monotonic(), self.base.simulation.pose[0], abs(self.base.simulation.velocity[0])))

    def wait_until(self, condition: Callable[[], bool]) -> None:
        limit = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < limit, "the condition never came true"
            time.sleep(0.02)

    def moved_for(self, began: float) -> float:
        """Wait until the base stands, and return for how long it moved on [s]."""
        self.wait_until(lambda: time.monotonic() > began + 0.2 and self.seen[-1][2] < STANDS)
        return max((at - began for at, _, speed in self.seen if speed > STANDS and at > began), default=0.0)


@pytest.fixture
def base(request: pytest.FixtureRequest) -> Iterator[RunningBase]:
    world, is_stamped = getattr(request, "param", ("empty", False))
    bridge = RosbridgeServer("127.0.0.1", 0)
    running = RunningBase(SimulatedBase([bridge], world=world, is_stamped=is_stamped, faults=LinkFaults()), bridge)
    tick = running.base.tick
    running.base.tick = lambda: (tick(), running.watch())[0]  # type: ignore[method-assign]
    command = running.base.simulation.command

    def take(linear: float, angular: float) -> bool:
        running.commands.append(linear)
        return command(linear, angular)

    running.base.simulation.command = take  # type: ignore[method-assign]
    stop, ready = threading.Event(), threading.Event()
    thread = threading.Thread(target=run, args=(running.base, stop, ready.set), name="simulated-base")
    thread.start()
    assert ready.wait(PATIENCE_S)
    try:
        yield running
    finally:
        stop.set()
        thread.join()
        running.base.close()


def drive_on(real: RosBase, base: RunningBase, linear: float = 0.5) -> None:
    """Command a velocity until the base is fast."""
    limit = time.monotonic() + PATIENCE_S
    while base.seen[-1][2] < FAST:
        assert time.monotonic() < limit, real.limited()
        real.command(linear, 0.0)
        time.sleep(0.05)


@pytest.mark.parametrize("base", [("empty", True)], indirect=True)
def test_shipped_policy_drives_through_the_bridge(base: RunningBase, all_shipped: Path, tmp_path: Path) -> None:
    done = rlservo(
        "rollout", "rlservo/NoObstacleNavigationMir100Rob-v0", "--bundle", all_shipped / "mir100_navigation",
        "--env-arg", f"robot={base.robot}", "--episodes", 2, "--seed", 1, "--yes", "--unproven", "--json",
        "--record", tmp_path / "run.mcap",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["successes"] == 2
    assert "blend_in -> run" in done.stderr  # Twist or TwistStamped was found out
    assert base.moved_for(time.monotonic()) == 0.0


@pytest.mark.parametrize("base", [("lab_6x8", False)], indirect=True)
def test_obstacle_environment_sees_what_the_simulated_one_sees(base: RunningBase) -> None:
    env = gym.make(
        "rlservo.envs:rlservo/ObstacleAvoidanceMir100Rob-v0", robot=base.robot, confirm=False, disable_env_checker=True
    )
    try:
        observation, _ = env.reset(seed=1)
        beams = env.unwrapped.observed_beams  # type: ignore[attr-defined]
        assert observation[4:] == pytest.approx(base.base.simulation.scan[beams], abs=0.15)
        x, y, yaw = base.base.simulation.pose
        target = env.unwrapped.target_position()  # type: ignore[attr-defined]
        assert 1.0 <= math.hypot(target[0] - x, target[1] - y) <= 1.55  # of the base as it stands, not of the origin
        assert math.cos(math.atan2(target[1] - y, target[0] - x) - yaw) > 0.45
        *_, info = env.step(env.action_space.sample() * 0)
        assert info["robot"]["state"] == "blend_in"
    finally:
        env.close()


@pytest.mark.parametrize("base", [("lab_6x8", False)], indirect=True)
def test_base_is_checked_without_being_driven(base: RunningBase) -> None:
    done = rlservo("robot-check", base.robot, "--json")
    found = {one["what"]: one["found"] for one in json.loads(done.stdout)["findings"]}
    x, y, yaw = base.base.simulation.pose
    assert f"{x:.2f}, {y:.2f} m, {yaw:.2f} rad" in found["odometry"] and found["fault"] == "none"
    assert not any(base.commands)


@pytest.mark.parametrize("base", [("lab_6x8", False)], indirect=True)
def test_question_names_where_the_base_will_go_and_how_fast(base: RunningBase, all_shipped: Path) -> None:
    words = (
        "rollout", "rlservo/ObstacleAvoidanceMir100Rob-v0", "--bundle", all_shipped / "mir100_obstacle_avoidance",
        "--env-arg", f"robot={base.robot}", "--env-arg", 'limits={"speed_scale": 0.2}', "--unproven",
    )  # fmt: skip
    x, y, yaw = base.base.simulation.pose
    asked = rlservo(*words, "--target", "base_link:1.2,0")
    goal = f"{x + 1.2 * math.cos(yaw):.2f}, {y + 1.2 * math.sin(yaw):.2f} m"
    assert asked.returncode == 2 and re.search(
        rf"from {x:.2f}, {y:.2f} to {goal} in its odometry's frame, 1\.20 m away, with at most 0\.1 m/s", asked.stderr
    ), asked.stderr
    refused = rlservo(*words, "--yes", "--target", f"odom:{x + 9.0},{y}")
    assert refused.returncode == 2 and "the target is 9.0 m away: an episode covers 5.2 m" in refused.stderr
    assert not any(base.commands)


def test_robot_and_cubes_are_put_where_a_console_says() -> None:
    base = SimulatedBase([], world="lab_6x8", is_stamped=False, faults=LinkFaults())
    *others, _ = base.simulation.cubes
    assert base.obey("cube 2 1.9 -0.25 0.5") == ""
    assert base.obey("place 1 2.5 0.5") == ""
    assert base.simulation.cubes == [*others, (1.9, -0.25, 0.5)]
    assert base.simulation.pose == pytest.approx((1.0, 2.5, 0.5))
    assert "cube 3 does not exist" in base.obey("cube 3 0 0 0")
    assert "expected three finite numbers" in base.obey("cube 0 1 nan 0")


@pytest.mark.parametrize("base", [("lab_6x8", False)], indirect=True)
def test_base_stops_before_a_wall_and_may_turn_away(base: RunningBase) -> None:
    real = RosBase(base.robot, limits=BaseLimits(stop_distance=0.3, blend_s=0.0))
    try:
        drive_on(real, base)  # east: the wall's inner face is at x = 2.82
        began = time.monotonic()
        while time.monotonic() - began < PATIENCE_S and not (
            base.seen[-1][2] < STANDS and "stop_distance" in real.limited()
        ):
            real.command(0.5, 0.0)
            time.sleep(0.05)
        front = base.base.simulation.pose[0] + 0.0376 + 0.45
        # On a busy machine its inputs may be as old as it permits; for a tenth of a second of that it allows.
        assert 2.82 - 0.5 < front <= 2.82 - 0.3 + 0.5 * (AGE_BOUND_S - 0.1)
        assert real.limited()["stop_distance"] > 0
        x = base.seen[-1][1]
        while base.seen[-1][1] > x - 0.1:
            real.command(-0.3, 0.0)
            time.sleep(0.05)
        assert not base.base.simulation.in_collision
    finally:
        real.close()


def test_silence_of_the_policy_and_a_lost_link_stop_the_base(base: RunningBase) -> None:
    real = RosBase(base.robot, limits=BaseLimits(blend_s=0.0))
    try:
        drive_on(real, base)
        assert base.moved_for(time.monotonic()) < 0.25 + BRAKING_S
        assert real.phase == Phase.LATE
        assert real.limited()["late_setpoint"] >= 1

        drive_on(real, base)
        base.faults.latency_s = 0.6  # what is seen is old, by its stamps
        began = time.monotonic()
        base.wait_until(lambda: (real.command(0.5, 0.0), real.phase == Phase.STALE)[1])
        base.faults.latency_s = 0.0
        assert base.moved_for(began) < 0.3 + 0.6 + BRAKING_S

        drive_on(real, base)
        base.faults.is_down = True
        assert base.moved_for(time.monotonic()) < TIMEOUT_S + BRAKING_S
        base.wait_until(lambda: bool(real.fault))
        # All topics are silent: which one is named depends on whose last message came first.
        assert real.fault.startswith(("connection_lost: no message on /odom", "connection_lost: no message on /f_scan"))
        base.faults.is_down = False
    finally:
        real.close()


def test_killed_process_leaves_a_standing_base_and_a_second_one_is_refused(base: RunningBase) -> None:
    program = f"""
import time
from rlservo.robots.ros2.base_driver import RosBase
base = RosBase({base.robot!r})
while True:
    base.command(0.5, 0.0)
    time.sleep(0.05)
"""
    process = subprocess.Popen([sys.executable, "-c", program])
    try:
        base.wait_until(lambda: bool(base.seen) and base.seen[-1][2] > FAST)
        with pytest.raises(RobotError, match="/cmd_vel is already commanded by another client"):
            RosBase(base.robot)
        process.kill()
        assert base.moved_for(time.monotonic()) < TIMEOUT_S + BRAKING_S
    finally:
        process.kill()
        process.wait()


def test_dead_mans_switch_must_be_held(base: RunningBase) -> None:
    real = RosBase(f"{base.robot},deadman=/deadman", limits=BaseLimits(blend_s=0.0, stop_distance=0.0))
    press = base.bridge.advertise("/deadman", "std_msgs/msg/Bool")
    try:
        base.wait_until(lambda: (real.command(0.5, 0.0), "deadman_released" in real.limited())[1])
        assert base.seen[-1][2] < STANDS
        base.wait_until(lambda: (press({"data": True}), real.command(0.5, 0.0), base.seen[-1][2] > FAST)[2])
        began = time.monotonic()
        press({"data": False})
        base.wait_until(lambda: (real.command(0.5, 0.0), base.seen[-1][2] < STANDS)[1])
        assert time.monotonic() - began < 0.2 + BRAKING_S
    finally:
        real.close()


def test_person_drives_the_base_until_it_is_given_back(base: RunningBase) -> None:
    env = gym.make(
        "rlservo.envs:rlservo/NoObstacleNavigationMir100Rob-v0", robot=base.robot, confirm=False,
        disable_env_checker=True, limits={"stop_distance": 0.0},
    )  # fmt: skip
    joystick = RosbridgeLink("127.0.0.1", base.bridge.port)
    drive = joystick.advertise("/cmd_vel", "geometry_msgs/msg/Twist")
    try:
        env.reset(options={"target_pose": (9.0, 0.0, 0.0)})
        robot: Any = env.unwrapped
        stand = env.action_space.sample() * 0

        def step() -> str:
            drive(messages.twist(0.3, 0.0))
            robot.robot.hold()  # an episode's end, or a late answer of the policy's server
            return str(env.step(stand)[-1]["robot"]["state"])

        robot.take_over()
        base.wait_until(lambda: step() == "human" and base.seen[-1][2] > FAST)
        base.commands.clear()
        base.wait_until(lambda: step() == "human" and len(base.commands) > 10)
        assert set(base.commands) == {0.3}  # none of ours among the person's

        env.reset(options={"target_pose": (-9.0, 0.0, 0.0)})
        assert step() == "human"
        assert set(base.commands) == {0.3}
        robot.take_over()
        base.wait_until(lambda: env.step(stand + 1.0)[-1]["robot"]["state"] == "run" and base.seen[-1][2] > FAST)
    finally:
        joystick.close()
        env.close()


class DriftingRobot:
    """A link to a base whose clock differs from ours, and goes slower."""

    SLOWER = 50e-6  # a usual quartz's
    knows_quality = False

    def __init__(self) -> None:
        self.now, self.delay_s = 1000.0, 0.05
        self.odometries = ["/mir"]
        self.publish: Publish = lambda _: None
        self._take: Callable[[Any], None] = lambda _: None

    def now_s(self) -> float:
        return self.now

    def pass_time(self, seconds: float) -> None:
        """Let time pass without messages, then deliver one."""
        self.now += seconds
        made_s = (self.now - self.delay_s) * (1.0 - self.SLOWER) - 500.0
        pose = {"position": {"x": 0.0, "y": 0.0}, "orientation": messages.quaternion(0.0)}
        twist = {"linear": {"x": 0.0, "y": 0.0}, "angular": {"z": 0.0}}
        state = {"child_frame_id": "base_link", "pose": {"pose": pose}, "twist": {"twist": twist}}
        self._take(messages.parse({"header": {"stamp": messages.stamp(made_s), "frame_id": "odom"}, **state}))

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None], *, is_kept: bool = False) -> None:
        if topic == "/odom":
            self._take = on_message
            self.pass_time(0.0)

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> Publish:
        return lambda values: self.publish(values)

    def publishers(self, topic: str) -> list[Endpoint]:
        return [Endpoint(name, messages.ODOMETRY) for name in self.odometries]

    def rivals(self, topic: str, since_s: float = 0.0) -> list[Endpoint]:
        return []

    def subscribers(self, topic: str) -> list[Endpoint]:
        return [Endpoint("/mir", messages.TWIST)]

    def close(self) -> None:
        pass


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> DriftingRobot:
    robot = DriftingRobot()
    monkeypatch.setattr("rlservo.robots.ros2.base_driver.open_link", lambda *_: robot)
    monkeypatch.setattr("rlservo.robots.ros2.link.DISCOVERY_S", 0.0)
    return robot


def test_two_odometries_on_one_topic_are_refused(robot: DriftingRobot) -> None:
    robot.odometries.append("/ekf")
    with pytest.raises(RobotError, match="second_publisher: /odom comes from /ekf and /mir: end one, or name another"):
        RosBase("ros2:clock=robot", limits=BaseLimits(stop_distance=0.0), needs_scan=False)


def test_command_that_cannot_be_sent_is_a_fault(robot: DriftingRobot) -> None:
    real = RosBase("rosbridge://mir", limits=BaseLimits(stop_distance=0.0), needs_scan=False)
    try:
        assert not real.fault

        def fail(_: object) -> None:
            raise OSError("no link")

        robot.publish = fail
        limit = time.monotonic() + PATIENCE_S
        while not real.fault:
            assert time.monotonic() < limit
            time.sleep(0.02)
        assert real.fault == "command_failed: OSError: no link"
    finally:
        real.close()


def test_clock_that_drifts_for_hours_is_no_age_but_a_late_message_is(robot: DriftingRobot) -> None:
    real = RosBase("rosbridge://mir", limits=BaseLimits(stop_distance=0.0), needs_scan=False)
    try:
        for _ in range(3 * 3600):
            robot.pass_time(1.0)
        assert real.state().age_s < 0.01
        robot.delay_s += 0.4
        robot.pass_time(1.0)
        assert real.state().age_s == pytest.approx(0.4, abs=0.01)
    finally:
        real.close()


def test_bridge_refuses_what_it_does_not_know_and_goes_on(base: RunningBase) -> None:
    with connect(f"ws://127.0.0.1:{base.bridge.port}", compression=None) as client:
        for text in ("no JSON", '{"op": "fragment"}', "[]"):
            client.send(text)
            assert json.loads(client.recv(PATIENCE_S))["level"] == "error"
        client.send(json.dumps({"op": "call_service", "service": "/rosapi/nothing", "id": "1"}))
        assert json.loads(client.recv(PATIENCE_S))["result"] is False
        client.send('{"op": "publish", "topic": "/cmd_vel", "msg": {}}')
        client.send(json.dumps({"op": "subscribe", "topic": "/odom", "type": "nav_msgs/msg/Odometry"}))
        assert "has the type nav_msgs/Odometry, not nav_msgs/msg" in json.loads(client.recv(PATIENCE_S))["msg"]
        client.send(json.dumps({"op": "subscribe", "topic": "/odom", "type": "nav_msgs/Odometry"}))
        odometry = json.loads(client.recv(PATIENCE_S))["msg"]
        assert abs(odometry["header"]["stamp"]["secs"] - time.time()) < PATIENCE_S  # ROS 1's, as a MiR's


def test_link_that_was_closed_without_its_bridge_does_not_come_back_to_a_new_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bridge = RosbridgeServer("127.0.0.1", 0)
    link = RosbridgeLink("127.0.0.1", bridge.port)
    link.advertise("/cmd_vel", messages.TWIST)

    def wait_until(condition: Callable[[], bool]) -> None:
        limit = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < limit
            time.sleep(0.02)

    other = RosbridgeLink("127.0.0.1", bridge.port)
    wait_until(lambda: other.rivals("/cmd_vel"))
    other.close()
    bridge.close()
    monkeypatch.setattr("rlservo.robots.ros2.rosbridge_link.CALL_S", 0.1)
    with pytest.raises(RobotError, match="the rosbridge does not answer"):
        link.publishers("/cmd_vel")
    monkeypatch.undo()
    link.close()
    bridge = RosbridgeServer("127.0.0.1", bridge.port)
    try:
        time.sleep(3.0)  # roslibpy connects again after a second
        other = RosbridgeLink("127.0.0.1", bridge.port)
        assert not other.rivals("/cmd_vel")
        other.close()
    finally:
        bridge.close()


def test_server_that_never_answers_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rlservo.robots.ros2.rosbridge_link.CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(RobotError, match=rf"the server at 127\.0\.0\.1:{port} is not a rosbridge"):
            RosBase(f"rosbridge://127.0.0.1:{port}")


def test_no_bridge_is_one_sentence() -> None:
    with pytest.raises(
        RobotError, match=r"no rosbridge answers at 127\.0\.0\.1:1 \(Connection refused\): is the robot"
    ):
        RosBase("rosbridge://127.0.0.1:1")
