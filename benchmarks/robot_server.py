"""Robot server speed: starts, steps per second through gRPC, and many simulators at once in real time.

    python benchmarks/robot_server.py [--seconds 3] [--servers 20] [--robo-gym robo-gym/bin/python]

A server manager and its robot servers run as processes of their own, as users run them. Steps are one UR5 command with
its state (SendActionGetState, 1object) and one MiR100 command and its state (SendAction, GetState, lab_6x8), on one
client of our own, which sends and reads messages and computes nothing. `--robo-gym` names the Python of environments
with robo-gym (docs/how-to/robo-gym.md), whose own environments are measured as well: observations, rewards and protobuf
are theirs. Medians of five rounds. Written to bench/robot_server.json too.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import numpy as np
from measuring import CPU, WALL, column, parser, rate, show, write

from rlservo.envs.robot_server.manager import RobotServers, ServerManager
from rlservo.envs.robot_server.robo_gym_messages import ROBOT_SERVER, Action, Empty, State, Success

JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
START = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)
ROUNDS = 5
REAL_RATE_HZ = 20
OBJECT = "objects_controller:=true n_objects:=1 object_0_model_name:=sphere50_no_collision object_0_frame:=target"
UR5 = f"roslaunch ur_robot_server ur_robot_server.launch ur_model:=ur5 rs_mode:=1object {OBJECT} action_cycle_rate:="
MIR100 = "roslaunch mir100_robot_server sim_robot_server.launch world_name:=lab_6x8.world"


def serialize(message: Any) -> bytes:
    return bytes(message.SerializeToString())


class Robot:
    def __init__(self, port: int, *, is_ur: bool) -> None:
        channel = grpc.insecure_channel(f"127.0.0.1:{port}")

        def call(name: str, answer: Any) -> Callable[..., Any]:
            method: Callable[..., Any] = channel.unary_unary(f"/{ROBOT_SERVER}/{name}", serialize, answer.FromString)
            return method

        self.set_state, self.get_state = call("SetState", Success), call("GetState", State)
        self.send, self.send_and_get = call("SendAction", Success), call("SendActionGetState", State)
        self._is_ur = is_ur
        rng = np.random.default_rng(0)
        offsets = rng.uniform(-0.3, 0.3, (200, 6)).astype(np.float32)
        ros = np.array([START[2], START[1], START[0], *START[3:]])
        self._actions = (ros + offsets if is_ur else offsets[:, :2]).tolist()
        self._next = 0

    def reset(self) -> None:
        """Put the robot at its start."""
        if self._is_ur:
            named = {f"{joint}_joint_position": value for joint, value in zip(JOINTS, START, strict=True)}
            assert self.set_state(State(state_dict=named)).success
        else:
            assert self.set_state(State(state=[0.0] * 3 + [0.0, 2.5, 0.0])).success

    def step(self) -> None:
        """Send a command and read the state, as robo-gym's environments do."""
        self._next = (self._next + 1) % len(self._actions)
        action = Action(action=self._actions[self._next])
        if self._is_ur:
            assert self.send_and_get(action).success
        else:
            assert self.send(action).success
            assert self.get_state(Empty()).success


def starts(count: int = 10) -> tuple[list[float], list[float]]:
    """Return seconds to start and to kill a UR5 server, one after the other."""
    servers = RobotServers()
    started, killed = [], []
    try:
        for _ in range(count):
            began = time.perf_counter()
            port = servers.start(UR5 + "10")
            started.append(time.perf_counter() - began)
            began = time.perf_counter()
            servers.kill(port)
            killed.append(time.perf_counter() - began)
    finally:
        servers.close()
    return started, killed


def speed(line: str, seconds: float, *, is_ur: bool) -> list[tuple[float, float]]:
    """Return steps per second on the fast clock, and per second of the server's CPU time, for each round."""
    servers = RobotServers()
    rounds = []
    try:
        port = servers.start(line)
        robot = Robot(port, is_ur=is_ur)
        cpu_s = partial(cpu_seconds, servers.running[port])
        for _ in range(ROUNDS):
            robot.reset()
            rounds.append(rate(robot.step, seconds, cpu_s=cpu_s))
    finally:
        servers.close()
    return rounds


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def robo_gym_speed(python: Path, seconds: float) -> dict[str, Any]:
    """Return what robo_gym_steps.py measures with that Python."""
    manager = ServerManager(port=0, servers=RobotServers())
    try:
        script = Path(__file__).with_name("robo_gym_steps.py")
        line = [str(python), "-W", "ignore", str(script), str(manager.port), str(seconds), str(ROUNDS)]
        done = subprocess.run(line, stdout=subprocess.PIPE, text=True, timeout=60 + 10 * ROUNDS * seconds)
    finally:
        manager.close()
    if done.returncode != 0:
        raise SystemExit(f"--robo-gym {python}: its environments could not be measured; see above")
    results: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return results


