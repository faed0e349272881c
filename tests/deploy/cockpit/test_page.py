"""The cockpit's page in a real browser: what a person with a mouse can do, and see."""

from __future__ import annotations

import io
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="the cockpit draws with viser")

from cockpits import TWO_FRAMES, Browser, Cockpit, Windows, cockpit_of, served_on
from rlservo.deploy.cockpit.drive import Drive
from rlservo.deploy.cockpit.panel import DrivePanel
from rlservo.deploy.cockpit.playback import PlaybackPanel, Tape
from rlservo.deploy.cockpit.policies import BundledPolicies, Choice, PolicySource, ServedPolicies
from rlservo.deploy.cockpit.scenery import OBSTACLE_LIFT, TARGET_LIFT
from rlservo.drive.control_loop import rollout
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from stores import control_of, load_store
from waiting import PATIENCE_S, wait_for

# In this order: each finds the drive as the one before has left it; a ghost's plot stays as long as its cycles do.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.random_order(disabled=True),
]

ENV = "rlservo/EndEffectorPositioningURSim-v0"
ARROW_M = 0.19  # from the target to where its handle's arrow is taken
# The most that a frame is made of: meshes (an instance counts as one), and corners of what is drawn once.
WORK_OF_A_FRAME = """async () => {
  const gl = WebGL2RenderingContext.prototype, own = {}, frames = [];
  const replace = (name, count) => {
    own[name] = gl[name];
    gl[name] = function (...given) { count(given); return own[name].apply(this, given); };
  };
  const add = (meshes, corners) => frames.length && (frames.at(-1)[0] += meshes, frames.at(-1)[1] += corners);
  replace("clear", () => frames.push([0, 0]));
  replace("drawElements", given => add(1, given[1]));
  replace("drawArrays", given => add(1, given[2]));
  replace("drawElementsInstanced", given => add(given[4], given[1]));
  replace("drawArraysInstanced", given => add(given[3], given[2]));
  while (frames.length < 4) await new Promise(done => setTimeout(done, 50));
  Object.assign(gl, own);
  const whole = frames.slice(0, -1);
  return [0, 1].map(index => Math.max(...whole.map(frame => frame[index])));
}"""
# Of the table's farthest cell and of its panel, whose width does not depend on the window's.
RIGHT_EDGES = """() => {
  const right = part => part.getBoundingClientRect().right;
  const table = [...document.querySelectorAll("table")].at(-1);
  return [Math.max(...[...table.querySelectorAll("th, td")].map(right)), right(table.parentElement)];
}"""
# Where the documents' pictures go: RLSERVO_PICTURES=docs/images pytest tests/deploy/cockpit/test_page.py -k picture
PICTURES = os.environ.get("RLSERVO_PICTURES")
CYCLES = 44 if PICTURES else 3  # of the README's moving picture, at 10 Hz
LARGEST_GIF_BYTES = 2 << 20


@pytest.fixture(scope="module")
def app(two_versions: Path) -> Any:
    """A policy server's application, made where no browser is driven."""
    with ThreadPoolExecutor(1) as elsewhere:
        store = elsewhere.submit(load_store, two_versions).result()
    return create_app(control_of(store), ServerSettings())


@pytest.fixture(scope="module")
def drive(two_versions: Path) -> Iterator[Drive]:
    drive = Drive(BundledPolicies(two_versions), Choice("ur5", "1"), seed=5)
    drive.start()
    yield drive
    drive.close()


@pytest.fixture(scope="module")
def cockpit(drive: Drive, two_versions: Path) -> Iterator[Cockpit]:
    with cockpit_of(lambda server: DrivePanel(server, drive, BundledPolicies(two_versions))) as served:
        yield served


@pytest.fixture(scope="module")
def window(cockpit: Cockpit, windows: Windows) -> Iterator[Browser]:
    """One window for all tests of the drive."""
    opened = windows(1000, 560)
    opened.open(cockpit.address)
    yield opened
    opened.close()


