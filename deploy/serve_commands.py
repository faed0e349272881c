"""The commands `rlservo serve`, `key`, `rollout` and `demo`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rlservo.deploy import policy_commands, terminal
from rlservo.deploy.terminal import Json, note, print_json
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.extras import needs_extra, require

if TYPE_CHECKING:
    from rlservo.serve_app.interface import ActingPolicy


TransportKind = Literal["http", "ws"]


def serve(
    directories: Annotated[
        list[str],
        typer.Argument(
            metavar="DIR|URI...", help="Bundles, policy folders, repositories; s3://... as `rlservo publish` writes it."
        ),
    ],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 is any free one.")] = 8000,
    grpc_port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Also serve the Open Inference Protocol over gRPC, here.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Server processes; each holds all policies.")] = 1,
    default_policy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Policy of a WebSocket at '/', where openpi's clients connect; the only one by default.",
        ),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record every decision into this folder (`rlservo log`).")
    ] = None,
    poll: Annotated[
        float | None,
        typer.Option(min=1, metavar="SECONDS", help="Look for new versions this often; they are loaded, not in use."),
    ] = None,
    session_store: Annotated[
        str | None,
        typer.Option(
            metavar="memory|URL",
            help="Where sessions by id are kept; several workers need redis://HOST:PORT/DATABASE.",
        ),
    ] = None,
    config: policy_commands.ConfigOption = None,
    versions: policy_commands.VersionsOption = None,
    alias: policy_commands.AliasOption = None,
    canary: policy_commands.CanaryOption = None,
    shadow: policy_commands.ShadowOption = None,
) -> None:
    """Serve policies on this machine until Ctrl-C. On a cluster, Ray's `serve deploy` does it (docs/cluster.md).

    Example: `rlservo serve policies`, then
    `curl -d '{"obs": [0, 0, 0]}' -H 'content-type: application/json' 127.0.0.1:8000/v1/policies/NAME/act`
    """
    with needs_extra("serve"):
        from rlservo.serve_app.engines.local import RunningServer, serve_policies
        from rlservo.serve_app.wire.admin_key_file import key_file
    if record is not None:
        with needs_extra("record"):
            import rlservo.serve_app.recording.log_file  # noqa: F401

    def ready(served: RunningServer) -> None:
        for name, default in served.policies:
            terminal.output().print(
                f"{served.url}/v1/policies/{name}  (version {default})", highlight=False, soft_wrap=True
            )
        if served.grpc is not None:
            terminal.output().print(f"{served.grpc}  gRPC, Open Inference Protocol", highlight=False, soft_wrap=True)
        if served.admin_key_file is not None:
            note(f"administration: rlservo policy --help; its key is in {served.admin_key_file}")
        terminal.output().print(
            f"ready; status page: {served.url} (API: {served.url}/docs); Ctrl-C stops", highlight=False, soft_wrap=True
        )

    serve_policies(
        directories,
        host=host,
        port=port,
        grpc_port=grpc_port,
        workers=workers,
        settings={
            name: value
            for name, value in (
                ("default_policy", default_policy),
                ("record", record and str(record)),
                ("poll_s", poll),
                ("session_store", session_store),
            )
            if value is not None
        },
        served=policy_commands.served_config(config, versions, alias, canary, shadow),
        admin_key_file=key_file(port),
        on_ready=ready,
        on_stop=lambda: note("stopping: requests in progress are answered first"),
    )


def key(
    label: Annotated[str, typer.Argument(help="Whom the key is for: a robot, a person. Shown in messages.")],
    admin: Annotated[bool, typer.Option("--admin", help="For administration; robots need no such key.")] = False,
    rate: Annotated[
        float | None, typer.Option(help="Requests a second that each replica answers of it; any number by default.")
    ] = None,
    burst: Annotated[
        int | None, typer.Option(help="Requests at once, after a pause; as many as in a second by default.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Make an API key. What is printed is the key for the client and the line with its hash for the server's key file.

    Example: `rlservo key cell-7`; append the line to a file and name that in RLSERVO_API_KEYS_FILE
    """
    from rlservo.serve_app.server.api_keys import new_key

    secret, line = new_key(label, admin=admin, rate=rate, burst=burst)
    if as_json:
        print_json({"key": secret, "line": line})
        return
    note("the key, for the client; it is not kept anywhere and not shown again:")
    print(secret)
    note("the line, for the server's key file (RLSERVO_API_KEYS_FILE):")
    print(line)


