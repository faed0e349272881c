"""The command `rlservo key`."""

from __future__ import annotations

from typing import Annotated

import typer

from rlservo.deploy.terminal import Json, note, print_json


def key(
    label: Annotated[str, typer.Argument(help="Label of the key, such as a robot's or user's name; shown in logs.")],
    admin: Annotated[bool, typer.Option("--admin", help="Make an admin key; robots do not need one.")] = False,
    explore: Annotated[
        bool, typer.Option("--explore", help="Let the key also request exploratory actions ('rlservo learn').")
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(help="Requests per second that each process accepts from this key; unlimited by default."),
    ] = None,
    burst: Annotated[
        int | None, typer.Option(help="Requests accepted at once after a pause; one second's worth by default.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Make an API key. Prints the key for the client, and the line with its hash for the server's key file.

    Example: `rlservo key cell-7`; append the line to a file named in RLSERVO_API_KEYS_FILE
    """
    from rlservo.serve_app.server.api_keys import new_key

    secret, line = new_key(label, admin=admin, explore=explore, rate=rate, burst=burst)
    if as_json:
        print_json({"key": secret, "line": line})
        return
    note("the key, for the client; it is not stored and not shown again:")
    print(secret)
    note("the line, for the server's key file (RLSERVO_API_KEYS_FILE):")
    print(line)
