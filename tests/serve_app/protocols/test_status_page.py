"""The page at `/`: its access and links, and its display in a real browser."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from browser import Browser, Tab
from bundles import controlled, write_box_policy, write_discrete_policy
from rlservo.bundle.bundle import read_contract, write_contract
from rlservo.bundle.contract import BakedStep
from rlservo.bundle.spaces import BoxSpec, Element
from rlservo.client.admin_client import AdminClient
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.pages import FOLDER
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_commands import SetAlias
from rlservo.serve_app.versions.plan_follower import PlanFollower
from servers import over_uvicorn
from stores import control_of, load_store

Controlled = Callable[..., AbstractContextManager[PlanFollower]]

CHROMIUM = "text/html,application/xhtml+xml,application/xml;q=0.9,image/avif,image/webp,*/*;q=0.8"
PAGE = {"accept": CHROMIUM}
OPERATOR, OPERATOR_LINE = new_key("operator", admin=True)
ROBOT, ROBOT_LINE = new_key("cell-7")
FIRST = {"policies": {"ur5": {"aliases": {"production": "1"}}}}  # which version is in use
POLICY = "document.querySelector('#policy-ur5').parentElement"
CONTRACT_BUTTON = f"{POLICY}.querySelector('tbody button')"
MARKUP = "<img src=x onerror='window.broken=1'><script>window.broken=1</script>&amp;"
ROUND_MS = 250  # between two of the page's looks, instead of two seconds
# Where pictures for the documents go, if they are wanted: CONTRIBUTING.md has the command.
PICTURES = os.environ.get("RLSERVO_TEST_PICTURES")


def test_programs_get_at_the_root_what_they_always_got(policies: Path) -> None:
    store = load_store(policies)
    for settings, statuses in ((ServerSettings(), (404, 404)), (ServerSettings(api_keys=ROBOT_LINE), (401, 404))):
        with over_uvicorn(create_app(control_of(store), settings)) as port, httpx.Client() as client:
            for accept in ("", "*/*", "application/json", "application/json, text/html;q=0.9"):
                headers = {"accept": accept}
                for key, status in zip(({}, {"authorization": f"Bearer {ROBOT}"}), statuses, strict=True):
                    reply = client.get(f"http://127.0.0.1:{port}/", headers={**headers, **key})
                    assert (reply.status_code, reply.headers["content-type"]) == (status, "application/json")
                    assert reply.json()["code"] == {401: "unauthenticated", 404: "not-found"}[status]
                    assert status == 401 or reply.headers["vary"] == "Accept"
            for method in ("POST", "PUT", "DELETE"):  # the page is no target of forms
                assert client.request(method, f"http://127.0.0.1:{port}/", headers=PAGE).status_code == statuses[0]


def test_the_page_is_open_its_data_are_not_and_nothing_may_be_added_to_it(policies: Path) -> None:
    store = load_store(policies)
    with (
        over_uvicorn(create_app(control_of(store), ServerSettings(api_keys=ROBOT_LINE))) as port,
        httpx.Client() as client,
    ):
        url = f"http://127.0.0.1:{port}"
        page = client.get(f"{url}/", headers=PAGE)
        assert page.status_code == 200 and page.content == (FOLDER / "index.html").read_bytes()
        assert page.headers["vary"] == "Accept" and client.head(f"{url}/", headers=PAGE).status_code == 200
        names = re.findall(r'(?:src|href)="(page/[^"]*)"', page.text) + ["page/dom.js"]
        assert len(names) == 4
        for reply in [page, *(client.get(f"{url}/{name}") for name in names)]:
            assert reply.status_code == 200
            rules = dict(rule.split(" ", 1) for rule in reply.headers["content-security-policy"].split("; "))
            assert rules.pop("default-src") == "'none'" and rules.pop("frame-ancestors") == "'none'"
            assert {rules.pop(f"{kind}-src") for kind in ("script", "style", "img", "connect")} == {"'self'"}
            assert rules == {
                "base-uri": "'none'",
                "form-action": "'none'",
                "require-trusted-types-for": "'script'",
                "trusted-types": "'none'",
            }
            assert reply.headers["referrer-policy"] == "no-referrer" and reply.headers["cache-control"] == "no-store"
            assert reply.headers["x-content-type-options"] == "nosniff" and reply.headers["x-frame-options"] == "DENY"
            assert reply.headers["cross-origin-resource-policy"] == "same-origin"
            assert "access-control-allow-origin" not in reply.headers and "set-cookie" not in reply.headers
        for path in ("page/index.html", "page/%2e%2e/status_page.py", "page/", "page", "page/x.js"):
            assert client.get(f"{url}/{path}", headers=PAGE).status_code in (400, 401, 404), path
        for path in ("v1/policies", "v1/policies/ur5", "metrics", "nowhere"):
            assert client.get(f"{url}/{path}", headers=PAGE).status_code == 401, path
        rebound = client.get(f"{url}/", headers={**PAGE, "host": "evil.example"})
        assert (rebound.status_code, rebound.json()["code"]) == (403, "forbidden")


def test_the_page_names_no_other_host_and_keeps_nothing() -> None:
    """What the security policy forbids is not tried either."""
    for file in FOLDER.iterdir():
        text = re.sub(r"^\s*(//|/?\*).*$", "", file.read_text(), flags=re.MULTILINE)
        assert set(re.findall(r"https?://[^\s\"'/]*", text)) <= {"http://www.w3.org"}, file
        for forbidden in (
            "innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function", "localStorage",
            "sessionStorage", "indexedDB", "cookie", "style=", "<style", "postMessage", "import(",
        ):  # fmt: skip
            assert forbidden not in text, (file, forbidden)
        assert not re.search(r"[\"'`=]/(v1|v2|page|docs|metrics)\b", text), file  # it works below a route prefix, too
        assert not re.search(r"<script(?![^>]*\bsrc=)|\son\w+=\"", text), file


@dataclass(frozen=True)
class Served:
    port: int

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def act(self, times: int = 1, key: str = "", value: float = 0.0) -> None:
        """Ask for actions, as a robot does."""
        headers = {"authorization": f"Bearer {key}"} if key else {}
        with httpx.Client(headers=headers, timeout=20) as client:
            for _ in range(times):
                reply = client.post(f"{self.url}/v1/policies/ur5/act", json={"obs": [value] * 27})
                assert reply.status_code == 200, reply.text


JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
NAMES = [f"{part} {joint}" for part in ("position of", "speed of", "last target of") for joint in JOINTS]
NAMES += [f"{part} {axis}" for part in ("target", "hand", "obstacle") for axis in "xyz"]


def describe(folder: Path, **changes: Any) -> None:
    """Give a bundle of `write_box_policy` a filter, and what else its contract shall say."""
    contract = read_contract(folder)
    values = {"count": 1000.0, "mean": [0.0] * 27, "std": [0.5] * 27}
    step = BakedStep(step="mean_std_filter", detail=changes.pop("detail", "RLlib's filter"), values=values)
    write_contract(folder, contract.model_copy(update={"baked_in": (step, *contract.baked_in), **changes}))


def observations(*names: str, unit: str = "rad") -> BoxSpec:
    elements = tuple(Element(name=name, unit=unit) for name in names)
    return BoxSpec(shape=(27,), dtype="float32", low=-2.0, high=None, elements=elements)


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ur5 in versions 1 and 2, both with a filter; gridworld."""
    root = tmp_path_factory.mktemp("policies")
    space = observations(*NAMES)
    for seed, version in enumerate("12"):
        folder = write_box_policy(root, version=version, seed=seed)
        describe(folder, description="Brings the arm's hand to a target.", observation_space=space)
    write_discrete_policy(root)
    return root


