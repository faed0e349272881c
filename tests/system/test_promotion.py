"""`rlservo policy promote` against `rlservo serve` under load: killed, interrupted, and with another operator."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bundles import write_box_policy
from rlservo.client.admin_client import AdminClient
from rlservo.client.policy_client import PolicyClient
from rlservo.client.promotion_evidence import PLAN, read_metrics
from rlservo.errors import RlservoError
from servers import Run, free_ports, running, wait_until_served

pytestmark = [pytest.mark.serve, pytest.mark.slow]

OBS = np.full(27, 0.5, np.float32)
PATIENCE_S = 60
WORKERS = 2


@dataclass
class Server:
    """ur5 in 1, 2 (the same network) and 3 (its actions leave the space)."""

    run: Run
    key_file: Path

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.run.port}"

    @contextlib.contextmanager
    def admin(self) -> Iterator[AdminClient]:
        with AdminClient(self.url, api_key=self.key_file.read_text().strip()) as client:
            yield client

    def serves(self, production: str, canary: str | None) -> bool:
        """Wait until a worker that is asked serves these; the others follow within a second."""
        deadline = time.monotonic() + PATIENCE_S
        with self.admin() as admin:
            while time.monotonic() < deadline:
                (policy,) = admin.listing()["policies"]
                if (policy["version"], policy["canary"] and policy["canary"]["version"]) == (production, canary):
                    return True
                time.sleep(0.1)
        return False

    def wait_until_all_follow(self, plan: int) -> None:
        deadline = time.monotonic() + PATIENCE_S
        with self.admin() as admin:
            while [each[PLAN] for each in running_workers(admin).values()] != [plan] * WORKERS:
                assert time.monotonic() < deadline
                time.sleep(0.1)

    def workers(self) -> list[int]:
        with self.admin() as admin:
            return [int(pid) for pid in running_workers(admin)]


def running_workers(admin: AdminClient) -> dict[str, dict[str, float]]:
    """The numbers of each worker; those that have ended, whose counts stay for a while, have no plan."""
    return {pid: each for pid, each in read_metrics(admin.metrics(), "ur5").items() if PLAN in each}


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policies")
    for version, scale in (("1", 1.0), ("2", 1.0), ("3", 400.0)):
        write_box_policy(folder, version=version, action_scale=scale)
    return folder


@pytest.fixture(scope="module")
def shared(versions: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    (port,), runtime = free_ports(1), tmp_path_factory.mktemp("runtime")
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(versions), "--workers", str(WORKERS)]
    with running([*command, "--port", str(port)], port, XDG_RUNTIME_DIR=str(runtime)) as run:
        assert run.process.stdout is not None
        threading.Thread(target=list, args=(run.process.stdout,), daemon=True).start()  # so that the pipe never fills
        wait_until_served(run)
        (key_file,) = runtime.rglob("*.key")
        yield Server(run, key_file)


@pytest.fixture
def server(shared: Server) -> Server:
    """A server whose production is version 1, without a canary."""
    with shared.admin() as admin:
        admin.canary("ur5", None)
        plan = admin.alias("ur5", "production", "1")["generation"]
    shared.wait_until_all_follow(plan)
    return shared


@dataclass
class Load:
    """Answers that clients got."""

    versions: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


@contextlib.contextmanager
def loaded(server: Server, clients: int = 3) -> Iterator[Load]:
    """Ask without end, each client one short episode after the other."""
    load, stop = Load(), threading.Event()

    def ask() -> None:
        with PolicyClient(server.url, "ur5", timeout_s=5.0) as client:
            while not stop.wait(0.01):
                try:
                    client.reset()
                    client.act(OBS)
                    load.versions[client.last_reply["version"]] += 1
                except RlservoError as error:
                    load.failures.append(error.code)

    threads = [threading.Thread(target=ask) for _ in range(clients)]
    for thread in threads:
        thread.start()
    try:
        yield load
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@contextlib.contextmanager
def promoting(server: Server, log: Path, version: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Run `rlservo policy promote`, and end it where the test has not."""
    command = [sys.executable, "-m", "rlservo.deploy.cli", "policy", "promote", "ur5", version, "--log", str(log),
               "--canary", "50%", "--max-error-rate", "5%", "--max-p99", "1s", "--every", "1", "--min-requests", "30",
               "--url", server.url, "--key-file", str(server.key_file), *words]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def checks_of(log: Path) -> list[dict[str, Any]]:
    lines = log.read_text().splitlines() if log.exists() else []
    return [entry for line in lines if line.endswith("}") and (entry := json.loads(line))["event"] == "check"]


def wait_for_checks(process: subprocess.Popen[str], log: Path, count: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while len(checks_of(log)) < count:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)


