"""A cockpit in this process, and a real browser that can reach nothing but this machine."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import uvicorn
from numpy.typing import NDArray
from onnx import numpy_helper
from PIL import Image

from browser import browser_program
from bundles import write_bundle
from rlservo.bundle import bundle as bundle_files
from servers import free_ports
from waiting import PATIENCE_S, wait_for

FLAGS = (
    "--no-sandbox",
    "--disable-background-networking",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",  # Debian's Chromium would draw the panels in the same software
    "--disable-gpu-compositing",  # and would put the page together in it: half of what a frame takes
)
SMOOTH = bool(os.environ.get("RLSERVO_PICTURES"))  # a picture for the README, whose edges are smooth
ROUGH = "--webgl-antialiasing-mode=none"  # four samples of a pixel would be the rest's two thirds
# A few frames a second are enough to see what happens, and each is drawn by the processors that the test shares.
FEW_FRAMES = """const each = requestAnimationFrame;
window.requestAnimationFrame = draw => setTimeout(() => each(draw), 300);"""
TWO_FRAMES = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
RESOLUTION = 0.5  # of the scene, to the screen's: viser would change it by how long frames take
# The scene is the largest canvas; the others are plots.
CORNER_OF_SCENE = """() => {
    const boxes = [...document.querySelectorAll("canvas")].map(canvas => canvas.getBoundingClientRect());
    const scene = boxes.sort((one, other) => other.width * other.height - one.width * one.height)[0];
    return [scene.x, scene.y];
}"""


@dataclass
class Browser:
    """A page in a real browser, and what it asked for."""

    page: Any
    requests: list[str] = field(default_factory=list)

    def open(self, address: str, resolution: float = RESOLUTION) -> None:
        self.page.goto(f"{address}/?fixedDpr={resolution}")
        self.page.wait_for_selector("text=frames/s", timeout=1e3 * PATIENCE_S)

    def text(self) -> str:
        return str(self.page.evaluate("document.body.innerText"))

    def wait_for(self, text: str) -> None:
        wait_for(lambda: text in self.text(), f"{text!r} in the page", poll_s=0.25)

    def drag(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> None:
        """Drag with the mouse from one pixel of the scene to another, slowly."""
        corner = np.array(self.page.evaluate(CORNER_OF_SCENE))
        start, end = corner + start, corner + end
        mouse = self.page.mouse
        mouse.move(*start)
        self.page.evaluate(TWO_FRAMES)  # until the handle has seen the mouse
        mouse.down()
        for share in np.linspace(0.0, 1.0, 12)[1:]:
            mouse.move(*(start + share * (end - start)))
            self.page.wait_for_timeout(60)
        self.page.evaluate(TWO_FRAMES)
        mouse.up()

    def click(self, name: str, *, role: str = "button") -> None:
        """Click what has this name, even if the browser draws too few pictures for Playwright to see it stable."""
        from playwright.sync_api import TimeoutError as NotInTimeError

        named = self.page.get_by_role(role, name=name, exact=True).first
        try:
            named.click(timeout=20e3)
        except NotInTimeError:
            named.click(force=True)

    def choose(self, label: str, option: str | None) -> None:
        """Choose an option of a dropdown, by its name or the second one there is; again if the list has closed."""
        from playwright.sync_api import TimeoutError as NotInTimeError

        options = self.page.get_by_role("option")
        wanted = options.nth(1) if option is None else options.get_by_text(option, exact=True).first
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.page.get_by_label(label, exact=True).first.click(timeout=20e3)
                return wanted.click(timeout=20e3)
            except NotInTimeError:
                assert time.monotonic() < deadline, f"{option or 'its second'} cannot be chosen as {label}"
                self.page.keyboard.press("Escape")

    def fill(self, label: str, number: str) -> None:
        """Type a number beside a slider."""
        row = self.page.locator("label", has_text=label).locator("xpath=../../..")
        field = row.locator("input[inputmode=decimal]")
        field.fill(number)
        field.press("Enter")

    def plots(self) -> int:
        """Return how many plots are shown."""
        return int(self.page.locator(".uplot").count())

    def picture_of_plot(self, index: int) -> str:
        """Return what a plot looks like, to be compared."""
        script = "index => document.querySelectorAll('.uplot canvas')[index].toDataURL()"
        return str(self.page.evaluate(script, index))

    def scene(self) -> NDArray[np.uint8]:
        """Return the picture of the scene, without the panels beside it."""
        size = self.page.viewport_size
        clip = {"x": 340, "y": 160, "width": size["width"] - 680, "height": size["height"] - 160}
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot(clip=clip))).convert("RGB"))

    def close(self) -> None:
        self.page.context.close()


@contextlib.contextmanager
def served_on(app: Any, port: int) -> Iterator[None]:
    """Serve an ASGI application from a thread on a port, where it was served before, or will be again."""
    server = uvicorn.Server(
        uvicorn.Config(app, port=port, log_level="critical", access_log=False, timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        wait_for(lambda: server.started or not thread.is_alive(), "the server")
        assert thread.is_alive(), f"port {port} could not be served on"
        yield
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture
def free_port() -> int:
    """A free port."""
    return free_ports(1)[0]


@pytest.fixture(scope="module")  # while it is there, no asyncio.run of another test's could work in this thread
def chromium() -> Iterator[Any]:
    """The browser, or a skip with the reason."""
    path = browser_program()
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, headless=True, args=FLAGS if SMOOTH else (*FLAGS, ROUGH))
        yield browser
        browser.close()


Windows = Callable[[int, int], Browser]


@pytest.fixture(scope="module")
def windows(chromium: Any) -> Windows:
    """Open a window of a size. The caller closes it."""

    def make(width: int, height: int) -> Browser:
        context = chromium.new_context(viewport={"width": width, "height": height})
        opened = Browser(context.new_page())
        opened.page.set_default_timeout(1e3 * PATIENCE_S)
        opened.page.add_init_script(FEW_FRAMES)
        opened.page.on("request", lambda request: opened.requests.append(request.url))
        opened.page.on("websocket", lambda socket: opened.requests.append(socket.url))
        return opened

    return make


@dataclass
class Cockpit:
    """A page that is served from this process."""

    address: str
    server: Any
    panel: Any

    def pixel(self, point: NDArray[np.float64], camera: Any = None) -> NDArray[np.float64]:
        """Return where a point of the world is in the scene of a browser, by default the first one's."""
        camera = camera or next(iter(self.server.get_clients().values())).camera
        ahead = camera.look_at - camera.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, camera.up_direction)
        right = right / np.linalg.norm(right)
        way = np.asarray(point) - camera.position
        x, y, z = way @ right, way @ np.cross(right, ahead), way @ ahead
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        drawn = np.array([camera.image_width / 2 + focal * x / z, camera.image_height / 2 - focal * y / z])
        return drawn / RESOLUTION


