"""The page of a bundle in Chromium: what is proven there, what moves, and that a wrong simulation shows itself."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper

from browser import Browser, Tab
from bundles import write_leaky_policy
from cache import cached, digest
from rlservo.bundle.bundle import load_bundle
from rlservo.deploy.page import npm_packages, static_site
from rlservo.errors import RlservoError

pytestmark = pytest.mark.slow

STATE = "document.body.dataset.state"
NO_PICTURE = "HTMLCanvasElement.prototype.getContext = () => null"
SLOW = "requestAnimationFrame = frame => setTimeout(() => frame(performance.now()), 400)"
ROBOTS = (
    "ur5_positioning", "ur_positioning", "ur10_isaac_reach", "panda_positioning", "mir100_navigation",
    "mir100_obstacle_avoidance", "mir100_sparse_fixes",
)  # fmt: skip
GENERIC = ("cartpole_dqn", "pendulum_sac")


class Handler(http.server.SimpleHTTPRequestHandler):
    """`python -m http.server` below a prefix; `.gz` is sent unpacked if the server `unpacks`."""

    extensions_map = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}  # noqa: RUF012
    unpacks = False

    def translate_path(self, path: str) -> str:
        return super().translate_path(path.removeprefix("/some/prefix"))

    def end_headers(self) -> None:
        if self.unpacks and self.path.partition("?")[0].endswith(".gz"):
            self.send_header("Content-Encoding", "gzip")
        super().end_headers()

    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def web_server(folder: Path, *, unpacks: bool = False) -> Iterator[str]:
    """Serve a folder and give its address."""
    handler = type("ThisHandler", (Handler,), {"unpacks": unpacks})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(handler, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/some/prefix/"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="session")
def libraries() -> dict[str, bytes]:
    """npm's packages; without a network the tests are skipped, but not in CI."""
    try:
        return npm_packages.libraries(lambda line: None)
    except RlservoError as error:
        if os.environ.get("GITHUB_ACTIONS"):
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def site(all_shipped: Path, libraries: dict[str, bytes]) -> Path:
    """A page of every shipped policy. Not to be written to."""

    def make(folder: Path) -> None:
        bundles = [all_shipped / name / "1" for name in (*ROBOTS, *GENERIC)]
        static_site.write_site(bundles, folder, lambda line: None)

    sources = [Path(static_site.__file__).parent, digest([all_shipped])]
    return cached("page", [*sources, *map(str, npm_packages.PACKAGES)], make)


@pytest.fixture
def page(site: Path, tmp_path: Path) -> Path:
    """A copy of that page, to be changed."""
    return Path(shutil.copytree(site, tmp_path / "page"))


@contextlib.contextmanager
def opened(browser: Browser, folder: Path, name: str = "", **how: Any) -> Iterator[Tab]:
    """Open the page at a policy, and wait until it is running or broken.

    It draws nothing: without a graphics card that takes most of the time.
    """
    with web_server(folder, **how) as address, browser.tab() as tab:
        tab.call("Page.addScriptToEvaluateOnNewDocument", source=NO_PICTURE)
        tab.resize(1280, 800)
        tab.visit(f"{address}#{name}")
        tab.wait_for(STATE)
        yield tab


def proofs(tab: Tab) -> list[tuple[str, str]]:
    lines = "[...document.querySelectorAll('#proofs li')].map(line => [line.className, line.innerText])"
    return [(kind, text) for kind, text in tab.evaluate(lines)]


@pytest.mark.parametrize("name", ROBOTS)
def test_browser_reproduces_python_and_the_robot_arrives(browser: Browser, site: Path, name: str) -> None:
    with opened(browser, site, name) as tab:
        (golden, first), (simulation, second) = proofs(tab)
        assert (golden, simulation) == ("good", "good"), (first, second)
        assert "golden values: 64 samples" in first
        assert "of Python's episodes" in second
        assert tab.evaluate(STATE) == "running"
        tab.wait_for("/^Arrived/.test(document.querySelector('#status').innerText)")
        assert not tab.complaints


def change(page: Path, name: str, edit: Callable[[dict[str, Any]], None]) -> None:
    """Change what Python tells the page of a policy."""
    file = page / "policies" / name / "facts.json"
    facts = json.loads(file.read_text())
    edit(facts)
    file.write_text(json.dumps(facts))


def replace(page: Path, before: str, after: str) -> None:
    """Change the page's simulation."""
    file = page / "robots.js"
    assert file.read_text().count(before) == 1, before
    file.write_text(file.read_text().replace(before, after))


