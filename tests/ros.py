"""ROS 2 for tests: the real rclpy in a Python of its own (`.ci/ros` makes it), robots, nodes and a bystander there."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import selectors
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from servers import HEEDING_CTRL_C
from stores import control_of, load_store

ROOT = Path(__file__).resolve().parents[1]
PYTHON = ROOT / ".ros" / "bin" / "python"
PATIENCE_S = 90.0
REPEAT_S = 5.0
DOMAINS = range(1, 101)  # whose ports are below those that the system gives to outgoing connections
STANDS = 0.01  # [rad/s], [m/s]


class Process:
    """A command of rlservo's with the real rclpy; its lines are read as they come."""

    def __init__(self, words: list[str], environment: dict[str, str]) -> None:
        self.lines: list[str] = []
        self._rest = b""
        self.process = subprocess.Popen(
            [*HEEDING_CTRL_C, str(PYTHON), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | environment,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self._selector = selectors.DefaultSelector()
        self._selector.register(self.process.stdout, selectors.EVENT_READ)

    def read(self, wait_s: float) -> bool:
        """Read what has been printed; return whether more output may come."""
        if self._selector.select(wait_s):
            assert self.process.stdout is not None
            part = os.read(self.process.stdout.fileno(), 65536)
            *lines, self._rest = (self._rest + part).split(b"\n")
            self.lines += [line.decode(errors="replace") for line in lines]
            return bool(part)
        return True

    def wait_for(self, text: str, after: int = 0) -> str:
        """Return the first line that holds `text`, `after` so many lines."""
        limit = time.monotonic() + PATIENCE_S
        while True:
            for line in self.lines[after:]:
                if text in line:
                    return line
            assert time.monotonic() < limit, "\n".join([f"{text!r} never came:", *self.lines])
            goes_on = self.read(0.5)
            assert goes_on or any(text in line for line in self.lines[after:]), "\n".join(self.lines)

    def read_all(self) -> None:
        """Read what has been printed so far."""
        while self._selector.get_map() and self._selector.select(0.0) and self.read(0.0):
            pass

    def type(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

    def children(self) -> list[int]:
        """Return the processes that it started."""
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [int(word) for word in path.read_text().split()]

    def end(self, number: int = signal.SIGINT) -> int:
        """End it by a signal and return its exit code; 0 waits until it ends by itself."""
        if number and self.process.poll() is None:
            self.process.send_signal(number)
        limit = time.monotonic() + PATIENCE_S
        while self.process.poll() is None:
            assert time.monotonic() < limit, "\n".join(["it does not end:", *self.lines])
            self.read(0.2)
        self.read_all()
        return self.process.returncode

    def close(self) -> None:
        """End it, whatever became of it."""
        if self.process.poll() is None:
            with contextlib.suppress(AssertionError):
                self.end()
            self.process.kill()
            self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()
        self._selector.close()


class SlowServer:
    """An application whose answers take `delay_s`."""

    def __init__(self, folder: Path) -> None:
        store = load_store(folder)
        self._app, self.delay_s = create_app(control_of(store), ServerSettings()), 0.0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            await asyncio.sleep(self.delay_s)
        await self._app(scope, receive, send)


class Ros:
    """A graph of its own, without other nodes."""

    def __init__(self) -> None:
        self._cleanup = contextlib.ExitStack()
        self.environment = {"ROS_DOMAIN_ID": str(self._free_domain()), "ROS_LOCALHOST_ONLY": "1"}
        self._processes: list[Process] = []
        self._graph: Process | None = None
        self._states = ""

    def rlservo(self, *words: object) -> Process:
        """Start a command of rlservo's."""
        return self.python("-m", "rlservo.deploy.cli", *map(str, words))

    def python(self, *words: str) -> Process:
        """Start a Python that has rclpy."""
        process = Process(list(words), self.environment)
        self._processes.append(process)
        self._cleanup.callback(process.close)
        return process

    def close(self) -> None:
        self._cleanup.close()

    def _last_lines(self) -> Iterator[str]:
        for one in self._processes:
            one.read_all()
            yield from ("--", *one.lines[-12:])

    def _free_domain(self) -> int:
        """Return a domain that no other tests use; the claim is a Unix socket's name."""
        for domain in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                claim.bind(f"\0rlservo-test-ros-{domain}")
            except OSError:
                claim.close()
            else:
                self._cleanup.callback(claim.close)
                return domain
        raise AssertionError("no ROS domain is free")

    # -- the bystander

    def ask(self, name: str, **arguments: Any) -> Any:
        """Have the bystander do something; see ros_graph.py."""
        if self._graph is None:
            self._graph = self.python(str(ROOT / "tests" / "ros_graph.py"))
            self._graph.wait_for("ready")
        seen = len(self._graph.lines)
        self._graph.type(json.dumps([name, arguments]))
        answer = json.loads(self._graph.wait_for("", after=seen))
        assert "error" not in answer, answer["error"]
        return answer["value"]

    def wait_until(self, condition: Callable[[], bool]) -> None:
        limit = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < limit, "\n".join(["the condition never came true:", *self._last_lines()])
            for one in self._processes:
                one.read_all()  # a full pipe would stop it
            time.sleep(0.1)

    # -- a node of rlservo's

    def heartbeat(self, node: str = "rlservo") -> dict[str, str]:
        """Return what a node's next heartbeat says."""
        began_s, beats = time.time(), []

        def look() -> bool:
            found = [message["status"][0] for _, message in self.ask("since", topic="/diagnostics", time_s=began_s)]
            beats.extend(one for one in found if one["name"] == f"/{node}: policy")
            return bool(beats)

        self.wait_until(look)
        return {"message": beats[-1]["message"], **{one["key"]: one["value"] for one in beats[-1]["values"]}}

    def give_target(self, x: float, y: float, z: float = 0.0, frame: str = "base_link") -> None:
        """Publish a target [m]."""
        self.ask(
            "publish", topic="/rlservo/target", kind="geometry_msgs/msg/PoseStamped",
            values={"header": {"frame_id": frame}, "pose": {"position": {"x": x, "y": y, "z": z}}},
        )  # fmt: skip

    def begin_driving(self, *target: float, frame: str = "base_link") -> None:
        """Give a target and wait until the policy drives to it."""
        beat, given = self.heartbeat(), 0.0
        episodes = int(beat["episodes"])

        def is_taken() -> bool:
            nonlocal beat, given
            if int(beat["episodes"]) > episodes:
                return True
            # A node that is new may not have discovered the publisher yet.
            if beat["state"] != "starting" and time.monotonic() > given + REPEAT_S:
                given = time.monotonic()
                self.give_target(*target, frame=frame)
            beat = self.heartbeat()
            return False

        self.wait_until(is_taken)

    def drive_to(self, *target: float, frame: str = "base_link") -> dict[str, str]:
        """Return the heartbeat after a target has been driven to."""
        self.begin_driving(*target, frame=frame)
        beat: dict[str, str] = {}

        def is_over() -> bool:
            beat.update(self.heartbeat())
            return beat["state"] not in ("running", "hold")

        self.wait_until(is_over)
        return beat

    # -- a robot

    def watch(self, topic: str, kind: str) -> None:
        """Take the robot's speed from its states on a topic."""
        self._states = topic
        self.ask("subscribe", topic=topic, kind=kind)
        self.ask("subscribe", topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray")

    def speed(self) -> float:
        """Return how fast the fastest joint [rad/s] or the base [m/s] is now."""
        states = self.ask("since", topic=self._states, time_s=0.0, count=1)
        return speed_of(states[-1][1]) if states else 0.0

    def moved_for(self, began_s: float) -> float:
        """Wait until the robot stands, and return for how long it moved on after a moment [s since 1970]."""
        self.wait_until(lambda: time.time() > began_s + 0.2 and self.speed() < STANDS)
        states = self.ask("since", topic=self._states, time_s=began_s)
        fast = [state["header"]["stamp"] for _, state in states if speed_of(state) > STANDS]
        return max((at["sec"] + at["nanosec"] * 1e-9 for at in fast), default=began_s) - began_s


def speed_of(state: dict[str, Any]) -> float:
    """Return the speed in a JointState [rad/s] or an Odometry [m/s]."""
    return max(map(abs, state["velocity"] if "velocity" in state else state["twist"]["twist"]["linear"].values()))


@pytest.fixture(scope="module")
def ros() -> Iterator[Ros]:
    """A ROS 2 graph. Skips without the Python that `.ci/ros` makes."""
    if not PYTHON.exists():
        assert not os.environ.get("RLSERVO_REQUIRE_ROS"), f"{PYTHON} is missing"
        pytest.skip("no ROS 2 here: .ci/ros makes a Python with rclpy's wheels, in .ros")
    graph = Ros()
    try:
        yield graph
    finally:
        graph.close()


@pytest.fixture(scope="module")
def nodes() -> list[Process]:
    """Nodes of a policy that a file's tests have started: all but the last have ended."""
    return []