@pytest.fixture
def server(repository: Path) -> Iterator[Served]:
    """A server that asks for a key only who administers it; version 1 is in use."""
    with controlled(repository, config=FIRST) as control:
        settings = ServerSettings(operator_key=OPERATOR_LINE.split()[-1])
        with over_uvicorn(create_app(control, settings, replica="replica-a")) as port:
            yield Served(port)


@pytest.fixture
def tab(browser: Browser) -> Iterator[Tab]:
    """A tab, 1280 pixels wide; at its end nothing but this machine may have been asked, and nothing complained."""
    with browser.tab() as opened:
        opened.resize(1280, 900)
        opened.hurry(ROUND_MS)
        yield opened
        hosts = {re.sub(r"^(\w+://[^/:]*).*", r"\1", request.url) for request in opened.requests.values()}
        assert {host for host in hosts if not host.startswith("data:")} <= {"http://127.0.0.1"}, hosts
        assert opened.evaluate("window.broken") is None


def picture(tab: Tab, name: str, folder: Path) -> None:
    """Save what is on the screen, for the documents where they are wanted."""
    tab.save_picture(Path(PICTURES or folder) / f"{name}.png")


def chart(tab: Tab, title: str) -> dict[str, Any]:
    """Return ur5's chart of this title: its levels' heights, its ticks' places and its curves' points."""
    texts = "[...svg.querySelectorAll(kind)].map(node => [node.textContent, node.getAttribute(at)])"
    found = tab.evaluate(
        f"(() => {{ const named = figure => figure.querySelector('strong').textContent === {title!r};"
        f"const svg = [...{POLICY}.querySelectorAll('figure')].find(named).querySelector('svg');"
        f"const texts = (kind, at) => {texts};"
        "const lines = [...svg.querySelectorAll('.grid')].map(line => line.getAttribute('d').match(/,([^H]*)/)[1]);"
        "return {levels: texts('.level', 'y'), lines, ticks: texts('text:not(.level)', 'x'),"
        " curves: [...svg.querySelectorAll('.curve')].map(curve => curve.getAttribute('d'))} })()"
    )
    assert [height for _, height in found["levels"]] == found["lines"]
    points = [re.findall(r"([\d.]+),([\d.]+)", path) for path in found["curves"]]
    return {
        "levels": {float(text): float(height) for text, height in found["levels"]},
        "ticks": {text: float(place) for text, place in found["ticks"]},
        "curves": [[(float(x), float(y)) for x, y in curve] for curve in points],
    }