def rollout(
    env: Annotated[str, typer.Argument(help="Gymnasium environment id.")],
    url: Annotated[str | None, typer.Option(help="Server to ask for actions.")] = None,
    policy: Annotated[str | None, typer.Option(help="Policy name on that server; its only one by default.")] = None,
    bundle: Annotated[Path | None, typer.Option(help="Act in process with this bundle instead of a server.")] = None,
    episodes: Annotated[int, typer.Option(min=1)] = 10,
    seed: Annotated[int | None, typer.Option(help="Episode i is reset with seed + i.")] = None,
    rate: Annotated[
        Literal["real", "max"], typer.Option(help="real: at the control rate, as on a robot; max: as fast as it goes.")
    ] = ("max"),
    explore: Annotated[bool, typer.Option("--explore", help="Sample actions instead of taking the mode.")] = False,
    env_arg: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Environment constructor argument (JSON value).")
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Write the first episode to this .mp4 file.")] = None,
    transport: Annotated[
        TransportKind, typer.Option(help="http: JSON, a request per action; ws: one WebSocket.")
    ] = "http",
    deadline_ms: Annotated[float | None, typer.Option(help="An action that takes longer is not used.")] = None,
    fallback: Annotated[
        str | None,
        typer.Option(
            metavar="hold|zero|stop|ACTION", help="What the robot does without an answer in time; by default it fails."
        ),
    ] = None,
    server_state: Annotated[
        bool, typer.Option("--server-state", help="Leave a recurrent policy's state with the server.")
    ] = False,
    api_key: Annotated[
        str | None, typer.Option(envvar="RLSERVO_API_KEY", help="Rather in the variable: others see arguments.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Record every decision, with rewards and ends: a new .mcap file, or a folder.")
    ] = None,
    disturb: Annotated[
        str | None,
        typer.Option(
            metavar="KIND=SIZE,...",
            help="Drive under disturbances, such as latency=3,noise=real,payload=3; `rlservo verify -h` has the kinds.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Drive an environment with a policy. Success, return, latency and deadline misses are reported.

    Example: `rlservo rollout rlservo/EndEffectorPositioningURSim-v0 --url http://127.0.0.1:8000 --policy ur5`
    """
    if (url is None) == (bundle is None):
        raise UsageError("give either --url (a server) or --bundle (in process)")
    if bundle is not None and (fallback, deadline_ms, transport) != (None, None, "http"):
        raise UsageError("--transport, --deadline-ms and --fallback are for a server (--url)")
    if video is not None:
        choose_gl_backend()
    if record is not None:
        require("record", "mcap", "orjson")
    with needs_extra("sim", "gymnasium", *(("imageio", "imageio_ffmpeg") if video else ())):
        from rlservo.serve_app.rollout.control_loop import rollout as run_rollout
        from rlservo.serve_app.rollout.report import render_report

    with (
        terminal.status(f"0 of {episodes} episodes") as show,
        _acting_policy(url, policy, bundle, transport, deadline_ms, server_state, api_key) as acting,
    ):
        report = run_rollout(
            _with_fallback(acting, fallback),
            env,
            episodes=episodes,
            seed=seed,
            rate=rate,
            explore=explore,
            env_kwargs=parse_env_arguments(env_arg or []),
            video=video,
            record=record,
            on_episode=lambda row: show(f"{row.index + 1} of {episodes} episodes"),
            disturb=disturb,
        )
    if as_json:
        print_json(report.as_dict())
    else:
        terminal.output().print(render_report(report))
    if report.interrupted:
        raise typer.Exit(130)
    if report.stopped is not None:
        raise typer.Exit(1)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the bundles and the picture; made anew.")] = Path("demo"),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per robot.")] = 20,
    checkpoints: Annotated[Path, typer.Option(help="Folder of the shipped checkpoints.")] = Path(
        "examples/checkpoints"
    ),
    cockpit: Annotated[
        bool, typer.Option("--cockpit", help="Instead of episodes, a page on which to drive both robots, until Ctrl-C.")
    ] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Of that page, on 127.0.0.1.")] = 8090,
) -> None:
    """Export two policies, serve them and drive both robots. The checkpoints are those that ship with the project.

    Example: `rlservo demo` in the checkout (`make demo` installs everything first)
    """
    choose_gl_backend()
    with needs_extra("all", "ray", "torch", "mujoco", "httpcore", *(("viser",) if cockpit else ())):
        from rlservo.deploy.demo.demo import run_demo

    def open_cockpit(url: str) -> None:
        from rlservo.deploy.cockpit_commands import drive_on_page

        drive_on_page(url, port)

    run_demo(
        out,
        checkpoints=checkpoints,
        episodes=episodes,
        console=terminal.output(),
        cockpit=open_cockpit if cockpit else None,
    )


def _acting_policy(
    url: str | None,
    name: str | None,
    bundle: Path | None,
    transport: TransportKind,
    deadline_ms: float | None,
    server_state: bool,
    api_key: str | None,
) -> ActingPolicy:
    """Return the policy to drive with; in process it needs no HTTP client."""
    if bundle is not None:
        from rlservo.serve_app.runtime.policy import Policy

        return Policy.load(bundle)
    with needs_extra("client"):
        from rlservo.serve_app.client.policy_client import PolicyClient
        from rlservo.serve_app.client.stream_client import StreamClient

    kind = StreamClient if transport == "ws" else PolicyClient
    return kind(str(url), name, deadline_ms=deadline_ms, server_state=server_state, api_key=api_key)


def _with_fallback(policy: ActingPolicy, fallback: str | None) -> ActingPolicy:
    if fallback is None:
        return policy
    from rlservo.serve_app.rollout.fallback import WithFallback

    if fallback in ("hold", "zero", "stop"):
        return WithFallback(policy, fallback)
    try:
        action = json.loads(fallback)
    except json.JSONDecodeError:
        raise UsageError(f"--fallback {fallback!r}: expected hold, zero, stop or an action such as [0, 0]") from None
    return WithFallback(policy, action)


def parse_env_arguments(pairs: list[str]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is a string."""
    arguments: dict[str, Any] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier():
            raise UsageError(f"--env-arg {pair!r}: expected NAME=VALUE, for example ur_model=ur10e")
        try:
            arguments[name] = json.loads(value)
        except json.JSONDecodeError:
            arguments[name] = value
    return arguments


def choose_gl_backend() -> None:
    """Let MuJoCo render off screen where there is no display. It must be said before mujoco is imported."""
    if "MUJOCO_GL" in os.environ or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    from ctypes.util import find_library  # it imports subprocess

    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return