@contextmanager
def driven(windows: Windows, source: PolicySource, choice: Choice, seed: int) -> Iterator[tuple[Drive, Any, Browser]]:
    """A drive of its own, its cockpit and a window on that."""
    with ExitStack() as cleanup:
        drive = Drive(source, choice, seed=seed)
        cleanup.callback(drive.close)
        drive.start()
        cockpit = cleanup.enter_context(cockpit_of(lambda server: DrivePanel(server, drive, source)))
        window = windows(1000, 560)
        cleanup.callback(window.close)
        window.open(cockpit.address)
        yield drive, cockpit, window


def drag(window: Browser, cockpit: Cockpit, place: Callable[[], Any], grip: Any, by: Any) -> None:
    """Drag what is at `place`, by its handle at `grip` from there, until it has moved by half of `by` or more.

    Again, from where it is then, where the mouse was quicker than a busy machine's next picture.
    """
    before = place()
    for patience_s in (10.0, 20.0, PATIENCE_S):
        start = place() + grip
        window.drag(cockpit.pixel(start), cockpit.pixel(start + by))
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            if (place() - before) @ by > 0.5 * by @ by:
                return
            time.sleep(0.05)
    raise AssertionError(f"it was dragged by {by}, and has moved by {place() - before}")


def scrub(window: Browser, number: int) -> None:
    """Type a decision's number; again where what was still playing put another one in its place."""
    for patience_s in (10.0, 20.0, PATIENCE_S):
        window.fill("Decision", str(number))
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            if f"Decision {number}" in window.text():
                return
            time.sleep(0.25)
    raise AssertionError(f"decision {number} is not shown: {window.text()}")


# These come first: they have windows of their own, and each one that is open is drawn by the processors.


def test_target_and_cubes_of_a_mir100_are_dragged_and_dropped(two_versions: Path, windows: Windows) -> None:
    choice = Choice("mir100_obstacle_avoidance", "1")
    with driven(windows, BundledPolicies(two_versions), choice, seed=3) as (drive, cockpit, window):
        window.click("Pause")
        window.wait_for("paused")
        left = np.array([0.0, 1.0, 0.0])

        def place(of: str) -> Any:
            return drive.view.after.target if of == "target" else drive.view.after.obstacles[1]

        for of, lift in (("target", TARGET_LIFT), ("cube", OBSTACLE_LIFT)):
            before = place(of)
            drag(window, cockpit, lambda of=of: place(of), 0.6 * left + (0.0, 0.0, lift), 0.4 * left)
            assert np.allclose(place(of)[[0, 2]], before[[0, 2]], atol=1e-3)
        window.click("Drop a cube ahead")
        robot = drive.view.after.robot
        wait_for(lambda: np.linalg.norm(drive.view.after.obstacles - robot, axis=1).min() < 1.31, "a cube is near")


def test_a_server_that_goes_away_is_said_and_comes_back(app: Any, windows: Windows, free_port: int) -> None:
    source = ServedPolicies(f"http://127.0.0.1:{free_port}")
    with ExitStack() as cleanup:
        cleanup.callback(source.close)
        with served_on(app, free_port):
            opened = driven(windows, source, Choice("ur5", "production"), seed=5)
            drive, _, window = cleanup.enter_context(opened)
        window.wait_for("waiting for the policy; the robot holds still")
        with served_on(app, free_port):
            wait_for(lambda: "waiting for the policy" not in window.text(), "it is back")
            cycles = drive.history[-1].number
            wait_for(lambda: drive.history[-1].number > cycles + 3, "the robot moves again")


