"""Clients over a bad line: a proxy that delays, cuts, tears and trickles between real servers and real policies."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.drive.control_loop import rollout
from rlservo.drive.fallback import StoppedError, WithFallback
from rlservo.errors import (
    DeadlineError,
    ObservationError,
    SessionLostError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import over_uvicorn
from stores import control_of, load_store

ROOT = Path(__file__).resolve().parents[2]
UR5 = "rlservo/EndEffectorPositioningURSim-v0"
KEY, LINE = new_key("robot", explore=True)
Client = PolicyClient | StreamClient
KINDS = pytest.mark.parametrize("kind", [PolicyClient, StreamClient])


class Stopwatch:
    """Time since it was made, without the time in which this process wanted to run and the machine ran something else.

    What is left is the client's own: a bound on it holds on a busy machine as on an idle one.
    """

    def __init__(self) -> None:
        self._began, self._before = time.monotonic(), self._waits()

    def seconds(self) -> float:
        waited = sum(s - self._before.get(thread, 0.0) for thread, s in self._waits().items())
        return time.monotonic() - self._began - waited

    @staticmethod
    def _waits() -> dict[str, float]:
        """Return how long each thread has waited for a core [s]; nothing where the kernel does not count it."""
        found = {}
        for file in Path("/proc/self/task").glob("*/schedstat"):
            with contextlib.suppress(OSError):  # a thread that has ended
                found[file.parent.name] = int(file.read_text().split()[1]) / 1e9
        return found


class FaultyLine:
    """A TCP proxy; `faults` holds what happens to the next pieces from the server, `always` to all of them.

    ("delay", s), ("trickle", s a byte), ("cut", n): n bytes and the connection ends, ("tear", n): n bytes and the rest
    of the piece is lost, ("swallow", 0): all of it is.
    """

    def __init__(self, upstream: int) -> None:
        self.upstream = upstream
        self.faults: deque[tuple[str, float]] = deque()
        self.always: tuple[str, float] | None = None
        self.connections = 0
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._start(self._accept)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def hang_up(self) -> None:
        """Cut every connection there is."""
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self.hang_up()
        for thread in self._threads:
            thread.join(10)
        for one in (self._listener, *self._sockets):
            one.close()

    def _start(self, run: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=run, args=arguments)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                robot = self._listener.accept()[0]
            except OSError:
                return
            self._sockets.append(robot)
            self.connections += 1
            try:
                server = socket.create_connection(("127.0.0.1", self.upstream))
            except OSError:
                robot.shutdown(socket.SHUT_RDWR)
                continue
            self._sockets.append(server)
            self._start(self._pump, robot, server, False)
            self._start(self._pump, server, robot, True)

    def _pump(self, source: socket.socket, target: socket.socket, faulty: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                kind, value = self._next() if faulty else ("", 0.0)
                if kind == "delay":
                    time.sleep(value)
                elif kind == "trickle":
                    for byte in data:
                        target.sendall(bytes([byte]))
                        time.sleep(value)
                    continue
                elif kind in ("cut", "tear", "swallow"):
                    data = data[: int(value)]
                target.sendall(data)
                if kind == "cut":
                    break
        for one in (source, target):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def _next(self) -> tuple[str, float]:
        if self.faults:
            return self.faults.popleft()
        return self.always or ("", 0.0)


@pytest.fixture(scope="module")
def store(recurrent: Path, shipped: Path) -> PolicyStore:
    return load_store(recurrent, shipped / "ur5")


@pytest.fixture(scope="module")
def port(store: PolicyStore) -> Iterator[int]:
    with over_uvicorn(create_app(control_of(store), ServerSettings(api_keys=LINE))) as port:
        yield port


@pytest.fixture
def line(port: int) -> Iterator[FaultyLine]:
    made = FaultyLine(port)
    yield made
    made.close()


def connected(kind: type[Client], line: FaultyLine, name: str = "ur5", **options: Any) -> Client:
    client = kind(line.url, name, api_key=KEY, **{"deadline_ms": 2000.0, **options})
    assert client.contract.name == name  # the first contact is not what is tested
    return client


def ur5_observations(count: int) -> list[Any]:
    return list(np.random.default_rng(0).uniform(-0.5, 0.5, (count, 27)).astype(np.float32))


@KINDS
def test_over_a_good_line_the_action_is_the_policys_own(
    kind: type[Client], line: FaultyLine, store: PolicyStore, recurrent: Path
) -> None:
    with connected(kind, line) as client:
        for obs in ur5_observations(20):
            np.testing.assert_allclose(client.act(obs), store.get("ur5").act(obs), rtol=1e-5, atol=1e-6)
        batch = np.stack(ur5_observations(5))
        np.testing.assert_allclose(client.act(batch), store.get("ur5").act(batch), rtol=1e-5, atol=1e-6)
        assert (
            client.act(batch[0], explore=True, seed=1).tolist() == client.act(batch[0], explore=True, seed=1).tolist()
        )
        with pytest.raises(ObservationError, match="of shape"):
            client.act(batch[0][:26])
        client.act(batch[0])
    assert client.reconnects == 0
    with pytest.raises(UsageError, match="closed"):
        client.act(batch[0])


@KINDS
def test_a_nested_recurrent_policy_acts_as_in_process(kind: type[Client], line: FaultyLine, recurrent: Path) -> None:
    rng = np.random.default_rng(4)
    with Policy.load(recurrent / "act_nested") as here:
        for server_state in (False, True):
            with connected(kind, line, "act_nested", server_state=server_state) as there:
                for _ in range(2):
                    here.reset()
                    there.reset()
                    for _ in range(6):
                        obs = {
                            "zeta": rng.uniform(-2, 2, 2).astype(np.float32),
                            "arm": {"mode": int(rng.integers(3)), "flags": rng.integers(0, 2, 4).astype(np.int8)},
                            "grid": (rng.integers(0, 2, 2), rng.integers(0, 10, (2, 2)).astype(np.int32)),
                        }
                        ours, theirs = here.act(obs), there.act(obs)
                        np.testing.assert_allclose(ours["a"][0], theirs["a"][0], rtol=1e-5, atol=1e-6)
                        assert ours["a"][1] == theirs["a"][1] and ours["b"].tolist() == theirs["b"].tolist()


@KINDS
def test_a_policy_that_sees_its_reward_gets_it(kind: type[Client], line: FaultyLine, recurrent: Path) -> None:
    with Policy.load(recurrent / "lstm_previous") as here, connected(kind, line, "lstm_previous") as there:
        for step in range(8):
            obs = np.full(3, 0.1 * step, np.float32)
            assert here.act(obs, reward=0.5 * step) == there.act(obs, reward=0.5 * step)


@KINDS
def test_a_late_reply_is_never_used_for_a_newer_observation(
    kind: type[Client], line: FaultyLine, store: PolicyStore
) -> None:
    seen = ur5_observations(6)
    expected = [store.get("ur5").act(obs) for obs in seen]
    with connected(kind, line, deadline_ms=300.0) as client:
        client.act(seen[0])
        for step in range(1, 6):
            if step % 2:
                line.faults.append(("delay", 0.5))
                began, watch = time.monotonic(), Stopwatch()
                with pytest.raises(DeadlineError):
                    client.act(seen[step])
                assert time.monotonic() - began > 0.2 and watch.seconds() < 0.49
                time.sleep(0.3)  # it arrives now, before the next question
            else:
                np.testing.assert_allclose(client.act(seen[step]), expected[step], rtol=1e-5, atol=1e-6)
        if isinstance(client, StreamClient):
            assert client.stale == 2 and client.reconnects == 0


@KINDS
@pytest.mark.parametrize("fault", [("trickle", 0.01), ("swallow", 0), ("tear", 5)])
def test_the_deadline_holds_however_slowly_an_answer_comes_and_the_line_heals(
    kind: type[Client], line: FaultyLine, store: PolicyStore, fault: tuple[str, float]
) -> None:
    seen = ur5_observations(30)
    with connected(kind, line, deadline_ms=200.0) as client:
        client.act(seen[0])
        line.faults.append(fault)
        watch = Stopwatch()
        with pytest.raises((DeadlineError, UnavailableError)):
            client.act(seen[1])
        assert watch.seconds() < 0.32
        line.always = None
        healed_by = time.monotonic() + 5
        for obs in seen[2:]:
            try:
                action = client.act(obs)
            except (DeadlineError, UnavailableError):
                assert time.monotonic() < healed_by
                continue
            np.testing.assert_allclose(action, store.get("ur5").act(obs), rtol=1e-5, atol=1e-6)
            break
        else:
            raise AssertionError("it never answered again")


@KINDS
@pytest.mark.parametrize("sent", [0, 1, 7, 60])
def test_a_connection_that_is_cut_within_a_frame_is_made_anew_in_the_same_call(
    kind: type[Client], line: FaultyLine, store: PolicyStore, sent: int
) -> None:
    seen = ur5_observations(3)
    with connected(kind, line) as client:
        client.act(seen[0])
        line.faults.append(("cut", sent))
        np.testing.assert_allclose(client.act(seen[1]), store.get("ur5").act(seen[1]), rtol=1e-5, atol=1e-6)
        assert client.reconnects == 1
        client.act(seen[2])
        assert client.reconnects == 1


@KINDS
def test_an_episode_whose_state_travels_survives_any_line(
    kind: type[Client], line: FaultyLine, recurrent: Path
) -> None:
    """Every action that comes is the one for this observation after the observations answered before, and no other."""
    rng = random.Random(5)
    kinds = [("delay", 0.12), ("cut", 0), ("cut", 9), ("tear", 30), ("trickle", 0.01), ("swallow", 0)]
    answered = 0
    with Policy.load(recurrent / "lstm_box") as here, connected(kind, line, "lstm_box", deadline_ms=90.0) as there:
        state: Any = None
        for step in range(1000):
            if step >= 80 and answered > 30:
                break
            obs = np.random.default_rng(step).uniform(-1, 1, 3).astype(np.float32)
            if rng.random() < 0.3:
                line.faults.append(rng.choice(kinds))
            watch = Stopwatch()
            try:
                action = there.act(obs)
            except (DeadlineError, UnavailableError):
                continue
            finally:
                assert watch.seconds() < 0.25
                if not answered:
                    line.faults.clear()
            step = here.step(obs, state=state)
            state = step.own_state
            np.testing.assert_allclose(action, step.action, rtol=1e-4, atol=1e-5)
            answered += 1
    assert answered > 30  # of 80, or on a busy machine, where more answers come late, of more


@KINDS
def test_a_memory_that_died_with_its_server_is_reported_and_not_begun_anew(
    kind: type[Client], line: FaultyLine, recurrent: Path, store: PolicyStore
) -> None:
    seen = [np.full(3, 0.1 * i, np.float32) for i in range(6)]
    with (
        Policy.load(recurrent / "lstm_box") as here,
        over_uvicorn(create_app(control_of(store), ServerSettings())) as other,
    ):
        expected = [here.act(obs) for obs in seen]
        with (
            connected(kind, line, "lstm_box", server_state=True) as held,
            connected(kind, line, "lstm_box") as carrying,
        ):
            for step in range(3):
                np.testing.assert_allclose(held.act(seen[step]), expected[step], rtol=1e-5, atol=1e-6)
                carrying.act(seen[step])
            line.upstream = other  # another process answers from now on
            line.hang_up()
            for _ in range(2):
                with pytest.raises(SessionLostError):
                    held.act(seen[3])
            np.testing.assert_allclose(carrying.act(seen[3]), expected[3], rtol=1e-5, atol=1e-6)
            held.reset()
            np.testing.assert_allclose(held.act(seen[0]), expected[0], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(held.act(seen[1]), expected[1], rtol=1e-5, atol=1e-6)


@KINDS
def test_a_server_that_is_away_is_unavailable_and_found_again(
    kind: type[Client], line: FaultyLine, port: int, store: PolicyStore
) -> None:
    (obs,) = ur5_observations(1)
    with connected(kind, line, deadline_ms=300.0) as client:
        client.act(obs)
        with socket.socket() as nobody:
            nobody.bind(("127.0.0.1", 0))
            line.upstream = nobody.getsockname()[1]
            line.hang_up()
            watch = Stopwatch()
            with pytest.raises(UnavailableError):
                client.act(obs)
            assert watch.seconds() < 0.5  # the deadline
        line.upstream = port
        np.testing.assert_allclose(client.act(obs), store.get("ur5").act(obs), rtol=1e-5, atol=1e-6)


def test_a_stream_is_refused_in_the_servers_own_words(line: FaultyLine) -> None:
    with (
        StreamClient(line.url, "nobody", api_key=KEY) as client,
        pytest.raises(UnknownPolicyError, match="no policy 'nobody' is loaded"),
    ):
        _ = client.contract
    with pytest.raises(UsageError, match="is not a server address"):
        StreamClient("127.0.0.1:8000")
    with StreamClient(line.url, "ur5") as client, pytest.raises(Exception, match="requires an API key") as caught:
        _ = client.contract
    assert caught.value.code == "unauthenticated"


# The fallback.


# A deadline that a busy machine keeps when nothing is in the way, and a delay that is none of its.
PROMPT_MS, LATE_S = 500.0, 0.7


def test_each_fallback_is_what_it_says(line: FaultyLine) -> None:
    seen = ur5_observations(3)
    told: list[str] = []
    for fallback, expected in (
        ("hold", None),
        ("zero", [0.0] * 5),
        ([0.1, 0.2, 0.3, 0.4, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5]),
    ):
        inner = connected(StreamClient, line, deadline_ms=PROMPT_MS)
        with WithFallback(inner, fallback, on_fallback=lambda error: told.append(error.code)) as policy:  # type: ignore[arg-type]
            first = policy.act(seen[0])
            line.faults.append(("delay", LATE_S))
            second = policy.act(seen[1])
            np.testing.assert_allclose(second, first if expected is None else np.float32(expected))
            second[:] = 9.0  # a loop may write into it
            time.sleep(0.3)
            assert not np.allclose(policy.act(seen[2]), second)
            assert (policy.counts.late, policy.counts.fallback) == (1, 1)
    assert told == ["deadline-passed"] * 3
    with WithFallback(connected(StreamClient, line, deadline_ms=PROMPT_MS), "stop") as policy:
        policy.act(seen[0])
        line.faults.append(("delay", LATE_S))
        with pytest.raises(StoppedError, match=r"stopped: .*did not answer within 500 ms"):
            policy.act(seen[1])
    with WithFallback(connected(StreamClient, line, deadline_ms=100.0), "hold") as policy:
        line.faults.extend([("swallow", 0)] * 2)
        assert policy.act(seen[0]).shape == (5,)  # nothing was commanded yet: it asks again
        assert policy.counts.late >= 2 and policy.counts.fallback == 0
        policy.reset()
        line.always = ("swallow", 0)
        with pytest.raises(StoppedError, match="no action to hold yet"):
            policy.act(seen[0])
        line.always = None
        with pytest.raises(ObservationError):  # waiting does not cure a wrong observation
            policy.act(seen[0][:3])


def test_the_client_is_told_what_was_commanded_instead(line: FaultyLine) -> None:
    seen = ur5_observations(2)
    for fallback in ("hold", "zero", [0.1, 0.2, 0.3, 0.4, 0.5]):
        inner = connected(StreamClient, line, deadline_ms=PROMPT_MS)
        told: list[Any] = []
        inner.set_last_action = told.append  # type: ignore[method-assign, assignment]
        with WithFallback(inner, fallback) as policy:  # type: ignore[arg-type]
            policy.act(seen[0])
            assert told == []
            line.faults.append(("delay", LATE_S))
            np.testing.assert_array_equal(policy.act(seen[1]), told.pop())


@pytest.mark.parametrize(
    ("name", "fallback", "sentence"),
    [
        ("ur5", "brake", "fallback 'brake' does not exist"),
        ("ur5", [0.0] * 4, "expects shape"),
        ("ur5", [0.0] * 4 + [7.0], "within -1 to 1"),
        ("ur5", {"x": 1}, "is not an action of policy 'ur5'"),
        ("lstm_previous", "zero", "is discrete, and 0 is one of its choices, not a stop: give an action"),
        ("lstm_previous", 4, "expects shape"),
        ("act_nested", {"a": [[1.0], 1]}, "must be a map with the keys a, b"),
    ],
)
def test_a_fallback_that_is_no_action_is_refused_before_the_loop(
    store: PolicyStore, name: str, fallback: Any, sentence: str
) -> None:
    with pytest.raises(UsageError, match=sentence):
        WithFallback(store.get(name), fallback)


@KINDS
def test_a_rollout_over_a_bad_line_finishes_and_counts(kind: type[Client], line: FaultyLine) -> None:
    rng = random.Random(1)
    faults = [("delay", 0.3), ("cut", 4), ("swallow", 0)]
    told: list[Exception] = []
    with WithFallback(connected(kind, line, deadline_ms=200.0), "hold", on_fallback=told.append) as policy:

        def episode_over(_row: Any) -> None:
            line.faults.extend([("", 0.0)] * 3 + rng.choices(faults, k=5))

        report = rollout(policy, UR5, episodes=4, seed=41_000, on_episode=episode_over)
    assert len(report.episodes) == 4 and report.stopped is None
    link = report.link
    assert link is not None and link.fallback == "hold"
    assert 0 < link.fallback_steps <= len(told) == link.late + link.unavailable + link.lost
    assert link.reconnects >= 1
    assert report.as_dict()["link"]["fallback_steps"] == link.fallback_steps


def test_a_rollout_whose_fallback_is_to_stop_ends_and_says_why(line: FaultyLine) -> None:
    with WithFallback(connected(StreamClient, line, deadline_ms=300.0), "stop") as policy:
        line.faults.extend([("", 0.0)] * 5 + [("delay", 0.5)])
        report = rollout(policy, UR5, episodes=3, seed=1)
    assert report.stopped is not None and "did not answer within 300 ms" in report.stopped
    assert report.link is not None and report.link.fallback_steps == 0 and report.link.late == 1
    assert len(report.episodes) == 0


@pytest.mark.parametrize("transport", ["http", "ws"])
def test_the_command_line_counts_what_happened(line: FaultyLine, transport: str) -> None:
    command = [sys.executable, "-m", "rlservo.deploy.cli", "rollout", UR5, "--url", line.url, "--policy", "ur5"]
    command += [
        "--transport",
        transport,
        "--deadline-ms",
        "200",
        "--fallback",
        "hold",
        "--episodes",
        "2",
        "--seed",
        "3",
    ]
    line.faults.extend([("", 0.0)] * 12 + [("delay", 0.4)])
    environment = {"RLSERVO_API_KEY": KEY, "PATH": "/usr/bin:/bin"}
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    link = json.loads(done.stdout)["link"]
    assert link["fallback"] == "hold" and link["fallback_steps"] >= 1 and link["late"] >= 1
