"""The commands `rlservo policy ...`: served versions, changed on a server or in a repository."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.serve import split_pair, split_share
from rlservo.deploy.terminal import Json, print_json
from rlservo.extras import needs_extra

if TYPE_CHECKING:
    from rich.table import Table

    from rlservo.client.admin_client import AdminClient
    from rlservo.serve_app.server.offline_commands import OfflineCommands

policy = typer.Typer(
    help="Change which versions are served. Aliases, rollback, canary and shadow, on a server or in a repository.",
    no_args_is_help=True,
)

Url = Annotated[str, typer.Option(help="URL of the server.", envvar="RLSERVO_URL")]
KeyFile = Annotated[
    Path | None,
    typer.Option(
        help="File with the admin key; by default RLSERVO_ADMIN_KEY, then the key that 'rlservo serve' wrote here."
    ),
]
Repository = Annotated[
    list[str] | None,
    typer.Option(
        metavar="DIR|URI",
        help="Repository to change instead of a server; its servers follow. Repeatable, as for 'rlservo serve'.",
    ),
]
Name = Annotated[str, typer.Argument(help="Policy name.")]
LOCAL = "http://127.0.0.1:8000"


@policy.command("list")
def list_policies(
    url: Url = LOCAL, key_file: KeyFile = None, repository: Repository = None, as_json: Json = False
) -> None:
    """List the served versions. With --repository, also list the versions that are not loaded.

    Behind a proxy or on Ray Serve the table shows only the replica that answers: repeat the command for others, or read
    `rlservo_plan_generation` in each one's metrics.

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
        shown = client.listing()
        others = {process: number for process, number in client.plans().items() if process != shown["replica"]}
    if as_json:
        print_json([shown, *({"replica": process, "generation": number} for process, number in others.items())])
        return
    terminal.output().print(table_of(shown))
    for name, versions in shown["not_loaded"].items():
        for version in versions:
            line = f"not loaded: {name} {version} (rlservo policy load {name} {version})"
            terminal.output().print(line, markup=False, highlight=False, soft_wrap=True)
    for sentence in shown["behind"]:
        terminal.output().print(f"behind: {sentence}", style="red", markup=False, highlight=False, soft_wrap=True)
    for process, number in others.items():
        terminal.output().print(f"process {process}: plan {number}", markup=False, highlight=False)


@policy.command()
def load(
    name: Name,
    version: Annotated[str | None, typer.Argument(help="Version; the newest of the repository by default.")] = None,
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Load and prove a version, without using it.

    Clients keep the version that they get. If the policy is not served yet, the first version loaded is in use at once.

    Example: `rlservo policy load ur5 4`
    """
    _give(url, key_file, repository, as_json, name, "load", version=version)


@policy.command()
def unload(
    name: Name,
    version: Annotated[str | None, typer.Argument(help="Version; the whole policy by default.")] = None,
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Unload an unused version, or a whole policy. No alias, canary or shadow may point to the version.

    Example: `rlservo policy unload ur5 3`
    """
    _give(url, key_file, repository, as_json, name, "unload", version=version)


@policy.command()
def alias(
    name: Name,
    pair: Annotated[
        str, typer.Argument(metavar="ALIAS=VERSION", help="Alias and version; ALIAS= removes it, except production.")
    ],
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Point an alias to a loaded version. Clients that name no version get `production`.

    Example: `rlservo policy alias ur5 production=4`
    """
    key, version = split_pair(pair, "production=4")
    _give(url, key_file, repository, as_json, name, "alias", alias=key, version=version or None)


@policy.command()
def rollback(
    name: Name,
    alias: Annotated[str, typer.Option(help="Alias to move.")] = "production",
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Point an alias back to its previous version. Repeat it to go further back.

    Example: `rlservo policy rollback ur5`
    """
    _give(url, key_file, repository, as_json, name, "rollback", alias=alias)


@policy.command()
def canary(
    name: Name,
    pair: Annotated[
        str, typer.Argument(metavar="VERSION=SHARE|off", help="Version or alias, and its share, 0 < share <= 1.")
    ],
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Give another version a share of the sessions. `off` ends the canary.

    Example: `rlservo policy canary ur5 candidate=0.1`
    """
    version, share = (None, None) if pair == "off" else split_share(pair)
    _give(url, key_file, repository, as_json, name, "canary", version=version, share=share)


@policy.command()
def shadow(
    name: Name,
    version: Annotated[str, typer.Argument(metavar="VERSION|off", help="Version or alias.")],
    url: Url = LOCAL,
    key_file: KeyFile = None,
    repository: Repository = None,
    as_json: Json = False,
) -> None:
    """Compute and compare another version's actions. `off` ends the shadow. The metrics show the differences.

    Example: `rlservo policy shadow ur5 candidate`
    """
    _give(url, key_file, repository, as_json, name, "shadow", version=None if version == "off" else version)


def _client(url: str, key_file: Path | None) -> AdminClient:
    with needs_extra("client"):
        from rlservo.client.admin_client import AdminClient
    return AdminClient.of_operator(url, key_file)


def _repository(places: list[str]) -> OfflineCommands:
    with needs_extra("serve"):
        from rlservo.serve_app.server.offline_commands import OfflineCommands
    return OfflineCommands(places)


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
    for sentence in reply["notes"]:
        terminal.note(sentence)


def table_of(replica: dict[str, Any]) -> Table:
    table = _columns(
        f"process {replica['replica'] or 'of the server'}, plan {replica['generation']} ({replica['changed_by']})",
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
