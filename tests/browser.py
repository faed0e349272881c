"""Chromium or Chrome for tests, by its DevTools protocol: tabs that visit, evaluate, press keys and note every request.

Protocol: https://chromedevtools.github.io/devtools-protocol (Page, Runtime, Network, Input, Emulation).
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import websockets.sync.client

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
REBOUND = "robot.rebound.test"  # a name that leads to this machine
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--no-first-run",
    "--remote-debugging-port=0",
    f"--host-resolver-rules=MAP {REBOUND} 127.0.0.1,MAP * ~NOTFOUND,EXCLUDE 127.0.0.1,EXCLUDE localhost",
)
PATIENCE_S = 60.0  # of a busy machine
LARGEST_MESSAGE = 64 << 20  # [bytes]; a picture is one
KEY_CODES = {"Tab": 9, "Enter": 13}


@dataclass
class Request:
    """A request of a tab; `ended` is None while it is on its way."""

    url: str
    headers: dict[str, str]
    began: float
    ended: float | None = None


@dataclass
class Tab:
    """A tab and what it has done so far."""

    socket: websockets.sync.client.ClientConnection
    requests: dict[str, Request] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)  # errors and warnings, those of the security policy among them
    _numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result; what happened meanwhile is noted."""
        number = next(self._numbers)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(PATIENCE_S))
            if message.get("id") == number:
                assert "error" not in message, (method, message)
                result: dict[str, Any] = message["result"]
                return result
            if "method" in message:
                self._note(message["method"], message["params"])

    def visit(self, url: str) -> None:
        """Open an address."""
        self.call("Page.navigate", url=url)

    def hurry(self, most_ms: int) -> None:
        """Let no timer of what is visited from now on wait longer than that."""
        source = f"{{ const later = setTimeout; window.setTimeout = (run, ms) => later(run, Math.min(ms, {most_ms})) }}"
        self.call("Page.addScriptToEvaluateOnNewDocument", source=source)

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript, awaited if it is a promise."""
        done = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, (expression, done)
        return done["result"].get("value")

    def wait_for(self, expression: str) -> Any:
        """Return the value of an expression as soon as it is true."""
        deadline = time.monotonic() + PATIENCE_S
        while not (value := self._try(expression)):
            assert time.monotonic() < deadline, (expression, self.text(), self.complaints)
            time.sleep(0.05)
        return value

    def _try(self, expression: str) -> Any:
        return self.evaluate(f"(() => {{ try {{ return {expression} }} catch {{ return null }} }})()")

    def text(self) -> str:
        """Return what can be read on the page."""
        return str(self.evaluate("document.body?.innerText ?? ''"))

    def wait_for_text(self, *parts: str) -> None:
        """Wait until all of these can be read."""
        self.wait_for(f"{json.dumps(parts)}.every(part => document.body.innerText.includes(part))")

    def press(self, key: str, *, shift: bool = False) -> None:
        """Press a key of the keyboard."""
        code, text = KEY_CODES[key], {"text": "\r"} if key == "Enter" else {}
        pressed = {"key": key, "code": key, "windowsVirtualKeyCode": code, "modifiers": 8 if shift else 0}
        self.call("Input.dispatchKeyEvent", type="keyDown", **pressed, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **pressed)

    def type(self, text: str) -> None:
        """Type into what has the focus."""
        self.call("Input.insertText", text=text)

    def resize(self, width: int, height: int, *, dark: bool = False) -> None:
        """Become a screen of this size, in CSS pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def save_picture(self, file: Path) -> None:
        """Write what is on the screen as a PNG file."""
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def _note(self, method: str, told: dict[str, Any]) -> None:
        number = told.get("requestId", "")
        if method == "Network.requestWillBeSent":
            sent = told["request"]
            self.requests[number] = Request(sent["url"], sent["headers"], told["timestamp"])
        elif method in ("Network.loadingFinished", "Network.loadingFailed") and number in self.requests:
            self.requests[number].ended = told["timestamp"]
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(str(told["exceptionDetails"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.complaints.append(f"{told['entry']['source']}: {told['entry']['text']}")


class Browser:
    """A running browser."""

    def __init__(self, address: str) -> None:
        """Take the address of its DevTools."""
        self._address = address

    @contextlib.contextmanager
    def tab(self) -> Iterator[Tab]:
        """Give a new tab, closed in the end."""
        asked = urllib.request.Request(f"{self._address}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(asked, timeout=PATIENCE_S) as reply:
            target = json.load(reply)
        url = target["webSocketDebuggerUrl"]
        with websockets.sync.client.connect(url, max_size=LARGEST_MESSAGE, compression=None, proxy=None) as socket:
            tab = Tab(socket)
            for domain in ("Page", "Runtime", "Network", "Log"):
                tab.call(f"{domain}.enable")
            yield tab
            tab.call("Page.close")


def browser_program() -> str:
    """Return the path of Chromium or Chrome; skip the test if there is none."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("no Chromium or Chrome is installed: no page was opened")
    return program


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that open a page."""
    for item in items:
        if {"browser", "chromium"} & set(getattr(item, "fixturenames", ())):
            item.add_marker("browser")


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A browser for all tests of this process, each with tabs of its own."""
    with browsing() as running:
        yield running


@contextlib.contextmanager
def browsing() -> Iterator[Browser]:
    """Start a browser that reaches nothing but this machine, and end it; skip the test if there is none."""
    program = browser_program()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        port_file, log = Path(folder, "DevToolsActivePort"), Path(folder, "log")
        with log.open("wb") as output:
            process = subprocess.Popen(
                [program, *FLAGS, f"--user-data-dir={folder}"], stdout=output, stderr=output, start_new_session=True
            )
        try:
            deadline = time.monotonic() + PATIENCE_S
            while not port_file.exists() or "\n" not in port_file.read_text():
                assert process.poll() is None and time.monotonic() < deadline, log.read_text()[-2000:]
                time.sleep(0.05)
            yield Browser(f"http://127.0.0.1:{port_file.read_text().split()[0]}")
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
