"""Child process of `rlservo cluster check`: a driver of a running cluster that reports a JSON object per line.

`cluster_check.py` runs it as `python -m rlservo.serve_app.ray_serve.cluster_probe PLAN`, in a process of its own: Ray's
C++ parts wait without a bound, end the process, and write to its terminal.
"""

from __future__ import annotations

import json
import os
import shlex
import socket
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from rlservo.serve_app.ray_serve.server_log import error_line, last_line

REACH_S = 5.0
NODE_S = 60.0  # a node's first worker takes seconds to start, on a small computer a quarter of a minute
OURS = "rlservo."  # what our applications' import path begins with
LOOPBACK = ("127.0.0.1", "localhost", "::1")
EVERY = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}  # an address to ask, for those that mean all interfaces
AGAIN = 'run eval "$(rlservo cluster env)" there, then ray stop and ray start'

Result = tuple[str, str | None, str]
"""(Name of the check, the problem or None, what was found)."""

NodeReports = list[tuple[str, dict[str, Any] | str]]
"""(A node's address, what `inspect_node` found there, or why it did not run)."""


def main() -> None:
    plan: dict[str, Any] = json.loads(sys.argv[1])
    threading.Thread(target=_end_with_parent, daemon=True).start()
    reports = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what Ray prints

    def report(**message: Any) -> None:
        reports.write(json.dumps(message) + "\n")

    try:
        for name, problem, found in check(plan, lambda what: report(waits=what)):
            report(check=name, ok=problem is None, message=problem or found)
    except Exception as error:
        report(error=error_line(error))
    report(done=True)


def check(plan: dict[str, Any], wait: Callable[[str], None]) -> Iterator[Result]:
    """Yield what each check found; `wait` gets what takes its time. Raises where the cluster does not answer."""
    import ray

    address = plan["address"] or os.environ.get("RAY_ADDRESS") or "auto"
    wait("this machine's cluster" if address == "auto" else f"the cluster at {address}")
    _reach(address)
    try:
        context: Any = ray.init(address=address, log_to_driver=False, configure_logging=False)
    except ConnectionError as error:
        if address == "auto":
            raise
        # Somebody listens there; Ray says no more than that it failed, of a wrong token, too.
        hint = "is it a head node, and is the token here the cluster's (RAY_AUTH_MODE, ~/.ray/auth_token)?"
        raise ConnectionError(f"{error_line(error)}: {hint}") from None
    nodes = [node for node in ray.nodes() if node["Alive"]]
    addresses = ", ".join(node["NodeManagerAddress"] for node in nodes)
    yield "cluster", None, f"{context.address_info['gcs_address']} answers; alive: {addresses}"
    mode = os.environ.get("RAY_AUTH_MODE")
    unlocked = "RAY_AUTH_MODE is not 'token' here: if the cluster takes no token, whoever reaches its ports owns it"
    yield "token", None if mode == "token" else f"{unlocked}; {AGAIN}", "the cluster takes this shell's token"
    wait("Serve's status from the dashboard")
    serve, problem = _serve(context.dashboard_url)
    wait(f"a task on each node ({addresses})")
    applications = [each for each in serve.get("applications", {}).values() if _is_ours(each)]
    places = plan["policies"] or [place for each in applications for place in _places(each)]
    folders = [place for place in places if "://" not in place]  # a replica fetches the others
    settings = proxy_settings(applications)
    reports = _inspect_nodes(nodes, [*plan["variables"], *plan["any_value"], *settings], folders)
    yield from check_nodes(reports, plan, settings, folders)
    if problem is not None:
        yield "serve", problem, ""
        return
    yield from _health(serve)
    wait("an answer of the policy server")
    yield from check_keys(serve, applications)


