"""The command `rlservo inspect`."""

from __future__ import annotations

import json
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
    bom: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a bill of materials (CycloneDX 1.6, JSON) instead.")
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
    if card is not None and bom is not None:
        raise UsageError("--card and --bom each write a file instead of the contract: give one of them")
    if card is not None:
        from rlservo.export.card import card as card_text

        _write(card, card_text(contents.contract, license=license))
    elif bom is not None:
        from rlservo.export.bill_of_materials import bill_of_materials

        made = bill_of_materials(contents.contract, contents.digest, contents.sums)
        _write(bom, json.dumps(made, indent=2) + "\n")
    elif as_json:
        print_json(contents.contract.model_dump(mode="json"))
    else:
        from rlservo.export.reports import contract_report

        terminal.output().print(contract_report(contents.contract))
        terminal.output().print(f"{contents.path}: all hashes match", markup=False, highlight=False, soft_wrap=True)


def _write(file: Path, text: str) -> None:
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{file} cannot be written: {error.strerror or error}") from error
