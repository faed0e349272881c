"""The command `rlservo serve`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rlservo.deploy import terminal
from rlservo.deploy.terminal import note
from rlservo.errors import UsageError
from rlservo.extras import needs_extra

if TYPE_CHECKING:
    pass


TransportKind = Literal["http", "ws"]


ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="YAML or JSON file of versions, aliases, canary and shadow, as in serve.yaml."),
]
VersionsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--versions", metavar="NAME=VERSION,...", help="Versions of a policy to load; repeatable. All by default."
    ),
]
AliasOption = Annotated[
    list[str] | None,
    typer.Option(
        "--alias",
        metavar="NAME:ALIAS=VERSION",
        help="Alias for a new plan, such as ur5:production=3; repeatable. By default the newest version is production.",
    ),
]
CanaryOption = Annotated[
    list[str] | None,
    typer.Option("--canary", metavar="NAME:VERSION=SHARE", help="Version that gets a share of the sessions."),
]
ShadowOption = Annotated[
    list[str] | None,
    typer.Option(
        "--shadow", metavar="NAME=VERSION", help="Version whose actions are computed and compared, but not sent."
    ),
]


MOST_SHOWN = 10  # bundles that are not served, in the lines of a start


def serve(
    directories: Annotated[
        list[str],
        typer.Argument(
            metavar="DIR|URI...",
            help="Bundles, policy folders or repositories, including s3://... written by `rlservo publish`.",
        ),
    ],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes any free one.")] = 8000,
    grpc_port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="Also serve the Open Inference Protocol over gRPC on this port."),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Number of server processes; each holds all policies.")] = 1,
    default_policy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Policy for WebSockets at '/', where openpi's clients connect; the only policy by default.",
        ),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record every decision into this folder (`rlservo log`).")
    ] = None,
    poll: Annotated[
        float | None,
        typer.Option(
            min=1, metavar="SECONDS", help="How often to look for new versions, which are loaded but not used."
        ),
    ] = None,
    session_store: Annotated[
        str | None,
        typer.Option(
            metavar="memory|URL",
            help="Storage of sessions by id; several workers need redis://HOST:PORT/DATABASE.",
        ),
    ] = None,
    require_signature: Annotated[
        Path | None, typer.Option(metavar="KEYS", help="Serve only what a key of this folder signed (`rlservo sign`).")
    ] = None,
    config: ConfigOption = None,
    versions: VersionsOption = None,
    alias: AliasOption = None,
    canary: CanaryOption = None,
    shadow: ShadowOption = None,
) -> None:
    """Serve policies on this machine until Ctrl-C. On a cluster use Ray's `serve deploy`.

    Example: `rlservo serve policies`, then
    `curl -d '{"obs": [0, 0, 0]}' -H 'content-type: application/json' 127.0.0.1:8000/v1/policies/NAME/act`
    """
    with needs_extra("serve"):
        from rlservo.client.formats.admin_key_file import key_file
        from rlservo.serve_app.engines.uvicorn_server import RunningServer, serve_policies
    if record is not None:
        with needs_extra("record"):
            import rlservo.recording.log_file  # noqa: F401

    def ready(served: RunningServer) -> None:
        for name, default in served.policies:
            terminal.show(f"{served.url}/v1/policies/{name}  (version {default})")
        for sentence in served.not_served[:MOST_SHOWN]:
            terminal.show(sentence)
        if len(served.not_served) > MOST_SHOWN:
            terminal.show(f"... and {len(served.not_served) - MOST_SHOWN} more bundles (rlservo policy list)")
        if served.grpc is not None:
            terminal.show(f"{served.grpc}  gRPC, Open Inference Protocol")
        if served.admin_key_file is not None:
            note(f"administration: rlservo policy --help; its key is in {served.admin_key_file}")
        terminal.show(f"ready; status page: {served.url} (API: {served.url}/docs); Ctrl-C stops")

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
                ("require_signature", require_signature and str(require_signature)),
            )
            if value is not None
        },
        served=served_config(config, versions, alias, canary, shadow),
        admin_key_file=key_file(port),
        on_ready=ready,
        on_stop=lambda: note("stopping: requests in progress are answered first"),
    )


def served_config(
    file: Path | None,
    versions: list[str] | None,
    aliases: list[str] | None,
    canaries: list[str] | None,
    shadows: list[str] | None,
) -> dict[str, Any]:
    """Return the configuration from the file and the options of `rlservo serve`; options win.

    Raises UsageError.
    """
    document = _load_config(file) if file is not None else {}
    policies = document.setdefault("policies", {})

    for option, texts in (("--versions", versions), ("--canary", canaries), ("--shadow", shadows)):
        names = [text.replace(":", "=").partition("=")[0] for text in texts or ()]
        if twice := [name for name in names if names.count(name) > 1]:
            raise UsageError(f"{option} names policy {twice[0]!r} twice: expected it once")
    for text in versions or ():
        name, numbers = split_pair(text, "ur5=3,4")
        if "=" in numbers:
            raise UsageError(f"--versions {text!r}: expected one policy, such as ur5=3,4; repeat the option for others")
        policies.setdefault(name, {})["versions"] = numbers.split(",")
    for text in aliases or ():
        name, pair = split_pair(text, "ur5:production=3", ":")
        key, version = split_pair(pair, "ur5:production=3")
        policies.setdefault(name, {}).setdefault("aliases", {})[key] = version
    for text in canaries or ():
        name, pair = split_pair(text, "ur5:candidate=0.1", ":")
        version, share = split_share(pair)
        policies.setdefault(name, {})["canary"] = {"version": version, "share": share}
    for text in shadows or ():
        name, version = split_pair(text, "ur5=candidate")
        policies.setdefault(name, {})["shadow"] = version
    return document


def _load_config(file: Path) -> dict[str, Any]:
    text = file.read_text(encoding="utf-8", errors="replace")
    try:
        document = json.loads(text) if file.suffix == ".json" else _parse_yaml(text)
    except ValueError as error:
        raise UsageError(f"{file} cannot be read: {' '.join(str(error).split())[:300]}") from None
    if not isinstance(document, dict) or not isinstance(document.get("policies", {}), dict):
        raise UsageError(f"{file}: expected a map whose 'policies' is a map, like user_config in deploy/serve.yaml")
    return document


def _parse_yaml(text: str) -> Any:
    try:
        import yaml
    except ModuleNotFoundError:
        raise UsageError("reading YAML needs the Python package 'pyyaml'; a .json file needs no package") from None
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


def split_pair(text: str, example: str, separator: str = "=") -> tuple[str, str]:
    """Return the words before and after the separator. Raises UsageError, which shows the example."""
    key, found, value = text.partition(separator)
    if not key or not found:
        raise UsageError(f"{text!r}: expected something like {example}")
    return key, value


def split_share(pair: str) -> tuple[str, float]:
    """Return the version and the share of `VERSION=SHARE`. Raises UsageError."""
    version, share = split_pair(pair, "candidate=0.1")
    try:
        return version, float(share)
    except ValueError:
        raise UsageError(f"{pair!r}: expected a share such as 0.1 after '='") from None