def inspect_node(names: list[str], folders: list[str], haproxy: str) -> dict[str, Any]:
    """Return what a process on a node sees. It runs there, where rlservo may be missing."""
    import ray

    found: dict[str, Any] = {
        "variables": {name: os.environ[name] for name in names if name in os.environ},
        "versions": {"Python": "{}.{}".format(*sys.version_info), "Ray": ray.__version__},
        "haproxy": None,
        "missing": [os.path.abspath(each) for each in map(os.path.expanduser, folders) if not os.path.isdir(each)],  # noqa: PTH100, PTH112
    }
    try:
        import rlservo

        found["versions"]["rlservo"] = rlservo.__version__
    except Exception as error:
        found["versions"]["rlservo"] = f"not importable ({error})"
    script = os.environ.get(haproxy, "")
    try:
        with open(script) as file:  # noqa: PTH123
            words = shlex.split(file.read())
        gone = [word for word in words if word.startswith("/") and not os.path.exists(word)]  # noqa: PTH110
        if not any(word.endswith("/haproxy/wrapper.py") for word in words):
            found["haproxy"] = f"{script} is not the wrapper that rlservo writes"
        elif gone or not os.access(script, os.X_OK):
            found["haproxy"] = f"{script} cannot run: {', '.join(gone) or 'it is not executable'} is missing"
    except (OSError, ValueError):
        found["haproxy"] = f"{script or haproxy + ', which is not set,'} cannot be read"
    return found


def _reach(address: str) -> None:
    """Raise OSError where nobody listens at host:port: Ray itself would try for a minute."""
    host, separator, port = address.rpartition(":")
    if separator and port.isdigit():
        with socket.create_connection((host.strip("[]"), int(port)), timeout=REACH_S):
            pass


