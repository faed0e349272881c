"""robo-gym's own environment, driven by a policy that is served somewhere: on our simulator, or on the real robot.

    rlservo serve policies                # one terminal, in rlservo's environment
    rlservo server-manager                # another one
    python examples/robo_gym_client.py    # a third, in robo-gym's environment
    python examples/robo_gym_client.py --task ObstacleAvoidanceMir100 --policy mir100_obstacle_avoidance

robo-gym pins an old protobuf, so it cannot share an environment with Ray: docs/how-to/robo-gym.md shows how to make its
own, and what to do before `--rs-address` drives a real robot.

Standard output has the report only: robo-gym's own output goes to standard error. Exit codes: 0, 1 for a failure, 2
for a wrong argument, 130 for Ctrl-C, after which no simulator is left.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from typing import Any, TextIO

import grpc
import gymnasium as gym
import numpy as np

from rlservo import PolicyClient, errors

# robo-gym's names, and the policies that docs/how-to/robo-gym.md serves for them.
POLICIES = {
    "EndEffectorPositioningUR": "ur5",
    "NoObstacleNavigationMir100": "mir100",
    "ObstacleAvoidanceMir100": "mir100_obstacle_avoidance",
}
UR_MODELS = ("ur3", "ur3e", "ur5", "ur5e", "ur10", "ur10e", "ur16e")
MANAGER_PORTS = range(50100, 50200)  # robo-gym looks for a server manager here
ANSWER_S = 5.0  # [s] to connect, and again to answer; robo-gym itself waits 20 s for each of a hundred ports
VERIFY = "/robo_gym_server_manager.grpc_msgs.server_manager.ServerManager/VerifyConnection"
GET_STATE = "/robot_server.RobotServer/GetState"
NOT_BY_PROXY = "no_grpc_proxy"  # gRPC's variable, which takes precedence over `no_proxy`
INTERRUPTED = 130  # the shell's exit code for Ctrl-C


def main() -> int:
    args = parse_arguments()
    with report_only_on_stdout() as out:
        try:
            import_robo_gym()
            env_id, arguments = locate_robot(args)
            endings: list[str] = []
            seconds: list[float] = []  # from asking for an action to having it
            is_interrupted = False
            try:
                with PolicyClient(args.url, args.policy or POLICIES[args.task]) as policy:
                    _ = policy.contract  # before a simulator is started for a policy that does not exist
                    drive(env_id, arguments, policy, args.episodes, endings, seconds, None if args.json else out)
            except KeyboardInterrupt:
                is_interrupted = True
            if endings:
                write_report(out, summary(env_id, endings, seconds, is_interrupted), as_json=args.json)
            if is_interrupted:
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            return INTERRUPTED
        except errors.RlservoError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    return 0


def parse_arguments() -> argparse.Namespace:
    """Return the arguments, or end with a sentence and exit code 2."""
    parser = argparse.ArgumentParser(description="Drive one of robo-gym's own environments with a served policy.")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--task", choices=POLICIES, default="EndEffectorPositioningUR", help="(default: %(default)s)")
    parser.add_argument(
        "--policy", help="its name on the server (default: ur5, mir100 or mir100_obstacle_avoidance, by the task)"
    )
    parser.add_argument("--ur-model", choices=UR_MODELS, help="arm of a UR task (default: ur5)")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--manager", default="127.0.0.1", help="where rlservo server-manager runs")
    parser.add_argument("--manager-port", type=int, help="the manager's port; 50100 to 50199 are searched by default")
    parser.add_argument("--rs-address", help="host:port of a running robot server, instead of a manager")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    args = parser.parse_args()
    if args.ur_model is not None and not args.task.endswith("UR"):
        parser.error(f"--ur-model is for UR tasks, and {args.task} has a MiR100")
    if args.episodes < 1:
        parser.error(f"--episodes is {args.episodes}: expected at least 1")
    if args.manager_port is not None and not 1 <= args.manager_port <= 65535:
        parser.error(f"--manager-port is {args.manager_port}: expected 1 to 65535")
    if args.rs_address is not None:
        host, colon, port = args.rs_address.rpartition(":")
        if not (host and colon and port.isascii() and port.isdigit() and 1 <= int(port[:9]) <= 65535):
            parser.error(f"--rs-address is {args.rs_address!r}: expected host:port, as in 127.0.0.1:50051")
    return args


@contextlib.contextmanager
def report_only_on_stdout() -> Iterator[TextIO]:
    """Reserve standard output for the report; other output, that of children too, goes to standard error."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    with os.fdopen(stdout, "w", encoding="utf-8") as out:
        yield out
        # Standard output stays with standard error: robo-gym prints once more when its environment is collected.


