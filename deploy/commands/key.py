"""The command `rlservo key`."""

from __future__ import annotations

from typing import Annotated

import typer

from rlservo.deploy.terminal import Json, note, print_json


def key(
    label: Annotated[str, typer.Argument(help="Whom the key is for: a robot, a person. Shown in messages.")],
    admin: Annotated[bool, typer.Option("--admin", help="For administration; robots need no such key.")] = False,
    rate: Annotated[
        float | None, typer.Option(help="Requests a second that each replica answers of it; any number by default.")
    ] = None,
    burst: Annotated[
        int | None, typer.Option(help="Requests at once, after a pause; as many as in a second by default.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Make an API key. What is printed is the key for the client and the line with its hash for the server's key file.

    Example: `rlservo key cell-7`; append the line to a file and name that in RLSERVO_API_KEYS_FILE
    """
    from rlservo.serve_app.server.api_keys import new_key

    secret, line = new_key(label, admin=admin, rate=rate, burst=burst)
    if as_json:
        print_json({"key": secret, "line": line})
        return
    note("the key, for the client; it is not kept anywhere and not shown again:")
    print(secret)
    note("the line, for the server's key file (RLSERVO_API_KEYS_FILE):")
    print(line)
