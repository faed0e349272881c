"""Checks of a running cluster, by a child process that connects to it (`cluster_probe.py`)."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import IO, Any

import rlservo
from rlservo.export.contract.errors import UnavailableError, UsageError
from rlservo.serve_app.ray_serve.environment import CLUSTER, HAPROXY_BINARY

NOTICE_PERIOD_S = 5.0  # between notices of what is waited for
LONGEST_S = 90.0  # without a report: a step's own bounds are shorter


@dataclass(frozen=True)
class Check:
    """Result of one check of the cluster."""

    name: str
    ok: bool
    message: str
    """What is there; of a problem also what to do."""


def check_cluster(
    address: str | None = None,
    *,
    configuration: Path | None = None,
    own: Sequence[str] = (),
    on_wait: Callable[[str], None] = lambda _: None,
) -> Iterator[Check]:
    """Yield the checks of the cluster at host:port (or RAY_ADDRESS, or this machine's), as they are done.

    `configuration` is a serve.yaml whose policy folders are looked for on every node, instead of those of what is
    deployed. `own` names variables to which the cluster gives values of its own. Raises UnavailableError where the
    cluster does not answer, UsageError.
    """
    if unknown := [name for name in own if name not in CLUSTER]:
        raise UsageError(f"'{unknown[0]}' is not one of the cluster's variables: {', '.join(CLUSTER)}")
    if address is not None and "://" in address:
        raise UsageError(f"'{address}' is a client's address: give the head node's HOST:PORT, and run this on a node")
    plan = {
        "address": address,
        "variables": {name: value for name, value in CLUSTER.items() if name not in own},
        "any_value": [HAPROXY_BINARY, *own],
        "versions": {
            "Python": "{}.{}".format(*sys.version_info),
            "Ray": metadata.version("ray"),
            "rlservo": rlservo.__version__,
        },
        "policies": [] if configuration is None else read_policies(configuration),
    }
    command = [sys.executable, "-m", "rlservo.serve_app.ray_serve.cluster_probe", json.dumps(plan)]
    with tempfile.TemporaryFile("w+") as log:
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True)
        assert child.stdin is not None and child.stdout is not None
        try:
            yield from _reports(child.stdout, log, on_wait)
        finally:
            child.kill()
            child.wait()
            child.stdin.close()


def read_policies(configuration: Path) -> list[str]:
    """Return the policy folders that a serve.yaml names. Raises UsageError."""
    import yaml

    try:
        document = yaml.safe_load(configuration.read_text())
        return [str(folder) for each in document["applications"] for folder in each["args"]["policies"]]
    except (KeyError, TypeError, UnicodeDecodeError, yaml.YAMLError):
        raise UsageError(f"{configuration}: expected 'applications' with 'args' and their 'policies'") from None


def _reports(stdout: IO[str], log: IO[str], on_wait: Callable[[str], None]) -> Iterator[Check]:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        with stdout:
            for line in stdout:
                lines.put(line)
        lines.put("")

    threading.Thread(target=read, daemon=True).start()
    waits, since = "Ray", time.monotonic()
    while True:
        try:
            line = lines.get(timeout=NOTICE_PERIOD_S)
        except queue.Empty:
            waited = time.monotonic() - since
            if waited > LONGEST_S:
                raise UnavailableError(f"no answer within {waited:.0f} s: {waits}") from None
            on_wait(f"waiting for {waits} ({waited:.0f} s)")
            continue
        if not line:
            log.seek(0)
            output = log.read().strip().splitlines() or ["without a word"]
            raise UnavailableError(f"Ray gave up while waiting for {waits}: {output[-1]}")
        since = time.monotonic()
        message: dict[str, Any] = json.loads(line)
        if "error" in message:
            raise UnavailableError(f"no answer from {waits}: {message['error']}")
        if "done" in message:
            return
        if "waits" in message:
            waits = message["waits"]
        else:
            yield Check(message["check"], message["ok"], message["message"])
