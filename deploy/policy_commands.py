"""The commands `rlservo policy ...`, and the options of `rlservo serve` about versions; the work is in serve_app."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlservo.deploy import terminal
from rlservo.deploy.terminal import Json, print_json
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.extras import needs_extra

if TYPE_CHECKING:
    from rich.table import Table

    from rlservo.serve_app.client.admin_client import AdminClient
    from rlservo.serve_app.server.repository_commands import RepositoryCommands

policy = typer.Typer(
    help="Say what is served. Versions, aliases, rollback, canary, shadow; by a server, or by the repository itself.",
    no_args_is_help=True,
)

Url = Annotated[str, typer.Option(help="The server.", envvar="RLSERVO_URL")]
KeyFile = Annotated[
    Path | None,
    typer.Option(help="File with the admin key; else RLSERVO_ADMIN_KEY, else the one 'rlservo serve' wrote here."),
]
Repository = Annotated[
    list[str] | None,
    typer.Option(
        metavar="DIR|URI",
        help="Without a server: where 'rlservo serve' reads; all its places, in its order. Every server follows.",
    ),
]
Name = Annotated[str, typer.Argument(help="Policy name.")]
LOCAL = "http://127.0.0.1:8000"


@policy.command("list")
def list_policies(
    url: Url = LOCAL, key_file: KeyFile = None, repository: Repository = None, as_json: Json = False
) -> None:
    """Show what is served, and since when. Of a repository also what it holds beside that.

    Example: `rlservo policy list`
    """
    if repository:
        listing = _repository(repository).listing()
        if as_json:
            print_json(listing)
            return
        _print_repository(listing)
        return
    with _client(url, key_file) as client:
        replicas = client.replicas()
        shown = {replica["replica"] for replica in replicas}
        others = {process: number for process, number in client.plans().items() if process not in shown}
    if as_json:
        print_json([*replicas, *({"replica": process, "generation": number} for process, number in others.items())])
        return
    for replica in replicas:
        terminal.output().print(_table(replica))
        for sentence in replica["behind"]:
            terminal.output().print(f"behind: {sentence}", style="red", markup=False, highlight=False, soft_wrap=True)
    for process, number in others.items():
        terminal.output().print(f"process {process}: plan {number}", markup=False, highlight=False)


@policy.command()
def load(
    name: Name,
    version: Annotated[str | None, typer.Argument(help="The repository's newest by default.")] = None,
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Load a version and prove it, ready for an alias.

    What clients get stays as it is until then; of a policy that is not served at all, the version loaded first is in
    use at once.

    Example: `rlservo policy load ur5 4`
    """
    _give(url, key_file, repository, as_json, name, "load", version=version)


