"""The server manager: real processes, started, crashed, killed and orphaned."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import grpc
import pytest

from rlservo.envs.robot_server.connections import count_connections
from rlservo.envs.robot_server.manager import MANAGER_PORTS, RobotServers, ServerManager
from rlservo.envs.robot_server.robo_gym_messages import ROBOT_SERVER, SERVER_MANAGER, Empty, ManagerStatus, State
from rlservo.envs.robot_server.robot_server import PortInUseError, ServerAddressError, bind
from rlservo.serve_app.engines.ports import listen
from servers import free_ports
from waiting import wait_for

UR = "roslaunch ur_robot_server ur_robot_server.launch ur_model:=ur5"
MIR = "roslaunch mir100_robot_server sim_robot_server.launch"


def get_state(port: int, timeout: float = 5.0) -> Any:
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = channel.unary_unary(f"/{ROBOT_SERVER}/GetState", response_deserializer=State.FromString)
        return call(Empty().SerializeToString(), timeout=timeout)


def is_alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123 (a process may end between two looks)
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_server_starts_answers_and_is_gone_after_the_kill(manager: ServerManager, client: Any) -> None:
    assert client.call("VerifyConnection").alive
    started = client.start(UR)
    assert started.success
    assert started.port not in MANAGER_PORTS
    pid = manager.servers.running[started.port]
    assert pid != os.getpid()
    assert get_state(started.port).success
    assert client.kill(started.port).success
    assert not is_alive(pid)
    listen("127.0.0.1", started.port).close()  # it is free again
    with pytest.raises(grpc.RpcError):
        get_state(started.port)


def test_line_that_cannot_be_honoured_is_answered_with_the_reason(
    manager: ServerManager, client: Any, caplog: pytest.LogCaptureFixture
) -> None:
    for line, reason in (
        (f"{UR} colour:=red", "unknown launch arguments: colour"),
        ("roslaunch ur_robot_server ur_robot_server.launch ur_model:=ur99", "ur_model 'ur99' does not exist"),
        (f"{UR} action_cycle_rate:=5000", "action_cycle_rate is 5000 Hz: expected 0.1 to 1000 Hz"),
        ("", "expected 'roslaunch"),
    ):
        for _ in range(10):  # as robo-gym's client does
            answer = client.start(line)
            assert not answer.success
            assert answer.port == 0
            assert reason in answer.info
        assert caplog.text.count(reason) == 1
    assert manager.servers.running == {}


def test_fixed_server_port_that_is_taken_is_answered_with_the_reason(client: Any) -> None:
    (port,) = free_ports(1)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        answer = client.start(f"{UR} server_port:={port}")
    assert not answer.success
    assert f"cannot listen on 127.0.0.1:{port}: the port is taken" in answer.info
    again = client.start(f"{UR} server_port:={port}")
    assert again.success
    assert again.port == port


def test_killing_an_unknown_port_names_those_that_run(client: Any) -> None:
    port = client.start(UR).port
    answer = client.kill(1)
    assert not answer.success
    assert answer.info == f"there is no robot server on port 1; running: {port}"
    assert client.kill(port).success
    assert client.kill(port).info == f"there is no robot server on port {port}; running: none"


def test_garbage_is_answered_and_the_manager_goes_on(client: Any) -> None:
    for name in ("StartNewServer", "KillServer", "KillAllServers"):
        answer = client.call(name, b"\xff\xff\xff")
        assert not answer.success
        assert answer.info == "3 bytes that are not a valid message"
    assert client.call("VerifyConnection", b"\xff\xff\xff").alive


def test_killed_robot_server_is_noticed_and_its_client_gets_an_error(
    manager: ServerManager, client: Any, caplog: pytest.LogCaptureFixture
) -> None:
    port, other = client.start(UR).port, client.start(MIR).port
    pid = manager.servers.running[port]
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(grpc.RpcError) as caught:
        for _ in range(100):  # the call that finds out may be the next one
            get_state(port)
    assert caught.value.code() == grpc.StatusCode.UNAVAILABLE
    wait_for(lambda: port not in manager.servers.running, timeout_s=2.0)
    wait_for(lambda: "exited unexpectedly: killed by SIGKILL" in caplog.text, timeout_s=2.0)
    assert not is_alive(pid)  # and no zombie is left
    assert get_state(other).success
    # robo-gym's ExceptionHandling wrapper kills the server it lost before it starts another.
    assert client.kill(port).success
    assert client.start(UR).success


def test_clients_of_servers_that_kill_all_ended_kill_theirs_and_go_on(manager: ServerManager, client: Any) -> None:
    ports = [client.start(UR).port, client.start(MIR).port]
    assert client.kill_all().success
    # robo-gym's `kill_sim` asserts that this succeeds, and its `restart_sim` begins with it.
    assert client.kill(ports[0]).success
    assert client.kill(ports[1]).success
    assert not client.kill(ports[0]).success  # once
    assert client.start(UR).success


@pytest.mark.slow
def test_robo_gyms_own_client_goes_on_after_kill_all(manager: ServerManager, robo_gym_python: Path) -> None:
    code = (
        "import sys, gymnasium, robo_gym\n"
        "port = int(sys.argv[1])\n"
        "make = lambda: gymnasium.make('EmptyEnvironmentURSim-v0', ip='127.0.0.1', lower_bound_port=port,"
        " upper_bound_port=port + 1, disable_env_checker=True).unwrapped\n"
        "killed, restarted = make(), make()\n"
        "assert killed.sm_client.kill_all()\n"
        "killed.kill_sim()\n"
        "restarted.restart_sim()\n"
        "restarted.reset()\n"
        "restarted.kill_sim()\n"
    )
    done = subprocess.run(
        [str(robo_gym_python), "-c", code, str(manager.port)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "Tentative 2" not in done.stdout
    assert manager.servers.running == {}


def test_stopped_process_that_does_not_listen_to_sigterm_is_killed_within_a_second(
    manager: ServerManager, client: Any
) -> None:
    port = client.start(UR).port
    pid = manager.servers.running[port]
    os.kill(pid, signal.SIGSTOP)
    began = time.monotonic()
    assert client.kill(port).success
    assert time.monotonic() - began < 1.0
    assert not is_alive(pid)


def test_limit_of_servers_is_kept_and_freed_by_a_kill() -> None:
    servers = RobotServers(max_servers=2)
    try:
        ports = [servers.start(UR), servers.start(MIR)]
        with pytest.raises(ValueError, match="2 robot servers are running, which is this manager's limit"):
            servers.start(UR)
        servers.kill(ports[0])
        servers.start(UR)
    finally:
        servers.close()
    assert servers.running == {}
    with pytest.raises(ValueError, match="this server manager is shutting down"):
        servers.start(UR)


@pytest.mark.parametrize(
    ("host", "port", "reason"),
    [
        ("203.0.113.7", 0, "the address is not this machine's"),
        ("no-such-host.invalid", 0, "Name or service not known|Temporary failure in name resolution|No address"),
        ("127.0.0.1", None, "the port is taken"),
    ],
)
def test_address_that_cannot_be_listened_on_is_named_with_its_true_reason(
    host: str, port: int | None, reason: str
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1] if port is None else port
        with pytest.raises(ServerAddressError) as caught:
            bind(grpc.server(futures.ThreadPoolExecutor(1)), host, port)
    assert re.fullmatch(rf"cannot listen on {host}:{port}: ({reason}).*", str(caught.value))
    assert isinstance(caught.value, PortInUseError) == (reason == "the port is taken")


OUT_OF_FILES = """
import resource, grpc
from concurrent import futures
from rlservo.envs.robot_server.robot_server import ServerAddressError, bind
server, held = grpc.server(futures.ThreadPoolExecutor(1)), []
resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
try:
    while True:
        held.append(open("/dev/null"))
