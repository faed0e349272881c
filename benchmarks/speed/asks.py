"""Requests to a served policy over every protocol, each checking its own answer, for soak.py and faults.py.

An `Asker` is one client: a connection that is made when it is needed and dropped when anything went wrong on it. It
never asks twice by itself. `WrongError` is another answer than the policy's in process: worse than none.
"""

from __future__ import annotations

import gzip
import json
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.bundle import load_bundle
from rlservo.export.contract.errors import DeadlineError, RlservoError, SessionError, SessionLostError, UnavailableError
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.wire.msgpack_arrays import unpack
from speed.catalogue import Case, binary, plain
from speed.loads import GrpcLine, HttpLine, LoadError, WebSocketLine
from speed.rounds import session_of
from speed.servers import Exchange, Server

ROWS = 64
TOLERANCE = 1e-4  # of an action's element: a batch is computed in another order than a single observation


class WrongError(LoadError):
    """An answer that is not the policy's."""


class Line(Protocol):
    """A connection that asks one thing again and again."""

    def __call__(self) -> bytes: ...
    def close(self) -> None: ...


@dataclass
class Asker:
    """One client that asks one thing."""

    open: Callable[[], Line]
    check: Callable[[bytes], None]
    kept: bool = True
    """Whether the connection is used again."""
    line: Line | None = None

    def __call__(self) -> None:
        """Ask once. Raises LoadError or OSError, after which the next ask is on a new connection."""
        if self.line is None:
            self.line = self.open()
        try:
            self.check(self.line())
        except BaseException:
            self.close()
            raise
        if not self.kept or getattr(self.line, "ended", False):
            self.close()

    def close(self) -> None:
        if self.line is not None:
            self.line.close()
            self.line = None


def askers(case: Case, server: Server) -> dict[str, Callable[[], Asker]]:
    """Return what makes a client of each kind, by name."""
    name, port = case.name, server.port
    expected = session_of(case).run(["action"], {"obs": case.batch(ROWS)})[0]
    act = f"/v1/policies/{name}/act"
    rows = Exchange("POST", act, json.dumps({"obs": case.batch(ROWS).tolist()}).encode())
    tensor = {"name": "obs", "shape": [1, len(case.obs)], "datatype": "FP32", "data": case.obs.tolist()}
    oip = Exchange("POST", f"/v2/models/{name}/infer", json.dumps({"inputs": [tensor]}).encode())
    large = binary(case, ROWS)
    zipped = replace(large, body=gzip.compress(large.body, 1), headers=(*large.headers, ("Content-Encoding", "gzip")))

    def http(exchange: Exchange, check: Callable[[bytes], None], status: int = 200) -> Callable[[], Asker]:
        return lambda: Asker(lambda: HttpLine(port, exchange, status=status), check)

    def get(path: str, part: bytes) -> Callable[[], Asker]:
        return http(Exchange("GET", path, b""), lambda answer: holds(answer, part))

    def streamed(answer: bytes) -> None:
        same(unpack(answer)["actions"][0], case.action)

    made: dict[str, Callable[[], Asker]] = {
        "json": http(plain(case, act), lambda answer: same(json.loads(answer)["action"], case.action)),
        "json batch": http(rows, lambda answer: same(json.loads(answer)["action"], expected)),
        "json refused": http(
            Exchange("POST", act, b'{"obs": [1, 2]}'), lambda answer: holds(answer, b"bad-observation"), 422
        ),
        "oip json": http(oip, lambda answer: same(json.loads(answer)["outputs"][0]["data"], case.action)),
        "oip binary": http(large, lambda answer: same(raw(answer, expected), expected)),
        "oip compressed": http(zipped, lambda answer: same(raw(answer, expected), expected)),
        "websocket": lambda: Asker(lambda: open_stream(server), streamed),
        "websocket anew": lambda: Asker(lambda: open_stream(server), streamed, kept=False),
        "contract": get(f"/v1/policies/{name}", b"observation_space"),
        "metadata": get(f"/v2/models/{name}", b"onnx"),
        "metrics": get("/metrics", b"rlservo_requests_total"),
    }
    if (grpc_port := server.grpc_port) is not None:
        made["grpc"] = lambda: Asker(
            lambda: GrpcLine(grpc_port, name, case.obs[None]), lambda answer: holds(answer, case.action.tobytes())
        )
    return made


class Acting(Protocol):
    """What `PolicyClient` and `StreamClient` have in common."""

    last_reply: dict[str, Any]

    def act(self, obs: Any) -> Any: ...
    def reset(self) -> None: ...
    def close(self) -> None: ...


