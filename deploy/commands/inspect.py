"""The command `rlservo inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import FOLDER, Version, bundle_of
from rlservo.deploy.terminal import Json, print_json
from rlservo.errors import UsageError


def inspect(
    bundle: Annotated[Path, typer.Argument(help=FOLDER)],
    version: Version = None,
    card: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a card (README.md) with the hub's front matter instead.")
    ] = None,
    license: Annotated[
        str, typer.Option(metavar="ID", help="With --card: the policy's license, such as apache-2.0.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Show a bundle's contract and proof.

    Example: `rlservo inspect policies/ur5`
    """
    from rlservo.bundle.bundle import load_bundle

    contents = load_bundle(bundle_of(bundle, version))
    if card is not None:
        from rlservo.export.card import card as card_text

        try:
            card.write_text(card_text(contents.contract, license=license), encoding="utf-8")
        except OSError as error:
            raise UsageError(f"{card} cannot be written: {error.strerror or error}") from error
    elif as_json:
        print_json(contents.contract.model_dump(mode="json"))
    else:
        from rlservo.export.reports import contract_report

        terminal.output().print(contract_report(contents.contract))
        terminal.output().print(f"{contents.path}: all hashes match", markup=False, highlight=False, soft_wrap=True)
