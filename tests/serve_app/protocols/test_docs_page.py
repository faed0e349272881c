"""/docs in a real browser that can reach nothing but this machine, as on a robot's network."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import httpx
import pytest

from browser import Browser
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.pages import FOLDER
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn
from stores import control_of, load_store


def test_the_page_names_no_other_host() -> None:
    page = (FOLDER / "docs.html").read_text() + (FOLDER / "docs.js").read_text()
    addresses = re.findall(r'(?:src|href|url)[=:]\s*"([^"]*)"', page)
    assert len(addresses) == 5
    assert not [address for address in addresses if address.startswith(("/", "http"))]


class BehindPrefix:
    """An application behind a proxy that takes a prefix off and says nothing of it, as nginx does."""

    def __init__(self, app: Any, prefix: str) -> None:
        self._app, self._prefix = app, prefix

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "lifespan":
            assert scope["path"].startswith(self._prefix)
            path = scope["path"][len(self._prefix) :]
            scope = {**scope, "path": path, "raw_path": path.encode()}
        await self._app(scope, receive, send)


def test_the_document_says_that_its_paths_are_beside_it(policies: Path) -> None:
    store = load_store(policies)
    app = create_app(control_of(store), ServerSettings())
    with over_uvicorn(BehindPrefix(app, "/robots")) as port:
        address = f"http://127.0.0.1:{port}/robots/openapi.json"
        (server,) = httpx.get(address, trust_env=False).json()["servers"]
        url = urljoin(address, server["url"]).rstrip("/") + "/healthz"
        assert httpx.get(url, trust_env=False).text == "OK"


@pytest.mark.parametrize("prefix", ["", "/robots"])
def test_the_documentation_is_drawn_and_tried_out_without_the_internet(
    browser: Browser, policies: Path, prefix: str
) -> None:
    store = load_store(policies)
    app = BehindPrefix(create_app(control_of(store), ServerSettings()), prefix)
    with over_uvicorn(app) as port, browser.tab() as tab:
        tab.visit(f"http://127.0.0.1:{port}{prefix}/docs")
        drawn = tab.wait_for(  # what Swagger UI makes of /openapi.json
            "(drawn => drawn.length > 3 && drawn.map(path => path.dataset.path))"
            "([...document.querySelectorAll('[data-path]')])"
        )
        assert {"/v1/policies/{name}/act", "/v2/models/{name}/infer", "/healthz"} <= set(drawn)
        for button in ("[id$=healthz_healthz_get] button", ".try-out__btn", ".execute"):
            tab.wait_for(f"(document.querySelector('{button}').click(), true)")
        tab.wait_for("document.querySelector('.live-responses-table').innerText.includes('OK')")
        # A page of the server's own may also ask for actions.
        body = "JSON.stringify({obs: Array(27).fill(0)})"
        act = f"{{method: 'POST', headers: {{'content-type': 'application/json'}}, body: {body}}}"
        assert tab.evaluate(f"fetch('{prefix}/v1/policies/ur5/act', {act}).then(reply => reply.status)") == 200
        asked = {request.url for request in tab.requests.values() if not request.url.startswith("data:")}
        assert {address.split("/")[2] for address in asked} == {f"127.0.0.1:{port}"}
        assert tab.complaints == []  # nothing that it needs is forbidden by its security policy