def row(version: str) -> str:
    """Return the expression of a version's cells, by their headings."""
    return (
        f"(() => {{ const table = {POLICY}.querySelector('table');"
        "const names = [...table.querySelectorAll('thead th')].map(cell => cell.textContent);"
        f"const line = [...table.tBodies[0].rows].find(line => line.cells[0].textContent === '{version}');"
        "return Object.fromEntries(names.map((name, index) => [name, line.cells[index].textContent])); })()"
    )


def test_the_page_shows_what_runs_and_sees_a_switch_of_versions(tab: Tab, server: Served, tmp_path: Path) -> None:
    server.act(40, value=1.0)  # two standard deviations off
    tab.visit(server.url)
    tab.wait_for_text("2 policies served", "Versions of ur5", "gridworld")
    cells = tab.wait_for(row("1"))
    assert (cells["State"], cells["Aliases"], cells["Requests"], cells["Failures"]) == (
        "ready",
        "production",
        "40",
        "0",
    )
    assert cells["Latency p50 / p99"].endswith(" ms, earlier") and "27 of 27 far; most 2 σ" in cells["Drift"]
    assert tab.evaluate(row("2"))["Drift"] == "nothing seen yet"

    # The open contract, the focus and the selection survive a refresh.
    tab.evaluate(f"{CONTRACT_BUTTON}.focus()")
    tab.press("Enter")
    tab.wait_for_text("Contract of ur5, version 1", "Observation, element by element", "obstacle z")
    buttons = "document.querySelectorAll('[aria-controls=policy-ur5-contract]')"
    tab.evaluate(f"[1, 0].forEach(index => {buttons}[index].click())")  # asked for at once, and sent one by one
    tab.wait_for_text("Contract of ur5, version 1")
    with AdminClient(server.url, api_key=OPERATOR) as admin:
        admin.canary("ur5", "2", 0.25)
        admin.shadow("ur5", "2")
        tab.wait_for_text("version 2 gets 25% of the sessions", "version 2 computes along")
        admin.canary("ur5", None)
        admin.alias("ur5", "production", "2")
    tab.wait_for_text("ur5: production leads to version 2 (before: 1)", "version 2 (a rollback leads to 1)")
    server.act(30)
    tab.wait_for(f"{row('2')}.Requests === '30' && Number({row('2')}['Per second']) > 0")
    cells = tab.evaluate(row("2"))
    assert cells["Aliases"] == "production" and re.fullmatch(r"[\d.]+ / [\d.]+ ms", cells["Latency p50 / p99"])
    assert tab.evaluate("document.activeElement.getAttribute('aria-label')") == "Contract of ur5, version 1"
    assert tab.evaluate("document.title") == "rlservo: 2 policies"
    for _ in range(150 if PICTURES else 0):  # curves take their time
        server.act(3)
        tab.evaluate(f"new Promise(resolve => setTimeout(resolve, {ROUND_MS}))")
    tab.evaluate("scrollTo(0, 0)")
    picture(tab, "status_page", tmp_path)
    assert tab.complaints == []

    # One request at a time, and no other than these.
    asked = [request for request in tab.requests.values() if "/page/" not in request.url]
    paths = [request.url.removeprefix(server.url) for request in asked]
    contracts = {f"/v1/policies/ur5/versions/{version}" for version in "12"}
    assert set(paths) == {"/", "/v1/policies", "/metrics", *contracts}
    for before, after in itertools.pairwise(asked):
        assert before.ended is not None and before.ended <= after.began, (before, after)
    assert not [request for request in tab.requests.values() if request.headers.get("Referer")]

    # The changes from before the page was opened.
    tab.visit(server.url)
    tab.wait_for_text("plan 1, configuration", ", alias ur5 production=2")


