"""`rlservo demo`: export two checkpoints, serve them on both engines, drive two robots, show the results.

Exporting and serving run as the very commands a user would type, in other processes; the loop runs here.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rlservo.bundle.contract import Contract
from rlservo.client.policy_client import PolicyClient
from rlservo.deploy.demo.picture import DemoRobot, Frame, RobotRun, Trace, draw_picture, film
from rlservo.deploy.terminal import ends_like_ctrl_c, show_command
from rlservo.drive.control_loop import rollout
from rlservo.errors import RlservoError, UnavailableError, UsageError
from rlservo.policy.acting_policy import ActingPolicy, Observation

FIRST_SEED = 10_000  # not among the seeds the policies were trained with
START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 30.0


ROBOTS = (
    DemoRobot(
        policy="ur5",
        checkpoint="ur_positioning",
        env_id="rlservo/EndEffectorPositioningURSim-v0",
        title="UR5",
        success_distance_m=0.1,
    ),
    DemoRobot(
        policy="mir100",
        checkpoint="mir100_navigation",
        env_id="rlservo/NoObstacleNavigationMir100Sim-v0",
        title="MiR100",
        success_distance_m=0.2,
    ),
)


def run_demo(
    out: Path, *, checkpoints: Path, episodes: int, console: Console, cockpit: Callable[[str], None] | None = None
) -> None:
    """Run the demo and leave bundles, `demo.png` and the server's log in `out`.

    `cockpit` takes the place of the episodes: it is given the server's address, and the server runs until it returns.
    Raises UsageError when the checkpoints are not there, RlservoError when a step fails; the server is always stopped.
    """
    for robot in ROBOTS:
        if not (checkpoints / robot.checkpoint).is_dir():
            raise UsageError(
                f"{checkpoints / robot.checkpoint} does not exist: run this in a checkout of rlservo, or name the "
                "folder of its example checkpoints with --checkpoints"
            )
    repository = out / "policies"
    shutil.rmtree(repository, ignore_errors=True)  # the only thing here that an earlier run would get in the way of
    out.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    console.rule("1  export: RLlib checkpoint to policy bundle")
    _run(
        ["export", str(checkpoints / robot.checkpoint), "--out", str(repository), "--name", robot.policy]
        for robot in ROBOTS
    )

    console.rule("2  serve: both policies on one endpoint")
    with ends_like_ctrl_c(), _server(console, _embedded(repository), out / "server.log") as url:
        if cockpit is not None:
            console.rule("3  drive: choose the robot on the page, drag its target")
            with suppress(KeyboardInterrupt):
                cockpit(url)
            return
        console.rule(f"3  drive: {episodes} episodes each, every action over HTTP")
        runs = _drive(console, url, episodes, with_pictures=True)
    results = {"embedded": runs}
    console.rule("4  the same on Ray Serve")
    if importlib.util.find_spec("ray") is None:
        console.print("Ray is not installed: pip install '.[ray]' in the checkout adds it, and this demo then shows it")
    else:
        with ends_like_ctrl_c(), _server(console, _ray_serve(repository, out), out / "ray_serve.log") as url:
            results["Ray Serve"] = _drive(console, url, episodes, with_pictures=False)
    picture = draw_picture(out / "demo.png", runs)
    console.rule("5  result")
    console.print(_table(results))
    console.print(f"picture: {picture}   bundles: {repository}   {time.monotonic() - start:.0f} s in all", markup=False)
    console.print(
        f"drive them yourself, in the browser: rlservo cockpit --bundle {shlex.quote(str(repository))}",
        markup=False,
        soft_wrap=True,
    )


class _Recorder(ActingPolicy):
    """Passes every call on to the policy and notes the observations, episode by episode."""

    def __init__(self, policy: PolicyClient, traces: list[Trace]) -> None:
        self._policy = policy
        self._traces = traces

    @property
    def contract(self) -> Contract:
        return self._policy.contract

    def act(self, obs: Observation, *, explore: bool = False, seed: int | None = None) -> Any:
        self._traces[-1].append(float(np.asarray(obs)[0]))  # both robots' first element is the distance to the target
        return self._policy.act(obs, explore=explore, seed=seed)

    def reset(self) -> None:
        self._traces.append([])
        self._policy.reset()

    def close(self) -> None:
        self._policy.close()


def _run(commands: Iterable[list[str]]) -> None:
    """Show and run rlservo commands in one process; their output goes to the terminal."""
    result = subprocess.run([sys.executable, "-m", "rlservo.deploy.demo.one_process", json.dumps(list(commands))])
    if result.returncode != 0:
        raise RlservoError(f"the export ended with exit code {result.returncode}")


def _drive(console: Console, url: str, episodes: int, *, with_pictures: bool) -> list[RobotRun]:
    """Drive every robot with its policy on a server."""
    runs: list[RobotRun] = []
    counts = ("--episodes", str(episodes), "--seed", str(FIRST_SEED))
    for robot in ROBOTS:
        show_command(["rollout", robot.env_id, "--url", url, "--policy", robot.policy, *counts])
        with PolicyClient(url, robot.policy) as policy, console.status("driving ..."):
            traces: list[Trace] = []
            report = rollout(_Recorder(policy, traces), robot.env_id, episodes=episodes, seed=FIRST_SEED)
            if report.interrupted:
                raise KeyboardInterrupt
            frames: list[Frame] = []
            if with_pictures:
                longest = max(report.episodes, key=lambda row: (bool(row.success), row.steps))
                seed = FIRST_SEED + longest.index
                frames = film(policy, robot.env_id, seed=seed, steps=longest.steps, note=console.print)
            runs.append(RobotRun(robot, report, traces, frames))
    return runs


@dataclass(frozen=True)
class _Command:
    """A server's command, as it is shown and as it runs."""

    shown: str
    words: list[str]
    port: int
    environment: dict[str, str] = field(default_factory=dict)


