"""The command `rlservo sign`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import FOLDER, Version, bundle_of


def sign(
    bundle: Annotated[Path, typer.Argument(help=FOLDER)],
    key: Annotated[
        Path, typer.Option(exists=True, dir_okay=False, help="Private key: elliptic (P-256 ...), PEM, no password.")
    ],
    certificate: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="The key's certificate, followed by those that issued it, in one PEM.",
        ),
    ] = None,
    version: Version = None,
) -> None:
    """Sign a bundle with OpenSSF Model Signing.

    The signature, model.sig beside the bundle's files, is for `rlservo serve --require-signature`.

    Example: `rlservo sign policies/ur5 --key team.key`
    """
    from rlservo.bundle.bundle import load_bundle
    from rlservo.serve_app.repository.signature import sign as sign_bundle

    contents = load_bundle(bundle_of(bundle, version))
    with terminal.writing(contents.path):
        file = sign_bundle(contents, key, certificate)
    about = f"{contents.contract.name} version {contents.contract.version}"
    terminal.output().print(f"{about} is signed: {file}", highlight=False, markup=False, soft_wrap=True)
