"""The command `rlservo publish`; the work is in serve_app/repository and export/renumber_bundle.py."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import bundle_of
from rlservo.deploy.terminal import Json, print_json
from rlservo.extras import needs_extra


def publish(
    bundle: Annotated[
        Path, typer.Argument(help="Bundle, policy folder (for its production version) or repository with one policy.")
    ],
    uri: Annotated[
        str, typer.Argument(metavar="URI", help="Destination: s3://bucket/policies, hf://owner/name, or a folder.")
    ],
    version: Annotated[
        str | None,
        typer.Option(metavar="N|next", help="Version to publish as: a number, or 'next'; the bundle's own by default."),
    ] = None,
    license: Annotated[
        str, typer.Option(metavar="ID", help="On a hub: the policy's license for its card, such as apache-2.0.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Publish a bundle for `rlservo serve URI`. A published version never changes.

    The bundle is proven first. Its files are written before its line in the index, without which no server sees the
    version; existing versions are never overwritten. Credentials come from the environment (AWS_..., HF_TOKEN).

    Example: `rlservo publish policies/ur5 s3://bucket/policies`
    """
    from rlservo.bundle.bundle import load_bundle
    from rlservo.policy.policy import Policy
    from rlservo.serve_app.repository.publication import next_version
    from rlservo.serve_app.repository.publication import publish as publish_bundle
    from rlservo.serve_app.repository.signature import SIGNATURE_FILE

    chosen = load_bundle(bundle_of(bundle, None))
    with terminal.writing(uri), tempfile.TemporaryDirectory(prefix="rlservo-publish-") as folder:
        if version == "next":
            version = next_version(uri, chosen.contract.name)
        if version not in (None, chosen.contract.version):
            with needs_extra("train", "torch", "onnx"):
                from rlservo.export.renumber_bundle import renumber

                if (chosen.path / SIGNATURE_FILE).exists():
                    terminal.note(
                        f"{SIGNATURE_FILE} is of version {chosen.contract.version}: {version} has no signature"
                    )
                chosen = renumber(chosen, str(version), Path(folder))
        Policy.load(chosen.path).close()  # do not publish a bundle that no server would load
        text = ""
        if uri.startswith("hf://"):
            from rlservo.export.card import card

            text = card(chosen.contract, license=license, place=uri)
        place = publish_bundle(chosen, uri, card=text, progress=terminal.note)
    contract = chosen.contract
    if as_json:
        print_json({"name": contract.name, "version": contract.version, "sha256": chosen.digest, "place": place})
        return
    terminal.output().print(
        f"{contract.name} version {contract.version} is published: {place}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
