"""Error classes of rlservo.

One table in `serve_app/protocols/error_statuses.py` maps these to status codes, and one handler in `deploy/cli.py` maps
them to exit codes.

    RlservoError                  error
    ├── CheckpointError           checkpoint-unreadable    not a checkpoint, damaged, or its code cannot be imported
    │   ├── AgentsDifferError     checkpoint-unreadable    its agents need a bundle each: one has to be named
    │   └── UnsupportedError      checkpoint-unsupported   readable, but cannot be exported faithfully
    ├── ParityError               parity-failed            the exported graph differs from RLlib's own actions
    ├── BundleError               bundle-invalid           missing, truncated or malformed bundle
    │   ├── BundleTamperedError   bundle-tampered          a file's hash differs from the recorded one
    │   └── GoldenMismatchError   golden-mismatch          this machine does not reproduce the golden vectors
    ├── UnknownPolicyError        unknown-policy
    │   └── UnknownVersionError   unknown-version
    ├── RequestError              bad-request              the request itself is malformed
    │   ├── StateNeededError      bad-request              ... and must carry state, which it does not
    │   ├── MediaTypeError        wrong-media-type
    │   └── TooLargeError         too-large
    ├── ObservationError          bad-observation          shape, dtype, non-finite or misnamed element
    ├── ActionError               unsafe-action            the policy produced an action that must not leave
    ├── DeadlineError             deadline-passed
    ├── ConflictError             conflict                 a change that contradicts what is served
    │   └── RefusedError              version-refused      a version or configuration that cannot be served
    ├── SessionError              session-conflict         a session's requests contradict each other
    │   └── SessionLostError      session-lost             the server has no such session (any more)
    ├── UnavailableError          unavailable              not ready, or the server cannot be reached
    │   ├── OverloadedError       over-capacity            the server is busy: try again
    │   ├── RateLimitError        rate-limited             the API key made more requests than it may
    │   ├── LateError             late                     the observation waited too long: send a newer one
    ├── InternalError             internal                 the server's own fault: see its log
    └── UsageError                bad-usage                an argument or the machine's state prevents the start
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar


class RlservoError(Exception):
    """An error with a sentence for people, a kebab-case code and details for programs."""

    code: ClassVar[str] = "error"

    def __init__(self, message: str, details: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.details: dict[str, Any] = dict(details or {})

    def prefix(self, place: str) -> None:
        """Put the place in front of the message; the error stays the same, for a bare `raise`."""
        self.message = f"{place}: {self.message}"
        self.args = (self.message,)


class CheckpointError(RlservoError):
    """The path holds no checkpoint that can be read."""

    code = "checkpoint-unreadable"


class AgentsDifferError(CheckpointError):
    """A module treats its `agents` differently, and none of them was named."""

    def __init__(self, message: str, agents: Sequence[str]) -> None:
        super().__init__(message, {"agents": list(agents)})
        self.agents = tuple(agents)


class UnsupportedError(CheckpointError):
    """The checkpoint can be read, but not exported without losing something."""

    code = "checkpoint-unsupported"


class NoNetworkError(UnsupportedError):
    """A module is a script, not a network."""


class ParityError(RlservoError):
    """The exported graph does not give RLlib's own actions; nothing was written."""

    code = "parity-failed"


class BundleError(RlservoError):
    """The path holds no usable policy bundle."""

    code = "bundle-invalid"


class BundleTamperedError(BundleError):
    """A bundle file's hash differs from the one recorded at export."""

    code = "bundle-tampered"


class GoldenMismatchError(BundleError):
    """The loaded graph does not reproduce the bundle's golden vectors on this machine."""

    code = "golden-mismatch"


class UnknownPolicyError(RlservoError):
    """No policy of that name is loaded."""

    code = "unknown-policy"


class UnknownVersionError(UnknownPolicyError):
    """The policy is loaded, but not in that version."""

    code = "unknown-version"


class RequestError(RlservoError):
    """The request cannot be understood."""

    code = "bad-request"


class StateNeededError(RequestError):
    """The policy has memory, and the request carries none of it.

    A client may not know that in advance: the limit on an action's step is set on the server. Clients get a
    `bad-request` with these details.
    """

    DETAILS: ClassVar[Mapping[str, str]] = {"send": "state"}

    def __init__(self, message: str, details: Mapping[str, Any] | None = None) -> None:
        super().__init__(message, {**(details or {}), **self.DETAILS})

    @classmethod
    def is_described_by(cls, details: Mapping[str, Any]) -> bool:
        return details.items() >= cls.DETAILS.items()


class MediaTypeError(RequestError):
    """The body is not of a type this endpoint reads."""

    code = "wrong-media-type"


class TooLargeError(RequestError):
    """The body exceeds the configured size."""

    code = "too-large"


class ObservationError(RlservoError):
    """The observation does not fit the policy's contract."""

    code = "bad-observation"


class ActionError(RlservoError):
    """The policy's action is not finite or not in the action space."""

    code = "unsafe-action"


class DeadlineError(RlservoError):
    """The answer could not have arrived in time, so the work was not done."""

    code = "deadline-passed"


class SessionError(RlservoError):
    """The request does not fit its session's state."""

    code = "session-conflict"


class SessionLostError(SessionError):
    """The server does not know the session: its memory is gone, and only a new episode can follow."""

    code = "session-lost"


class UnavailableError(RlservoError):
    """The server is not ready, over capacity, or out of reach."""

    code = "unavailable"
    retry_after_s: float | None = None  # [s] after which to ask the server again, if it gave a time


class OverloadedError(UnavailableError):
    """The server is at capacity; nothing was computed."""

    code = "over-capacity"


class RateLimitError(UnavailableError):
    """The API key has made more requests than its line allows; nothing was computed."""

    code = "rate-limited"

    def __init__(self, message: str, details: Mapping[str, Any] | None = None, *, key: str = "") -> None:
        """`key` is the label of the API key, if there was one."""
        super().__init__(message, {"key": key, **(details or {})} if key else details)
        self.key = key


class LateError(UnavailableError):
    """The observation waited too long to count as fresh; nothing was computed."""

    code = "late"


class ConflictError(RlservoError):
    """The change contradicts the versions served now."""

    code = "conflict"


class RefusedError(ConflictError):
    """A version or a configuration cannot be served, so what ran before continues."""

    code = "version-refused"


class InternalError(RlservoError):
    """The server failed through a fault of its own."""

    code = "internal"


class UsageError(RlservoError):
    """An argument, or something already running on the machine, prevents the start."""

    code = "bad-usage"


class UnauthenticatedError(RlservoError):
    """The request carries no key, or one that is not known."""

    code = "unauthenticated"


class ForbiddenError(RlservoError):
    """The key, or the page the request comes from, may not do this."""

    code = "forbidden"

    def __init__(self, message: str, details: Mapping[str, Any] | None = None, *, key: str = "") -> None:
        """`key` is the label of the API key, if there was one."""
        super().__init__(message, {"key": key, **(details or {})} if key else details)
        self.key = key


_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def quoted(names: Iterable[str]) -> str:
    """Return names for a sentence, each in quotes."""
    return ", ".join(f"'{name}'" for name in names)


def first_line(error: BaseException) -> str:
    """Return the first line of an exception's text without colours, with its type if the text alone says little."""
    text = (_COLOURS.sub("", str(error)).strip() or type(error).__name__).splitlines()[0][:300]
    return f"{type(error).__name__}: {text}" if isinstance(error, LookupError) else text