def outcome_of(process: subprocess.Popen[str]) -> tuple[int, str]:
    said, _ = process.communicate(timeout=3 * PATIENCE_S)
    return process.returncode, said


def test_killed_half_way_and_started_again_it_promotes_and_no_client_sees_it(server: Server, tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    with loaded(server) as load:
        with promoting(server, log, "2", "--for", "8s") as process:
            wait_for_checks(process, log, 3)
            process.kill()
            process.wait()
        assert server.serves("1", "2")
        with promoting(server, log, "2", "--for", "8s") as process:
            code, said = outcome_of(process)
    assert code == 0 and said.startswith("promoted: version 2 of 'ur5': failed requests: 0 of"), said
    assert server.serves("2", None)
    assert load.failures == [] and load.versions["1"] > 30 < load.versions["2"]


def test_it_stops_when_another_operator_moves_the_alias(server: Server, tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    with loaded(server), promoting(server, log, "2", "--for", "10m") as process:
        wait_for_checks(process, log, 2)
        with server.admin() as admin:
            admin.alias("ur5", "production", "3")
        code, said = outcome_of(process)
    assert code == 4 and "production is 3 and no longer 1" in said, said
    assert server.serves("3", None)


def test_ctrl_c_ends_the_canary_and_sigterm_leaves_it(server: Server, tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    for number, code, left in ((signal.SIGTERM, 143, ("1", "2")), (signal.SIGINT, 130, ("1", None))):
        with promoting(server, log, "2", "--for", "10m") as process:
            wait_for_checks(process, log, len(checks_of(log)) + 1)
            process.send_signal(number)
            assert outcome_of(process)[0] == code
        assert server.serves(*left)


@pytest.mark.parametrize("number", [signal.SIGFPE, signal.SIGKILL])  # as onnxruntime dies of a division
def test_a_version_on_trial_whose_worker_dies_is_rolled_back(
    server: Server, tmp_path: Path, number: signal.Signals
) -> None:
    log = tmp_path / "log.jsonl"
    with loaded(server) as load, promoting(server, log, "2", "--for", "10m", "--every", "5") as process:
        wait_for_checks(process, log, 1)
        os.kill(server.workers()[0], number)  # and its successor is ready long before the next look
        code, said = outcome_of(process)
    assert code == 1 and f"1 of {server.url}'s workers died while version 2 was on trial" in said, said
    assert server.serves("1", None) and load.versions["2"] > 0


def test_workers_that_are_replaced_in_order_cost_no_promotion_and_lose_no_counts(
    server: Server, tmp_path: Path
) -> None:
    log = tmp_path / "log.jsonl"
    with loaded(server) as load, promoting(server, log, "2", "--for", "40s", "--every", "5") as process:
        wait_for_checks(process, log, 1)
        before = set(server.workers())
        server.run.process.send_signal(signal.SIGHUP)
        code, said = outcome_of(process)
        assert before - set(server.workers())
    assert code == 0, said
    assert server.serves("2", None)
    counted = int(re.findall(r"failed requests: 0 of ([0-9,]+)", said)[0].replace(",", ""))
    assert counted <= load.versions["2"]  # which goes on after the decision
    (last,) = [line for line in map(json.loads, log.read_text().splitlines()) if line["event"] == "decision"]
    answered = last["counts"]["total"]["rlservo_request_seconds_bucket/2/+Inf"]
    assert answered >= 0.9 * counted and load.failures == []


def test_a_server_of_one_process_that_dies_and_is_started_again_is_evidence(versions: Path, tmp_path: Path) -> None:
    repository, (port,) = Path(shutil.copytree(versions, tmp_path / "policies")), free_ports(1)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(repository), "--port", str(port),
               "--alias", "ur5:production=1"]  # fmt: skip
    runtime, plans = tmp_path / "runtime", str(tmp_path / "plans")
    runtime.mkdir()
    keys = {"RLSERVO_PLAN": plans, "XDG_RUNTIME_DIR": str(runtime)}
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(running(command, port, **keys))
        wait_until_served(first)
        (key_file,) = runtime.rglob("*.key")
        server, log = Server(first, key_file), tmp_path / "log.jsonl"
        with promoting(server, log, "2", "--for", "10m", "--every", "10") as process:
            wait_for_checks(process, log, 1)
            os.kill(first.processes("rlservo.deploy.cli serve")[0], signal.SIGFPE)
            first.process.wait(PATIENCE_S)
            again = stack.enter_context(running(command, port, **keys))
            wait_until_served(again)
            (server.key_file,) = runtime.rglob("*.key")
            code, said = outcome_of(process)
        assert code == 1 and "has started again while version 2 was on trial" in said, said
