"""Measuring in turns: every server has its turn in every round, so that a slow moment of the machine falls on all.

A sample is one server's turn at one measure: what the load gave, and what the server's processes used meanwhile.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from speed import loads
from speed.catalogue import BARE, BARE_ASGI, BATCH, DIRECT, RLLIB, RLSERVO, Case
from speed.loads import GrpcLine, HttpLine, Load, LoadError, RefusedError, WebSocketLine
from speed.machine import OTHER, PROXY, REPLICA, cpu_by_role
from speed.paced import SETTLE_S, http_robot, paced, paced_calls, stream_robot
from speed.servers import Server, ask

IN_PROCESS = "onnxruntime in process"
JSON1, JSON16, LINE, STREAM, GRPC = "json, 1 connection", "json, 16 connections", "json line", "websocket", "grpc"
LARGE = f"binary, batch of {BATCH}"
ONES, HEAVY = "alone: json, 16 connections", "alone: binary, batch of 64, 16 connections"
ONE = "one observation"
JSON64 = "json, 64 connections"
CONNECTIONS, MANY_CONNECTIONS = 16, 64
FLEETS = ((16, 50.0), (64, 20.0))
"""(robots, how often each asks a second) of the paced loads."""
PACED_TURNS = 3
"""How many turns' time a paced one has: of 1,600 requests the longest two are the p99.9, which says little."""
PLANNED_HZ = (20.0, 50.0, 125.0, 500.0)
MOST_ROBOTS = 1024

Turn = Callable[[], Load]


@dataclass(frozen=True)
class Sample:
    """One turn."""

    load: Load
    cpu_s: dict[str, float]  # by role, of the server's processes

    @property
    def cpu_us(self) -> float:
        """CPU time of the whole server per request [us]."""
        return 1e6 * sum(self.cpu_s.values()) / self.load.count

    @property
    def cores(self) -> dict[str, float]:
        """How many cores each part kept busy."""
        busy = {role: used / self.load.seconds for role, used in self.cpu_s.items()}
        return {"generator": self.load.generator_cpu_s / self.load.seconds, **busy}


Samples = dict[tuple[str, str], list[Sample]]


class Rounds:
    """The measures, each with its servers' turns."""

    def __init__(
        self,
        case: Case,
        servers: Iterable[Server],
        folder: Path,
        seconds: int,
        fleets: Iterable[tuple[int, float]] = FLEETS,
    ) -> None:
        self._servers = {server.name: server for server in servers}
        self._turns: list[tuple[str, str, Turn]] = []
        session = session_of(case)
        single, many = {"obs": case.obs[None]}, {"obs": case.batch(BATCH)}

        over_wrk = partial(wrk_turn, folder=folder, seconds=seconds)

        def over(open_line: Callable[[], Any]) -> Turn:
            def turn() -> Load:
                # Opened for each turn: uvicorn closes a connection that was quiet while the others had theirs.
                with closing(open_line()) as line:
                    return loads.timed(line, seconds)

            return turn

        def in_process(feed: dict[str, Any]) -> Turn:
            return lambda: loads.timed(lambda: session.run(["action"], feed), seconds)

        ours = [server for server in self._servers.values() if server.name in (RLSERVO, DIRECT, BARE, BARE_ASGI)]
        compared = list(self._servers.values())
        self._add(ONE, [(IN_PROCESS, in_process(single))])
        self._add(JSON1, [(server.name, over_wrk(server, server.act, 1)) for server in compared])
        self._add(JSON16, [(server.name, over_wrk(server, server.act, CONNECTIONS)) for server in compared])
        self._add(JSON64, [(one.name, over_wrk(one, one.act, MANY_CONNECTIONS)) for one in compared])
        self._add(LINE, [(one.name, over(partial(HttpLine, one.port, one.act))) for one in ours])
        streams = [
            (one.name, over(partial(WebSocketLine, one.port, one.stream, one.message, greets=one.greets)))
            for one in ours
            if one.stream is not None
        ]
        self._add(STREAM, streams)
        calls = [
            (one.name, over(partial(GrpcLine, one.grpc_port, case.name, case.obs[None])))
            for one in compared
            if one.grpc_port is not None
        ]
        self._add(GRPC, calls)
        large = [(one.name, over(partial(HttpLine, one.port, one.batch))) for one in ours if one.batch is not None]
        self._add(LARGE, [(IN_PROCESS, in_process(many)), *large])
        for robots, rate_hz in fleets:
            fleet: dict[str, Any] = {"robots": robots, "rate_hz": rate_hz, "seconds": PACED_TURNS * seconds}
            self._add(
                paced_measure("json", robots, rate_hz),
                [(one.name, partial(paced, partial(http_robot, one.port, one.act), **fleet)) for one in ours],
            )
            self._add(
                paced_measure("websocket", robots, rate_hz),
                [
                    (
                        one.name,
                        partial(paced, partial(stream_robot, one.port, one.stream, one.message, one.greets), **fleet),
                    )
                    for one in ours
                    if one.stream is not None
                ],
            )
            self._add(
                paced_measure("grpc", robots, rate_hz),
                [
                    (one.name, partial(paced_calls, one.grpc_port, case.name, case.obs[None], **fleet))
                    for one in compared
                    if one.grpc_port is not None
                ],
            )

    def _add(self, measure: str, turns: list[tuple[str, Turn]]) -> None:
        self._turns += [(measure, name, turn) for name, turn in turns]

    def run(self, rounds: int, tell: Callable[[str], None]) -> Samples:
        """Take every turn once per round; the order within a measure turns by one each round."""
        samples: Samples = {(measure, name): [] for measure, name, _ in self._turns}
        measures = list(dict.fromkeys(measure for measure, _, _ in self._turns))
        self._warm()
        for number in range(rounds):
            began = time.monotonic()
            for measure in measures:
                turns = [(name, turn) for other, name, turn in self._turns if other == measure]
                shift = number % len(turns)
                for name, turn in turns[shift:] + turns[:shift]:
                    samples[measure, name].append(self._sample(name, turn))
            tell(f"round {number + 1} of {rounds}: {time.monotonic() - began:.0f} s")
        return samples

    def _sample(self, name: str, turn: Turn) -> Sample:
        return sample(self._servers.get(name), turn)

    def _warm(self) -> None:
        for measure, _, turn in self._turns:
            if not is_paced(measure):  # which settles first
                turn()


