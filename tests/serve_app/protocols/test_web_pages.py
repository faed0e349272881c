"""Pages of other origins in a real browser, which send a policy server everything that a browser lets them send.

The page is served in three ways: from the policy server's own address, where its requests succeed (which shows that
they are valid); from another port; and under a name that now resolves to the policy server ("DNS rebinding").
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from browser import REBOUND, Browser
from bundles import controlled, write_leaky_policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower
from servers import over_uvicorn

Controlled = Callable[..., AbstractContextManager[PlanFollower]]

SESSION = "robot-7"
ACT = {"obs": [0.1, 0.2, 0.3], "session_id": SESSION}
INFER = {
    "parameters": {"sequence_id": SESSION},
    "inputs": [{"name": "obs", "shape": [1, 3], "datatype": "FP32", "data": [0.1, 0.2, 0.3]}],
}
PAGE = """<!DOCTYPE html><meta charset="utf-8"><title>page</title><body><script>
const target = %(target)s, act = %(act)s, infer = %(infer)s;
const posts = [
  ["act", "/v1/policies/leaky/act", act], ["infer", "/v2/models/leaky/infer", infer],
  ["unload", "/v2/repository/models/leaky/unload", "{}"], ["load", "/v2/repository/models/leaky/load", "{}"],
  ["newline", "/v2/repository/models/leaky/unload%%0a", "{}"],
  ["admin", "/v1/admin/policies/leaky/unload", "{}"], ["index", "/v2/repository/index", "{}"],
];
const out = {};
const note = async (name, promise) => {
  try { const reply = await promise; out[name] = reply && reply.type === "opaque" ? "sent" : reply && reply.status; }
  catch (error) { out[name] = String(error); }
};
const form = (path, body) => new Promise(done => {
  const frame = document.createElement("iframe"); frame.name = "f" + Math.random(); document.body.append(frame);
  const form = document.createElement("form"), input = document.createElement("input");
  const cut = body.lastIndexOf("}");
  Object.assign(form, {method: "POST", action: target + path, enctype: "text/plain", target: frame.name});
  const start = body.slice(0, cut) + (cut > 1 ? "," : "");
  Object.assign(input, {type: "hidden", name: start + '"reset":false,"x":"', value: '"}'});
  form.append(input); document.body.append(form);
  frame.onload = () => done({status: "loaded"}); setTimeout(() => done({status: "waited"}), 3000); form.submit();
});
const socket = path => new Promise(done => {
  const ws = new WebSocket(target.replace("http", "ws") + path);
  ws.onopen = () => { ws.close(); done({status: "open"}); }; ws.onerror = () => done({status: "refused"});
});
(async () => {
  for (const [name, path, body] of posts) {
    const blob = type => new Blob([body], type ? {type} : {});
    const send = (mode, type) => fetch(target + path, {method: "POST", mode, body: blob(type)});
    await note(name + " blob", send("no-cors", ""));
    await note(name + " text", send("no-cors", "text/plain"));
    await note(name + " no referrer", fetch(target + path,
      {method: "POST", mode: "no-cors", body: new Blob([body]), referrerPolicy: "no-referrer"}));
    await note(name + " json", send("cors", "application/json"));
    await note(name + " octets", send("cors", "application/octet-stream"));
    await note(name + " beacon", Promise.resolve({status: navigator.sendBeacon(target + path, new Blob([body]))}));
    await note(name + " form", form(path, body));
  }
  for (const path of ["/", "/v1/policies/leaky/stream"]) await note("socket " + path, socket(path));
  for (const path of ["/v1/policies", "/v2/repository/index", "/metrics"])
    await note("read " + path, fetch(target + path));
  await note("read page", fetch(target + "/", {headers: {accept: "text/html"}}));
  await fetch("/report", {method: "POST", headers: {"content-type": "application/json"}, body: JSON.stringify(out)});
})();
</script>"""


@dataclass
class Pages:
    """An ASGI application that serves the page and takes its report, and leaves everything else to another one."""

    app: Any
    page: str = ""
    report: dict[str, Any] = field(default_factory=dict)
    reported: threading.Event = field(default_factory=threading.Event)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http" or scope["path"] not in ("/page.html", "/report"):
            await self.app(scope, receive, send)
            return
        if scope["path"] == "/report":
            body, more = b"", True
            while more:
                message = await receive()
                body, more = body + message.get("body", b""), message.get("more_body", False)
            self.report = json.loads(body)
            self.reported.set()
        content = self.page.encode()
        headers = [(b"content-type", b"text/html"), (b"content-length", b"%d" % len(content))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": content})


async def nothing(scope: Any, receive: Any, send: Any) -> None:
    """An application with no page of its own."""
    if scope["type"] == "lifespan":
        return
    await send({"type": "http.response.start", "status": 404, "headers": [(b"content-length", b"0")]})
    await send({"type": "http.response.body", "body": b""})


def visit(browser: Browser, url: str, pages: Pages) -> dict[str, Any]:
    """Open a page, and wait for its report."""
    with browser.tab() as tab:
        tab.visit(url)
        assert pages.reported.wait(180), tab.complaints
    return pages.report


def page_for(target: str) -> str:
    return PAGE % {
        "target": json.dumps(target),
        "act": json.dumps(json.dumps(ACT)),
        "infer": json.dumps(json.dumps(INFER)),
    }


@dataclass(frozen=True)
class Target:
    port: int
    pages: Pages
    control: PlanFollower

    def step(self, **more: Any) -> int:
        """Ask once, as the robot; return which step of its episode that was."""
        url = f"http://127.0.0.1:{self.port}/v1/policies/leaky/act"
        reply = httpx.post(url, json={**ACT, **more}, timeout=20)
        assert reply.status_code == 200, reply.text
        return int(reply.json()["session_step"])


@pytest.fixture
def target(tmp_path: Path) -> Iterator[Target]:
    """A server without keys but the operator's, one policy with a memory, and a session on it."""
    write_leaky_policy(tmp_path / "policies")
    _, line = new_key("operator", admin=True)
    with controlled(tmp_path / "policies") as control:
        pages = Pages(create_app(control, ServerSettings(operator_key=line.split()[-1])))
        with over_uvicorn(pages) as port:
            yield Target(port, pages, control)