except OSError:
    pass
try:
    bind(server, "127.0.0.1", 0)
except ServerAddressError as error:
    held.clear()
    print(error)
"""


def test_out_of_file_descriptors_is_not_called_a_taken_port() -> None:
    done = subprocess.run([sys.executable, "-c", OUT_OF_FILES], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "cannot listen on 127.0.0.1:0: Too many open files", done.stderr


@pytest.mark.slow
def test_eight_servers_at_once_all_answer_and_all_end(manager: ServerManager, client: Any) -> None:
    answers: list[Any] = []
    threads = [threading.Thread(target=lambda line=line: answers.append(client.start(line))) for line in [UR, MIR] * 4]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(answer.success for answer in answers)
    running = manager.servers.running
    assert len({answer.port for answer in answers}) == len(running) == 8
    assert all(get_state(port).success for port in running)
    assert client.kill_all().success
    assert manager.servers.running == {}
    assert not any(is_alive(pid) for pid in running.values())
    assert client.start(UR).success  # it continues


# -- the command


@pytest.fixture
def command() -> Iterator[Callable[..., tuple[subprocess.Popen[str], int]]]:
    """Run `rlservo server-manager` or `robot-server` and return the process and its port."""
    processes: list[subprocess.Popen[str]] = []

    def run(*arguments: str) -> tuple[subprocess.Popen[str], int]:
        line = [sys.executable, "-m", "rlservo.deploy.cli", *arguments]
        process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        processes.append(process)
        assert process.stdout is not None
        said = process.stdout.readline()
        found = re.search(r":(\d+)[,:]", said)
        assert found, said
        return process, int(found[1])

    yield run
    for process in processes:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def children(pid: int) -> list[int]:
    found = []
    with contextlib.suppress(OSError), open(f"/proc/{pid}/task/{pid}/children") as listed:  # noqa: PTH123
        found = [int(child) for child in listed.read().split()]
    return found


def robot_servers_of(pid: int) -> list[int]:
    """All processes whose parent is the manager, whichever of its threads started them."""
    found = []
    for entry in os.listdir("/proc"):  # noqa: PTH208
        with contextlib.suppress(OSError, ValueError), open(f"/proc/{int(entry)}/stat") as stat:  # noqa: PTH123
            if int(stat.read().rsplit(")", 1)[1].split()[1]) == pid:
                found.append(int(entry))
    return found


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_nothing_outlives_the_manager_however_it_ends(command: Any, end: signal.Signals) -> None:
    process, port = command("server-manager", "--port", str(free_ports(1)[0]))
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        from rlservo.envs.robot_server.robo_gym_messages import ServerRequest

        start = channel.unary_unary(f"/{SERVER_MANAGER}/StartNewServer", response_deserializer=ServerRequest.FromString)
        ports = [start(ServerRequest(cmd=line).SerializeToString(), timeout=60).port for line in (UR, MIR)]
    servers = robot_servers_of(process.pid)
    assert len(servers) == 2
    assert all(get_state(port).success for port in ports)
    process.send_signal(end)
    process.wait(5)
    assert process.returncode == (-end if end == signal.SIGKILL else 0)
    wait_for(lambda: not any(is_alive(pid) for pid in servers), timeout_s=2.0)


def test_manager_takes_the_first_free_port_of_robo_gyms_range(command: Any) -> None:
    first, first_port = command("server-manager")
    _, second_port = command("server-manager")
    assert first_port in MANAGER_PORTS
    assert second_port in MANAGER_PORTS
    assert second_port > first_port  # they do not share one
    for port in (first_port, second_port):
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            verify = channel.unary_unary(
                f"/{SERVER_MANAGER}/VerifyConnection", response_deserializer=ManagerStatus.FromString
            )
            assert verify(Empty().SerializeToString(), timeout=5).alive
    first.terminate()
    first.wait(5)
    listen("127.0.0.1", first_port).close()  # it is free again


def test_manager_says_so_when_every_port_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    assert range(50100, 50200) == MANAGER_PORTS  # robo-gym's; some may be outgoing connections' that end meanwhile
    with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("127.0.0.1", 0)) as last:
        ports = (first.getsockname()[1], last.getsockname()[1])
        monkeypatch.setattr("rlservo.envs.robot_server.manager.MANAGER_PORTS", ports)
        servers = RobotServers()
        try:
            with pytest.raises(
                PortInUseError, match=rf"every port from {ports[0]} to {ports[1]} on 127.0.0.1 is taken"
            ):
                ServerManager(servers=servers)
        finally:
            servers.close()


def test_robot_server_command_serves_and_ends_on_ctrl_c(command: Any) -> None:
    process, port = command("robot-server", "ur", "--ur-model", "ur10e", "--rs-mode", "1moving2points", "--port", "0")
    state = get_state(port)
    assert len(state.state_dict) == 34
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0
    process, port = command("robot-server", "mir100", "--world", "lab_6x8", "--port", "0")
    assert len(get_state(port).state) == 1030
    process.terminate()
    assert process.wait(20) == 0


HAMMERED = """
import os, subprocess, sys
from rlservo.envs.robot_server.robot_server import arrives, stop_signals
signals = stop_signals()
send = f"import os, time\\nfor _ in range(10_000): os.kill({os.getpid()}, 15); time.sleep(0.0001)"
sender = subprocess.Popen([sys.executable, "-c", send])
while sender.poll() is None:
    arrives(signals, 1e-6)