def test_the_page_shows_how_each_version_succeeds(tab: Tab, server: Served) -> None:
    tab.visit(server.url)
    tab.wait_for_text("Versions of ur5")
    curves = f"{POLICY}.querySelectorAll('.curve').length"
    assert "by version" not in tab.text() and tab.evaluate(curves) == 0  # an empty chart has words, not axes
    for version, endings in (("1", ["collision"] * 3 + ["success"]), ("2", ["success"] * 4)):
        for status in endings:
            end = {"obs": [0.0] * 27, "final_status": status}
            assert httpx.post(f"{server.url}/v1/policies/ur5/versions/{version}/act", json=end).status_code == 200
    tab.wait_for_text("Episodes that succeeded, by version: 25% of 4 with 1, … 100% of 4 with 2")
    drawn = chart(tab, "Success by version [%]")
    assert drawn["levels"] == {0.0: 120.0, 50.0: 64.0, 100.0: 8.0} and list(drawn["ticks"]) == ["1", "2"]
    (success,) = drawn["curves"]
    assert [y for _, y in success] == [92.0, 8.0]  # 25% and 100%
    assert [x for x, _ in success] == pytest.approx(list(drawn["ticks"].values()), abs=0.1)


def test_the_page_draws_requests_and_latency_over_time(tab: Tab, server: Served) -> None:
    tab.visit(server.url)
    tab.wait_for_text("Versions of ur5", "No requests yet: their rate")
    for _ in range(3):
        server.act(5)
        tab.evaluate(f"new Promise(resolve => setTimeout(resolve, {ROUND_MS}))")
    counted = "[...document.querySelectorAll('.curve')].every(curve => curve.getAttribute('d').includes('L'))"
    tab.wait_for(f"document.querySelector('.curve') && {counted}")
    assert tab.evaluate("document.querySelector('.facts').textContent").startswith("In useversion 1")

    drawn = chart(tab, "Latency [ms]")
    levels = sorted(drawn["levels"])
    assert len(levels) >= 2 and all(b == pytest.approx(10 * a) for a, b in itertools.pairwise(levels)), levels
    heights = [drawn["levels"][level] for level in levels]
    assert heights == sorted(heights, reverse=True) and (heights[0], heights[-1]) == (120.0, 8.0)
    # What the curves end at is what the versions' table says: the one version that answered, in the same look.
    shown = tab.evaluate(f"({row('1')})['Latency p50 / p99']")
    decades = np.interp([curve[-1][1] for curve in drawn["curves"]], heights[::-1], np.log10(levels)[::-1])
    assert 10**decades == pytest.approx([float(part) for part in shown.removesuffix(" ms").split(" / ")], rel=0.1)
    median, high = drawn["curves"]
    assert all(below[1] >= above[1] for below, above in zip(median, high, strict=True))  # y grows downwards
    # Times are local, and where the axis says.
    assert len(drawn["ticks"]) >= 3 and all(re.fullmatch(r"\d\d:\d\d:\d\d", text) for text in drawn["ticks"])
    seconds = [int(text[-2:]) for text in drawn["ticks"]]
    assert all((b - a) % 60 == 15 for a, b in itertools.pairwise(seconds))
    rates = chart(tab, "Requests [1/s]")
    assert rates["levels"][0.0] == 120.0 and rates["levels"][max(rates["levels"])] == 8.0
    answered, failed = rates["curves"]
    assert {y for _, y in failed} == {120.0} and answered[-1][1] < 120.0 and len(answered) == len(failed)
    assert tab.complaints == []