def real_time(count: int, seconds: float) -> tuple[float, list[float]]:
    """Return how long it took to start `count` servers at once, and each one's rate on the real clock [Hz]."""
    servers = RobotServers(clock="real")
    ports: list[int] = []
    rates: list[float] = []
    try:
        began = time.perf_counter()
        starting = [
            threading.Thread(target=lambda: ports.append(servers.start(f"{UR5}{REAL_RATE_HZ}"))) for _ in range(count)
        ]
        for thread in starting:
            thread.start()
        for thread in starting:
            thread.join()
        together = time.perf_counter() - began

        def drive(port: int) -> None:
            robot = Robot(port, is_ur=True)
            robot.reset()
            robot.step()
            steps = round(seconds * REAL_RATE_HZ)
            from_here = time.perf_counter()
            for _ in range(steps):
                robot.step()
            rates.append(steps / (time.perf_counter() - from_here))

        driving = [threading.Thread(target=drive, args=(port,)) for port in ports]
        for thread in driving:
            thread.start()
        for thread in driving:
            thread.join()
    finally:
        servers.close()
    return together, rates


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--seconds", type=float, default=3.0, help="per round")
    options.add_argument("--servers", type=int, default=20, help="how many at once in real time")
    options.add_argument("--robo-gym", type=Path, nargs="*", default=[], help="Pythons that have robo-gym")
    args = options.parse_args()
    if missing := [str(python) for python in args.robo_gym if not python.is_file()]:
        options.error(f"--robo-gym {missing[0]}: there is no such file")

    started, killed = starts()
    results: dict[str, Any] = {"start_s": started, "kill_s": killed}
    rows = [row("start a UR5 server (s)", started, max, ".2f", "2"), row("kill it (s)", killed, max, ".2f", "1")]
    for name, robot, line, goal in (("ur5", "UR5", f"{UR5}10", "1,000"), ("mir100", "MiR100", MIR100, "500")):
        rounds = speed(line, args.seconds, is_ur=name == "ur5")
        results[f"{name}_steps_per_s"], results[f"{name}_steps_per_server_cpu_s"] = wall, cpu = (
            column(rounds, WALL), column(rounds, CPU),
        )  # fmt: skip
        rows.append(row(f"{robot} steps/s, our own client", wall, min, ",.0f", goal))
        rows.append(row("  per second of the server's CPU", cpu, min, ",.0f"))
    results["robo_gym"] = [robo_gym_speed(python, args.seconds) for python in args.robo_gym]
    for one in results["robo_gym"]:
        for name, robot in (("ur5", "UR5"), ("mir100", "MiR100")):
            what = f"{robot} steps/s, robo-gym's environment (Python {one['python']}, protobuf {one['protobuf']})"
            rows.append(row(what, one[name]["steps_per_s"], min, ",.0f"))
            rows.append(row("  its client's CPU per step (ms)", one[name]["client_cpu_ms_per_step"], max, ".2f"))
    together, rates = real_time(args.servers, max(args.seconds, 5.0))
    results |= {"servers": args.servers, "start_together_s": together, "real_time_hz": rates}
    rows.append(row(f"start {args.servers} at once (s)", [together], max, ".1f"))
    what = f"{args.servers} UR5s at {REAL_RATE_HZ} Hz, real clock [Hz]"
    rows.append(row(what, rates, min, ".2f", str(REAL_RATE_HZ)))
    show("Robot servers", ("what", "median", "worst", "goal"), rows)
    write(args.out, "robot_server", results)


def row(what: str, figures: list[float], worst: Callable[[list[float]], float], form: str, goal: str = "") -> list[str]:
    return [what, format(statistics.median(figures), form), format(worst(figures), form), goal]


if __name__ == "__main__":
    main()
