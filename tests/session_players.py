"""Robots that play LSTM episodes in sessions by id, abandon some, and compare every action with a policy's own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import grpc
import numpy as np

from rlservo.policy.policy import Policy
from rlservo.policy.recurrent_state import State
from rlservo.serve_app.protocols.open_inference.oip_messages import messages

MODEL = "lstm_box"
# The last is a proxy's, whose replica has died.
NO_ANSWER = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED, grpc.StatusCode.UNKNOWN)
PATIENCE_S = 300.0  # for one answer, tries included
LONG_S = 15.0  # for one try that is not given up on purpose: the machine may be busy


class Connection(Protocol):
    """A client's way to the server."""

    async def ask(self, request: dict[str, Any]) -> tuple[int, Any, int | None]:
        """Send a request for `MODEL` in the terms of the JSON protocol; give (HTTP's status, action, session step).

        Raises OSError and EOFError.
        """
        ...

    async def close(self) -> None: ...


class GivenUpError(Exception):
    """No answer came that could be used, and the step may have been taken."""


class HttpConnection:
    """A connection that is kept alive, and closed when a request on it is given up."""

    def __init__(self, port: int, *, is_oip: bool, key: str = "") -> None:
        self._port = port
        self._authorization = f"authorization: Bearer {key}\r\n" if key else ""
        self._is_oip = is_oip
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, request: dict[str, Any]) -> tuple[int, Any, int | None]:
        """Send one request. Raises OSError, EOFError."""
        if self._streams is None:
            self._streams = await asyncio.open_connection("127.0.0.1", self._port)
        reader, writer = self._streams
        is_done = False
        try:
            body = json.dumps(self._oip(request) if self._is_oip else request).encode()
            path = f"/v2/models/{MODEL}/infer" if self._is_oip else f"/v1/policies/{MODEL}/act"
            head = f"POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n{self._authorization}"
            writer.write(f"{head}content-length: {len(body)}\r\n\r\n".encode() + body)
            received = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
            length = int(received.split("content-length:")[1].split("\r\n")[0])
            content = await reader.readexactly(length)
            is_done = "connection: close" not in received
        finally:
            if not is_done:
                await self.close()
        status = int(received.split()[1])
        if not content.startswith(b"{"):  # a proxy's, whose replica has died
            raise ConnectionError(f"{status} {content[:80]!r}")
        reply = json.loads(content)
        if status != 200:
            return status, reply, None
        if self._is_oip:
            return status, reply["outputs"][0]["data"], reply["parameters"]["session_step"]
        return status, reply["action"], reply["session_step"]

    async def close(self) -> None:
        """Close it; the next request opens another."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None

    @staticmethod
    def _oip(request: dict[str, Any]) -> dict[str, Any]:
        obs = request["obs"]
        parameters = {
            "sequence_id": request["session_id"], "sequence_start": request["reset"], "sequence_end": request["end"],
            "seq": request["seq"],
        }  # fmt: skip
        return {
            "inputs": [{"name": "obs", "shape": [1, len(obs)], "datatype": "FP32", "data": obs}],
            "parameters": parameters,
        }


class GrpcConnection:
    """A gRPC channel with a connection of its own."""

    def __init__(self, port: int, *, key: str = "") -> None:
        self._address = f"127.0.0.1:{port}"
        # The second names the application to Ray Serve.
        self._metadata = (("authorization", f"Bearer {key}"), ("application", "rlservo"))
        self._channel: grpc.aio.Channel | None = None

    async def ask(self, request: dict[str, Any]) -> tuple[int, Any, int | None]:
        """Send one request. Raises ConnectionError."""
        if self._channel is None:
            # The robots try again themselves, so the channel does not. With its own retries grpcio 1.85 has filled
            # 16 GB in some runs against two replicas that are killed; whether by them is not known.
            options = [("grpc.use_local_subchannel_pool", 1), ("grpc.enable_retries", 0)]
            self._channel = grpc.aio.insecure_channel(self._address, options)
        obs = np.float32(request["obs"])
        message: Any = messages.ModelInferRequest(model_name=MODEL, raw_input_contents=[obs.tobytes()])
        message.inputs.add(name="obs", datatype="FP32", shape=[1, len(obs)])
        message.parameters["sequence_id"].string_param = request["session_id"]
        message.parameters["sequence_start"].bool_param = request["reset"]
        message.parameters["sequence_end"].bool_param = request["end"]
        message.parameters["seq"].int64_param = request["seq"]
        call: Any = self._channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
        try:
            content = await call(message.SerializeToString(), metadata=self._metadata)
        except grpc.aio.AioRpcError as error:
            if error.code() in NO_ANSWER:
                raise ConnectionError(error.details()) from None
            return 400, f"{error.code()} {error.details()}", None
        reply: Any = messages.ModelInferResponse.FromString(content)
        action = np.frombuffer(reply.raw_output_contents[0], np.float32)
        return 200, action, reply.parameters["session_step"].int64_param

    async def close(self) -> None:
        if self._channel is not None:
            await self._channel.close()


@dataclass
class Tally:
    """Outcome of the robots' requests."""

    answered: int = 0
    given_up: int = 0
    episodes: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


