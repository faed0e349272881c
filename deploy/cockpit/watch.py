"""The panel of a robot server: its simulation while robo-gym's own environment drives it."""

from __future__ import annotations

import html
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import viser

from rlservo.deploy.cockpit.page import aim_cameras
from rlservo.deploy.cockpit.readings import WINDOW, Plot, escape
from rlservo.deploy.cockpit.scenery import Scenery
from rlservo.deploy.cockpit.stage import Scene, Stage
from rlservo.envs.robot_server.robots.robot import RobotState
from rlservo.envs.robot_server.state_reader import RobotServerError, StateReader, env_of, quantities, show_state
from rlservo.errors import UnavailableError

PERIOD_S = 0.05  # between two looks at the state
RETRY_S = 1.0


class WatchPanel:
    """The page's content for a robot server."""

    def __init__(self, server: viser.ViserServer, address: str, arguments: Mapping[str, Any]) -> None:
        """Read once. Raises UnavailableError if no robot server answers; later one may stop and start again."""
        self._server, self._arguments = server, dict(arguments)
        self._reader = StateReader(address)
        try:
            state = self._reader.read()
            self._open(state)
        except RobotServerError as error:
            self._reader.close()
            raise UnavailableError(str(error)) from error
        self.trouble = ""
        """Current trouble, or empty."""
        self._is_closed = threading.Event()
        self._states: deque[RobotState] = deque([state], maxlen=WINDOW)
        gui = server.gui
        self.status = gui.add_markdown("")
        with gui.add_folder("State"):
            self._names = _plotted(state)
            self._plot = Plot(gui, "Last looks, 20 a second", self._names)
            self._table = gui.add_html("")
        self._looks = threading.Thread(target=self._look, name="cockpit-robot-server", daemon=True)
        self._looks.start()

    @property
    def scene(self) -> Scene:
        """Positions at the last reading."""
        return self._scenes[1]

    def draw(self) -> None:
        """Draw a frame of the scene."""
        before, after, since = self._scenes
        self._scenery.draw(before, after, min(1.0, (time.perf_counter() - since) / PERIOD_S), None)

    def refresh(self, frames_per_s: float) -> None:
        """Refresh numbers and plots."""
        states = list(self._states)
        shown = quantities(states[-1])
        lines = [f"**robot server {self._reader.address}**, {frames_per_s:.0f} frames/s"]
        if self.trouble:
            lines.append(f"⚠ **{escape(self.trouble)}**")
        self.status.content = "\n\n".join(lines)
        rows = [quantities(state) for state in states]
        self._plot.update(range(len(rows)), [[row[name][0] for row in rows] for name in self._names])
        self._table.content = (
            "<table style='font-size:0.72em;padding:0 0.5em'>"
            + "".join(
                f"<tr><td>{html.escape(name)}</td><td style='text-align:right'>{value:.3f}</td><td>{unit}</td></tr>"
                for name, (value, unit) in shown.items()
            )
            + "</table>"
        )

    def close(self) -> None:
        """End reading and the connection."""
        self._is_closed.set()
        self._looks.join()
        self._reader.close()
        self._stage.close()

    def _open(self, state: RobotState) -> None:
        self._stage = Stage(env_of(state), self._arguments)
        self._stage.begin()
        scene = self._shown(state)
        self._scenes = scene, scene, time.perf_counter()
        self._scenery = Scenery(self._server, self._stage)
        aim_cameras(self._server, *self._stage.env.viewpoint())

    def _shown(self, state: RobotState) -> Scene:
        show_state(self._stage.env, state)
        return self._stage.scene()

    def _look(self) -> None:
        wait_s = PERIOD_S
        while not self._is_closed.wait(wait_s):
            try:
                state = self._reader.read()
                scene = self._shown(state)
            except (RobotServerError, ValueError) as error:
                self.trouble, wait_s = f"{error}; looking again", RETRY_S
                continue
            self._states.append(state)
            self._scenes = self._scenes[1], scene, time.perf_counter()
            self.trouble, wait_s = "", PERIOD_S


def _plotted(state: RobotState) -> list[str]:
    names = list(quantities(state))
    joints = [name for name in names if name.endswith("joint_position")]
    return joints or [name for name in names if name in ("x", "y", "yaw", "linear_velocity", "angular_velocity")]