def swap_joints(facts: dict[str, Any]) -> None:
    joints = facts["robot"]["joints"]
    joints[0], joints[1] = joints[1], joints[0]


def shorten_cycle(facts: dict[str, Any]) -> None:
    facts["robot"]["substeps"] -= 1


def see_other_beams(facts: dict[str, Any]) -> None:
    facts["robot"]["observed_beams"] = [beam + 1 for beam in facts["robot"]["observed_beams"][:-1]] + [1011]


def arrive_early(facts: dict[str, Any]) -> None:
    facts["robot"]["within"] *= 1.5


WRONG: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "joint order": ("ur5_positioning", lambda page: change(page, "ur5_positioning", swap_joints), "base_position"),
    "degrees": (
        "ur5_positioning",
        lambda page: replace(page, "return (data.qpos[index] -", "return (data.qpos[index] * 57.29578 -"),
        "base_position_normalized",
    ),
    "control period": ("ur5_positioning", lambda page: change(page, "ur5_positioning", shorten_cycle), "target_r"),
    "quaternion order": (
        "ur10_isaac_reach", lambda page: replace(page, 'WXYZ = "wxyz"', 'WXYZ = "xyzw"'), "target_qw",
    ),
    "last action": (
        "ur10_isaac_reach", lambda page: replace(page, ": this.last)[index]", ": this.previous)[index]"), "last_action",
    ),
    "beams": (
        "mir100_obstacle_avoidance",
        lambda page: change(page, "mir100_obstacle_avoidance", see_other_beams),
        "laser_",
    ),
    "left and right": (
        "mir100_navigation", lambda page: replace(page, "this.target[0] - x) - yaw)", "this.target[0] - x) + yaw)"),
        "target_theta",
    ),
    "rare fixes": ("mir100_sparse_fixes", lambda page: replace(page, "=== 0;", ">= 0;"), "target_r"),
    "success": (
        "panda_positioning", lambda page: change(page, "panda_positioning", arrive_early), "the ending (success",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_simulation_is_shown_in_red_and_nothing_moves(browser: Browser, page: Path, what: str) -> None:
    name, spoil, element = WRONG[what]
    spoil(page)
    with opened(browser, page, name) as tab:
        (golden, _), (simulation, second) = proofs(tab)
        assert (golden, simulation) == ("good", "bad")
        assert element in second.partition("differs: ")[2], second
        assert_still(tab)


def assert_still(tab: Tab) -> None:
    assert tab.evaluate(STATE) == "broken"
    assert tab.evaluate("document.querySelector('#status').className") == "bad"
    assert "nothing moves" in tab.text()
    assert tab.evaluate("document.querySelector('#proof-title').innerText") == "Not proven in this browser"
    assert tab.evaluate("document.querySelector('#controls').hidden && document.querySelector('#inputs').hidden")


@pytest.mark.parametrize("name", ["ur5_positioning", "pendulum_sac"])
def test_another_network_is_shown_in_red_and_nothing_moves(browser: Browser, page: Path, name: str) -> None:
    file = page / "policies" / name / "policy.onnx"
    model = onnx.load(file)
    weight = max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))
    values = numpy_helper.to_array(weight).copy()
    values.flat[:100] += np.float32(0.01)
    weight.CopyFrom(numpy_helper.from_array(values, weight.name))
    onnx.save(model, file)
    with opened(browser, page, name) as tab:
        assert proofs(tab)[0][0] == "bad"
        assert_still(tab)


def forget_the_action(facts: dict[str, Any]) -> None:
    del facts["golden"]["outputs"]["action"]


def forget_the_samples(facts: dict[str, Any]) -> None:
    for place in (*facts["golden"]["inputs"].values(), *facts["golden"]["outputs"].values()):
        place["shape"][0] = 0


def forget_the_episodes(facts: dict[str, Any]) -> None:
    for start in facts["robot"]["starts"]:
        start.pop("observations", None)


@pytest.mark.parametrize("forget", [forget_the_action, forget_the_samples, forget_the_episodes])
def test_a_comparison_with_nothing_proves_nothing(browser: Browser, page: Path, forget: Any) -> None:
    change(page, "ur5_positioning", forget)
    with opened(browser, page, "ur5_positioning") as tab:
        assert [text.partition("differs: ")[2] for kind, text in proofs(tab) if kind == "bad"] == [
            "nothing to compare with"
        ]
        assert_still(tab)


