"""Two servers with two workers each, and operators, over one repository: following, conflicts, a killed worker."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rlservo.client.admin_client import AdminClient
from rlservo.client.formats.admin_key_file import read_key
from rlservo.errors import ConflictError
from servers import Run, ask, launched
from waiting import wait_for

pytestmark = [pytest.mark.serve, pytest.mark.slow]

OBS = [round(0.01 * i, 2) for i in range(27)]
RLSERVO = [sys.executable, "-m", "rlservo.deploy.cli"]


@pytest.fixture
def repository(policies: Path, tmp_path: Path) -> Path:
    """ur5 in 1, 2 and 10."""
    return Path(shutil.copytree(policies / "ur5", tmp_path / "policies" / "ur5")).parent


@pytest.fixture
def servers(repository: Path) -> Iterator[list[Run]]:
    settings = {"plan": str(repository)}
    with contextlib.ExitStack() as stack:
        runs = [
            stack.enter_context(launched(repository, workers=2, with_admin_key=True, settings=settings))
            for _ in range(2)
        ]
        for run in runs:
            run.wait_until_ready()
        yield runs


def listings(run: Run) -> dict[str, dict[str, Any]]:
    """Return what each worker serves, by its name."""
    found: dict[str, dict[str, Any]] = {}
    deadline = time.monotonic() + 30
    while len(found) < 2:
        listing = ask(run.port, "GET", "/v1/policies")[1]
        found[listing["replica"]] = listing
        assert time.monotonic() < deadline
    return found


def defaults(run: Run) -> set[str]:
    return {listing["policies"][0]["version"] for listing in listings(run).values()}


def admin(run: Run) -> AdminClient:
    assert run.key_file is not None
    return AdminClient(f"http://127.0.0.1:{run.port}", api_key=read_key(run.key_file))


def test_every_worker_of_every_server_follows_whoever_changed_the_plan(servers: list[Run], repository: Path) -> None:
    assert [defaults(run) for run in servers] == [{"10"}, {"10"}]
    with admin(servers[0]) as client:
        client.alias("ur5", "production", "2")
    wait_for(lambda: all(defaults(run) == {"2"} for run in servers))
    done = subprocess.run(
        [*RLSERVO, "policy", "rollback", "ur5", "--repository", str(repository)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "default 10" in done.stdout and f"plan 3 in {repository}/.plan" in done.stdout
    wait_for(lambda: all(defaults(run) == {"10"} for run in servers))
    key_file, url = str(servers[0].key_file), f"http://127.0.0.1:{servers[0].port}"
    listed = [*RLSERVO, "policy", "list", "--json", "--url", url, "--key-file", key_file]

    def followed() -> dict[str, int]:
        said = subprocess.run(listed, capture_output=True, text=True, check=True).stdout
        return {process["replica"]: process["generation"] for process in json.loads(said)}

    wait_for(lambda: followed() == dict.fromkeys(listings(servers[0]), 3))  # workers share their metrics each second
    killed = int(next(iter(listings(servers[1]))))
    os.kill(killed, signal.SIGKILL)  # its successor comes up with the plan
    wait_for(lambda: str(killed) not in listings(servers[1]))
    assert {each["generation"] for run in servers for each in listings(run).values()} == {3}


def test_of_operators_that_race_through_two_servers_one_wins_each_time(servers: list[Run], repository: Path) -> None:
    won: list[tuple[int, str]] = []
    told: list[str] = []

    def operate(run: Run, version: str) -> None:
        with admin(run) as client:
            for _ in range(10):
                try:
                    reply = client.alias("ur5", "production", version)
                    won.append((reply["generation"], version))
                except ConflictError as error:
                    told.append(error.message)

    versions = ("1", "2", "10", "2")
    threads = [threading.Thread(target=operate, args=(servers[n % 2], version)) for n, version in enumerate(versions)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all("another command came first (plan" in sentence for sentence in told)
    plans = [json.loads(file.read_text()) for file in sorted((repository / ".plan").iterdir())]
    assert [plan["generation"] for plan in plans] == list(range(1, len(plans) + 1))
    production = {plan["generation"]: plan["policies"]["ur5"]["aliases"]["production"] for plan in plans}
    assert won and all(production[generation] == version for generation, version in won)
    last = production[len(plans)]
    wait_for(lambda: all(defaults(run) == {last} for run in servers))