def test_what_a_policy_says_of_itself_is_text(tab: Tab, tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path)
    space = observations(MARKUP, *NAMES[1:], unit="<b>rad</b>")
    describe(folder, description=f"Reaches a target. {MARKUP}", observation_space=space, detail=MARKUP)
    store = load_store(tmp_path)
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as port:
        Served(port).act(16)
        tab.visit(f"http://127.0.0.1:{port}")
        tab.wait_for_text(f"Reaches a target. {MARKUP}", "most 0 σ: <img")
        tab.evaluate(f"{CONTRACT_BUTTON}.click()")
        tab.wait_for_text("Contract of ur5, version 1", "<b>rad</b>", f"mean std filter: {MARKUP}")
        line = "[...document.querySelectorAll('.contract tbody tr')].find(row => row.textContent.includes('img'))"
        assert tab.evaluate(f"{line}.cells[1].textContent") == MARKUP
        assert tab.evaluate(f"{line}.cells[7].textContent") == "0"  # its drift, found by that name
        assert tab.evaluate("document.querySelectorAll('main img, main script, main b').length") == 0
        # Even a fault of the page's own script could not make markup of it.
        tried = "(() => { try { document.body.innerHTML = '<p>' } catch (error) { return error.name } })()"
        assert tab.evaluate(tried) == "TypeError"
        assert tab.evaluate("document.querySelectorAll('script').length") == 1


@pytest.mark.slow
def test_several_replicas_are_summed_and_their_differences_said(tab: Tab, repository: Path) -> None:
    """Behind a proxy that takes turns, each answer is another replica's."""
    with controlled(repository, config=FIRST) as one, controlled(repository, config=FIRST) as other:
        replicas = [
            create_app(control, ServerSettings(), replica=name)
            for control, name in ((one, "replica-a"), (other, "replica-b"))
        ]
        turns = itertools.cycle(replicas)

        async def proxy(scope: Any, receive: Any, send: Any) -> None:
            await (replicas[0] if scope["type"] == "lifespan" else next(turns))(scope, receive, send)

        with over_uvicorn(proxy) as port:
            Served(port).act(50)
            tab.visit(f"http://127.0.0.1:{port}")
            tab.wait_for_text("replica-a", "replica-b", "the sum of what these said")
            tab.wait_for(f"{row('1')}.Requests === '50' && {row('1')}.State === 'ready'")
            assert one.plan is not None
            asyncio.run(one.give(SetAlias(alias="production", version="2"), "ur5"))
            tab.wait_for_text("Not every replica has followed the last change yet.", "(before: 1)")
            assert tab.evaluate(row("2"))["Aliases"] == "production"
            asyncio.run(other.give(SetAlias(alias="production", version="2"), "ur5"))
            tab.wait_for("!document.body.innerText.includes('Not every replica')")
            # Whichever replica is asked: no change is seen twice, or back.
            assert tab.evaluate("document.getElementById('changes').children.length") == 1
            Served(port).act(20)  # each is looked at again and again
            tab.wait_for(f"{row('1')}.Requests === '50' && {row('2')}.Requests === '20'")


def test_the_page_reads_prometheus_text_as_it_is_written(tab: Tab, server: Served) -> None:
    from prometheus_client import CollectorRegistry, Gauge, Histogram, generate_latest

    registry = CollectorRegistry()
    names = ["plain", 'quote " and \\ and \\n', "line\nbreak", "a} 7", 'comma,="{', "\r ü  "]
    gauge = Gauge("odd", "Help\nof it", ["name", "more"], registry=registry)
    for index, name in enumerate(names):
        gauge.labels(name, "x").set(index)
    gauge.labels("infinite", "x").set(float("-inf"))
    gauge.labels("small", "x").set(1.5e-7)
    seconds = Histogram("took", "Seconds", buckets=[0.1, 0.2, 1.0], registry=registry)
    for value in [0.05] * 50 + [0.15] * 40 + [0.5] * 9 + [7.0]:
        seconds.observe(value)
    tab.visit(server.url)
    tab.wait_for_text("2 policies served")
    text = json.dumps(generate_latest(registry).decode())
    found = tab.evaluate(
        f"""import("/page/metrics.js").then(({{ parse, quantile, sumBy }}) => {{
          const samples = parse({text});
          const counts = sumBy(samples, "took_bucket", "le", {{}});
          const odd = samples.get("odd");
          return [odd.map(({{ labels, value }}) => [labels.get("name"), String(value), labels.get("more")]),
            [0.25, 0.5, 0.7, 0.99, 1].map(share => quantile(counts, share)).map(String), quantile(new Map(), 0.5)];
        }})"""
    )
    expected = [[name, str(index), "x"] for index, name in enumerate(names)]
    assert found[0] == [*expected, ["infinite", "-Infinity", "x"], ["small", "1.5e-7", "x"]]
    assert [float(value) for value in found[1]] == pytest.approx([0.05, 0.1, 0.15, 1.0, float("inf")])
    assert found[2] is None


