"""One MCAP file that is being written: channels, JSON messages, one chunk per flush.

A file is readable to its last flush, even if its writer is killed. A message has two times: its log time follows the
monotonic clock from the file's start, so that plots never run backwards; its publish time is the wall clock's.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from mcap.writer import CompressionType, Writer

import rlservo
from rlservo.recording.policy_format import (
    DROPPED_SCHEMA,
    LeafArrays,
    PolicyFormat,
    decision_schema,
    json_rows,
    outcome_schema,
)
from rlservo.recording.records import DecisionRecord, OutcomeRecord

PROFILE = "rlservo"
CHUNK_BYTES = 256 * 1024
YIELD_EVERY = 8  # messages written before other threads get the interpreter
YIELD_S = 2e-5  # after a sleep of 0 this thread would get the interpreter back before a waiting one is awake
DROPPED_TOPIC = "/rlservo/dropped"


class LogFile:
    """An MCAP file that this process writes and locks: others may read it, but do not delete it."""

    def __init__(self, path: Path) -> None:
        """Create `path`, readable only by its owner. Raises OSError, FileExistsError if it exists."""
        self.path = path
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        fcntl.flock(descriptor, fcntl.LOCK_EX)  # released when the process ends, for whatever reason
        self._stream = os.fdopen(descriptor, "wb")
        self._wall_ns, self._monotonic_ns = time.time_ns(), time.monotonic_ns()
        self._channels: dict[tuple[PolicyFormat | None, str], int] = {}
        self._attached: set[str] = set()
        self._sequence = 0
        try:
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile=PROFILE, library=f"rlservo {rlservo.__version__}")
            started = {
                "host": socket.gethostname(),
                "pid": str(os.getpid()),
                "wall_ns": str(self._wall_ns),
                "rlservo": rlservo.__version__,
            }
            self._writer.add_metadata("rlservo", started)
            self.flush()  # from now on it is an MCAP file to every reader
        except BaseException:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        return self._stream.tell()

    @property
    def is_deleted(self) -> bool:
        """Whether the file has been deleted: later writes are lost."""
        return os.fstat(self._stream.fileno()).st_nlink == 0

    @property
    def age_s(self) -> float:
        return (time.monotonic_ns() - self._monotonic_ns) / 1e9

    def add_decision(self, record: DecisionRecord) -> None:
        """Write a decision, or one per row of a batch. Raises ValueError or RequestError if it does not fit."""
        policy, own, inputs = record.policy, record.own_action, record.dist_inputs
        columns = [_member("obs", policy.observations.encode_rows(record.obs))]
        for name, action in (
            ("action", record.action),
            ("commanded", record.commanded),
            ("last_action_input", record.last_action_input),
        ):
            if action is not None:
                columns.append(_member(name, policy.actions.encode_rows(action)))
        if own is not None and inputs is not None:
            columns.append(_member("own_action", policy.actions.encode_rows(LeafArrays(own))))
            columns.append([b'"dist_inputs":[%b]' % row for row in json_rows(inputs)])
            logp = policy.log_probability(inputs, own)
            if logp is not None:
                columns.append(_member("logp", json_rows(logp[:, None])))
        if record.reward_input is not None:
            columns.append(_rewards("reward_input", record.reward_input, len(columns[0])))
        self._add_rows("decision", record, columns, _details(record))

    def add_outcome(self, record: OutcomeRecord) -> None:
        """Write the outcome of a decision. Raises ValueError or RequestError if it does not fit."""
        policy, columns = record.policy, []
        if record.reward is not None:
            columns.append(_rewards("reward", record.reward, record.rows))
        if record.final_obs is not None:
            columns.append(_member("final_obs", policy.observations.encode_rows(record.final_obs)))
        if record.commanded is not None:
            columns.append(_member("commanded", policy.actions.encode_rows(record.commanded)))
        ending: dict[str, Any] = {
            "terminated": record.terminated or None,
            "truncated": record.truncated or None,
            "final_status": record.final_status,
            "robot": record.robot,
            "may_teach": None if record.may_teach else False,
        }
        self._add_rows("outcome", record, columns, _members(ending))

    def add_dropped(self, count: int) -> None:
        """Note that `count` records are missing at this place."""
        channel = self._channel(None, "dropped")
        self._sequence += 1
        now = time.time_ns()
        self._writer.add_message(channel, self._log_time(time.monotonic_ns()), b'{"count":%d}' % count, now)

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives this process."""
        self._writer.flush()

    def close(self) -> None:
        """Write the index and close."""
        try:
            self._writer.finish()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close without an index, after a failed write."""
        with contextlib.suppress(OSError):  # the writer tries once more to write its buffer
            self._stream.close()

    def _add_rows(
        self, kind: str, record: DecisionRecord | OutcomeRecord, columns: list[list[bytes]], shared: list[bytes]
    ) -> None:
        """Write a message for each row: its own members from `columns`, and the shared ones."""
        channel = self._channel(record.policy, kind)
        log_time = self._log_time(record.monotonic_ns)
        for row, members in enumerate(zip(*columns, strict=True) if columns else [()] * record.rows):
            head = _head(_row_episode(record.episode, row, record.rows), record.step)
            self._sequence += 1
            message = b"{%b}" % b",".join((head, *members, *shared))
            self._writer.add_message(channel, log_time, message, record.wall_ns, self._sequence % 2**32)
            if self._sequence % YIELD_EVERY == 0:
                time.sleep(YIELD_S)

    def _log_time(self, monotonic_ns: int) -> int:
        return max(0, self._wall_ns + monotonic_ns - self._monotonic_ns)

    def _channel(self, policy: PolicyFormat | None, kind: str) -> int:
        known = self._channels.get((policy, kind))
        if known is not None:
            return known
        if policy is None:
            schema, topic, metadata = DROPPED_SCHEMA, DROPPED_TOPIC, {}
        else:
            schema = decision_schema(policy) if kind == "decision" else outcome_schema(policy)
            topic = f"/{policy.title}/{kind}"
            metadata = {
                "policy": policy.contract.name,
                "version": policy.contract.version,
                "graph_sha256": policy.graph_hash,
                "contract_sha256": policy.contract_hash,
                "options": orjson.dumps(policy.options).decode(),
            }
            self._attach(policy)
        schema_id = self._writer.register_schema(str(schema["title"]), "jsonschema", orjson.dumps(schema))
        made = self._writer.register_channel(topic, "json", schema_id, metadata)
        self._channels[policy, kind] = made
        return made

    def _attach(self, policy: PolicyFormat) -> None:
        if policy.contract_hash not in self._attached:
            self._attached.add(policy.contract_hash)
            name = f"contracts/{policy.contract_hash}.json"
            now = time.time_ns()
            self._writer.add_attachment(now, now, name, "application/json", policy.contract_document)


def _head(episode: str, step: int) -> bytes:
    return b'"episode":%b,"step":%d' % (orjson.dumps(episode), step) if episode else b'"step":%d' % step


def _row_episode(episode: str, row: int, rows: int) -> str:
    return episode if rows == 1 or not episode else f"{episode}.{row}"


def _member(name: str, values: list[bytes]) -> list[bytes]:
    key = b'"%b":' % name.encode()
    return [key + value for value in values]


def _members(fields: dict[str, Any]) -> list[bytes]:
    """Return the fields that are not None as members of an object."""
    given = {name: value for name, value in fields.items() if value is not None}
    return [orjson.dumps(given)[1:-1]] if given else []


def _details(record: DecisionRecord) -> list[bytes]:
    """Return the fields that are the same for every row of a batch."""
    return _members(
        {
            "explore": record.explore or None,
            "latency_ms": None if record.latency_ms is None else round(record.latency_ms, 4),
            "seq": record.seq,
            "request_id": record.request_id,
            "trace_id": record.trace_id,
            "warnings": list(record.warnings) or None,
            "error": record.error,
        }
    )


def _rewards(name: str, reward: Any, rows: int) -> list[bytes]:
    """Return one reward per row, from one for each, or one for all."""
    rewards = np.broadcast_to(np.ravel(np.asarray(reward, np.float64)), rows)
    return _member(name, json_rows(np.ascontiguousarray(rewards)[:, None]))