def test_a_recording_scrubs_and_jumps_to_the_worst_moment(two_versions: Path, windows: Windows, tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    with Policy.load(two_versions / "ur5" / "1") as policy:
        rollout(policy, ENV, episodes=2, seed=3, record=file)
    tape = Tape(file, bundle=two_versions / "ur5" / "2")
    assert len(tape.episodes) == 2 and tape.moments
    with cockpit_of(lambda server: PlaybackPanel(server, tape, env_id=None)) as cockpit:
        window = windows(1000, 560)
        window.open(cockpit.address)
        window.click("Pause")
        scrub(window, 7)
        first = window.scene()
        scrub(window, 20)
        wait_for(lambda: np.abs(window.scene().astype(int) - first).max() > 30, "the arm is elsewhere")
        number, _ = tape.find(tape.moments[0])
        window.choose("Worst moments", None)
        window.wait_for(f"Episode {number}: ")
        window.wait_for(f"Decision {tape.moments[0].step}")
        window.close()


def test_the_handle_is_dragged_and_the_robot_reaches_the_new_target(
    cockpit: Cockpit, drive: Drive, window: Browser
) -> None:
    drive.do(drive.pause)
    window.wait_for("paused")
    before = drive.view.after.target
    assert before is not None
    up = np.array([0.0, 0.0, 1.0])
    drag(window, cockpit, lambda: drive.view.after.target, ARROW_M * up, 0.12 * up)
    assert np.allclose(drive.view.after.target[:2], before[:2], atol=1e-3)
    window.click("Play")
    window.wait_for("Arrived.")
    view = drive.view
    assert view.after.target is not None and np.linalg.norm(view.after.robot - view.after.target) <= 0.1
    window.click("New target")
    wait_for(lambda: drive.view.phase == "driving", "it goes on")


def test_the_tab_has_a_title_and_the_page_a_legend(window: Browser) -> None:
    assert window.page.title() == "rlservo cockpit"
    window.wait_for("robot's path")


def test_the_plots_move_and_the_table_tells_what_the_policy_sees(drive: Drive, window: Browser) -> None:
    drive.do(drive.play)
    assert window.plots() >= 4  # distance, action, value, latency
    first = window.picture_of_plot(0)
    wait_for(lambda: window.picture_of_plot(0) != first, "another picture of the plot")
    window.click("Observation", role="tab")
    window.wait_for("shoulder_velocity")
    text = window.text()
    assert "rad/s" in text and "±1.1" in text and " ± " in text
    table, panel = window.page.evaluate(RIGHT_EDGES)
    assert table <= panel  # the last column as well
    window.click("Plots", role="tab")


def test_the_ghost_appears_and_the_difference_is_plotted(drive: Drive, window: Browser) -> None:
    drive.do(drive.play)
    assert "Ghost's action minus" not in window.text()
    window.choose("Second version", "2")
    wait_for(lambda: drive.view.ghost is not None, "the ghost")
    window.wait_for("Ghost's action minus")
    wait_for(lambda: np.abs(drive.history[-1].difference).max() > 1e-3, "another action")
    wait_for(lambda: drive.view.ghost[1].robot is not None, "its pose")
    window.click("Pause")
    window.wait_for("paused")
    with_ghost = window.scene()
    window.choose("Second version", "none")
    wait_for(lambda: drive.view.ghost is None, "no ghost")
    wait_for(lambda: np.abs(window.scene().astype(int) - with_ghost).max() > 30, "the ghost is gone from the picture")
    window.click("Play")


def test_a_second_browser_may_watch_on_a_phone_and_go(
    cockpit: Cockpit, drive: Drive, window: Browser, windows: Windows
) -> None:
    phone = windows(390, 844)
    phone.open(cockpit.address)
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert len(cockpit.server.get_clients()) == 2
    # The sheet with the panels covers three fifths of the screen: what the camera looks at is above it.
    top = 0.4 * 844
    line = phone.page.get_by_text("frames/s").first
    sheet = wait_for(line.bounding_box, "the line is there, which is redrawn twice a second")
    assert sheet["y"] > top
    camera = cockpit.server.get_clients()[max(cockpit.server.get_clients())].camera
    view = drive.view

    def are_above_the_sheet() -> bool:
        points = (view.stage.env.viewpoint()[1], view.after.robot, view.after.target)
        drawn = [cockpit.pixel(point, camera) for point in points]
        return drawn[0][1] < top and all(0 < x < 390 and 0 < y < sheet["y"] for x, y in drawn)

    wait_for(are_above_the_sheet, "what matters is drawn above the sheet")
    phone.page.wait_for_timeout(2e3)  # the page puts its camera where a desktop's begins, a few frames later
    wait_for(are_above_the_sheet, "it still is", 30.0)
    phone.close()
    wait_for(lambda: len(cockpit.server.get_clients()) == 1, "the phone is gone")
    first = window.text()
    wait_for(lambda: window.text() != first, "the first browser's numbers go on")


def test_a_picture_for_the_readme(cockpit: Cockpit, drive: Drive, window: Browser, tmp_path: Path) -> None:
    window.page.set_viewport_size({"width": 1280, "height": 720})
    if PICTURES:
        window.open(cockpit.address, resolution=1.0)
    window.page.get_by_role("alert").locator("button").first.click()  # that it draws in software
    drive.drag_target(np.array([-0.35, 0.45, 0.35]))
    drive.do(drive.play)
    window.choose("Second version", "2")
    wait_for(lambda: drive.view.ghost is not None, "the ghost")
    drive.do(lambda: drive.begin("own", keep_target=True))
    start = drive.history[-1].number
    wait_for(lambda: drive.history[-1].number > start + 18, "both are on their way")
    drive.do(drive.pause)
    window.wait_for("paused")
    window.page.wait_for_timeout(3000)  # until the last frame is drawn
    file = Path(PICTURES or tmp_path) / "cockpit.png"
    picture = Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")
    picture.quantize(256).save(file, optimize=True)
    drive.do(lambda: drive.begin("own"))
    moving = []
    for _ in range(CYCLES):
        window.page.evaluate(TWO_FRAMES)
        moving.append(Image.open(io.BytesIO(window.page.screenshot())).convert("RGB").resize((960, 540)))
        drive.do(drive.step)
    palette = moving[-1].quantize(96)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in moving]
    file = file.with_suffix(".gif")
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=100, loop=0, optimize=True)
    assert file.stat().st_size < LARGEST_GIF_BYTES
    assert len({frame.tobytes() for frame in frames}) == CYCLES  # the robot moves
    window.page.set_viewport_size({"width": 1000, "height": 560})
    drive.do(lambda: drive.choose_ghost(None))
    drive.do(drive.play)
    assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 500  # no empty page