"""


def test_a_signal_at_any_moment_of_the_wait_is_survived() -> None:
    """With an Event that the handler sets, most runs end here in the lock that their own thread holds."""
    done = subprocess.run([sys.executable, "-c", HAMMERED], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr[-2000:]


SIGNALLED_ELSEWHERE = """
import signal, threading, time
from rlservo.envs.robot_server.robot_server import arrives, stop_signals
signals = stop_signals()
threading.Timer(0.5, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGTERM)).start()
assert arrives(signals)
"""


def test_a_signal_that_interrupts_no_wait_still_ends_it() -> None:
    """One that another thread gets, or that comes a moment before the wait, runs its handler at the next step."""
    done = subprocess.run([sys.executable, "-c", SIGNALLED_ELSEWHERE], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("robot-server", "ur", "--ur-model", "ur7"), "ur_model 'ur7' does not exist: expected one of ur3"),
        (("robot-server", "ur", "--rs-mode", "x"), "rs_mode 'x' does not exist"),
        (("robot-server", "ur", "--object", "duck"), "object model 'duck' does not exist"),
        (("robot-server", "ur", "--action-cycle-rate", "0"), "action_cycle_rate is 0 Hz: expected 0.1 to 1000 Hz"),
        (("robot-server", "mir100", "--world", "moon"), "world 'moon' does not exist: expected one of"),
        (("server-manager", "--host", "203.0.113.7", "--port", "50101"), "cannot listen on 203.0.113.7:50101"),
    ],
)
def test_impossible_options_are_one_sentence(arguments: tuple[str, ...], message: str) -> None:
    line = [sys.executable, "-m", "rlservo.deploy.cli", *arguments]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, 2)
    assert message in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


# -- orphans


def test_robot_server_without_a_client_ends_itself_called_or_not_and_one_with_a_client_stays() -> None:
    servers = RobotServers(orphan_s=3.0)
    try:
        left = servers.start(UR)
        get_state(left)  # comes and goes
        kept = servers.start(UR)
        with grpc.insecure_channel(f"127.0.0.1:{kept}") as channel:
            call = channel.unary_unary(f"/{ROBOT_SERVER}/GetState", response_deserializer=State.FromString)
            call(Empty().SerializeToString(), timeout=5)
            never_called = servers.start(UR)  # now: on a busy machine a start takes as long as a server waits
            assert count_connections(kept) == 1
            wait_for(lambda: left not in servers.running, timeout_s=20.0)
            wait_for(lambda: never_called not in servers.running, timeout_s=20.0)
            assert kept in servers.running
        wait_for(lambda: kept not in servers.running, timeout_s=20.0)
    finally:
        servers.close()
