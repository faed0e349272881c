"""The version of a policy folder that a command takes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal

FOLDER = "Bundle folder, or a policy folder for its production version (without a plan, its newest)."
Version = Annotated[
    str | None,
    typer.Option("--version", metavar="VERSION|newest", help="Version of a policy folder, instead of production."),
]


def bundle_of(folder: Path, version: str | None) -> Path:
    """Return the folder of the version; say so if it is not the newest and was not asked for. Raises BundleError."""
    from rlservo.bundle.bundle import find_bundles, resolve_bundle

    chosen = resolve_bundle(folder, version)
    newest = find_bundles(folder)[-1]
    if version is None and chosen != newest:
        terminal.note(
            f"{folder}: version {chosen.name} is taken, which is in production; the newest is {newest.name} "
            "(--version newest)"
        )
    return chosen