def test_a_difference_that_is_no_number_is_shown(browser: Browser, page: Path) -> None:
    file = page / "policies" / "ur5_positioning"
    place = json.loads((file / "facts.json").read_text())["golden"]["outputs"]["action"]
    data = np.fromfile(file / "data.bin", np.uint8)
    data[place["offset"] :][:4] = np.frombuffer(np.float32("nan").tobytes(), np.uint8)
    data.tofile(file / "data.bin")
    with opened(browser, page, "ur5_positioning") as tab:
        assert "largest difference NaN" in proofs(tab)[0][1]
        assert_still(tab)


def test_a_policy_that_the_page_lacks_is_not_replaced_by_another(browser: Browser, site: Path) -> None:
    with opened(browser, site, "ur5_positionin") as tab:
        assert tab.evaluate(STATE) == "broken"
        assert "no policy ur5_positionin" in tab.text()


def test_a_slow_browser_is_shown_as_slow(browser: Browser, site: Path) -> None:
    with web_server(site) as address, browser.tab() as tab:
        tab.call("Page.addScriptToEvaluateOnNewDocument", source=f"{NO_PICTURE}; {SLOW}")
        tab.visit(f"{address}#ur5_positioning")
        tab.wait_for("/slow browser/.test(document.querySelector('#now').innerText)")
        tab.wait_for("parseInt(document.querySelector('#now dd:last-child').innerText) < 40")


def test_an_action_of_another_robot_keeps_its_unit(browser: Browser, page: Path) -> None:
    def name_it(facts: dict[str, Any]) -> None:
        element = {"name": "elbow_normalized", "unit": "N*m", "quantity": "joint effort", "joint": "elbow"}
        facts["action"]["action"]["elements"] = [{**element, "axis": "", "frame": "", "scale": None, "offset": None}]

    change(page, "pendulum_sac", name_it)
    with opened(browser, page, "pendulum_sac") as tab:
        line = "document.querySelector('#action .bar')"
        assert tab.evaluate(f"{line}.querySelector('meter').ariaLabel") == "elbow normalized"
        shown = tab.evaluate(f"{line}.querySelector('output').innerText")
        assert shown.endswith(" N*m")
        assert float(shown.split()[0]) == pytest.approx(first_action(page), abs=0.005)


def first_action(page: Path) -> float:
    """Return what onnxruntime for Python computes for Pendulum's first golden sample."""
    folder = page / "policies" / "pendulum_sac"
    place = json.loads((folder / "facts.json").read_text())["golden"]["inputs"]["obs"]
    sample = np.fromfile(folder / "data.bin", np.float32, count=3, offset=place["offset"])
    session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    return float(np.ravel(session.run(["action"], {"obs": sample[None]})[0])[0])


def test_an_action_outside_its_space_is_said_and_not_shown(browser: Browser, page: Path) -> None:
    change(page, "pendulum_sac", lambda facts: facts["action"]["action"].update(bounds=[[-1e-6], [1e-6]]))
    with opened(browser, page, "pendulum_sac") as tab:
        tab.wait_for("document.querySelector('#status').className === 'bad'")
        assert "outside -0.000001 to 0.000001" in tab.evaluate("document.querySelector('#status').innerText")
        assert tab.evaluate("document.querySelector('#action output').innerText") == "–"


def test_a_broken_graph_and_a_missing_file_are_one_sentence(browser: Browser, page: Path) -> None:
    (page / "policies" / "cartpole_dqn" / "policy.onnx").write_bytes(b"no graph")
    (page / "policies" / "pendulum_sac" / "data.bin").unlink()
    for file in (page / "policies" / "ur5_positioning" / "facts.json", page / "lib" / "mujoco.wasm.gz"):
        file.write_bytes(file.read_bytes()[:-100])
    for name, words in (
        ("cartpole_dqn", "ERROR_CODE"),
        ("pendulum_sac", "data.bin cannot be fetched: 404"),
        ("ur5_positioning", "facts.json cannot be fetched: "),
        ("mir100_navigation", "mujoco.wasm.gz cannot be fetched: "),
    ):
        with opened(browser, page, name) as tab:
            assert tab.evaluate(STATE) == "broken"
            assert words in tab.evaluate("document.querySelector('#status').innerText")


def test_page_asks_only_its_own_server_and_breaks_no_rule_of_its_policy(browser: Browser, site: Path) -> None:
    with web_server(site) as address, browser.tab() as tab:
        tab.visit(address)
        tab.wait_for(f"{STATE} === 'running'")
        urls = [request.url for request in tab.requests.values() if not request.url.startswith("data:")]
        assert all(url.startswith(address) for url in urls)
        assert len(urls) > 10
        # Without a graphics card Chromium complains of drawing.
        assert [line for line in tab.complaints if not line.startswith("rendering: ")] == []


