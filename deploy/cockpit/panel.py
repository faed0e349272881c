"""The panel of a drive: buttons, choices, sliders, observations and actions."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser

from rlservo.bundle.contract import Contract
from rlservo.deploy.cockpit.drive import Drive
from rlservo.deploy.cockpit.message_checks import number_of
from rlservo.deploy.cockpit.page import aim_cameras, set_value
from rlservo.deploy.cockpit.policies import FALLBACKS, Choice, PolicySource, ServerLink
from rlservo.deploy.cockpit.readings import Readings, escape
from rlservo.deploy.cockpit.scenery import LEGEND, Scenery
from rlservo.deploy.cockpit.stage import Stage, StageDisturbance
from rlservo.deploy.cockpit.view import View
from rlservo.errors import RlservoError
from rlservo.robots.ur.parameters import UR_PARAMETERS

NO_GHOST = "none"
LOOK_S = 2.0  # between two looks at what a server has
DROP_DISTANCE = 1.3  # [m], ahead of the robot, of an obstacle that is dropped


class DrivePanel:
    """The page's content for a drive."""

    def __init__(self, server: viser.ViserServer, drive: Drive, source: PolicySource) -> None:
        self._server, self._drive, self._source = server, drive, source
        self._versions = source.versions()
        self._is_closed = threading.Event()
        self._scenery: Scenery | None = None
        self._readings: Readings | None = None
        self._drawn: Stage | None = None
        self._drawn_contract: Contract | None = None
        gui = server.gui
        self.status = gui.add_markdown("")
        with gui.add_folder("Drive"):
            time_buttons = gui.add_button_group("Time", ("Play", "Pause", "Step"))
            times = {"Play": drive.play, "Pause": drive.pause, "Step": drive.step}
            time_buttons.on_click(lambda event: self._press(times, event.target.value))
            starts: dict[str, Callable[[], None]] = {
                "New target": lambda: drive.begin("here"),
                "Reset": lambda: drive.begin("own", keep_target=True),
                "Random start": lambda: drive.begin("random", keep_target=True),
            }
            begin = gui.add_button_group("Episode", tuple(starts))
            begin.on_click(lambda event: self._press(starts, event.target.value))
            speed = gui.add_slider("Speed", min=0.1, max=4.0, step=0.1, initial_value=1.0)
            speed.on_update(lambda event: drive.do(partial(drive.set_speed, number_of(event.target))))
            self._push = gui.add_checkbox("Drag the robot", initial_value=False, hint="instead of its target")
            self._push.on_update(lambda _: self._offer_start())
            self._hand = gui.add_button("Take over, give back", visible=False, hint="lead the arm by hand")
            self._hand.on_click(lambda _: drive.do(drive.take_over))
            self._drop = gui.add_button("Drop a cube ahead", visible=False)
            self._drop.on_click(lambda _: self._drop_obstacle())
        with gui.add_folder("Policy"):
            names = list(self._versions)
            self._name = gui.add_dropdown("Policy", names, initial_value=drive.choice.name)
            self._version = gui.add_dropdown(
                "Version", self._versions[drive.choice.name], initial_value=drive.choice.version
            )
            self._robot = gui.add_dropdown("Robot", tuple(UR_PARAMETERS), initial_value="ur5", visible=False)
            self._deadline = gui.add_slider(
                "Deadline [ms]", min=5, max=1000, step=5, initial_value=1000, visible=source.is_remote
            )
            self._fallback = gui.add_dropdown("Without answer", FALLBACKS, visible=source.is_remote)
        with gui.add_folder("Disturbances", expand_by_default=False):
            self._action_latency = gui.add_slider("Action late [cycles]", min=0, max=10, step=1, initial_value=0)
            self._observation_latency = gui.add_slider("Observed late [cycles]", min=0, max=10, step=1, initial_value=0)
            self._noise = gui.add_slider("Noise (sd)", min=0.0, max=0.2, step=0.005, initial_value=0.0)
            self._payload = gui.add_slider("Payload [kg]", min=0.0, max=10.0, step=0.5, initial_value=0.0)
        with gui.add_folder("Ghost"):
            self._ghost = gui.add_dropdown("Second version", (NO_GHOST,))
        gui.add_html(LEGEND)
        self._connect()
        self._offer_versions()
        self._looks = threading.Thread(target=self._look_again, name="cockpit-versions", daemon=True)
        if source.is_remote:
            self._looks.start()

    def close(self) -> None:
        """End the panel's own threads."""
        self._is_closed.set()
        if self._looks.is_alive():
            self._looks.join()

    # -- drawing

    def draw(self) -> None:
        """Draw a frame of the scene."""
        view = self._drive.view
        if view.stage is not self._drawn:
            self._rebuild(view)
        assert self._scenery is not None
        share = min(1.0, (time.perf_counter() - view.since) / view.period_s)
        self._scenery.draw(view.before, view.after, share, view.ghost)

    def refresh(self, frames_per_s: float) -> None:
        """Refresh numbers and plots."""
        view = self._drive.view
        history = list(self._drive.history)
        if view.contract is not self._drawn_contract:
            self._rebuild_readings(view)
        assert self._readings is not None
        words = self._readings.update(history, late_beyond_ms=view.late_beyond_ms)
        rate = f"{100 * view.successes / view.episodes:.0f}%" if view.episodes else "no episode yet"
        lines = [
            f"**{view.contract.name}** version {view.contract.version}, {view.phase}, {frames_per_s:.0f} frames/s",
            f"{view.sentence} Reached: **{view.successes} of {view.episodes}** ({rate}).",
            f"Late: {view.late}. Fallback actions: {view.fallbacks}.",
        ]
        lines += [f"⚠ **{escape(sentence)}**" for sentence in (view.refusal, view.trouble) if sentence]
        lines += [f"⚠ {escape(sentence)}" for sentence in words]
        if view.refusal:  # show what drives on, not what was chosen in vain
            set_value(self._name, self._drive.choice.name)
            self._offer_versions()
            set_value(self._version, self._drive.choice.version)
            set_value(self._robot, view.stage.arguments.get("ur_model", "ur5"))
        content = "\n\n".join(lines)
        if self.status.content != content:
            self.status.content = content

    def _rebuild(self, view: View) -> None:
        """Draw another robot."""
        if self._scenery is not None:
            self._scenery.remove()
        drive, env = self._drive, view.stage.env
        self._scenery = Scenery(
            self._server,
            view.stage,
            on_target=drive.drag_target,
            on_robot=drive.drag_robot,
            on_obstacle=lambda index, at: drive.do(lambda: drive.move_obstacle(index, at)),
        )
        self._offer_start()
        aim_cameras(self._server, *env.viewpoint())
        self._hand.visible = getattr(env, "is_real", False)
        self._drop.visible = len(env.obstacle_positions()) > 0
        self._robot.visible = not env.IS_PLANAR
        set_value(self._robot, view.stage.arguments.get("ur_model", "ur5"))
        self._payload.visible = not env.IS_PLANAR
        set_value(self._ghost, NO_GHOST)
        self._drawn = view.stage

    def _offer_start(self) -> None:
        if self._scenery is not None:
            self._scenery.offer_start(self._push.value)

    def _rebuild_readings(self, view: View) -> None:
        if self._readings is not None:
            self._readings.remove()
        self._readings = Readings(self._server.gui, view.contract)
        self._drawn_contract = view.contract

    # -- choices

    def _connect(self) -> None:
        """Pass every choice of a person to the drive, but not those set by the code."""

        def on_change(handle: Any, action: Callable[[], None]) -> None:
            handle.on_update(lambda event: action() if event.client is not None else None)

        on_change(self._name, self._choose_policy)
        on_change(self._version, self._choose)
        on_change(self._robot, lambda: self._choose({"ur_model": self._robot.value}))
        on_change(self._deadline, self._choose)
        on_change(self._fallback, self._choose)
        on_change(self._ghost, self._choose_ghost)
        for slider in (self._action_latency, self._observation_latency, self._noise, self._payload):
            on_change(slider, self._disturb)

    def _press(self, commands: Mapping[str, Callable[[], None]], button: Any) -> None:
        if button in commands:
            self._drive.do(commands[button])

    def _choose_policy(self) -> None:
        self._offer_versions()
        set_value(self._version, next(iter(self._versions.get(self._name.value, ())), self._version.value))
        self._choose()

    def _choose(self, env_arguments: dict[str, Any] | None = None) -> None:
        choice = Choice(self._name.value, self._version.value)
        link = ServerLink(number_of(self._deadline), self._fallback.value)
        if env_arguments is not None:
            env_arguments = {**self._drive.view.stage.arguments, **env_arguments}
        self._drive.do(lambda: self._drive.choose(choice, link, env_arguments))

    def _choose_ghost(self) -> None:
        version = self._ghost.value
        choice = None if version == NO_GHOST else Choice(self._name.value, version)
        self._drive.do(lambda: self._drive.choose_ghost(choice))

    def _disturb(self) -> None:
        disturbance = StageDisturbance(
            int(number_of(self._action_latency)), int(number_of(self._observation_latency)), number_of(self._noise)
        )
        if self._payload.visible:
            disturbance = replace(disturbance, payload=number_of(self._payload))
        self._drive.do(lambda: self._drive.disturb(disturbance))

    def _drop_obstacle(self) -> None:
        """Put the obstacle that is farthest from the robot ahead of it, on its way to the target."""

        def drop() -> None:
            env = self._drive.view.stage.env
            robot, target, obstacles = env.robot_position(), env.target_position(), env.obstacle_positions()
            if target is None or not len(obstacles):
                return
            ahead = (target - robot) / max(1e-6, float(np.linalg.norm(target - robot)))
            index = int(np.argmax(np.linalg.norm(obstacles - robot, axis=1)))
            self._drive.move_obstacle(index, robot + DROP_DISTANCE * ahead)

        self._drive.do(drop)

    def _offer_versions(self) -> None:
        versions = tuple(self._versions.get(self._name.value, ()))
        ghosts: Any = self._ghost  # typed by what it had at first
        for dropdown, options in ((self._version, versions), (ghosts, (NO_GHOST, *versions))):
            if options and tuple(dropdown.options) != options:
                dropdown.options = options

    def _look_again(self) -> None:
        """Update the choices from the server repeatedly; while it does not answer, keep the last ones."""
        while not self._is_closed.wait(LOOK_S):
            with contextlib.suppress(RlservoError):
                self._versions = self._source.versions() or self._versions
            if tuple(self._name.options) != tuple(self._versions):
                self._name.options = tuple(self._versions)
            self._offer_versions()
