"""Audit of administration: a line of JSON for every command, carried out or refused. Never with a key in it.

Lines go to the logger `rlservo.administration`, whatever the log's level is, and to the settings' `audit_file`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rlservo.serve_app.server.api_keys import without_keys
from rlservo.serve_app.server.request_log import FIELDS, LONGEST_ID, administration

OK = "ok"
UNANSWERED = "unanswered"  # its client went, or the replica ended: a change may or may not have been made
LONGEST = 256  # characters of what a client chose


@dataclass
class AuditEntry:
    """One request, and what became of it."""

    method: str
    path: str
    peer: str | None
    request_id: str | None
    is_administration: bool = False
    key: str = ""
    """The label of its key; empty where none was accepted."""
    command: str = ""
    policy: str = ""
    version: str | None = None
    change: str = ""
    """The command as a person would write it."""
    code: str = ""
    """`ok`, or the error's."""
    generation: int | None = None

    def write(self) -> None:
        """Write the line, if it is for a command: what only reads is none, unless it was refused."""
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
    """Return a client's text, shortened; who sends a key in the wrong place does not find it in the log."""
    return without_keys(text[:LONGEST])
