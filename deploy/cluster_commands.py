"""The commands `rlservo cluster ...`: options here, work in rlservo.serve_app.ray_serve."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from rlservo.deploy import terminal
from rlservo.export.contract.errors import UsageError

HAPROXY_FOLDER = "~/.cache/rlservo/haproxy"

cluster = typer.Typer(
    help="Prepare a Ray cluster's nodes, and check them.",
    no_args_is_help=True,
)


@cluster.command("env")
def print_environment(
    haproxy_folder: Annotated[
        Path, typer.Option(help="Where HAProxy's wrapper is written. Keep the folder while the cluster runs.")
    ] = Path(HAPROXY_FOLDER),
    stream_idle_s: Annotated[
        float | None, typer.Option(help="Seconds of silence after which a stream is closed, by server and HAProxy.")
    ] = None,
    max_connections_per_address: Annotated[
        int | None, typer.Option(help="Connections that one client address may have; 0: no bound.")
    ] = None,
    one_machine: Annotated[
        bool, typer.Option("--one-machine", help="For ray start --head --node-ip-address 127.0.0.1: bind to loopback.")
    ] = False,
    format: Annotated[
        Literal["sh", "env-file"], typer.Option(help="sh: to eval; env-file: for systemd and docker.")
    ] = "sh",
) -> None:
    """Print the variables that `ray start` needs on every node.

    It also writes HAProxy's wrapper, so run it on each node. Settings that HAProxy shares with the server are given
    here (or in RLSERVO_STREAM_IDLE_S and RLSERVO_MAX_CONNECTIONS_PER_ADDRESS), not in serve.yaml.

    Example: `eval "$(rlservo cluster env)" && ray start --head`
    """
    options = {"stream_idle_s": stream_idle_s, "max_connections_per_address": max_connections_per_address}
    with terminal.needs_extra("serve"):
        from rlservo.serve_app.ray_serve.environment import cluster_environment
    variables = cluster_environment(
        haproxy_folder.expanduser().absolute(),
        settings={name: value for name, value in options.items() if value is not None},
        one_machine=one_machine,
    )
    write = _export if format == "sh" else _assign
    print("\n".join(write(name, value) for name, value in variables.items()))


def _export(name: str, value: str) -> str:
    return f"export {name}={shlex.quote(value)}"


def _assign(name: str, value: str) -> str:
    """Return a line that systemd and docker read alike: docker takes quotes and backslashes for what they are."""
    if set(value) & set("'\"\\\n\r#") or value != value.strip():
        raise UsageError(f"an env-file cannot hold {name}={value!r}: choose a folder without quotes and backslashes")
    return f"{name}={value}"


@cluster.command()
def check(
    address: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="The head node. RAY_ADDRESS or this machine's by default.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="A serve.yaml whose policy folders to look for, instead of those of what is deployed."),
    ] = None,
    own: Annotated[
        list[str] | None,
        typer.Option(metavar="VARIABLE", help="A variable to which this cluster gives a value of its own; repeatable."),
    ] = None,
    as_json: terminal.Json = False,
) -> None:
    """Check a running cluster.

    Its nodes' variables, versions, HAProxy and policy folders, Serve's health, and whether anybody may use it.
    Run it on a node, in the shell that has the cluster's variables. A line per check, with what to do where there is a
    problem; exit status 0 only without one.

    Example: `eval "$(rlservo cluster env)" && rlservo cluster check`
    """
    with terminal.needs_extra("serve"):
        from rlservo.serve_app.ray_serve.cluster_check import check_cluster
    results: list[dict[str, Any]] = []
    for each in check_cluster(address, configuration=config, own=own or (), on_wait=terminal.note):
        results.append({"check": each.name, "ok": each.ok, "message": each.message})
        if not as_json:
            print(f"{'ok     ' if each.ok else 'PROBLEM'}  {each.name}: {each.message}", flush=True)
    is_well = all(each["ok"] for each in results)
    if as_json:
        terminal.print_json({"ok": is_well, "checks": results})
    raise typer.Exit(0 if is_well else 1)
