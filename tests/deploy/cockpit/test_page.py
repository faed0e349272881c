"""The cockpit's page in a real browser: what a person with a mouse can do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser", reason="the cockpit draws with viser")

from cockpits import Browser, Cockpit, cockpit_of, wait_for
from rlservo.deploy.cockpit.drive import Drive
from rlservo.deploy.cockpit.panel import DrivePanel
from rlservo.deploy.cockpit.policies import BundledPolicies, Choice

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

HANDLE_M = 0.13  # from the target to where its handle's arrow is taken


@pytest.fixture
def drive(two_versions: Path) -> Iterator[Drive]:
    drive = Drive(BundledPolicies(two_versions), Choice("ur5", "1"), seed=5)
    drive.start()
    yield drive
    drive.close()


@pytest.fixture
def cockpit(drive: Drive, two_versions: Path) -> Iterator[Cockpit]:
    with cockpit_of(lambda server: DrivePanel(server, drive, BundledPolicies(two_versions))) as served:
        yield served


def test_the_handle_is_dragged_and_the_robot_reaches_the_new_target(
    cockpit: Cockpit, drive: Drive, browser: Callable[..., Browser]
) -> None:
    window = browser()
    window.open(cockpit.address)
    drive.do(drive.pause)
    before = drive.view.after.target
    assert before is not None
    axis = np.array([0.0, 0.0, 1.0])
    start, end = cockpit.pixel(before + HANDLE_M * axis), cockpit.pixel(before + (HANDLE_M + 0.2) * axis)
    window.page.screenshot(path="/tmp/before.png")
    print(start, end)
    window.drag(start, end)
    window.page.screenshot(path="/tmp/after.png")
    wait_for(lambda: drive.view.after.target[2] > before[2] + 0.1, "the target is where it was dragged to")
    assert np.allclose(drive.view.after.target[:2], before[:2], atol=1e-3)
    drive.do(drive.play)
    window.wait_for("Arrived.")