@policy.command()
def unload(
    name: Name,
    version: Annotated[str | None, typer.Argument(help="The whole policy by default.")] = None,
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Drop a version that nothing leads to, or a whole policy.

    Example: `rlservo policy unload ur5 3`
    """
    _give(url, key_file, repository, as_json, name, "unload", version=version)


@policy.command()
def alias(
    name: Name,
    pair: Annotated[str, typer.Argument(metavar="ALIAS=VERSION", help="ALIAS= removes it; production= cannot be.")],
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Let an alias lead to a loaded version. `production` is what clients get that ask for none.

    Example: `rlservo policy alias ur5 production=4`
    """
    key, version = _pair(pair, "production=4")
    _give(url, key_file, repository, as_json, name, "alias", alias=key, version=version or None)


@policy.command()
def rollback(
    name: Name,
    alias: Annotated[str, typer.Option(help="Which alias.")] = "production",
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Let an alias lead where it led before. Once more goes one further back.

    Example: `rlservo policy rollback ur5`
    """
    _give(url, key_file, repository, as_json, name, "rollback", alias=alias)


@policy.command()
def canary(
    name: Name,
    pair: Annotated[str, typer.Argument(metavar="VERSION=SHARE|off", help="A version or alias, and 0 < share <= 1.")],
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Send a share of the sessions to another version, or end that.

    Example: `rlservo policy canary ur5 candidate=0.1`
    """
    version, share = (None, None) if pair == "off" else _share(pair)
    _give(url, key_file, repository, as_json, name, "canary", version=version, share=share)


@policy.command()
def shadow(
    name: Name,
    version: Annotated[str, typer.Argument(metavar="VERSION|off", help="A version or alias.")],
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Let another version compute along, or end that. How its actions differ is recorded.

    Example: `rlservo policy shadow ur5 candidate`
    """
    _give(url, key_file, repository, as_json, name, "shadow", version=None if version == "off" else version)


# What `rlservo serve` says of versions.

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="YAML or JSON file of versions, aliases, canary and shadow, as in serve.yaml."),
]
VersionsOption = Annotated[
    list[str] | None,
    typer.Option("--versions", metavar="NAME=VERSION,...", help="Versions to load; all of the repository by default."),
]
AliasOption = Annotated[
    list[str] | None,
    typer.Option(
        "--alias",
        metavar="NAME:ALIAS=VERSION",
        help="ur5:production=3, say; repeat it. Without one the newest version is production, and stays it.",
    ),
]
CanaryOption = Annotated[
    list[str] | None,
    typer.Option("--canary", metavar="NAME:VERSION=SHARE", help="Share of the sessions for another version."),
]
ShadowOption = Annotated[
    list[str] | None,
    typer.Option("--shadow", metavar="NAME=VERSION", help="Version that computes along, only to be compared."),
]


def served_config(
    file: Path | None,
    versions: list[str] | None,
    aliases: list[str] | None,
    canaries: list[str] | None,
    shadows: list[str] | None,
) -> dict[str, Any]:
    """Return the configuration that the file and the options of `rlservo serve` mean; options win.

    Raises UsageError.
    """
    document = _load_config(file) if file is not None else {}
    policies = document.setdefault("policies", {})

    for text in versions or ():
        name, numbers = _pair(text, "ur5=3,4")
        policies.setdefault(name, {})["versions"] = numbers.split(",")
    for text in aliases or ():
        name, pair = _pair(text, "ur5:production=3", ":")
        key, version = _pair(pair, "ur5:production=3")
        policies.setdefault(name, {}).setdefault("aliases", {})[key] = version
    for text in canaries or ():
        name, pair = _pair(text, "ur5:candidate=0.1", ":")
        version, share = _share(pair)
        policies.setdefault(name, {})["canary"] = {"version": version, "share": share}
    for text in shadows or ():
        name, version = _pair(text, "ur5=candidate")
        policies.setdefault(name, {})["shadow"] = version
    return document


def _load_config(file: Path) -> dict[str, Any]:
    text = file.read_text(encoding="utf-8", errors="replace")
    try:
        document = json.loads(text) if file.suffix == ".json" else _parse_yaml(text)
    except ValueError as error:
        raise UsageError(f"{file} cannot be read: {' '.join(str(error).split())[:300]}") from None
    if not isinstance(document, dict) or not isinstance(document.get("policies", {}), dict):
        raise UsageError(f"{file}: expected a map with 'policies', as user_config in deploy/serve.yaml")
    return document


def _parse_yaml(text: str) -> Any:
    try:
        import yaml
    except ModuleNotFoundError:
        raise UsageError("reading YAML needs the Python package 'pyyaml'; a .json file needs nothing") from None
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


def _pair(text: str, example: str, separator: str = "=") -> tuple[str, str]:
    key, found, value = text.partition(separator)
    if not key or not found:
        raise UsageError(f"{text!r}: expected for example {example}")
    return key, value


def _share(pair: str) -> tuple[str, float]:
    version, share = _pair(pair, "candidate=0.1")
    try:
        return version, float(share)
    except ValueError:
        raise UsageError(f"{pair!r}: expected a share such as 0.1 after '='") from None


@contextlib.contextmanager
def _client(url: str, key_file: Path | None) -> Iterator[AdminClient]:
    with needs_extra("client"):
        from rlservo.serve_app.client.admin_client import AdminClient, find_key
    with AdminClient(url, api_key=find_key(url, key_file)) as client:
        yield client


def _repository(places: list[str]) -> RepositoryCommands:
    with needs_extra("serve"):
        from rlservo.serve_app.server.repository_commands import RepositoryCommands
    return RepositoryCommands(places)


def _give(
    url: str, key_file: Path | None, places: list[str] | None, as_json: bool, name: str, command: str, **document: Any
) -> None:
    """Give a command to a server, or to a repository, and show what is served then."""
    if places:
        reply = _repository(places).command(name, command, document)
    else:
        with _client(url, key_file) as client:
            reply = client.command(name, command, document)
    if as_json:
        print_json(reply)
        return
    aliases = ", ".join(f"{alias}={version}" for alias, version in reply["aliases"].items()) or "none"
    lines = [f"{reply['policy']}: default {reply['default']}, loaded {', '.join(reply['versions']) or 'none'}"]
    lines.append(f"aliases {aliases}")
    if reply["canary"] is not None:
        lines.append(f"canary {reply['canary']['version']} gets {reply['canary']['share']:g} of the sessions")
    if reply["shadow"] is not None:
        lines.append(f"shadow {reply['shadow']}")
    lines.append(f"plan {reply['generation']}" + (f" in {reply['place']}" if "place" in reply else ""))
    terminal.output().print("; ".join(lines), markup=False, highlight=False, soft_wrap=True)


def _table(replica: dict[str, Any]) -> Table:
    table = _columns(
        f"process {replica['replica']}, plan {replica['generation']} ({replica['changed_by']})",
        *("policy", "version", "state", "aliases", "since (UTC)", "requests", "reason"),
    )
    for each in replica["policies"]:
        for version in each["version_states"]:
            marks = [*version["aliases"]]
            state = (version["version"], version["state"], ", ".join(marks), _when(version["loaded_at"]))
            table.add_row(each["name"], *state, str(version["requests"]), version["reason"])
    return table


def _print_repository(listing: dict[str, Any]) -> None:
    table = _columns(None, "policy", "version", "state", "used as")
    for each in listing["policies"]:
        others = {"canary": each["canary"] and each["canary"]["version"], "shadow": each["shadow"]}
        uses = each["aliases"] | {use: each["aliases"].get(target, target) for use, target in others.items() if target}
        for version in each["versions"]:
            used_as = ", ".join(use for use, target in uses.items() if target == version)
            table.add_row(each["name"], version, "loaded", used_as)
        for version in each["not_loaded"]:
            table.add_row(each["name"], version, "not loaded", "")
    terminal.output().print(table)
    plan = "no plan yet: the first server or command writes one, with every version"
    if listing["generation"]:
        plan = f"plan {listing['generation']} ({listing['changed_by']}, {_when(listing['changed_at'])} UTC)"
    terminal.output().print(f"{plan}; in {listing['place']}", markup=False, highlight=False, soft_wrap=True)
    for sentence in listing["errors"]:
        terminal.errors().print(sentence, style="red", markup=False, highlight=False, soft_wrap=True)


def _columns(title: str | None, *names: str) -> Table:
    from rich.table import Table

    table = Table(title=title)
    for name in names:
        table.add_column(name, overflow="fold")
    return table


def _when(time: str | None) -> str:
    return "" if time is None else time[:19].replace("T", " ")
