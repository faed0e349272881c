"""The command `rlservo page`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import Version, bundle_of


def page(
    bundle: Annotated[Path, typer.Argument(help="Bundle, policy folder, or a folder of policies: a page of them all.")],
    out: Annotated[Path, typer.Option(help="Folder for the page; an earlier page there is replaced.")],
    version: Version = None,
) -> None:
    """Write a web page of a bundle.

    Its policy and its robot run in the browser, without a server of rlservo's.

    The first time it fetches onnxruntime-web, MuJoCo and three.js from npm's registry, 43 MB; then it needs no network,
    and the page never does. Any web server shows it: `python -m http.server --directory site`.

    Example: `rlservo page policies/ur5 --out site`
    """
    from rlservo.bundle.bundle import find_bundles
    from rlservo.deploy.page.static_site import write_site

    folders = sorted({folder.parent for folder in find_bundles(bundle)})
    chosen = [bundle_of(bundle if len(folders) == 1 else folder, version) for folder in folders]
    with terminal.status("reading") as show, terminal.ends_like_ctrl_c(), terminal.writing(out):
        sizes = write_site(chosen, out, show)
    names = ", ".join(folder.parent.name for folder in chosen)
    line = f"written   {out / 'index.html'}: {names}; {sum(sizes.values()) / 1e6:.1f} MB"
    terminal.output().print(line, markup=False, highlight=False, soft_wrap=True)