def _inspect_nodes(nodes: list[dict[str, Any]], names: list[str], folders: list[str]) -> NodeReports:
    """Return by node's address what a task there found, or why there is none."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    from rlservo.serve_app.ray_serve.environment import HAPROXY_BINARY

    task: Any = ray.remote(num_cpus=0, max_retries=0)(inspect_node)
    tasks = [
        task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)).remote(
            names, folders, HAPROXY_BINARY
        )
        for node in nodes
    ]
    ready, _ = ray.wait(tasks, num_returns=len(tasks), timeout=NODE_S)
    reports: NodeReports = []
    for node, reference in zip(nodes, tasks, strict=True):
        found: dict[str, Any] | str = f"no task ran there within {NODE_S:g} s"
        try:
            found = ray.get(reference) if reference in ready else found
        except Exception as error:
            found = error_line(error)
        reports.append((node["NodeManagerAddress"], found))
    return reports


def check_nodes(
    reports: NodeReports, plan: dict[str, Any], settings: dict[str, float], folders: list[str]
) -> Iterator[Result]:
    for address, report in reports:
        if isinstance(report, str):
            yield "node", f"{address}: {report}", ""
            continue
        variables = report["variables"]
        wrong = [
            f"{name} is {variables[name]!r}, not {value!r}" if name in variables else f"{name} is not set"
            for name, value in plan["variables"].items()
            if variables.get(name) != value
        ]
        wrong += [f"{name} is not set" for name in plan["any_value"] if name not in variables]
        count = len(plan["variables"]) + len(plan["any_value"])
        yield "variables", f"{address}: {'; '.join(wrong)}: {AGAIN}" if wrong else None, f"{address} has all {count}"
        for name, value in settings.items():
            if float(variables.get(name, "nan")) != value:
                shown = f"{name} is {variables.get(name, 'not set')!r}, but the application's setting is {value:g}"
                yield "settings", f"{address}: {shown}: HAProxy goes by the first; give it to rlservo cluster env", ""
        versions = report["versions"].items()
        other = [f"{name} {version}" for name, version in versions if version != plan["versions"][name]]
        mine = ", ".join(f"{name} {version}" for name, version in plan["versions"].items())
        yield (
            "versions",
            f"{address}: {', '.join(other)}; here: {mine}: install the same" if other else None,
            f"{address} has {mine}",
        )
        haproxy = report["haproxy"]
        yield "haproxy", haproxy and f"{address}: {haproxy}: {AGAIN}", f"{address} has HAProxy's wrapper"
        if folders:
            missing = ", ".join(report["missing"])
            problem = f"{address}: {missing} is not there: replicas cannot start on this node" if missing else None
            yield "policies", problem, f"{address} has {', '.join(folders)}"


def _serve(dashboard: str | None) -> tuple[dict[str, Any], str | None]:
    """Return Serve's state as the dashboard's REST API tells it, or a sentence why not."""
    from ray.dashboard.modules.serve.sdk import ServeSubmissionClient

    if not dashboard:
        return (
            {},
            "the cluster has no dashboard, which 'serve deploy' needs: ray start without --include-dashboard=false",
        )
    try:
        details: dict[str, Any] = ServeSubmissionClient(f"http://{dashboard}").get_serve_details()
    except Exception as error:
        where = "run this on the head node, or look at its dashboard.log"
        return {}, f"the dashboard at {dashboard} does not answer ({error_line(error)}): {where}"
    if not details["applications"]:
        return details, "nothing is deployed: serve deploy deploy/serve.yaml"
    return details, None


def _health(serve: dict[str, Any]) -> Iterator[Result]:
    for proxy in serve["proxies"].values():
        bad = proxy["status"] != "HEALTHY"
        state = f"on {proxy['node_ip']} is {proxy['status']}"
        yield "proxy", f"{state}: see its log, {proxy['log_file_path']}" if bad else None, state
    for name, application in serve["applications"].items():
        bad = application["status"] != "RUNNING"
        parts = [application["message"], *(each["message"] for each in application["deployments"].values())]
        why = last_line(" ".join(filter(None, parts))) or "see serve status"
        state = f"'{name}' is {application['status']}"
        yield "application", f"{state}: {why}" if bad else None, state


def check_keys(serve: dict[str, Any], applications: list[dict[str, Any]]) -> Iterator[Result]:
    """Check whether a request without a key is answered."""
    options = serve.get("http_options") or {}
    host, port = str(options.get("host")), options.get("port")
    for application in applications:
        url = f"http://{EVERY.get(host, host)}:{port}{(application['route_prefix'] or '/').rstrip('/')}/v1/policies"
        try:
            # The url is made of http:// and what Serve says; no proxy of the environment stands before a cluster.
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=REACH_S) as reply:
                status = reply.status
        except urllib.error.HTTPError as error:
            status = error.code
        except OSError as error:
            yield "keys", f"{url} does not answer: {error}", ""
            continue
        is_open = status == 200
        if is_open and host not in LOOPBACK:
            advice = "make a key with 'rlservo key LABEL' and name its file in api_keys_file"
            yield "keys", f"whoever reaches {host}:{port} is answered without an API key: {advice}", ""
        elif is_open:
            yield "keys", None, f"{host}:{port} takes requests without a key, of this machine alone"
        elif status in (401, 403):
            yield "keys", None, f"{host}:{port} takes no request without a key"
        else:
            yield "keys", f"{url} answers {status}", ""


def _is_ours(application: dict[str, Any]) -> bool:
    return str((application.get("deployed_app_config") or {}).get("import_path", "")).startswith(OURS)


def _arguments(application: dict[str, Any]) -> dict[str, Any]:
    arguments: dict[str, Any] = application["deployed_app_config"].get("args") or {}
    return arguments


def _places(application: dict[str, Any]) -> list[str]:
    policies = _arguments(application).get("policies", [])
    return policies.split(",") if isinstance(policies, str) else [str(policy) for policy in policies]


def proxy_settings(applications: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Return what the applications' settings say that HAProxy has to know, by the variable's name."""
    from rlservo.serve_app.ray_serve.environment import PROXY_SETTINGS
    from rlservo.serve_app.server.settings import PREFIX

    return {
        PREFIX + name.upper(): float(value)
        for application in applications
        for name, value in (_arguments(application).get("settings") or {}).items()
        if name in PROXY_SETTINGS
    }


def _end_with_parent() -> None:
    """End when standard input does: the command is no more, whatever ended it."""
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