def test_a_server_may_unpack_webassembly(browser: Browser, site: Path) -> None:
    with opened(browser, site, "mir100_navigation", unpacks=True) as tab:
        assert tab.evaluate(STATE) == "running"


def test_a_browser_without_simd_is_told(browser: Browser, site: Path) -> None:
    with web_server(site) as address, browser.tab() as tab:
        tab.call("Page.addScriptToEvaluateOnNewDocument", source="WebAssembly.validate = () => false")
        tab.visit(address)
        tab.wait_for_text("This browser is too old: the page needs WebAssembly with SIMD")


def test_any_other_policy_acts_on_what_is_set(browser: Browser, site: Path) -> None:
    with opened(browser, site, "pendulum_sac") as tab:
        before = tab.evaluate("document.querySelector('#action output').innerText")
        script = """(() => { const slider = document.querySelectorAll('#fields input')[2];
            slider.value = -Number(slider.value) || 5; slider.oninput(); })()"""
        tab.evaluate(script)
        tab.wait_for(f"document.querySelector('#action output').innerText !== {json.dumps(before)}")
        tab.wait_for_text("golden values: 64 samples")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", ["ur5_positioning", "mir100_navigation"])
def test_robot_follows_a_target_that_is_dragged(windows: Any, site: Path, name: str) -> None:
    target = """() => { const { stage, robot } = rlservo, box = stage.canvas.getBoundingClientRect();
        const seen = stage.target.position.clone().project(stage.camera);
        return [box.x + (seen.x + 1) / 2 * box.width, box.y + (1 - seen.y) / 2 * box.height, ...robot.target]; }"""
    with web_server(site) as address:
        page = windows(900, 700).page
        page.goto(f"{address}#{name}")
        page.wait_for_function(f"{STATE} === 'running'")
        x, y, *before = page.evaluate(target)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 60, y + 20, steps=4)
        page.mouse.up()
        _, _, *after = page.evaluate(target)
        assert np.linalg.norm(np.subtract(after, before)) > 0.05
        page.wait_for_function("/^Arrived/.test(document.querySelector('#status').innerText)")
        robot, there = page.evaluate("[rlservo.robot.robotPosition(), rlservo.robot.target]")
        assert there == after  # no new target while a person drags
        assert np.linalg.norm(np.subtract(robot, there)) < 0.21
        page.context.close()


def test_memory_moves_on_and_names_stay_text(
    browser: Browser,
    libraries: dict[str, bytes],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(static_site, "libraries", lambda say: libraries)
    evil = "<img src=x onerror=document.title='evil'>"
    folder = write_leaky_policy(tmp_path / "bundles", name="leaky")
    rewrite(folder, evil)
    static_site.write_site([folder], tmp_path / "page", lambda line: None)
    with opened(browser, tmp_path / "page") as tab:
        assert tab.evaluate(STATE) == "running"
        weights = numpy_helper.to_array(onnx.load(folder / "policy.onnx").graph.initializer[0])
        seen = load_bundle(folder).golden()[0]["obs"][0] @ weights
        shown = [f"{value:.2f}".removesuffix(".00") for value in np.clip(2.0 * seen, -1.0, 1.0)]  # h is h / 2 + seen
        outputs = "[...document.querySelectorAll('#action output')].map(output => output.innerText.trim())"
        tab.wait_for(f"{outputs}.join() === {json.dumps(','.join(shown))}")
        assert evil in tab.text()
        assert tab.evaluate("document.images.length === 0 && document.title") == "leaky 1"
        assert "its own rate is not known" in tab.text()


def rewrite(folder: Path, description: str) -> None:
    """Give a bundle another description, and no rate."""
    from rlservo.bundle import bundle as bundle_files

    contract = bundle_files.read_contract(folder)
    bundle_files.write_contract(
        folder, contract.model_copy(update={"description": description, "control_rate_hz": None})
    )


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", ["mir100_obstacle_avoidance", "cartpole_dqn"])
def test_page_fits_a_phone_and_a_desk(browser: Browser, site: Path, name: str, width: int) -> None:
    with web_server(site) as address, browser.tab() as tab:
        tab.resize(width, 844)
        tab.call("Page.addScriptToEvaluateOnNewDocument", source=SLOW)  # which is one line more
        tab.visit(f"{address}#{name}")
        tab.wait_for(f"{STATE} === 'running'")
        if name == "mir100_obstacle_avoidance":
            tab.wait_for("document.querySelector('#now').innerText.includes('slow browser')")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
