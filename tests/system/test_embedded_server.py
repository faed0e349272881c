"""The embedded server: start, end, and workers that are killed, stopped and replaced under load."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from bundles import write_box_policy, write_slow_policy
from loads import CLIENTS, Load, busiest
from rlservo.errors import BundleError, UsageError
from rlservo.policy.policy import Policy
from rlservo.serve_app.engines.uvicorn_server import serve_policies
from servers import Run, ask, free_ports, launched, running, wait_until_served
from waiting import wait_for

OBS = [round(0.01 * i, 2) for i in range(27)]
PATIENCE_S = 120  # [s] on a busy machine


def test_arguments_and_bundles_are_checked_before_anything_starts(
    policies: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RLSERVO_PLAN", str(tmp_path / "plan"))  # other tests share the folder of policies
    (port,) = free_ports(1)
    with pytest.raises(BundleError, match="does not exist"):
        serve_policies([tmp_path / "nowhere"], port=port)
    with pytest.raises(UsageError, match="workers must be 1 or more"):
        serve_policies([policies], port=port, workers=0)
    with pytest.raises(UsageError, match="threads"):
        serve_policies([policies], port=port, settings={"threads": -1})
    with pytest.raises(UsageError, match="the default policy 'no' is not served"):
        serve_policies([policies], port=port, settings={"default_policy": "no"})
    with pytest.raises(UsageError, match="without API keys"):
        serve_policies([policies], port=port, host="0.0.0.0")


@pytest.mark.serve
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])  # SIGTERM ends `shipped_server` and `workers`
def test_a_server_that_is_ended_leaves_nothing(policies: Path, number: signal.Signals, workers: int) -> None:
    # With one process nothing is left that could remove the key's file: the next server replaces it.
    with_key = workers > 1 or number != signal.SIGKILL
    with launched(policies, workers=workers, with_admin_key=with_key, with_grpc=True) as run:
        run.wait_until_ready()
        assert run.key_file is None or run.key_file.exists()
        assert run.end(number) == (-signal.SIGKILL if number == signal.SIGKILL else 0)


@pytest.mark.serve
@pytest.mark.parametrize("is_ready", [True, False])
def test_workers_end_with_a_server_whose_terminal_is_gone(policies: Path, is_ready: bool) -> None:
    (port,) = free_ports(1)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(policies), "--workers", "2"]
    with running([*command, "--port", str(port)], port) as run:
        assert run.process.stdout is not None
        if is_ready:
            assert any(line.startswith("ready") for line in run.process.stdout)
        run.process.stdout.close()
        # Without a reader of its addresses it ends by itself; later it serves on, until it is told to end.
        assert run.end(*([signal.SIGTERM] if is_ready else [])) == (0 if is_ready else 1)


@pytest.mark.serve
def test_a_bundle_that_is_refused_ends_the_command_with_its_sentence(policies: Path, tmp_path: Path) -> None:
    for workers in ("1", "2"):
        command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(tmp_path), "--workers", workers]
        done = subprocess.run(
            [*command, "--port", "0"], capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert done.returncode != 0 and "Traceback" not in done.stderr
        assert str(tmp_path) in done.stderr


@pytest.mark.serve
def test_a_user_without_a_home_is_served(policies: Path) -> None:
    (port,) = free_ports(1)
    command = ["env", "-u", "HOME", "-u", "XDG_RUNTIME_DIR", "-u", "XDG_CACHE_HOME", sys.executable, "-m"]
    with running([*command, "rlservo.deploy.cli", "serve", str(policies), "--port", str(port)], port) as run:
        wait_until_served(run)
        assert ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 200
        assert run.end(signal.SIGINT) == 0


def test_too_few_open_files_are_said_before_the_start(policies: Path) -> None:
    command = ["sh", "-c", 'ulimit -n 40; exec "$@"', "sh", sys.executable, "-m", "rlservo.deploy.cli", "serve"]
    done = subprocess.run([*command, policies], capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert done.stderr == "rlservo: this process may open 40 files, a server needs 64: raise 'ulimit -n'\n"


@pytest.mark.serve
def test_few_open_files_are_a_warning_and_connections_wait(policies: Path) -> None:
    limit_by = ["sh", "-c", 'ulimit -n 256; exec "$@"', "sh"]
    (port,) = free_ports(1)
    command = [*limit_by, sys.executable, "-m", "rlservo.deploy.cli", "serve", str(policies), "--port", str(port)]
    with running(command, port) as run:
        wait_until_served(run)
        connections = []
        for _ in range(400):
            with contextlib.suppress(OSError):
                connections.append(socket.create_connection(("127.0.0.1", port), timeout=5))
        for connection in connections:
            connection.close()
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(OSError):
                if ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 200:
                    break
            assert time.monotonic() < deadline
            time.sleep(0.2)
        assert run.end(signal.SIGTERM) == 0
        assert run.process.stdout is not None
        assert "this process may open 256 files" in run.process.stdout.read()


@pytest.fixture(scope="module")
def workers(policies: Path) -> Iterator[tuple[Run, Load]]:
    expected = Policy.load(policies / "ur5" / "10").act(OBS)
    with launched(policies, workers=2, with_admin_key=True, with_grpc=True) as run:
        run.wait_until_ready()
        yield run, Load(run.port, "ur5", OBS, [np.asarray(expected)])
        assert run.end(signal.SIGTERM) == 0


@pytest.mark.serve
def test_a_port_that_is_taken_is_named_with_its_holder(policies: Path, workers: tuple[Run, Load]) -> None:
    run, _ = workers
    with pytest.raises(UsageError, match=rf"port {run.port} on 127.0.0.1 is in use by '.*' \(process \d+\)"):
        serve_policies([policies], port=run.port)
    assert ask(run.port, "GET", "/v2/health/ready")[0] == 200


def worker_pids(run: Run) -> list[int]:
    found = []
    for child in psutil.Process(run.process.pid).children():
        with contextlib.suppress(psutil.Error):  # it may have ended
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child.pid)
    return sorted(found)


@pytest.mark.serve
@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "noticed_s"),
    # The second is killed in a health check, which waits for it.
    [((signal.SIGKILL,), 15.0), ((signal.SIGSTOP, signal.SIGKILL), 15.0), ((signal.SIGSTOP,), 60.0)],
)
def test_a_worker_that_is_killed_or_stopped_is_replaced_under_load(
    workers: tuple[Run, Load], numbers: tuple[signal.Signals, ...], noticed_s: float
) -> None:
    run, load = workers
    before = worker_pids(run)
    assert len(before) == 2
    with load.run():
        time.sleep(1)
        for number in numbers:
            os.kill(before[0], number)
            time.sleep(1)
        load.pause_s = 0.1  # that a worker is stopped is noticed after 30 s
        wait_for(lambda: before[0] not in (now := worker_pids(run)) and len(now) == 2, timeout_s=noticed_s, poll_s=0.2)
        load.pause_s = Load.pause_s
        time.sleep(2)
    assert load.asked > 100 and load.wrong == 0
    # A stopped worker keeps its clients waiting up to their own time limit; then they ask another one.
    assert len(load.failures) <= (CLIENTS if signal.SIGSTOP in numbers else 0), load.failures
    load.failures.clear()


@pytest.mark.serve
@pytest.mark.slow
def test_sighup_replaces_every_worker_and_no_request_fails(workers: tuple[Run, Load]) -> None:
    run, load = workers
    before = worker_pids(run)
    with load.run():
        time.sleep(1)
        run.process.send_signal(signal.SIGHUP)
        wait_for(lambda: not set(before) & set(now := worker_pids(run)) and len(now) == 2, poll_s=0.2)
        time.sleep(1)
    assert load.asked > 100 and (load.wrong, load.failures) == (0, [])


@contextlib.contextmanager
def two_workers_of(program: str, policies: Path, folder: Path) -> Iterator[tuple[Run, list[str]]]:
    """A server, ready, of a program that changes a part of it, and the lines it has printed so far."""
    script = folder / "serve.py"
    script.write_text(program)
    (port,) = free_ports(1)
    command = [sys.executable, str(script), "serve", str(policies), "--port", str(port), "--workers", "2"]
    with running(command, port) as run:
        lines: list[str] = []
        threading.Thread(target=lines.extend, args=(run.process.stdout,), daemon=True).start()
        wait_for(lambda: any(line.startswith("ready") for line in lines), "the line that it is ready")
        yield run, lines


# uvicorn 0.54 makes a worker's server twice if its two threads come to it at once; the one that it asks whether it has
# started is then not the one that runs, here every time.
ASKED_THE_WRONG_ONE = """
import uvicorn
from uvicorn.supervisors.multiprocess import Process