def test_out_of_distribution_is_coloured_and_said(drive: Drive, window: Browser) -> None:
    drive.drag_target(np.array([3.0, 0.0, 0.5]))  # training had none beyond 0.75 m
    window.wait_for("standard deviations above what it was in training")
    window.click("Observation", role="tab")
    wait_for(lambda: window.page.locator("tr[style*='#ff9d8f']").count() > 0, "a red row")
    window.click("Plots", role="tab")
    drive.do(lambda: drive.begin("own"))


def test_nothing_was_asked_of_another_machine(window: Browser) -> None:
    hosts = {urlsplit(address.removeprefix("blob:")).hostname for address in window.requests}
    assert hosts == {"127.0.0.1"} and len(window.requests) >= 2


def test_a_frame_is_few_meshes_and_few_triangles(drive: Drive, window: Browser) -> None:
    """Software draws an instance as slowly as a mesh of its own: no path, beam or floor is made of many."""
    meshes, corners = window.page.evaluate(WORK_OF_A_FRAME)
    assert len(drive.history) > 100  # there is a path
    assert 10 < meshes < 60 and 5_000 < corners < 30_000


def test_a_frame_takes_far_less_than_a_twentieth_of_a_second(cockpit: Cockpit) -> None:
    """Of processor time: what a busy machine makes of it on the wall is not the cockpit's doing."""
    spent = []
    for _ in range(100):
        began = time.thread_time()
        cockpit.panel.draw()
        spent.append(time.thread_time() - began)
    assert np.median(spent) < 0.025
