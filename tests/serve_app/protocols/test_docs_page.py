"""/docs in a real browser that can reach nothing but this machine, as on a robot's network."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from browser import BROWSERS
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.docs_page import PAGE
from rlservo.serve_app.server.settings import ServerSettings
from stores import load_store

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--virtual-time-budget=20000",
)
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"

# uvicorn 0.54 picks a protocol that it itself calls deprecated; Ray Serve leaves the choice to it.
pytestmark = pytest.mark.filterwarnings("ignore:The `websockets` implementation:DeprecationWarning")


def test_the_page_names_no_other_host() -> None:
    addresses = re.findall(r'(?:src|href|url)[=:]\s*"([^"]*)"', PAGE)
    assert len(addresses) == 4
    assert not [address for address in addresses if address.startswith(("/", "http"))]


def test_the_documentation_is_drawn_without_the_internet(
    policies: Path, served: Callable[[Any], AbstractContextManager[int]], tmp_path: Path
) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no Chromium or Chrome is installed: /docs was not drawn")
    store = load_store(policies)
    with served(create_app(lambda: store, ServerSettings())) as port:
        done = subprocess.run(
            [browser, *FLAGS, "--virtual-time-budget=20000", OFFLINE, f"--user-data-dir={tmp_path}", "--dump-dom", f"http://127.0.0.1:{port}/docs"],
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
    drawn = set(re.findall(r'data-path="([^"]*)"', done.stdout))  # what Swagger UI makes of /openapi.json
    assert {"/v1/policies/{name}/act", "/v2/models/{name}/infer", "/healthz"} <= drawn, done.stderr[-2000:]