class Episode:
    """A client of a policy with a memory: plays an episode again and again, and checks every action of it.

    A memory that was begun anew in the middle of an episode gives other actions: that is what this looks for. A loss
    that the server tells is counted, and the episode begins anew.
    """

    def __init__(self, client: Acting, seen: Sequence[Any], expected: Sequence[Any], *, held: bool = False) -> None:
        """Play `seen`; `held`: the memory is the server's."""
        self._client, self._seen, self._expected, self._held = client, seen, expected, held
        self._step = 0
        self._is_doubtful = False  # whether the last try failed: its step may have been taken all the same
        self.told = 0
        """How often the server said that the memory is gone, or by `session_step` that it is ahead."""

    def __call__(self) -> None:
        """Take one step. Raises LoadError."""
        try:
            action = self._client.act(self._seen[self._step])
        except (SessionLostError, SessionError):
            self.told += 1
            self._begin()
            return
        except (UnavailableError, DeadlineError) as error:
            if isinstance(error, DeadlineError) and self._held:
                self._begin()  # the step may have been done, only its answer was late
            self._is_doubtful = True
            raise LoadError(f"{error.code}: {error.message}") from None
        except RlservoError as error:
            raise WrongError(f"{error.code}: {error.message}") from None
        doubtful, self._is_doubtful = self._is_doubtful, False
        if doubtful and self._held and self._client.last_reply.get("session_step") == self._step + 2:
            self.told += 1
            self._begin()
            return
        identical(action, self._expected[self._step])
        self._step += 1
        if self._step == len(self._seen):
            self._begin()

    def close(self) -> None:
        self._client.close()

    def _begin(self) -> None:
        self._client.reset()
        self._step = 0


@dataclass
class SessionsById:
    """Sessions as curl has them: ids in JSON without `seq`, all of them in turns, on a connection for each request."""

    port: int
    name: str
    seen: Sequence[Any]
    expected: Sequence[Any]
    count: int = 16
    told: int = 0
    """How often the server said that a session is gone, or by `session_step` that a step was taken after all."""

    def __post_init__(self) -> None:
        self._prefix = secrets.token_hex(4)
        self._steps = [0] * self.count
        self._next = 0
        self._last = [""] * self.count

    def __call__(self) -> None:
        """Take a step of the next session. Raises LoadError or OSError."""
        number, step = self._next, self._steps[self._next]
        body = {"obs": plain_values(self.seen[step]), "session_id": f"{self._prefix}-{number}", "reset": step == 0}
        connection = HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            connection.request(
                "POST", f"/v1/policies/{self.name}/act", json.dumps(body), {"Content-Type": "application/json"}
            )
            reply = connection.getresponse()
            status, answer = reply.status, json.loads(reply.read())
        except (OSError, HTTPException, ValueError) as error:
            self._steps[number] = 0  # the step may have been taken
            raise LoadError(f"{type(error).__name__}: {error}") from None
        finally:
            connection.close()
        if status == 410:
            self.told += 1
            self._steps[number] = 0
            return
        if status in (503, 504):
            self._steps[number] *= status == 503  # a 504 may have been computed
            self._last[number] = f"{status} {answer.get('code')}: {answer.get('error')}"
            raise LoadError(self._last[number])
        if status != 200:
            raise WrongError(f"{status} {answer}")
        if answer["session_step"] == step + 2 and self._last[number]:
            # The step that was answered 503 had been taken: the one thing that only a client with `seq` is spared.
            self.told += 1
            self._steps[number] = 0
            return
        self._last[number] = ""
        identical(answer["action"], self.expected[step])
        self._steps[number] = (step + 1) % len(self.seen)
        self._next = (number + 1) % self.count

    def close(self) -> None:
        """Leave the sessions to the server, which forgets them when they have been idle."""


def plain_values(obs: Any) -> Any:
    """Return an observation as JSON has it."""
    if isinstance(obs, dict):
        return {key: plain_values(value) for key, value in obs.items()}
    return np.asarray(obs).tolist()


def episode_of(bundle: Path, steps: int) -> tuple[list[Any], list[Any]]:
    """Return (observations, actions) of an episode in process, from the bundle's golden observations."""
    recorded = load_bundle(bundle).golden()[0]["obs"]
    seen = [recorded[step % len(recorded)] for step in range(steps)]
    with Policy.load(bundle) as policy:
        return seen, [policy.act(obs) for obs in seen]


def open_stream(server: Server) -> WebSocketLine:
    """Return a WebSocket that asks for one action."""
    assert server.stream is not None
    return WebSocketLine(server.port, server.stream, server.message, greets=server.greets)


def raw(answer: bytes, expected: NDArray[Any]) -> NDArray[Any]:
    """Return the tensor at the end of a binary answer."""
    return np.frombuffer(answer[-expected.nbytes :], expected.dtype).reshape(expected.shape)


def same(action: Any, expected: Any) -> None:
    """Raise WrongError unless the action is the expected one."""
    if not np.allclose(action, expected, atol=TOLERANCE):
        raise WrongError(f"a wrong action: {action}")


def identical(action: Any, expected: Any) -> None:
    """Raise WrongError unless the action is the expected one, bit by bit."""
    wanted = np.asarray(expected)
    if not np.array_equal(np.asarray(action, wanted.dtype), wanted):
        raise WrongError(f"a wrong action: {action} instead of {wanted.tolist()}")


def holds(answer: bytes, part: bytes) -> None:
    """Raise WrongError unless the answer has the part in it."""
    if part not in answer:
        raise WrongError(f"an answer without {part!r}: {answer[:200]!r}")
