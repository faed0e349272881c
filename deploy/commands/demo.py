"""The command `rlservo demo`; the work is in rlservo.deploy.demo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.environment_options import choose_gl_backend
from rlservo.extras import needs_extra


def demo(
    out: Annotated[
        Path, typer.Option(help="Folder for the bundles and the picture; an existing one is replaced.")
    ] = Path("demo"),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per robot.")] = 20,
    checkpoints: Annotated[Path, typer.Option(help="Folder of the shipped checkpoints.")] = Path(
        "examples/checkpoints"
    ),
    cockpit: Annotated[
        bool,
        typer.Option("--cockpit", help="Open a page to drive both robots, until Ctrl-C, instead of running episodes."),
    ] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of that page on 127.0.0.1.")] = 8090,
) -> None:
    """Export two shipped policies, serve and drive them.

    Example: `rlservo demo` in the checkout (`make demo` installs everything first)
    """
    choose_gl_backend()
    with needs_extra("all", "ray", "torch", "mujoco", "httptools", *(("viser",) if cockpit else ())):
        from rlservo.deploy.demo.demo import run_demo

    def open_cockpit(url: str) -> None:
        from rlservo.deploy.commands.cockpit import drive_on_page

        drive_on_page(url, port)

    run_demo(
        out,
        checkpoints=checkpoints,
        episodes=episodes,
        console=terminal.output(),
        cockpit=open_cockpit if cockpit else None,
    )
