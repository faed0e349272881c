"""The command `rlservo cockpit`: options here, work in rlservo.deploy.cockpit."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import bundle_of
from rlservo.deploy.commands.environment_options import Target, parse_env_arguments
from rlservo.errors import UsageError
from rlservo.extras import needs_extra

if TYPE_CHECKING:
    from rlservo.deploy.cockpit.policies import PolicySource

PORT = 8090


def cockpit(
    url: Annotated[str | None, typer.Option(help="Server that gives the actions.")] = None,
    policy: Annotated[str | None, typer.Option(help="Policy name; the first one by default.")] = None,
    version: Annotated[str | None, typer.Option(help="Version or alias; production by default.")] = None,
    bundle: Annotated[
        Path | None, typer.Option(help="Act in process with this bundle, or with the bundles in this folder.")
    ] = None,
    env: Annotated[
        str | None, typer.Option(help="Environment id (rlservo/...); by default the policy's training environment.")
    ] = None,
    env_arg: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Environment constructor argument (JSON value).")
    ] = None,
    target: Target = None,
    recording: Annotated[
        Path | None, typer.Option(help="Show a recording (.mcap); with --bundle, also that bundle's actions.")
    ] = None,
    robot_server: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Show a robot server's simulation while a client drives it.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Record the episodes, and who drives, into a new .mcap file or a folder.")
    ] = None,
    unproven: Annotated[
        bool, typer.Option("--unproven", help="Real robot: accept a policy that was not proven under latency.")
    ] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page on 127.0.0.1.")] = PORT,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the first episode.")] = None,
    api_key: Annotated[
        str | None,
        typer.Option(envvar="RLSERVO_API_KEY", help="API key. Prefer the variable: other users can see arguments."),
    ] = None,
) -> None:
    """Show a policy driving a robot in the browser.

    Drag its target, read its observations. Ctrl-C ends it.

    Example: `rlservo cockpit --url http://127.0.0.1:8000 --policy ur5`
    """
    shown = [url, recording, robot_server, None if recording is not None else bundle]
    if sum(each is not None for each in shown) != 1:
        raise UsageError(
            "expected one of --url (a server), --bundle (in process), --recording (with or without --bundle) and "
            "--robot-server"
        )
    if record is not None and (recording is not None or robot_server is not None):
        raise UsageError("--record needs --url or --bundle")
    arguments = parse_env_arguments(env_arg or [], target)
    if "robot" in arguments:  # prints a line per change of its state
        terminal.show_log()
    with needs_extra("cockpit"):
        from rlservo.deploy.cockpit.run import run_drive, run_playback, run_watch

    with terminal.ends_like_ctrl_c(), contextlib.suppress(KeyboardInterrupt):
        if recording is not None:
            chosen = None if bundle is None else bundle_of(bundle, version)
            run_playback(recording, bundle=chosen, policy=policy, env_id=env, port=port, on_ready=_tell)
            return
        if robot_server is not None:
            run_watch(robot_server, env_arguments=arguments, port=port, on_ready=_tell)
            return
        run_drive(
            _source(url, bundle, api_key),
            policy=policy,
            version=version,
            env_id=env,
            env_arguments=arguments,
            port=port,
            seed=seed,
            record=record,
            unproven=unproven,
            on_ready=_tell,
        )


def drive_on_page(url: str, port: int) -> None:
    """Show robots driven by a server's policies on a page, until an interrupt."""
    with needs_extra("cockpit"):
        from rlservo.deploy.cockpit.run import run_drive

    source = _source(url, None, None)
    run_drive(source, policy=None, version=None, env_id=None, env_arguments={}, port=port, seed=None, on_ready=_tell)


def _source(url: str | None, bundle: Path | None, api_key: str | None) -> PolicySource:
    from rlservo.deploy.cockpit.policies import BundledPolicies, ServedPolicies

    return ServedPolicies(str(url), api_key=api_key) if bundle is None else BundledPolicies(bundle)


def _tell(address: str) -> None:
    terminal.output().print(f"cockpit at {address}; Ctrl-C stops", highlight=False, soft_wrap=True)