def check_untouched(target: Target, report: dict[str, Any], plan: Any) -> None:
    assert target.step() == 2, report  # the session has not moved since
    assert target.control.plan == plan and target.control.store is not None
    assert target.control.store.names == ("leaky",)
    assert {report[name] for name in report if name.startswith("socket")} == {"refused"}, report
    assert not [name for name, outcome in report.items() if name.startswith("read") and outcome == 200], report


def test_the_servers_own_page_gets_through(browser: Browser, target: Target) -> None:
    """Or the tests below would show nothing."""
    target.step(reset=True)
    target.pages.page = page_for(f"http://127.0.0.1:{target.port}")
    report = visit(browser, f"http://127.0.0.1:{target.port}/page.html", target.pages)
    assert report["act json"] == report["infer json"] == report["infer octets"] == report["read /v1/policies"] == 200
    assert report["read page"] == 200
    assert report["socket /"] == report["socket /v1/policies/leaky/stream"] == "open"
    assert report["unload json"] == report["admin json"] == 401 and report["newline json"] == 400
    # What a form can send is not answered even here.
    assert [report[f"{name} {kind}"] for name in ("act", "infer") for kind in ("blob", "text")] == [415] * 4
    assert target.step() == 5  # the first, three that the page was answered, and this one


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_page_from_another_port_moves_nothing(browser: Browser, target: Target, host: str) -> None:
    """127.0.0.1 on another port is the same site to a browser, localhost another one."""
    target.step(reset=True)
    plan = target.control.plan
    pages = Pages(nothing, page_for(f"http://127.0.0.1:{target.port}"))
    with over_uvicorn(pages) as port:
        report = visit(browser, f"http://{host}:{port}/page.html", pages)
    assert report["act blob"] == report["infer blob"] == "sent", report
    check_untouched(target, report, plan)


def test_a_page_whose_name_leads_to_the_server_moves_and_reads_nothing(browser: Browser, target: Target) -> None:
    target.step(reset=True)
    plan = target.control.plan
    url = f"http://{REBOUND}:{target.port}"
    target.pages.page = page_for(url)
    report = visit(browser, f"{url}/page.html", target.pages)
    answers = {outcome for name, outcome in report.items() if not name.endswith(("form", "beacon"))}
    assert answers == {403, 400, "refused"}, report
    check_untouched(target, report, plan)
