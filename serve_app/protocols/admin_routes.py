"""Administration over HTTP: load, unload, alias, rollback, canary, shadow, and the recordings.

A command answers once the change is proven, written into the repository's plan, and served by the process that received
it; the other processes follow. `access_checks.authorize` requires an admin key. The Open Inference Protocol's `load`
and `unload` are two of these commands under other names.

Of recordings a remote learner gets names, sizes, and bytes from any offset: files only grow, so a copy continues at its
end.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

from rlservo.errors import RequestError
from rlservo.serve_app.protocols.error_statuses import JSON_HEADERS, Headers
from rlservo.serve_app.protocols.http_endpoint import OCTETS, check_media_type
from rlservo.serve_app.protocols.request_fields import encode_json, parse_json
from rlservo.serve_app.protocols.routing import GET, POST, Answer, Call, Route
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.logs import OK
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.versions.deployment_plan import Plan
from rlservo.serve_app.versions.plan_commands import COMMANDS, Changed, Command, Load, Unload, parse

MOST_BYTES = 8 << 20  # of a recording, in a reply


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v1/admin, and the repository extension's load and unload."""

    async def carry_out(call: Call, command: Command) -> Plan:
        name, entry = call.params["name"], call.audit
        entry.command, entry.policy, entry.change = command.verb, name, command.line(name)
        entry.version = getattr(command, "version", None)
        after = await handler.control.give(command, name)
        entry.code, entry.generation = OK, after.generation
        return after

    def commanded(command: str) -> Answer:
        async def answer(call: Call) -> tuple[bytes, Headers]:
            check_media_type(call.headers)
            document, _ = parse_json(call.body, such_as='{"version": "2"}')
            given = parse(command, document)
            after = await carry_out(call, given)
            return Changed.of(after, call.params["name"], given.notes).model_dump_json().encode(), JSON_HEADERS

        return answer

    # Triton's clients send a body, as JSON or as octets, whose parameters mean nothing here: it is not read. As on a
    # Triton with pinned versions, loading changes what clients get only if the model was not served at all. Moving
    # `production` is left to /v1/admin, which has a rollback.
    def repository(kind: type[Load | Unload]) -> Answer:
        async def answer(call: Call) -> tuple[bytes, Headers]:
            check_media_type(call.headers, OCTETS, optional=True)
            await carry_out(call, kind())
            return b"{}", JSON_HEADERS

        return answer

    admin, model = "/v1/admin/policies", "/v2/repository/models/{name}"
    load, unload = "Load a model's newest version", "Unload all versions of a model"
    return [
        *(
            Route(POST, f"{admin}/{{name}}/{command}", Access.admin, kind.summary, commanded(command))
            for command, kind in COMMANDS.items()
        ),
        Route(POST, f"{model}/load", Access.admin, load, repository(Load)),
        Route(POST, f"{model}/unload", Access.admin, unload, repository(Unload)),
        *_recordings(handler),
    ]


def _recordings(handler: RequestHandler) -> list[Route]:
    def folder() -> Path:
        if handler.settings.record is None:
            raise RequestError("this server does not record: start it with --record FOLDER")
        return Path(handler.settings.record)

    def sizes() -> dict[str, int]:
        return {path.name: path.stat().st_size for path in sorted(folder().glob("*.mcap"))}

    def piece(file: str, begin: str) -> bytes:
        if not begin.isdigit() or len(begin) > 18:
            raise RequestError(f"{begin[:40]!r} is not an offset in a recording: expected a number, 0 or more")
        path = folder() / file
        if path.suffix != ".mcap" or not path.is_file():  # perhaps deleted since it was listed, as the oldest ones are
            return b""
        with path.open("rb") as stream:
            stream.seek(int(begin))
            return stream.read(MOST_BYTES)

    async def recordings(_call: Call) -> tuple[bytes, Headers]:
        return encode_json(await asyncio.to_thread(sizes)), JSON_HEADERS

    async def recording(call: Call) -> tuple[bytes, Headers]:
        return await asyncio.to_thread(piece, call.params["file"], call.params["begin"]), ((b"content-type", OCTETS),)

    place = "/v1/admin/recordings"
    return [
        Route(GET, place, Access.admin, "Recordings and their sizes [bytes], by name", recordings),
        Route(GET, f"{place}/{{file}}/{{begin}}", Access.admin, "Bytes of a recording, at most 8 MiB", recording),
    ]