@dataclass
class Robot:
    """One session's client. It numbers its requests; a start without an answer is followed by one under another id."""

    number: int
    connection: Connection
    policy: Policy
    tally: Tally
    over: asyncio.Event

    def __post_init__(self) -> None:
        self._draw = random.Random(self.number)
        self._rng = np.random.default_rng(self.number)
        self._seq = 0
        self._id = f"robot-{self.number}"

    async def play(self) -> None:
        while not self.over.is_set() and not self.tally.wrong:
            # The possible memories: (steps, state). Several if steps were given up.
            self._places: list[tuple[int, State | None]] = [(0, None)]
            length = self._draw.randrange(2, 20)
            for step in range(length):
                if not await self._step(begins=step == 0, ends=step == length - 1):
                    break
            self.tally.episodes += 1
        await self.connection.close()

    async def _step(self, *, begins: bool, ends: bool) -> bool:
        """Take a step; return whether the episode continues."""
        obs = self._rng.uniform(-1, 1, 3).astype(np.float32)
        steps = [(count, self.policy.step(obs, before=state)) for count, state in self._places]
        given_up_after_s = self._draw.choice([0.0015, 0.005, 0.02]) if self._draw.random() < 0.1 else LONG_S
        choice = self._draw.choice(["again", "next", "abandon"])
        self._seq += 1
        began = time.monotonic()
        while True:
            request = {
                "obs": obs.tolist(), "session_id": self._id, "reset": begins, "end": ends, "seq": self._seq,
            }  # fmt: skip
            try:
                action, count = await self._once(request, given_up_after_s)
                break
            except GivenUpError as error:
                if time.monotonic() - began > PATIENCE_S:
                    self.tally.wrong.append(f"no answer for {PATIENCE_S:g} s: {error}")
                    return False
                if given_up_after_s < LONG_S and choice != "again" and not begins and len(self._places) < 8:
                    self._places += [(count + 1, step.state) for count, step in steps]  # it may have been taken
                    return choice == "next"
                if begins:
                    self._id = f"robot-{self.number}-{self._seq}-{time.monotonic_ns()}"
                given_up_after_s = LONG_S
                await asyncio.sleep(0.05)
        self.tally.answered += 1
        fitting = [(was, step) for was, step in steps if was + 1 == count and _same(step.action, action)]
        if not fitting:
            expected = [(was + 1, step.action.tolist()) for was, step in steps]
            self.tally.wrong.append(f"{self._id}, request {self._seq}: step {count}, {action}; expected {expected}")
        self._places = [(was + 1, step.state) for was, step in fitting]
        return bool(fitting)

    async def _once(self, request: dict[str, Any], timeout_s: float) -> tuple[Any, int | None]:
        try:
            status, action, count = await asyncio.wait_for(self.connection.ask(request), timeout_s)
        except (OSError, EOFError, asyncio.TimeoutError) as error:
            self.tally.given_up += 1
            self.tally.errors[repr(error)[:60]] += 1  # for who reads the failure
            raise GivenUpError(repr(error)) from None
        self.tally.statuses[status] += 1
        if status not in (200, 503):
            self.tally.wrong.append(f"{self._id}, request {self._seq}: {status} {action}")
        if status != 200:
            raise GivenUpError(f"{status} {action}")
        return action, count


def _same(expected: Any, got: Any) -> bool:
    return np.array_equal(expected, np.asarray(got, expected.dtype))


async def play(connections: Sequence[Connection], bundle: Path, processes: Callable[[], list[int]], rest: int) -> Tally:
    """Let a robot play by each of the connections, through four disturbances with so many answers around each.

    One of the server's processes is killed, or stopped for a while.
    """
    tally, over = Tally(), asyncio.Event()
    with Policy.load(bundle) as policy:
        robots = [Robot(number, each, policy, tally, over) for number, each in enumerate(connections)]
        disturbing = asyncio.create_task(_disturb(tally, processes, rest))
        disturbing.add_done_callback(lambda _: over.set())
        try:
            await asyncio.gather(*(robot.play() for robot in robots))
        finally:
            disturbing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await disturbing
    return tally


async def _disturb(tally: Tally, processes: Callable[[], list[int]], rest: int) -> None:
    draw = random.Random(1)
    for how in ("kill", "stop", "kill", "stop", ""):
        until = tally.answered + rest
        while tally.answered < until:
            await asyncio.sleep(0.02)
        if not how:
            return
        pid = draw.choice(processes())
        with contextlib.suppress(ProcessLookupError):
            if how == "kill":
                os.kill(pid, signal.SIGKILL)
                continue
            os.kill(pid, signal.SIGSTOP)
            try:
                await asyncio.sleep(draw.choice([0.05, 0.3, 1.5, 2.5]))
            finally:
                os.kill(pid, signal.SIGCONT)
