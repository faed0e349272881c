"""The command `rlservo rollout`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import bundle_of
from rlservo.deploy.commands.environment_options import Target, choose_gl_backend, parse_env_arguments, require_robot
from rlservo.deploy.terminal import Json, print_json, show_log
from rlservo.errors import UsageError
from rlservo.extras import needs_extra, require

if TYPE_CHECKING:
    from rlservo.policy.acting_policy import ActingPolicy

TransportKind = Literal["http", "ws"]
VersionOrAlias = Annotated[
    str | None,
    typer.Option(help="Version or alias (with --bundle: a version or 'newest'); production by default."),
]


def rollout(
    env: Annotated[str, typer.Argument(help="Gymnasium environment id.")],
    url: Annotated[str | None, typer.Option(help="Server that gives the actions.")] = None,
    policy: Annotated[str | None, typer.Option(help="Policy name on that server; by default its only policy.")] = None,
    bundle: Annotated[Path | None, typer.Option(help="Act in process with this bundle instead of a server.")] = None,
    version: VersionOrAlias = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to drive.")] = 10,
    seed: Annotated[int | None, typer.Option(help="Seed; episode i is reset with seed + i.")] = None,
    rate: Annotated[
        Literal["real", "max"], typer.Option(help="real: at the control rate, as on a robot; max: at full speed.")
    ] = ("max"),
    explore: Annotated[
        bool, typer.Option("--explore", help="Sample actions from the distribution instead of taking its mode.")
    ] = False,
    env_arg: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Environment constructor argument (JSON value).")
    ] = None,
    target: Target = None,
    video: Annotated[Path | None, typer.Option(help="Write the first episode to this .mp4 file.")] = None,
    transport: Annotated[
        TransportKind, typer.Option(help="http: one JSON request per action; ws: one WebSocket.")
    ] = "http",
    deadline_ms: Annotated[
        float | None, typer.Option(help="Deadline for each action; late actions are not used.")
    ] = None,
    fallback: Annotated[
        str | None,
        typer.Option(
            metavar="hold|zero|stop|ACTION",
            help="Command to the robot if an action is late; by default the rollout fails.",
        ),
    ] = None,
    server_state: Annotated[
        bool, typer.Option("--server-state", help="Keep a recurrent policy's state on the server.")
    ] = False,
    api_key: Annotated[
        str | None,
        typer.Option(envvar="RLSERVO_API_KEY", help="API key. Prefer the variable: other users can see arguments."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Record every decision, reward and ending into a new .mcap file or a folder.")
    ] = None,
    disturb: Annotated[
        str | None,
        typer.Option(
            metavar="KIND=SIZE,...",
            help="Disturbances to apply, such as latency=3,noise=real,payload=3; see `rlservo verify -h`.",
        ),
    ] = None,
    app_dir: Annotated[
        Path, typer.Option(help="Folder of the Python module that registers your environment.")
    ] = Path(),
    yes: Annotated[
        bool, typer.Option("--yes", help="Real robot: move without confirmation; after a stop it still asks.")
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Real arm: show start, path, speeds and end of one episode; nothing moves."),
    ] = False,
    unproven: Annotated[
        bool, typer.Option("--unproven", help="Real robot: accept a policy that was not proven under latency.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Drive an environment with a policy. Reports success, return, latency and deadline misses.

    Examples: `rlservo rollout rlservo/EndEffectorPositioningURSim-v0 --url http://127.0.0.1:8000 --policy ur5`,
    `rlservo rollout my_module:MyEnv-v0 --bundle policies/mine --app-dir my_project`
    """
    if (url is None) == (bundle is None):
        raise UsageError("expected either --url (a server) or --bundle (in process)")
    if bundle is not None and (fallback, deadline_ms, transport) != (None, None, "http"):
        raise UsageError("--transport, --deadline-ms and --fallback need a server (--url)")
    arguments = parse_env_arguments(env_arg or [], target) | ({"confirm": False} if yes else {})
    if dry_run:
        if "robot" not in arguments:
            raise UsageError("--dry-run needs a real arm: add --env-arg robot=ADDRESS")
        arguments, episodes, unproven, rate = arguments | {"dry_run": True}, 1, True, "max"
    if "robot" in arguments:
        require_robot(str(arguments["robot"]))
        show_log()
    if video is not None:
        choose_gl_backend()
    if record is not None:
        require("record", "mcap", "orjson")
    from rlservo.export.checkpoints.unpickle import user_code

    with needs_extra("sim", "gymnasium", *(("imageio", "imageio_ffmpeg") if video else ())):
        from rlservo.drive.control_loop import rollout as run_rollout
        from rlservo.drive.report import render_report

    with (
        user_code(app_dir),
        terminal.status(f"0 of {episodes} episodes") as show,
        acting_policy(url, policy, bundle, version, transport, deadline_ms, server_state, api_key) as acting,
    ):
        report = run_rollout(
            with_fallback(acting, fallback),
            env,
            episodes=episodes,
            seed=seed,
            rate=rate,
            explore=explore,
            env_kwargs=arguments,
            video=video,
            record=record,
            on_episode=lambda row: show(f"{row.index + 1} of {episodes} episodes"),
            disturb=disturb,
            unproven=unproven,
        )
    if as_json:
        print_json(report.as_dict())
    else:
        terminal.output().print(render_report(report))
    if report.interrupted:
        raise typer.Exit(130)
    if report.stopped is not None:
        raise typer.Exit(1)


def acting_policy(
    url: str | None,
    name: str | None,
    bundle: Path | None,
    version: str | None,
    transport: TransportKind,
    deadline_ms: float | None,
    server_state: bool,
    api_key: str | None,
) -> ActingPolicy:
    """Return the policy; in process it needs no HTTP client."""
    if bundle is not None:
        from rlservo.policy.compiled_policy import open_policy

        return open_policy(bundle_of(bundle, version))
    with needs_extra("client"):
        from rlservo.client.policy_client import PolicyClient
        from rlservo.client.stream_client import StreamClient

    kind = StreamClient if transport == "ws" else PolicyClient
    return kind(str(url), name, version=version, deadline_ms=deadline_ms, server_state=server_state, api_key=api_key)


def with_fallback(policy: ActingPolicy, fallback: str | None) -> ActingPolicy:
    """Return the policy with the fallback for late actions. Raises UsageError."""
    if fallback is None:
        return policy
    from rlservo.drive.fallback import WithFallback

    if fallback in ("hold", "zero", "stop"):
        return WithFallback(policy, fallback)
    try:
        action = json.loads(fallback)
    except json.JSONDecodeError:
        raise UsageError(f"--fallback {fallback!r}: expected hold, zero, stop or an action such as [0, 0]") from None
    return WithFallback(policy, action)