def import_robo_gym() -> None:
    """Register robo-gym's environments. Raises RlservoError when it is not installed, or does not import."""
    try:
        importlib.import_module("robo_gym")
    except ImportError as error:
        raise errors.RlservoError(
            f"robo-gym cannot be imported in {sys.executable} ({error}): docs/how-to/robo-gym.md says how to make an "
            "environment for it"
        ) from error
    except TypeError as error:  # protobuf's "Descriptors cannot be created directly"
        raise errors.RlservoError(
            "robo-gym cannot be imported with this protobuf: it needs one below 3.21, in an environment of its own "
            "(docs/how-to/robo-gym.md)"
        ) from error


def locate_robot(args: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Return the environment's id and arguments, for a manager or a robot server that answers.

    Raises UnavailableError when none does: robo-gym would try for minutes without a message.
    """
    ur = {"ur_model": args.ur_model or "ur5"} if args.task.endswith("UR") else {}
    if args.rs_address:
        host, _, port = args.rs_address.rpartition(":")
        if not answers(host.strip("[]"), int(port), GET_STATE):
            raise errors.UnavailableError(f"--rs-address {args.rs_address}: no robot server answers there")
        return f"{args.task}Rob-v0", {"rs_address": args.rs_address, **ur}
    ports = MANAGER_PORTS if args.manager_port is None else (args.manager_port,)
    for port in ports:
        if answers(args.manager, port, VERIFY):
            bounds = {"lower_bound_port": port, "upper_bound_port": port + 1}
            return f"{args.task}Sim-v0", {"ip": args.manager, **bounds, **ur}
    where = f"{args.manager}:{ports[0]}" if len(ports) == 1 else f"{args.manager}, ports {ports[0]} to {ports[-1]}"
    raise errors.UnavailableError(f"no server manager answers at {where}: start one with 'rlservo server-manager'")


def answers(host: str, port: int, method: str) -> bool:
    """Return whether a gRPC server there answers the method. Raises UnavailableError for a host out of reach."""
    try:
        socket.create_connection((host, port), timeout=ANSWER_S).close()
    except ConnectionRefusedError:
        return False
    except (OSError, UnicodeError) as error:  # the other ports of this host would fail the same way, each as slowly
        raise errors.UnavailableError(f"{host}:{port} cannot be reached: {error}") from error
    ask_directly(host)
    with grpc.insecure_channel(f"[{host}]:{port}" if ":" in host else f"{host}:{port}") as channel:
        try:
            channel.unary_unary(method)(b"", timeout=ANSWER_S)
        except grpc.RpcError:
            return False
    return True


def ask_directly(host: str) -> None:
    """Keep gRPC, robo-gym's own channels too, from asking the proxy of `http_proxy` for a host that we reach."""
    exempt = os.environ.get(NOT_BY_PROXY) or os.environ.get("no_proxy") or ""
    if host not in exempt.split(","):
        os.environ[NOT_BY_PROXY] = ",".join(filter(None, (exempt, host)))


def drive(
    env_id: str,
    arguments: dict[str, Any],
    policy: PolicyClient,
    episodes: int,
    endings: list[str],
    seconds: list[float],
    out: TextIO | None,
) -> None:
    """Run the episodes; `endings` and `seconds` grow as they go, and a line for each is written to `out`.

    The simulator is ended in any case. Raises RlservoError for what robo-gym or the policy's server reports.
    """
    env: Any = None
    try:
        with hold_interrupts(), sentences(f"{env_id} could not be started"):
            env = gym.make(env_id, disable_env_checker=True, **arguments).unwrapped
        for number in range(1, episodes + 1):
            endings.append(drive_one_episode(env, policy, seconds))
            if out is not None:
                print(f"episode {number}: {endings[-1]}", file=out, flush=True)
    finally:
        if hasattr(env, "kill_sim"):  # robo-gym's own; its UR environments' `close` leaves the simulator
            with hold_interrupts():
                end_simulator(env)


def drive_one_episode(env: gym.Env[Any, Any], policy: PolicyClient, seconds: list[float]) -> str:
    """Return how the episode ended."""
    with sentences("the reset failed"):
        first = env.reset()
    obs = first[0] if isinstance(first, tuple) else first  # robo-gym 2.0.1's obstacle avoidance gives no info
    policy.reset()
    while True:
        began = time.perf_counter()
        action = policy.act(obs)
        seconds.append(time.perf_counter() - began)
        with sentences("a step failed"):
            obs, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return str(info["final_status"])


@contextlib.contextmanager
def hold_interrupts() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait for the end of a call: robo-gym's client swallows them and tries ten times."""
    signals: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _frame: signals.append(number)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    if signals:
        raise KeyboardInterrupt


@contextlib.contextmanager
def sentences(what: str) -> Iterator[None]:
    """Turn whatever robo-gym raises into one sentence. Its protocol carries no reasons: the server's log has them."""
    try:
        yield
    except grpc.RpcError as error:
        reason = error.details() if isinstance(error, grpc.Call) else str(error)
        raise errors.UnavailableError(f"{what}: the robot server does not answer ({reason})") from error
    except Exception as error:  # robo-gym's own tree, AssertionError, RuntimeError, Exception
        reason = " ".join(str(error).split()) or type(error).__name__
        raise errors.RlservoError(f"{what}: {reason}; see the log of the server manager or robot server") from error


def end_simulator(env: Any) -> None:
    """End the robot server that robo-gym started."""
    try:
        env.kill_sim()
    except Exception as error:  # its manager is gone, and with it the robot server
        print(f"the robot server could not be stopped: {error}", file=sys.stderr)
    env.expect_sim_running = False  # or `__del__` tries ten times more


def summary(env_id: str, endings: list[str], seconds: list[float], is_interrupted: bool) -> dict[str, Any]:
    """Return the report of the episodes that ended."""
    p50, p95, p99 = (1000.0 * np.percentile(seconds, [50, 95, 99])).tolist()
    return {
        "environment": env_id,
        "episodes": len(endings),
        "successes": endings.count("success"),
        "endings": {ending: endings.count(ending) for ending in sorted(set(endings))},
        "steps": len(seconds),
        "latency_ms": {"p50": p50, "p95": p95, "p99": p99},
        "interrupted": is_interrupted,
    }


def write_report(out: TextIO, report: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(report, indent=2), file=out, flush=True)
        return
    latency = report["latency_ms"]
    print(f"{report['successes']} of {report['episodes']} at the target", file=out)
    print(
        f"action latency p50 {latency['p50']:.2f} ms, p95 {latency['p95']:.2f} ms, p99 {latency['p99']:.2f} ms over "
        f"{report['steps']:,} steps",
        file=out,
        flush=True,
    )


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a simulator must not stay behind
    try:
        code = main()
    except KeyboardInterrupt:  # before or after `main` watches for it
        code = INTERRUPTED
    sys.exit(code)
