"""The command line `rlservo`: composes the folders, owns nothing. Each command's work is done where it belongs.

Heavy libraries are imported by the command that needs them, so that `rlservo inspect` works on a robot without Ray.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import rlservo
from rlservo.deploy import policy_commands, robot_commands, terminal
from rlservo.export.contract.errors import RlservoError, UsageError

if TYPE_CHECKING:
    from rlservo.serve_app.interface import ActingPolicy

app = typer.Typer(
    name="rlservo",
    help="From a Ray RLlib checkpoint to a robot in the loop: export it, prove it, serve it, drive with it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: rich's tables and its Markdown parser would double the time of `--help`
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Rate(str, Enum):
    """How fast the loop runs."""

    real = "real"
    max = "max"


class TransportKind(str, Enum):
    """How to reach the server."""

    http = "http"
    ws = "ws"


class Pick(str, Enum):
    """Which end of a metric is the better one."""

    max = "max"
    min = "min"


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document for programs.")]


def main() -> None:
    """Run the command line: exit code 0 only on success, one sentence and no traceback on an error."""
    try:
        app()
    except RlservoError as error:
        terminal.errors().print(f"rlservo: {error.message}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(2 if isinstance(error, UsageError) else 1) from None
    except BrokenPipeError:  # the reader of our output went away, as in `rlservo inspect ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:
        what = f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
        terminal.errors().print(f"rlservo: {what}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None


@contextmanager
def _extra(name: str) -> Iterator[None]:
    """Say which extra to install when an import inside fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("rlservo"):
            raise
        raise UsageError(
            f"this command needs the Python package {error.name!r}: pip install 'rlservo[{name}]'"
        ) from error


def _note(line: str) -> None:
    """Print a line that a program reading our output should not see."""
    terminal.errors().print(line, style="dim", markup=False, highlight=False, soft_wrap=True)


def _print_json(document: Any) -> None:
    print(json.dumps(document, indent=2))