@contextlib.contextmanager
def cockpit_of(make_panel: Callable[[Any], Any]) -> Iterator[Cockpit]:
    """Serve a page with a panel, and draw it from a thread."""
    from rlservo.deploy.cockpit.page import served_page, show

    (port,) = free_ports(1)
    stop = threading.Event()
    with served_page(port, "rlservo cockpit") as server:
        panel = make_panel(server)
        thread = threading.Thread(target=show, args=(panel, stop))
        thread.start()
        try:
            yield Cockpit(f"http://127.0.0.1:{port}", server, panel)
        finally:
            stop.set()
            thread.join()
            panel.close()


@pytest.fixture(scope="session")
def two_versions(shipped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped policies, and of ur5 a version 2 with somewhat other weights."""
    root = tmp_path_factory.mktemp("two") / "policies"
    shutil.copytree(shipped, root)
    first, second = root / "ur5" / "1", root / "ur5" / "2"
    second.mkdir()
    graph = onnx.load(first / bundle_files.ONNX_FILE)
    del graph.metadata_props[:]  # the copy of the contract
    rng = np.random.default_rng(0)
    for tensor in graph.graph.initializer:
        array = numpy_helper.to_array(tensor)
        if array.ndim == 2 and array.dtype == np.float32:
            noise = 0.6 * rng.standard_normal(array.shape).astype(np.float32) * array.std()
            tensor.CopyFrom(numpy_helper.from_array(array + noise, tensor.name))
    onnx.save(graph, second / bundle_files.ONNX_FILE)
    contract = bundle_files.read_contract(first).model_copy(update={"version": "2"})
    write_bundle(second, contract, np.load(first / bundle_files.GOLDEN_FILE)["input/obs"][:8])
    return root
