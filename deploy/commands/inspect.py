"""The command `rlservo inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.terminal import Json, print_json


def inspect(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, or a policy folder for its newest version.")],
    as_json: Json = False,
) -> None:
    """Show a bundle's contract and proof.

    Example: `rlservo inspect policies/ur5`
    """
    from rlservo.export.contract.bundle import load_bundle

    contents = load_bundle(bundle)
    if as_json:
        print_json(contents.contract.model_dump(mode="json"))
    else:
        from rlservo.export.reports import contract_report

        terminal.output().print(contract_report(contents.contract))
        terminal.output().print(f"{contents.path}: all hashes match", markup=False, highlight=False, soft_wrap=True)
