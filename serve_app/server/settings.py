"""Settings of the server: one class, one environment prefix, a sentence under each field.

`RLSERVO_MAX_BODY_BYTES=1000000 rlservo serve ...` sets one. Nothing here is read at import.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from typing_extensions import Self

from rlservo.errors import UsageError
from rlservo.policy.options import PolicyOptions

PREFIX = "RLSERVO_"
MEMORY = "memory"  # this process's memory, where sessions are kept by default


class ServerSettings(BaseModel):
    """Settings of a policy server."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    threads: int = Field(1, ge=1, le=256)
    """onnxruntime threads per policy; one is fastest for networks of kilobytes and keeps concurrent requests apart."""

    max_body_bytes: int = Field(4 << 20, ge=1024)
    """A larger request body is refused with 413 before all of it is read. A request for actions that is larger than
    `max_batch` observations of its policy need is refused unparsed."""

    max_batch: int = Field(4096, ge=1)
    """More observations in one request are refused with 413: the event loop computes a batch in one go."""

    body_timeout_s: float = Field(2.0, gt=0, allow_inf_nan=False)
    """[s] A client that takes longer to send its body gets 408 (embedded server; on a cluster, nginx or an Ingress must
    do this)."""

    max_ongoing_requests: int = Field(128, ge=1)
    """Largest number of requests that may wait for one process; further ones get 503 immediately."""

    max_queue_ms: float = Field(1000.0, gt=0, allow_inf_nan=False)
    """[ms] Requests that have waited longer get 503 and are not computed."""

    max_incoming: int = Field(512, ge=1)
    """Largest number of requests per process whose body is still being sent."""

    max_streams: int = Field(256, ge=1)
    """Largest number of streams (WebSocket, gRPC) that may be open, per process."""

    max_connections_per_address: int = Field(1024, ge=0)
    """Largest number of connections from one client address to a process of the embedded server, of 4096 in
    total; further ones get 429, or are closed at once if they are many. 0: no bound, for a server behind a proxy."""

    trusted_proxies: str = ""
    """Addresses, separated by commas, of proxies in front of the embedded server whose `X-Forwarded-For` names the
    client, for the log and the bound above; none by default."""

    stream_idle_s: float = Field(300.0, gt=0, allow_inf_nan=False)
    """[s] A stream (WebSocket, gRPC) that was silent for this long is closed."""

    api_keys_file: str | None = None
    """File with the hashes of the API keys, one per line: `<label> <act|explore|admin> sha256:<hash>`; `rlservo key`
    makes the lines."""

    api_keys: str = Field("", repr=False)
    """The same lines, separated by commas, for setups where a variable is easier than a file."""

    operator_key: str = Field("", repr=False, pattern=r"^(sha256:[0-9a-f]{64})?$")
    """`sha256:<hash>` of a key for administration; unlike `api_keys`, it does not make other clients need a key."""

    allow_unauthenticated: bool = False
    """Accept requests from other machines without any key: anyone who can reach the port can request actions."""

    allowed_hosts: str = ""
    """Names, separated by commas, that requests may use for this server besides `localhost`, its own address and, if
    other machines can reach it, any address and the machine's name; `*` allows any. A server with API keys that other
    machines can reach accepts any name unless some are given here: a web page has no key."""

    default_policy: str | None = None
    """Policy of a WebSocket at `/`, where openpi's clients connect; by default the only policy. Also set by
    `rlservo serve --default-policy`."""

    log_file: str | None = None
    """Append the log to this file; without one it goes to standard error, which Ray keeps in its session folder."""

    audit_file: str | None = None
    """Also append a line for every administrative command, carried out or refused, to this file. All processes of a
    machine append to the same one."""

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest log level; `info` includes every request that got no action."""

    log_requests: bool = False
    """Also log every request that got its action; a line costs about as much time as the policy."""

    log_values: bool = False
    """Log error messages, which may quote observations."""

    tracing: bool = False
    """Send a span of each request to OpenTelemetry's collector (`OTEL_EXPORTER_OTLP_ENDPOINT`; extra `tracing`), within
    the client's trace if it sent `traceparent`."""

    session_store: str = Field(MEMORY, repr=False)  # the URL may hold a password
    """Storage of sessions that clients name by id: `memory` of the process, or for several workers or replicas
    `redis://[USER:PASSWORD@]HOST:PORT/DATABASE` (`rediss://` with TLS, `unix://` for a socket). Each server needs a
    database of its own. Also set by `rlservo serve --session-store`."""

    max_sessions: int = Field(1024, ge=1)
    """Largest number of episodes that one process remembers at once, in sessions and on streams (each row of a
    batch is one); further ones get 503."""

    session_idle_s: float = Field(300.0, gt=0, allow_inf_nan=False)
    """[s] A session without a step for this long is forgotten; a stream keeps its episode while it is open."""

    policy_options: dict[str, PolicyOptions] = {}
    """Options of each policy, by policy name; '*' is for the others. The variable takes a JSON object."""

    record: str | None = None
    """Record every decision into this folder, except for policies with the option `"record": false`. Off by default, as
    observations may be private. Also set by `rlservo serve --record`."""

    record_bytes: int = Field(10 << 30, ge=4 << 20)
    """Beyond this size the oldest recordings in the folder are deleted. Each has at most 256 MB, and at most a quarter
    of this."""

    max_policy_bytes: int = Field(512 << 20, ge=1024)
    """A larger policy.onnx (or policy.ts) is refused before it is read. Loading takes about twice its size."""

    require_signature: str | None = None
    """Serve only bundles with a signature (`rlservo sign`) by a key of this folder: public keys, or certificates of
    issuers, in `*.pem` files. It is read at each load, so keys can be added and removed while serving; what is loaded
    stays. Also set by `rlservo serve --require-signature`."""

    plan: str | None = None
    """Folder or URI whose `.plan` holds the aliases, canaries and shadows. By default the first policy folder
    that is writable, else the user's state folder (`$XDG_STATE_HOME/rlservo`)."""

    load_timeout_s: float = Field(30.0, gt=0, allow_inf_nan=False)
    """[s] Time limit for listing policies, loading and proving one version, and reading or writing the plan: a file
    system or storage may hang. One call to object storage may take half of it."""

    cache: str | None = None
    """Local folder for versions fetched from remote repositories (`rlservo serve s3://...`); replicas share it. By
    default `$XDG_CACHE_HOME/rlservo/bundles`, else the same below `~/.cache`."""

    cache_bytes: int = Field(10 << 30, ge=1 << 20)
    """Largest size of the cache: the least recently used versions are removed, never those in use."""

    poll_s: float | None = Field(None, ge=1, allow_inf_nan=False)
    """[s] How often to look for new versions of policies and load them, as `rlservo policy load` does: ready but
    not in use. Off by default. Also set by `rlservo serve --poll`."""

    @field_validator("api_keys_file", "audit_file", "log_file", "record", "cache", "require_signature")
    @classmethod
    def _absolute(cls, value: str | None) -> str | None:
        """A replica's working directory is not the caller's."""
        return None if value is None else str(Path(value).expanduser().absolute())

    @field_validator("allowed_hosts")
    @classmethod
    def _names(cls, value: str) -> str:
        for name in value.split(","):
            if re.fullmatch(r"\s*(\*|\[?[A-Za-z0-9._:-]+\]?)?\s*", name) is None:
                raise ValueError(f"expected names without scheme or path, such as robot-7.local, got {name[:80]!r}")
        return value

    @field_validator("session_store")
    @classmethod
    def _store(cls, value: str) -> str:
        if value != MEMORY and not value.startswith(("redis://", "rediss://", "unix://")):
            raise ValueError("expected memory, or a URL such as redis://127.0.0.1:6379/0")
        return value

    @field_validator("policy_options", mode="before")
    @classmethod
    def _parse(cls, value: Any) -> Any:
        return json.loads(value) if isinstance(value, str) else value

    @classmethod
    def from_environment(
        cls, given: Mapping[str, Any] | None = None, *, environment: Mapping[str, str] | None = None
    ) -> Self:
        """Return settings from `given`, then `RLSERVO_*` of the environment, then the defaults.

        Variables of other parts of rlservo share the prefix and are ignored. Raises UsageError.
        """
        given = given or {}
        environment = os.environ if environment is None else environment
        values: dict[str, Any] = {
            name: environment[PREFIX + name.upper()]
            for name in cls.model_fields
            if PREFIX + name.upper() in environment
        }
        values.update(given)
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            name = str(first["loc"][0]) if first["loc"] else "settings"
            source = PREFIX + name.upper() if name in values and name not in given else f"the setting '{name}'"
            path = ".".join(map(str, first["loc"][1:]))
            inside = f" at '{path}'" if path else ""
            known = ", ".join(PolicyOptions.model_fields if inside else cls.model_fields)
            hint = f"; known: {known}" if first["type"] == "extra_forbidden" else ""
            field = cls.model_fields.get(name)
            given_text = "" if field is not None and not field.repr else f" (given: {first['input']!r:.80})"
            raise UsageError(
                f"{source} is not usable{inside}: {first['msg'].removeprefix('Value error, ')}{given_text}{hint}"
            ) from None  # it may be a key