Process.server = property(lambda self: uvicorn.Server(self.config))

if __name__ == "__main__":
    from rlservo.deploy.cli import main

    main()
"""


@pytest.mark.serve
@pytest.mark.slow
def test_workers_say_themselves_that_they_have_started(policies: Path, tmp_path: Path) -> None:
    with two_workers_of(ASKED_THE_WRONG_ONE, policies, tmp_path) as (run, _lines):
        before = worker_pids(run)
        run.process.send_signal(signal.SIGHUP)
        wait_for(lambda: not set(before) & set(now := worker_pids(run)) and len(now) == 2, "new workers", poll_s=0.2)
        assert run.end(signal.SIGTERM) == 0


# A worker's imports take longer than a worker that serves may be silent, as on a starved machine.
STARTS_SLOWLY = """
import time
from rlservo.serve_app.engines import uvicorn_server

uvicorn_server.HUNG_S = 6

if __name__ == "__main__":
    from rlservo.deploy.cli import main

    main()
else:
    time.sleep(12)
"""


@pytest.mark.serve
@pytest.mark.slow
def test_workers_that_take_long_to_start_are_not_taken_for_hung(policies: Path, tmp_path: Path) -> None:
    with two_workers_of(STARTS_SLOWLY, policies, tmp_path) as (run, lines):
        assert not [line for line in lines if "did not answer" in line]
        assert run.end(signal.SIGTERM) == 0


@pytest.mark.serve
@pytest.mark.slow
def test_sighup_keeps_workers_that_new_ones_cannot_replace(tmp_path: Path) -> None:
    write_box_policy(tmp_path / "policies")
    with launched(tmp_path / "policies", workers=2) as run:
        run.wait_until_ready()
        before = worker_pids(run)
        shutil.rmtree(tmp_path / "policies")
        run.process.send_signal(signal.SIGHUP)
        wait_for(lambda: "could not start: worker" in "".join(run.output), "the sentence that it stays")
        assert worker_pids(run) == before
        assert ask(run.port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 200
        assert run.end(signal.SIGTERM) == 0


@pytest.mark.serve
@pytest.mark.slow
@pytest.mark.parametrize("lost", ["policies", "plan"])  # a worker that began another plan would serve other versions
def test_workers_keep_serving_when_one_cannot_start_again_and_it_is_tried_until_it_can(
    tmp_path: Path, lost: str
) -> None:
    write_box_policy(tmp_path / "policies")
    with launched(tmp_path / "policies", workers=2, RLSERVO_PLAN=str(tmp_path / "plan")) as run:
        run.wait_until_ready()
        dies, stays = worker_pids(run)
        (tmp_path / lost).rename(tmp_path / "away")
        os.kill(dies, signal.SIGKILL)
        wait_for(lambda: "cannot replace another: 1 keep serving" in "".join(run.output), "the sentence on it")
        assert worker_pids(run) == [stays]
        assert ask(run.port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 200
        assert lost == "policies" or "has lost the plan that this server follows" in "".join(run.output)
        (tmp_path / "away").rename(tmp_path / lost)
        wait_for(lambda: len(worker_pids(run)) == 2, "the second worker")
        wait_for(lambda: ask(run.port, "GET", "/metrics")[1].count(b"rlservo_plan_generation{") == 2, "both to serve")
        assert run.process.poll() is None and stays in worker_pids(run)
        assert run.end(signal.SIGTERM) == 0


@pytest.mark.serve
@pytest.mark.slow
def test_a_worker_that_dies_during_a_slow_replacement_is_replaced_too(policies: Path) -> None:
    with launched(policies, workers=2) as run:
        run.wait_until_ready()
        before = set(worker_pids(run))
        run.process.send_signal(signal.SIGHUP)
        wait_for(lambda: set(worker_pids(run)) - before, "the first new worker")
        (slow,) = set(worker_pids(run)) - before
        os.kill(slow, signal.SIGSTOP)
        os.kill(max(before), signal.SIGKILL)
        wait_for(lambda: set(worker_pids(run)) - before - {slow}, "another in place of the dead one", timeout_s=60)
        wait_for(
            lambda: f"new worker {slow} is still starting" in "".join(run.output), "the sentence that it takes long"
        )
        os.kill(slow, signal.SIGCONT)
        wait_for(lambda: not before & set(now := worker_pids(run)) and len(now) == 2, "new workers", poll_s=0.2)
        assert run.end(signal.SIGTERM) == 0


@pytest.mark.serve
def test_workers_leave_the_key_of_the_server_that_followed_theirs(policies: Path) -> None:
    with launched(policies, workers=2, with_admin_key=True) as run:
        run.wait_until_ready()
        assert run.key_file is not None
        run.key_file.write_text("rls_of-a-later-server\n")
        run.process.kill()
        run.process.wait()
        wait_for(lambda: not run.left(), "the workers' end")
        assert run.key_file.read_text() == "rls_of-a-later-server\n"


@pytest.mark.serve
@pytest.mark.slow
@pytest.mark.parametrize("waited_s", [0.0, 2.0])  # the second: in the health check of a worker that does not answer
def test_a_server_with_stopped_workers_ends_as_one_without(policies: Path, waited_s: float) -> None:
    with launched(policies, workers=3) as run:
        run.wait_until_ready()
        for pid in worker_pids(run):
            os.kill(pid, signal.SIGSTOP)
        time.sleep(waited_s)
        began = time.monotonic()
        assert run.end(signal.SIGTERM) == 0
        print(f"ended in {time.monotonic() - began:.1f} s")
        assert time.monotonic() - began < 15


@pytest.mark.serve
@pytest.mark.slow
def test_a_worker_that_dies_is_logged_with_the_signal_and_the_version_it_was_computing(tmp_path: Path) -> None:
    slow, log = write_slow_policy(tmp_path / "policies", version="3"), tmp_path / "server.log"

    def deaths() -> list[str]:
        lines = map(json.loads, log.read_text().splitlines())
        return [line["message"] for line in lines if line["level"] == "error" and "replaced" in line["message"]]

    def serving() -> list[int]:
        """The workers, if both serve."""
        text = ask(run.port, "GET", "/metrics")[1].decode()
        pids = [int(pid) for pid in re.findall(r'rlservo_plan_generation{replica="(\d+)"}', text)]
        return pids if sorted(pids) == worker_pids(run) and len(pids) == 2 else []

    with launched(slow, workers=2, settings={"log_file": str(log)}) as run:
        run.wait_until_ready()
        load = Load(run.port, "ur5", OBS, [Policy.load(slow).act(OBS)], pause_s=0.0)
        signals = (signal.SIGFPE, signal.SIGSEGV, signal.SIGKILL)
        with load.run():
            for signum in signals:
                for _ in range(4):  # between two answers it computes nothing
                    pids, number = wait_for(serving), len(deaths())
                    time.sleep(1)
                    os.kill(busiest(pids), signum)
                    wait_for(lambda number=number: len(deaths()) > number)
                    assert f"was ended by signal {signum.value} " in deaths()[-1]
                    if "while computing nothing" not in deaths()[-1]:
                        break
                assert "while computing version 3 of policy 'ur5'" in deaths()[-1]
        asked, number = wait_for(serving)[0], len(deaths())
        os.kill(asked, signal.SIGSTOP)
        time.sleep(2)  # a health check waits for it now
        os.kill(asked, signal.SIGKILL)
        wait_for(lambda: len(deaths()) > number)
        assert deaths()[-1].startswith(f"worker {asked} was ended by signal 9 ")
        idle, number = wait_for(serving)[0], len(deaths())
        os.kill(idle, signal.SIGSEGV)
        wait_for(lambda: len(deaths()) > number)
        assert run.end(signal.SIGTERM) == 0
    assert deaths()[-1].startswith(f"worker {idle} was ended by signal 11 ") and "computing nothing" in deaths()[-1]
