"""One MCAP file being written: channels, JSON messages, a chunk each flush.

A file is readable to its last flush, whatever becomes of its writer. Times are two: a message's log time goes on with
the monotonic clock from the file's start, so that plots never run backwards, and its publish time is the wall clock's.
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
from rlservo.serve_app.recording.policy_format import (
    DROPPED_SCHEMA,
    NUMBERS,
    PolicyFormat,
    decision_schema,
    outcome_schema,
)
from rlservo.serve_app.recording.records import DecisionRecord, OutcomeRecord

PROFILE = "rlservo"
CHUNK_BYTES = 256 * 1024
YIELD_EVERY = 8  # messages written at a stretch before other threads get the interpreter
DROPPED_TOPIC = "/rlservo/dropped"


class LogFile:
    """An MCAP file that this process writes and holds a lock on: others may read it, and do not delete it."""

    def __init__(self, path: Path) -> None:
        """Create `path`, readable by its owner alone. Raises OSError, FileExistsError where it exists."""
        self.path = path
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        fcntl.flock(descriptor, fcntl.LOCK_EX)  # ends with the process, however that ends
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
        except BaseException:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        return self._stream.tell()

    @property
    def is_deleted(self) -> bool:
        """Whether nobody can open it any more: what is written is lost."""
        return os.fstat(self._stream.fileno()).st_nlink == 0

    @property
    def age_s(self) -> float:
        return (time.monotonic_ns() - self._monotonic_ns) / 1e9

    def add_decision(self, record: DecisionRecord) -> None:
        """Write a decision, of a batch one for each row. Raises ValueError or RequestError where it does not fit."""
        policy = record.policy
        observed = policy.observations.rows(record.obs)
        acted = None if record.action is None else policy.actions.rows(record.action)
        commanded = None if record.commanded is None else policy.actions.rows(record.commanded)
        last = None if record.last_action_input is None else policy.actions.rows(record.last_action_input)
        shared = self._shared(record)
        own, inputs = record.own_action, record.dist_inputs
        logp = None if own is None or inputs is None else policy.log_probability(inputs, own)
        for row, leaves in enumerate(observed):
            episode = _row_episode(record.episode, row, len(observed))
            parts = [_head(episode, record.step), b'"obs":' + policy.observations.encode(leaves)]
            if acted is not None:
                parts.append(b'"action":' + policy.actions.encode(acted[row]))
            if commanded is not None:
                parts.append(b'"commanded":' + policy.actions.encode(commanded[row]))
            if last is not None:
                parts.append(b'"last_action_input":' + policy.actions.encode(last[row]))
            if own is not None and inputs is not None:
                chosen = {name: leaf[row] for name, leaf in own.items()}
                parts.append(b'"own_action":' + policy.actions.encode(chosen))
                parts.append(b'"dist_inputs":' + orjson.dumps(inputs[row], option=NUMBERS))
            if logp is not None:
                parts.append(b'"logp":%b' % orjson.dumps(float(logp[row])))
            if record.reward_input is not None:
                parts.append(b'"reward_input":%b' % _row_reward(record.reward_input, row))
            self._add(policy, "decision", b"{" + b",".join([*parts, *shared]) + b"}", record)

    def add_outcome(self, record: OutcomeRecord) -> None:
        """Write what came of a decision. Raises ValueError or RequestError where it does not fit."""
        policy = record.policy
        observed = None if record.final_obs is None else policy.observations.rows(record.final_obs)
        commanded = None if record.commanded is None else policy.actions.rows(record.commanded)
        for row in range(record.rows):
            parts = [_head(_row_episode(record.episode, row, record.rows), record.step)]
            if record.reward is not None:
                parts.append(b'"reward":%b' % _row_reward(record.reward, row))
            if record.terminated:
                parts.append(b'"terminated":true')
            if record.truncated:
                parts.append(b'"truncated":true')
            if record.final_status is not None:
                parts.append(b'"final_status":%b' % orjson.dumps(record.final_status))
            if observed is not None:
                parts.append(b'"final_obs":' + policy.observations.encode(observed[row]))
            if commanded is not None:
                parts.append(b'"commanded":' + policy.actions.encode(commanded[row]))
            self._add(policy, "outcome", b"{" + b",".join(parts) + b"}", record)

    def add_dropped(self, count: int) -> None:
        """Mark that `count` records are missing before this place."""
        channel = self._channel(None, "dropped")
        self._sequence += 1
        now = time.time_ns()
        self._writer.add_message(channel, self._log_time(time.monotonic_ns()), b'{"count":%d}' % count, now)

    def flush(self) -> None:
        """Hand everything to the operating system: it survives this process."""
        self._writer.flush()

    def close(self) -> None:
        """Write the index and close."""
        try:
            self._writer.finish()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close without an index, where writing failed."""
        with contextlib.suppress(OSError):  # it tries once more to write what it still holds
            self._stream.close()

    def _shared(self, record: DecisionRecord) -> list[bytes]:
        """Return the fields that are the same for every row of a batch."""
        fields: dict[str, Any] = {
            "explore": record.explore or None,
            "latency_ms": None if record.latency_ms is None else round(record.latency_ms, 4),
            "seq": record.seq,
            "request_id": record.request_id,
            "warnings": list(record.warnings) or None,
            "error": record.error,
        }
        given = {name: value for name, value in fields.items() if value is not None}
        return [orjson.dumps(given)[1:-1]] if given else []

    def _add(self, policy: PolicyFormat, kind: str, message: bytes, record: DecisionRecord | OutcomeRecord) -> None:
        self._sequence += 1
        self._writer.add_message(
            self._channel(policy, kind),
            self._log_time(record.monotonic_ns),
            message,
            record.wall_ns,
            self._sequence % 2**32,
        )
        if self._sequence % YIELD_EVERY == 0:
            time.sleep(0)

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


def _row_reward(reward: Any, row: int) -> bytes:
    rewards = np.ravel(np.asarray(reward, np.float64))
    return orjson.dumps(float(rewards[row if len(rewards) > 1 else 0]))
