"""/docs in a real browser that can reach nothing but this machine, as on a robot's network."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from browser import Browser
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.docs_page import PAGE
from rlservo.serve_app.server.settings import ServerSettings
from stores import load_store

# uvicorn 0.54 picks a protocol that it itself calls deprecated; Ray Serve leaves the choice to it.
pytestmark = pytest.mark.filterwarnings("ignore:The `websockets` implementation:DeprecationWarning")


def test_the_page_names_no_other_host() -> None:
    addresses = re.findall(r'(?:src|href|url)[=:]\s*"([^"]*)"', PAGE)
    assert len(addresses) == 4
    assert not [address for address in addresses if address.startswith(("/", "http"))]


def test_the_documentation_is_drawn_and_tried_out_without_the_internet(
    browser: Browser, policies: Path, served: Callable[[Any], AbstractContextManager[int]]
) -> None:
    store = load_store(policies)
    with served(create_app(lambda: store, ServerSettings())) as port, browser.tab() as tab:
        tab.visit(f"http://127.0.0.1:{port}/docs")
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
        assert tab.evaluate(f"fetch('/v1/policies/ur5/act', {act}).then(reply => reply.status)") == 200
        asked = {request.url for request in tab.requests.values() if not request.url.startswith("data:")}
        assert {address.split("/")[2] for address in asked} == {f"127.0.0.1:{port}"}
        assert tab.complaints == []  # nothing that it needs is forbidden by its security policy