def _embedded(repository: Path) -> _Command:
    port = _free_port()
    words = ["serve", str(repository), "--port", str(port)]
    return _Command(shlex.join(["rlservo", *words]), [sys.executable, "-m", "rlservo.deploy.cli", *words], port)


def _ray_serve(repository: Path, out: Path) -> _Command:
    """Return `serve run` with a configuration such as deploy/serve.yaml, in a Ray of its own on this machine."""
    port = _free_port()
    application = {
        "name": "rlservo",
        "route_prefix": "/",
        "import_path": "rlservo.serve_app.engines.ray_serve:build",
        "args": {"policies": [str(repository.absolute())]},
    }
    file = out / "serve.yaml"
    file.write_text(json.dumps({"http_options": {"host": "127.0.0.1", "port": port}, "applications": [application]}))
    switches = {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",
        "RAY_AUTH_MODE": "token",
        "RAY_worker_niceness": "0",
    }
    shown = " ".join(f"{name}={value}" for name, value in switches.items())
    words = [sys.executable, "-m", "ray.serve.scripts", "run", str(file)]
    environment = {**switches, "RAY_ADDRESS": "local", "RAY_USAGE_STATS_ENABLED": "0"}
    return _Command(f"{shown} serve run {file}", words, port, environment)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    return port


@contextmanager
def _server(console: Console, command: _Command, log: Path) -> Iterator[str]:
    """Run a server until the block ends; stop it as Ctrl-C would."""
    console.print(f"$ {command.shown}", style="bold", markup=False, highlight=False, soft_wrap=True)
    url = f"http://127.0.0.1:{command.port}"
    with log.open("wb") as stream:
        # Not in our process group: a Ctrl-C at the terminal reaches us alone, and we pass it on once.
        server = subprocess.Popen(
            command.words,
            env={**os.environ, **command.environment},
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
        try:
            with console.status("starting the server ..."):
                _wait_until_ready(server, url, log)
            console.print(f"serving at {url} (its log: {log})", markup=False)
            yield url
        finally:
            with console.status("stopping the server ..."):
                _stop(server)


def _end_with_parent() -> None:
    """Have the kernel send the server SIGTERM when this process is killed (Linux: PR_SET_PDEATHSIG)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)


def _wait_until_ready(server: subprocess.Popen[bytes], url: str, log: Path) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    with PolicyClient(url, ROBOTS[0].policy, timeout_s=2.0, retries=0) as probe:
        while True:
            if server.poll() is not None:
                raise RlservoError(f"the server exited while starting: {_last_line(log)}")
            try:
                probe.wait_until_ready(timeout_s=1.0)
                return
            except UnavailableError:
                if time.monotonic() > deadline:
                    raise RlservoError(f"the server was not ready after {START_TIMEOUT_S:.0f} s: see {log}") from None


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else f"it printed nothing to {log}"


def _stop(server: subprocess.Popen[bytes]) -> None:
    if server.poll() is None:
        server.send_signal(signal.SIGINT)
    try:
        server.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        server.send_signal(signal.SIGTERM)
        server.wait(STOP_TIMEOUT_S)


def _table(results: Mapping[str, Sequence[RobotRun]]) -> Table:
    table = Table(title="Every action from a server, random targets, means over the episodes")
    for column in ("robot", "engine"):
        table.add_column(column, no_wrap=True)
    for column in ("at the target", "return", "time", "answer p50", "answer p99", "later than 100 ms"):
        table.add_column(column, justify="right")
    for engine, runs in results.items():
        for run in runs:
            report = run.report
            latency = report.latency_ms
            rate = report.control_rate_hz or 10.0
            table.add_row(
                run.robot.title,
                engine,
                f"{report.successes} of {len(report.episodes)}",
                f"{report.return_mean:.2f}",
                f"{(report.length_mean or 0.0) / rate:.1f} s",
                f"{latency.p50:.2f} ms" if latency else "-",
                f"{latency.p99:.2f} ms" if latency else "-",
                f"{report.deadline_misses} of {report.steps}",
            )
    return table