def test_with_keys_the_page_asks_for_one_and_keeps_it_nowhere(tab: Tab, repository: Path, tmp_path: Path) -> None:
    with controlled(repository) as control:
        app = create_app(control, ServerSettings(api_keys=ROBOT_LINE))
        with over_uvicorn(app) as port:
            server = Served(port)
            server.act(3, key=ROBOT)
            tab.visit(server.url)
            tab.wait_for_text("This server requires an API key.")
            tab.wait_for("document.activeElement.id === 'key'")
            assert "ur5" not in tab.text()
            names = "['type', 'autocomplete', 'name', 'value']"
            fields = f"{names}.map(name => document.getElementById('key').getAttribute(name))"
            assert tab.evaluate(fields) == ["password", "off", None, None]
            picture(tab, "status_page_key", tmp_path)
            for typed, sentence in (
                (new_key("nobody")[0], "The server refused the key: the server does not know this API key."),
                ("ключ", "A key has no spaces and no special letters."),
            ):
                tab.type(typed)
                tab.press("Enter")
                tab.wait_for_text(sentence)
                assert tab.evaluate("document.getElementById('key').value") == ""
            tab.type(ROBOT)
            tab.press("Enter")
            tab.wait_for_text("2 policies served", "An API key is in use.")
            assert tab.evaluate(row("2"))["Requests"] == "3"
            kept = "[localStorage, sessionStorage].map(store => store.length).join() + document.cookie + location.href"
            assert tab.evaluate(kept) == f"0,0{server.url}/"
            assert ROBOT not in tab.evaluate("document.documentElement.outerHTML + JSON.stringify(history.state)")
            carrying = [request for request in tab.requests.values() if ROBOT in json.dumps(request.headers)]
            assert carrying and not [request for request in carrying if ROBOT in request.url]
            tab.evaluate("document.getElementById('forget').click()")
            tab.wait_for("!document.getElementById('key-form').hidden")
            assert "ur5" not in tab.text() and tab.evaluate("document.querySelectorAll('.policy').length") == 0
            tab.type(ROBOT)
            tab.press("Enter")
            tab.wait_for_text("2 policies served")
            tab.visit(server.url)  # as a reload
            tab.wait_for_text("This server requires an API key.")


def test_a_small_screen_and_a_keyboard_are_enough(tab: Tab, server: Served, tmp_path: Path) -> None:
    server.act(40, value=1.0)
    tab.resize(390, 844, dark=True)
    tab.visit(server.url)
    tab.wait_for_text("2 policies served", "Versions of ur5")
    seen = []
    for _ in range(12):
        tab.press("Tab")
        seen.append(
            tab.evaluate("document.activeElement.getAttribute('aria-label') ?? document.activeElement.textContent")
        )
        outline = tab.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline == "solid", seen
        if seen[-1] == "Contract of ur5, version 2":
            break
    assert {"API documentation", "Versions of ur5", "Contract of ur5, version 1"} <= set(seen), seen
    tab.press("Enter")
    tab.wait_for_text("Contract of ur5, version 2", "Action, ready for the environment's step")
    assert tab.evaluate("document.activeElement.getAttribute('aria-expanded')") == "true"
    # Nothing is cut: neither the page nor a table is wider than the screen, and each value has its column's name.
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    widths = "[...document.querySelectorAll('.scroll')].map(region => [region.clientWidth, region.scrollWidth])"
    assert len(tab.evaluate(widths)) >= 4 and all(inner <= outer for outer, inner in tab.evaluate(widths))
    edges = "[...document.querySelectorAll('td, text, dd')].map(node => node.getBoundingClientRect().right)"
    assert max(tab.evaluate(edges)) <= 390
    named = "[...document.querySelectorAll('td')].map(cell => getComputedStyle(cell, '::before').content)"
    assert {'"Share"', '"Drift"', '"Shift now [σ]"'} <= set(tab.evaluate(named))
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 24, 29)"
    unnamed = "[...document.querySelectorAll('table')].filter(table => !table.caption?.textContent)"
    unscoped = "[...document.querySelectorAll('th')].filter(cell => !['row', 'col'].includes(cell.scope))"
    assert tab.evaluate(f"[{unnamed}.length, {unscoped}.length]") == [0, 0]
    tab.evaluate("scrollTo(0, 0); document.querySelectorAll('.scroll').forEach(region => region.scrollTo(0, 0))")
    picture(tab, "status_page_390", tmp_path)