@app.callback(invoke_without_command=True)
def _root(show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if show_version:
        print(f"rlservo {rlservo.__version__}")
        raise typer.Exit


@app.command()
def export(
    checkpoint: Annotated[
        str, typer.Argument(help="RLlib checkpoint folder (of a Tune trial the newest), or a URI such as s3://...")
    ],
    out: Annotated[Path, typer.Option(help="Repository folder; the bundle goes to OUT/<name>/<version>/.")],
    name: Annotated[str | None, typer.Option(help="Policy name; the environment's by default.")] = None,
    version: Annotated[str | None, typer.Option(help="Integer or x.y.z; the next integer by default.")] = None,
    description: Annotated[str, typer.Option(help="A sentence for people, kept in the contract.")] = "",
    module_id: Annotated[
        str | None, typer.Option(help="Which RLModule (old API stack: policy); needed when there are several.")
    ] = None,
    all_modules: Annotated[
        bool, typer.Option("--all-modules", help="Export every module, each to OUT/<name>-<module>; all or none.")
    ] = False,
    agent_id: Annotated[
        str | None, typer.Option(help="For which agent, where a module serves several that are filtered differently.")
    ] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
    metric: Annotated[
        str | None, typer.Option(help="Of a Tune trial or experiment, the checkpoint with the best of this metric.")
    ] = None,
    mode: Annotated[Pick, typer.Option(help="Whether the best is the largest or the smallest.")] = Pick.max,
    as_json: Json = False,
) -> None:
    """Turn an RLlib checkpoint into a policy bundle. It is proven equal to RLlib's own actions, or nothing is written.

    Examples: `rlservo export examples/checkpoints/ur5_positioning --out policies`,
    `rlservo export ~/ray_results/PPO_2026 --metric env_runners/episode_return_mean --out policies`
    """
    started = time.perf_counter()
    if all_modules and (module_id is not None or agent_id is not None):
        raise UsageError("--all-modules exports every module: leave --module-id and --agent-id out")
    with terminal.errors().status("importing") as status, ExitStack() as fetching:
        with _extra("train"):
            from rlservo.export.checkpoints.experiment import best_checkpoint
            from rlservo.export.checkpoints.remote import fetched
            from rlservo.export.commands.export import LOADING_RUNS_CODE, export_all_modules, export_checkpoint
            from rlservo.export.commands.report import export_report, peak_memory_mb

        if metric is not None:
            _note(LOADING_RUNS_CODE.format(path=checkpoint))
            local = fetching.enter_context(fetched(checkpoint, status.update))
            best = best_checkpoint(local, metric, mode.value, app_dir=app_dir, notify=_note)
            _note(f"{best.path} has the {mode.value} {metric}: {best.score:g}")
            checkpoint = str(best.path)
        if all_modules:
            results = export_all_modules(
                checkpoint,
                out,
                name=name,
                version=version,
                description=description,
                app_dir=app_dir,
                notify=_note,
                progress=status.update,
            )
        else:
            one = export_checkpoint(
                checkpoint,
                out,
                name=name,
                version=version,
                description=description,
                module_id=module_id,
                agent_id=agent_id,
                app_dir=app_dir,
                notify=_note,
                progress=status.update,
            )
            results = [one]
    cost = {"seconds": round(time.perf_counter() - started, 2), "peak_memory_mb": round(peak_memory_mb())}
    if as_json:
        documents = [
            {"path": str(result.path), "contract": result.contract.model_dump(mode="json"), **cost}
            for result in results
        ]
        _print_json(documents if all_modules else documents[0])
        return
    for result in results:
        terminal.output().print(export_report(result.contract), soft_wrap=True)
        terminal.output().print(f"written   {result.path}", markup=False, highlight=False, soft_wrap=True)
    terminal.output().print(
        f"cost      {cost['seconds']:.1f} s, {cost['peak_memory_mb']} MB at the peak", highlight=False
    )


@app.command()
def prune(
    checkpoint: Annotated[str, typer.Argument(help="RLlib checkpoint folder or URI.")],
    out: Annotated[Path, typer.Option(help="Folder to make; it must not exist.")],
    module_id: Annotated[str | None, typer.Option(help="Which RLModule; needed when there are several.")] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
) -> None:
    """Copy only what export needs out of a checkpoint. The copy is small enough to commit or to mail.

    Example: `rlservo prune runs/PPO-.../checkpoint_000015 --out examples/checkpoints/mine`
    """
    with _extra("train"):
        from rlservo.export.commands.prune import prune_checkpoint

    prune_checkpoint(checkpoint, out, module_id=module_id, app_dir=app_dir, notify=_note)


@app.command()
def inspect(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, or a policy folder: its newest version.")],
    as_json: Json = False,
) -> None:
    """Show a bundle's contract. It says what goes in, what comes out, what is baked in and how it was proven.

    Example: `rlservo inspect policies/ur5`
    """
    from rlservo.export.contract.bundle import load_bundle

    loaded = load_bundle(bundle)
    if as_json:
        _print_json(loaded.contract.model_dump(mode="json"))
    else:
        from rlservo.export.commands.report import contract_report

        terminal.output().print(contract_report(loaded.contract))
        terminal.output().print(f"{loaded.path}: all hashes match", markup=False, highlight=False, soft_wrap=True)


@app.command()
def verify(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, or a policy folder: its newest version.")],
    checkpoint: Annotated[str, typer.Option(help="The RLlib checkpoint to compare with; a folder or a URI.")],
    env: Annotated[str | None, typer.Option(help="Environment id for a closed-loop comparison.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of the closed loop.")] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
    as_json: Json = False,
) -> None:
    """Prove a bundle against its checkpoint again. With --env also in closed loop, written into the contract.

    Example: `rlservo verify policies/ur5 --checkpoint runs/best --env rlservo/EndEffectorPositioningURSim-v0`
    """
    with _extra("train"):
        from rlservo.export.commands.report import verification_report
        from rlservo.export.commands.verify import verify_bundle

    with terminal.errors().status("reading the bundle") as status:
        result = verify_bundle(
            bundle,
            checkpoint,
            env_id=env,
            episodes=episodes,
            first_seed=seed,
            app_dir=app_dir,
            notify=_note,
            progress=status.update,
        )
    if as_json:
        _print_json(
            {
                "parity": result.parity.model_dump(mode="json"),
                "evaluation": result.evaluation.model_dump(mode="json") if result.evaluation else None,
                "same_checkpoint": result.same_checkpoint,
            }
        )
    else:
        terminal.output().print(verification_report(result.parity, result.evaluation))


@app.command()
def serve(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Bundles, policy folders or repositories.")
    ],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535)] = 8000,
    grpc_port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Also serve the Open Inference Protocol over gRPC, here.")
    ] = None,
    replicas: Annotated[int, typer.Option(min=1, help="Server processes; each holds all policies.")] = 1,
    default_policy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Policy of a WebSocket at '/', where openpi's clients connect; the only one by default.",
        ),
    ] = None,
    config: policy_commands.ConfigOption = None,
    versions: policy_commands.VersionsOption = None,
    alias: policy_commands.AliasOption = None,
    canary: policy_commands.CanaryOption = None,
    shadow: policy_commands.ShadowOption = None,
) -> None:
    """Serve policies with Ray Serve until Ctrl-C. Nothing is left running afterwards.

    Example: `rlservo serve policies`, then
    `curl -d '{"obs": [0, 0, 0]}' -H 'content-type: application/json' 127.0.0.1:8000/v1/policies/NAME/act`
    """
    with _extra("serve"):
        from rlservo.serve_app.ray_serve.launcher import Served, serve_policies
        from rlservo.serve_app.server.admin_key import key_file

    def ready(served: Served) -> None:
        for name, default in served.policies:
            terminal.output().print(
                f"{served.url}/v1/policies/{name}  (version {default})", highlight=False, soft_wrap=True
            )
        if served.grpc is not None:
            terminal.output().print(f"{served.grpc}  gRPC, Open Inference Protocol", highlight=False, soft_wrap=True)
        if not served.haproxy:
            terminal.errors().print(
                "HAProxy is not installed here: Ray's own proxy answers, at several times the latency"
            )
        if served.admin_key_file is not None:
            _note(f"administration: rlservo policy --help; its key is in {served.admin_key_file}")
        terminal.output().print(
            f"ready; documentation at {served.url}/docs; Ctrl-C stops", highlight=False, soft_wrap=True
        )

    serve_policies(
        directories,
        host=host,
        port=port,
        grpc_port=grpc_port,
        replicas=replicas,
        settings=None if default_policy is None else {"default_policy": default_policy},
        served=policy_commands.served_config(config, versions, alias, canary, shadow),
        admin_key_file=key_file(port),
        on_start=lambda: terminal.errors().print("starting Ray Serve ...", style="dim"),
        on_ready=ready,
    )