def wrk_turn(server: Server, exchange: Any, connections: int, *, folder: Path, seconds: int) -> Turn:
    return lambda: loads.wrk(server.port, exchange, folder, connections=connections, seconds=seconds)


def sample(server: Server | None, turn: Turn) -> Sample:
    """Take a turn, and what the server's processes use meanwhile."""
    members = {} if server is None else server.members()
    before = cpu_by_role(members)
    load = turn()
    after = cpu_by_role(members)
    return Sample(load, {role: after[role] - before[role] for role in (REPLICA, PROXY, OTHER)})


def scaling(ways: Iterable[Server], folder: Path, seconds: int) -> dict[tuple[str, str], Sample]:
    """Return one sample of each measure that tells what a second replica is worth, of one server's `ways` in."""
    found = {}
    for measure, name_of in ((ONES, "act"), (HEAVY, "heavy")):
        for way in ways:
            turn = wrk_turn(way, getattr(way, name_of), CONNECTIONS, folder=folder, seconds=seconds)
            turn()  # what it has to do once is not what is measured
            found[measure, way.name] = sample(way, turn)
    return found


def paced_measure(protocol: str, robots: int, rate_hz: float) -> str:
    return f"paced {protocol}, {robots} robots at {rate_hz:g} Hz"


def is_paced(measure: str) -> bool:
    return measure.startswith("paced ")


def carried(server: Server, rate_hz: float, seconds: float) -> tuple[int, float]:
    """Return how many robots get 99.9% of their actions within a quarter of the period, and the cores that takes.

    Each number is tried once: twice as many until one fails, then halfway between. JSON.
    """
    make = partial(http_robot, server.port, server.act)
    most, cores, least_bad = 0, 0.0, MOST_ROBOTS + 1
    robots = max(1, int(400 / rate_hz))
    while most < robots < least_bad:
        before = cpu_by_role(server.members())
        try:
            load = paced(make, robots=robots, rate_hz=rate_hz, seconds=seconds)
        except RefusedError:
            load = None
        except LoadError as error:
            raise LoadError(f"{server.name}, {robots} robots at {rate_hz:g} Hz: {error}") from None
        after = cpu_by_role(server.members())
        if load is not None and load.p999_ms is not None and load.p999_ms <= 250 / rate_hz:
            most = robots
            cores = sum(after[role] - before[role] for role in after) / (load.seconds + SETTLE_S)
            robots = 2 * robots if least_bad > MOST_ROBOTS else (robots + least_bad) // 2
        else:
            least_bad = robots
            robots = (most + robots) // 2
        if least_bad <= MOST_ROBOTS and least_bad - most <= max(1, most // 8):
            break
    return most, cores


def session_of(case: Case) -> Any:
    """Return a session as every server here has one: on one thread."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(case.onnx_file, options, providers=["CPUExecutionProvider"])


def check_answers(servers: Iterable[Server], case: Case) -> None:
    """See that the servers give the policy's own action. RLlib's example answers an argmax, whatever the policy."""
    for server in servers:
        answer = json.loads(ask(server)[1])
        if server.name == RLLIB:
            continue
        action = answer["outputs"][0]["data"] if "outputs" in answer else answer["action"]
        if not np.allclose(action, case.action, atol=1e-4):
            raise SystemExit(f"{server.name} answers {action}, the policy itself {case.action.tolist()}")
