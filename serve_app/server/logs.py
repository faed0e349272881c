"""Log of requests and of administration: a line of JSON per event, never with observations or keys.

Requests that fail are always written, with their code; `log_requests` adds those that succeed, `log_values` adds error
messages, which may quote observations. Each command of administration, carried out or refused, goes to the logger
`rlservo.administration`, regardless of the log's level, and to the settings' `audit_file`.
"""

from __future__ import annotations

import json
import logging
import time
from dataclasses import dataclass
from typing import Any

from rlservo.errors import UsageError
from rlservo.serve_app.server.access_checks import READING
from rlservo.serve_app.server.api_keys import without_keys
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.sessions.request import Request, trace_id
from rlservo.serve_app.versions.policy_store import Decision

LOGGER = "rlservo"
FIELDS = "fields"  # attribute of a record that holds its fields
LONGEST_ID = 128
LONGEST = 256  # characters of a text that a client chose
OK = "ok"
UNANSWERED = "unanswered"  # its client hung up, or the replica ended: the change may or may not have been made

_requests = logging.getLogger(f"{LOGGER}.requests")
administration = logging.getLogger(f"{LOGGER}.administration")


class JsonFormatter(logging.Formatter):
    """Writes a record as one JSON object on one line."""

    def __init__(self, replica: str = "") -> None:
        super().__init__()
        self._replica = replica

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line: dict[str, Any] = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if self._replica:
            line["replica"] = self._replica
        line.update(getattr(record, FIELDS, {}))
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure(settings: ServerSettings, *, replica: str = "") -> None:
    """Send this process's log as JSON to the settings' file or to standard error; administration also to its own file.

    Raises UsageError if a file cannot be written.
    """
    logger = logging.getLogger(LOGGER)
    logger.setLevel(settings.log_level.upper())
    logger.propagate = False
    administration.setLevel(logging.INFO)  # at any level of the log
    for each, what, file in ((logger, "log", settings.log_file), (administration, "audit", settings.audit_file)):
        for previous in list(each.handlers):
            each.removeHandler(previous)
            previous.close()
        if file is None and each is administration:
            continue
        try:
            handler = logging.StreamHandler() if file is None else logging.FileHandler(file)
        except OSError as error:
            raise UsageError(f"the {what} file {file} cannot be written: {error.strerror}") from None
        handler.setFormatter(JsonFormatter(replica))
        each.addHandler(handler)


def write_answer(request: Request, decision: Decision, seconds: float) -> None:
    """Write a request that got its action."""
    fields = _fields(request, decision.name, decision.version, OK, seconds)
    fields["batch"] = decision.batch or 1
    _requests.info("answered", extra={FIELDS: fields})


def write_failure(request: Request, code: str, sentence: str | None) -> None:
    """Write a request that got no action, with an error's sentence if values may be logged."""
    if not _requests.isEnabledFor(logging.INFO):
        return
    version = request.version and request.version[:32]
    fields = _fields(request, request.policy[:64], version, code, time.perf_counter() - request.received)
    if request.peer is not None:
        fields["peer"] = request.peer
    if sentence is not None:
        fields["error"] = sentence
    _requests.info("refused", extra={FIELDS: fields})


def _fields(request: Request, policy: str, version: str | None, code: str, seconds: float) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "request_id": request.request_id and without_keys(request.request_id[:LONGEST_ID]),
        "protocol": request.protocol,
        "policy": policy,
        "version": version,
        "code": code,
        "ms": round(seconds * 1e3, 3),
    }
    if (trace := trace_id(request.headers)) is not None:
        fields["trace_id"] = trace
    if request.stream_id is not None and request.seq is not None:
        fields["seq"] = request.seq
    return fields


@dataclass
class AuditEntry:
    """One request for administration and its outcome: the fields of its line, in which clients' texts are shortened."""

    method: str
    path: str
    peer: str | None
    request_id: str | None
    key: str = ""
    """The label of its key; empty if none was accepted."""
    command: str = ""
    policy: str = ""
    version: str | None = None
    change: str = ""
    """The command as a user would type it."""
    code: str = UNANSWERED
    """`ok`, or the error's code."""
    generation: int | None = None

    def write(self) -> None:
        """Write the line for a command; reading is not a command, unless it was refused."""
        if self.method in READING and self.code in (UNANSWERED, OK):
            return
        # A key sent in the wrong place does not reach the log.
        fields = {name: without_keys(v[:LONGEST]) if isinstance(v, str) else v for name, v in vars(self).items()}
        administration.info("changed" if self.code == OK else "refused", extra={FIELDS: fields})