@app.command()
def key(
    label: Annotated[str, typer.Argument(help="Whom the key is for: a robot, a person. Shown in messages.")],
    admin: Annotated[bool, typer.Option("--admin", help="For administration; robots need no such key.")] = False,
    as_json: Json = False,
) -> None:
    """Make an API key. What is printed is the key for the client and the line with its hash for the server's key file.

    Example: `rlservo key cell-7`; append the line to a file and name that in RLSERVO_API_KEYS_FILE
    """
    from rlservo.serve_app.server.api_keys import new_key

    made, line = new_key(label, admin=admin)
    if as_json:
        _print_json({"key": made, "line": line})
        return
    _note("the key, for the client; it is not kept anywhere and not shown again:")
    print(made)
    _note("the line, for the server's key file (RLSERVO_API_KEYS_FILE):")
    print(line)


@app.command()
def rollout(
    env: Annotated[str, typer.Argument(help="Gymnasium environment id.")],
    url: Annotated[str | None, typer.Option(help="Server to ask for actions.")] = None,
    policy: Annotated[str | None, typer.Option(help="Policy name on that server; its only one by default.")] = None,
    bundle: Annotated[Path | None, typer.Option(help="Act in process with this bundle instead of a server.")] = None,
    episodes: Annotated[int, typer.Option(min=1)] = 10,
    seed: Annotated[int | None, typer.Option(help="Episode i is reset with seed + i.")] = None,
    rate: Annotated[Rate, typer.Option(help="real: at the control rate, as on a robot; max: as fast as it goes.")] = (
        Rate.max
    ),
    explore: Annotated[bool, typer.Option("--explore", help="Sample actions instead of taking the mode.")] = False,
    env_arg: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Environment constructor argument (JSON value).")
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Write the first episode to this .mp4 file.")] = None,
    transport: Annotated[
        TransportKind, typer.Option(help="http: JSON, a request per action; ws: one WebSocket.")
    ] = TransportKind.http,
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
    as_json: Json = False,
) -> None:
    """Drive an environment with a policy. Success, return, latency and deadline misses are reported.

    Example: `rlservo rollout rlservo/EndEffectorPositioningURSim-v0 --url http://127.0.0.1:8000 --policy ur5`
    """
    if (url is None) == (bundle is None):
        raise UsageError("give either --url (a server) or --bundle (in process)")
    if bundle is not None and (fallback, deadline_ms, transport) != (None, None, TransportKind.http):
        raise UsageError("--transport, --deadline-ms and --fallback are for a server (--url)")
    if video is not None:
        choose_gl_backend()
    with _extra("sim"):
        from rlservo.serve_app.rollout.control_loop import rollout as run_rollout
        from rlservo.serve_app.rollout.report import render_report

    with _acting_policy(url, policy, bundle, transport, deadline_ms, server_state, api_key) as acting:
        report = run_rollout(
            _with_fallback(acting, fallback),
            env,
            episodes=episodes,
            seed=seed,
            rate=rate.value,
            explore=explore,
            env_kwargs=parse_env_arguments(env_arg or []),
            video=video,
        )
    if as_json:
        _print_json(report.as_dict())
    else:
        terminal.output().print(render_report(report))
    if report.interrupted:
        raise typer.Exit(130)
    if report.stopped is not None:
        raise typer.Exit(1)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the bundles and the picture; made anew.")] = Path("demo"),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per robot.")] = 20,
    checkpoints: Annotated[Path, typer.Option(help="Folder of the shipped checkpoints.")] = Path(
        "examples/checkpoints"
    ),
) -> None:
    """Export two policies, serve them and drive both robots. The checkpoints are those that ship with the project.

    Example: `rlservo demo` in the checkout (`make demo` installs everything first)
    """
    choose_gl_backend()
    with _extra("all"):
        from rlservo.deploy.demo.demo import run_demo

    run_demo(out, checkpoints=checkpoints, episodes=episodes, console=terminal.output())


robot_commands.add_to(app)
app.add_typer(policy_commands.policy, name="policy")


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
    with _extra("client"):
        from rlservo.serve_app.client.policy_client import PolicyClient
        from rlservo.serve_app.client.stream_client import StreamClient

    kind = StreamClient if transport is TransportKind.ws else PolicyClient
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


if __name__ == "__main__":
    main()
