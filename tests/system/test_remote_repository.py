"""`rlservo serve s3://...`: versions published while it runs, and a restart while the storage is unreachable.

A second Ctrl-C ends that one at once, and nothing is left.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bundles import write_box_policy
from servers import ask, free_ports, running, wait_until_served
from storages import SECRET, Storage

pytestmark = [pytest.mark.serve, pytest.mark.slow]

OBS = [round(0.01 * i, 2) for i in range(27)]
RLSERVO = [sys.executable, "-m", "rlservo.deploy.cli"]


def test_published_versions_are_served_also_when_the_storage_is_away(storage: Storage, tmp_path: Path) -> None:
    from rlservo.bundle.bundle import load_bundle
    from rlservo.serve_app.repository.publication import publish

    publish(load_bundle(write_box_policy(tmp_path, version="1", seed=1)), storage.uri)
    (port,) = free_ports(1)
    log = tmp_path / "server.jsonl"
    runtime = tmp_path / "runtime"
    runtime.mkdir(mode=0o700)
    environment = {
        **storage.environment,
        "RLSERVO_PLAN": storage.uri,
        "XDG_RUNTIME_DIR": str(runtime),
        "RLSERVO_CACHE": str(tmp_path / "cache"),
        "RLSERVO_LOG_FILE": str(log),
    }
    command = [*RLSERVO, "serve", storage.uri, "--port", str(port)]

    def versions() -> list[str]:
        (policy,) = ask(port, "GET", "/v1/policies")[1]["policies"]
        return list(policy["versions"])

    with running(command, port, **environment) as run:
        wait_until_served(run)
        status, first = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})
        assert status == 200 and first["version"] == "1"
        publish(load_bundle(write_box_policy(tmp_path, version="2", seed=2)), storage.uri)
        loaded = subprocess.run(
            [*RLSERVO, "policy", "load", "ur5", "--repository", storage.uri],
            env=os.environ | environment, capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert loaded.returncode == 0, loaded.stderr
        deadline = time.monotonic() + 120
        while versions() != ["1", "2"] and time.monotonic() < deadline:
            time.sleep(0.2)
        assert versions() == ["1", "2"]
        again = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[1]
        assert (again["version"], again["action"]) == ("1", first["action"])  # loaded, and not in use
        seen = str(ask(port, "GET", "/v1/policies")[1]) + str(ask(port, "GET", "/metrics")[1])
        assert run.end(signal.SIGINT) in (0, 130)  # the command may not yet have seen that it is ready
    storage.go_away()
    with running([*command, "--alias", "ur5:production=1"], port, **environment) as run:
        wait_until_served(run)
        again = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[1]
        assert (again["version"], again["action"]) == ("1", first["action"])
        assert versions() == ["1", "2"]
        (run.key_file,) = (runtime / "rlservo").iterdir()  # the operator's; `end` asserts that it goes
        run.end(signal.SIGINT, signal.SIGINT)
    written = log.read_text() + seen
    assert "serving plan 2, the last one that was seen here" in written
    assert SECRET not in written
