"""Log of requests and of administration: a line of JSON per event, never with observations or keys.

Requests that fail are always written, with their code; `log_requests` adds those that succeed, `log_values` adds error
messages, which may quote observations. Each command of administration, carried out or refused, goes to the logger
`rlservo.administration`, regardless of the log's level, and to the settings' `audit_file`.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from dataclasses import dataclass
from typing import Any

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.episodes.request import Request
from rlservo.serve_app.server.api_keys import without_keys
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import Decision

LOGGER = "rlservo"
FIELDS = "fields"  # attribute of a record that holds its fields
LONGEST_ID = 128

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
    """Send this process's log as JSON to the settings' file or to standard error. Raises UsageError."""
    handler: logging.Handler
    handler = logging.StreamHandler(sys.stderr) if settings.log_file is None else logging.FileHandler(settings.log_file)
    handler.setFormatter(JsonFormatter(replica))
    logger = logging.getLogger(LOGGER)
    for previous in list(logger.handlers):
        logger.removeHandler(previous)
        previous.close()
    logger.addHandler(handler)
    logger.setLevel(settings.log_level.upper())
    logger.propagate = False
    _log_administration(settings, replica)


def _log_administration(settings: ServerSettings, replica: str) -> None:
    """Log administration at any log level, and to the audit file if there is one."""
    administration.setLevel(logging.INFO)
    for previous in list(administration.handlers):
        administration.removeHandler(previous)
        previous.close()
    if settings.audit_file is not None:
        try:
            handler = logging.FileHandler(settings.audit_file)
        except OSError as error:
            raise UsageError(f"the audit file {settings.audit_file} cannot be written: {error.strerror}") from None
        handler.setFormatter(JsonFormatter(replica))
        administration.addHandler(handler)


class RequestLog:
    """Writes the outcome of requests."""

    def __init__(self, settings: ServerSettings) -> None:
        self.every = settings.log_requests
        self._values = settings.log_values

    def write_answer(self, request: Request, decision: Decision, seconds: float) -> None:
        """Write a request that got its action; check `every` first."""
        fields = _fields(request, decision.name, decision.version, "ok", seconds)
        fields["batch"] = decision.batch or 1
        _requests.info("answered", extra={FIELDS: fields})

    def write_failure(self, request: Request, code: str, sentence: str) -> None:
        """Write a request that got no action."""
        if not _requests.isEnabledFor(logging.INFO):
            return
        version = request.version and request.version[:32]
        fields = _fields(request, request.policy[:64], version, code, time.perf_counter() - request.received)
        if request.peer is not None:
            fields["peer"] = request.peer
        if self._values:
            fields["error"] = sentence
        _requests.info("refused", extra={FIELDS: fields})


def _fields(request: Request, policy: str, version: str | None, code: str, seconds: float) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "request_id": _shorten(request.request_id),
        "protocol": request.protocol,
        "policy": policy,
        "version": version,
        "code": code,
        "ms": round(seconds * 1e3, 3),
    }
    if request.stream_id is not None and request.seq is not None:
        fields["seq"] = request.seq
    return fields


def _shorten(request_id: str | None) -> str | None:
    return request_id and without_keys(request_id[:LONGEST_ID])


OK = "ok"
UNANSWERED = "unanswered"  # its client hung up, or the replica ended: the change may or may not have been made
LONGEST = 256  # characters of a text that a client chose


@dataclass
class AuditEntry:
    """One request and its outcome."""

    method: str
    path: str
    peer: str | None
    request_id: str | None
    is_administration: bool = False
    key: str = ""
    """The label of its key; empty if none was accepted."""
    command: str = ""
    policy: str = ""
    version: str | None = None
    change: str = ""
    """The command as a user would type it."""
    code: str = ""
    """`ok`, or the error's code."""
    generation: int | None = None

    def write(self) -> None:
        """Write the line for a command; reading is not a command, unless it was refused."""
        if not self.is_administration or (self.method in ("GET", "HEAD", "OPTIONS") and self.code in ("", OK)):
            return
        code = self.code or UNANSWERED
        fields: dict[str, Any] = {
            "request_id": None if self.request_id is None else _safe(self.request_id[:LONGEST_ID]),
            "method": self.method,
            "path": _safe(self.path),
            "command": self.command,
            "policy": _safe(self.policy),
            "version": None if self.version is None else _safe(self.version),
            "change": _safe(self.change.strip()),
            "code": code,
            "key": self.key,
            "peer": self.peer,
        }
        if self.generation is not None:
            fields["generation"] = self.generation
        administration.info("changed" if code == OK else "refused", extra={FIELDS: fields})


def _safe(text: str) -> str:
    """Return a client's text, shortened; a key sent in the wrong place does not reach the log."""
    return without_keys(text[:LONGEST])