@pytest.mark.slow
def test_a_server_that_goes_away_is_said_and_comes_back_by_itself(tab: Tab, repository: Path, tmp_path: Path) -> None:
    store = load_store(repository)
    app = create_app(control_of(store), ServerSettings())
    with over_uvicorn(app) as port:
        tab.visit(f"http://127.0.0.1:{port}")
        tab.wait_for_text("2 policies served")
    tab.wait_for_text("No answer since", "This page goes on asking.", "the server does not answer", "Versions of ur5")
    assert tab.evaluate("document.title") == "rlservo: no answer"
    picture(tab, "status_page_away", tmp_path)
    with over_uvicorn(app, port):
        tab.wait_for_text("2 policies served", "the server answers again")
        assert "No answer" not in tab.text() and tab.evaluate("document.body.className") == ""


@pytest.mark.slow
def test_a_hidden_page_asks_nothing(tab: Tab, server: Served) -> None:
    tab.visit(server.url)
    tab.wait_for_text("2 policies served")
    hide = "Object.defineProperty(document, 'hidden', {{configurable: true, value: {}}});"
    said = "document.dispatchEvent(new Event('visibilitychange'))"
    a_round = f"new Promise(resolve => setTimeout(resolve, {ROUND_MS}))"
    tab.evaluate(hide.format("true") + said)
    for _ in range(4):  # what was under way
        tab.evaluate(a_round)
    before = len(tab.requests)
    for _ in range(4):
        tab.evaluate(a_round)
    assert len(tab.requests) == before
    tab.evaluate(hide.format("false") + said)
    tab.wait_for("performance.getEntriesByType('resource').filter(entry => entry.name.endsWith('/metrics')).length > 1")
    assert len(tab.requests) > before


FOREIGN = """<!DOCTYPE html><meta charset="utf-8"><title>foreign</title><script>
const target = %s, out = {};
const note = (name, promise) => promise.then(value => { out[name] = value }, error => { out[name] = error.name });
const load = (tag, path) => new Promise(done => {
  const node = document.createElement(tag);
  Object.assign(node, {onload: () => done("loaded"), onerror: () => done("refused")});
  node.src = target + path; document.head.append(node);
});
const frame = path => new Promise(done => {
  const node = document.createElement("iframe");
  node.onload = () => { try { done(String(node.contentDocument)) } catch (error) { done(error.name) } };
  node.src = target + path; document.documentElement.append(node);
});
window.finished = Promise.all([
  note("page", fetch(target + "/", {headers: {accept: "text/html"}}).then(reply => reply.text())),
  note("opaque", fetch(target + "/", {headers: {accept: "text/html"}, mode: "no-cors"}).then(reply => reply.type)),
  note("script", load("script", "/page/status.js")), note("icon", load("img", "/page/icon.svg")),
  note("frame", frame("/")), note("docs", frame("/docs")),
]).then(() => out);
</script>"""


def test_a_foreign_page_gets_nothing_of_it(tab: Tab, server: Served) -> None:
    """Neither to read, nor to embed, nor to frame: 127.0.0.1 on another port is the same site to a browser."""
    content = (FOREIGN % json.dumps(server.url)).encode()

    async def foreign(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            headers = [(b"content-type", b"text/html"), (b"content-length", b"%d" % len(content))]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": content})

    with over_uvicorn(foreign) as port:
        tab.visit(f"http://127.0.0.1:{port}/")
        tab.wait_for("window.finished")
        found = tab.evaluate("window.finished")
        assert [found.pop(name) for name in ("page", "opaque", "script", "icon")] == ["TypeError"] * 2 + ["refused"] * 2
        assert found == {"frame": "null", "docs": "null"}
        frames = tab.call("Page.getFrameTree")["frameTree"]["childFrames"]
        assert [frame["frame"]["url"] for frame in frames] == ["chrome-error://chromewebdata/"] * 2, frames
