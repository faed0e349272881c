"""The panel of a recording: episodes to scrub through, and the moments at which a replay differs most."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from rlservo.deploy.cockpit.message_checks import number_of
from rlservo.deploy.cockpit.page import aim_cameras, set_value
from rlservo.deploy.cockpit.readings import Readings, escape
from rlservo.deploy.cockpit.scenery import LEGEND, Scenery
from rlservo.deploy.cockpit.stage import Scene, Stage, home_arguments, home_of
from rlservo.deploy.cockpit.view import Cycle
from rlservo.errors import UsageError
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.reader import Recording
from rlservo.recording.replay.follower import Follower
from rlservo.recording.replay.replay import Moment, replay

MOST_EPISODES = 500  # in memory
# Objects whose position is not recorded are left out: the room and the cubes round a MiR100.
EMPTY_FLOOR = "rlservo/NoObstacleNavigationMir100Sim-v0"
NO_MOMENT = "-"
WAYS = {"Pause": 0, "Back": -1, "Step": 1}


class Tape:
    """Recorded episodes of one policy, and with a bundle its actions for them."""

    def __init__(self, path: Path, *, bundle: Path | None = None, policy: str | None = None) -> None:
        """Raise UsageError if there is nothing to show, RecordingError if there is no recording."""
        recording = Recording(path)
        self.differences: list[NDArray[Any]] = []
        """Differences of the bundle's actions from the recorded ones, by episode; NaN if unknown."""
        self.moments: list[Moment] = []
        """The moments at which they differ most."""
        self.episodes: list[RecordedEpisode] = []
        if bundle is None:
            self.episodes = list(islice(_of_one_policy(recording, policy), MOST_EPISODES))
        else:
            for followed in islice(Follower(bundle).follow(recording, policy), MOST_EPISODES):
                self.episodes.append(followed.episode)
                if "action" not in followed.action:
                    raise UsageError(
                        f"the actions of {followed.episode.policy.title} are nested: no robot of rlservo takes nested "
                        "actions"
                    )
                difference = followed.action["action"] - followed.episode.action["action"]
                difference = difference.reshape(len(followed.episode), -1).astype(np.float64)
                difference[~followed.known] = np.nan
                self.differences.append(difference)
        if not self.episodes:
            raise UsageError(f"{path} has no decisions of {f'policy {policy!r}' if policy else 'any policy'}")
        self.contract = self.episodes[0].policy.contract
        if bundle is not None:
            self.moments = replay(recording, bundle, name=policy).worst

    def find(self, moment: Moment) -> tuple[int, int]:
        """Return episode and row of a moment; the first ones if it is beyond the episodes in memory."""
        for number, episode in enumerate(self.episodes):
            rows = np.flatnonzero((episode.steps == moment.step) & (np.abs(episode.time_s - moment.time_s) < 1e-3))
            if episode.id == moment.episode and len(rows):
                return number, int(rows[0])
        return 0, 0

    def cycles(self, number: int) -> list[Cycle]:
        """Return an episode as a drive would have shown it."""
        episode = self.episodes[number]
        obs, action = episode.obs["obs"], episode.executed["action"]
        warned: dict[int, list[str]] = {}
        for row, sentence in episode.warnings:
            warned.setdefault(row, []).append(sentence)
        names = [element.name for element in self.contract.observation_space.elements]
        return [
            Cycle(
                number=int(episode.steps[row]),
                obs=obs[row],
                action=np.atleast_1d(action[row]),
                latency_ms=float(episode.latency_ms[row]),
                is_late=bool(episode.fell_back[row]) or not bool(episode.acted[row]),
                fallback=episode.errors[row] or "",
                warnings=tuple(warned.get(row, ())),
                value=None,
                distance=float(obs[row].ravel()[0]) if names[:1] == ["target_r"] else None,
                difference=self.differences[number][row] if self.differences else None,
            )
            for row in range(len(episode))
        ]


class PlaybackPanel:
    """The page's content for a recording."""

    def __init__(self, server: viser.ViserServer, tape: Tape, *, env_id: str | None) -> None:
        """Raise UsageError if the recorded policy's environment cannot be drawn."""
        self._tape = tape
        contract = tape.contract
        home = env_id or home_of(contract)
        Stage(home, home_arguments(contract), contract).close()  # or an error about what does not fit
        self._stage = Stage(EMPTY_FLOOR if "Mir100" in home else home, home_arguments(contract))
        self._stage.begin()
        self._period_s = 1.0 / (contract.control_rate_hz or 10.0)
        self._scenery = Scenery(server, self._stage)
        self._episode, self._row = 0, 0.0
        self._is_playing = True
        self._cycles = tape.cycles(0)
        self._shown: tuple[int, int] | None = None
        self._scenes: tuple[Scene, Scene] | None = None
        self._last = time.perf_counter()
        gui = server.gui
        self.status = gui.add_markdown("")
        gui.add_html(LEGEND)
        with gui.add_folder("Recording"):
            titles = tuple(f"{number}: {_title(episode)}" for number, episode in enumerate(tape.episodes))
            self._choice = gui.add_dropdown("Episode", titles)
            self._slider = gui.add_slider("Decision", min=0, max=max(1, len(self._cycles) - 1), step=1, initial_value=0)
            play = gui.add_button_group("Time", ("Play", "Pause", "Back", "Step"))
            self._speed = gui.add_slider("Speed", min=0.1, max=8.0, step=0.1, initial_value=1.0)
            moments = (NO_MOMENT, *(_moment_title(number, moment) for number, moment in enumerate(tape.moments)))
            self._moment = gui.add_dropdown("Worst moments", moments, visible=bool(tape.moments))
        self._readings = Readings(gui, contract, "The bundle's action minus the recorded one")
        self._choice.on_update(lambda event: self._choose(titles, event.target.value))
        self._slider.on_update(lambda event: self._scrub(event))
        self._moment.on_update(lambda event: self._jump(moments, event.target.value))
        play.on_click(lambda event: self._press(str(event.target.value)))
        aim_cameras(server, *self._stage.env.viewpoint())

    def draw(self) -> None:
        """Draw a frame of the scene, and let time continue."""
        now = time.perf_counter()
        if self._is_playing:
            row = self._row + (now - self._last) / self._period_s * number_of(self._speed)
            self._row = min(row, len(self._cycles) - 1.0)
            self._is_playing = self._row < len(self._cycles) - 1
        self._last = now
        key = (self._episode, int(self._row))
        if key != self._shown or self._scenes is None:
            self._shown, self._scenes = key, (self._scene(key[1]), self._scene(key[1] + 1))
        before, after = self._scenes
        self._scenery.draw(before, after, self._row - int(self._row), None)

    def refresh(self, frames_per_s: float) -> None:
        """Refresh numbers and plots."""
        row, episode = int(self._row), self._tape.episodes[self._episode]
        words = self._readings.update(self._cycles[: row + 1], late_beyond_ms=1e3 * self._period_s)
        cycle = self._cycles[row]
        lines = [
            f"**{episode.policy.title}**, recorded; {frames_per_s:.0f} frames/s",
            f"Episode {self._episode}: {escape(_title(episode))}. Decision **{cycle.number}**.",
        ]
        if cycle.is_late:
            lines.append(f"⚠ **The action is not the policy's.** {escape(cycle.fallback)}")
        lines += [f"⚠ {escape(sentence)}" for sentence in words]
        self.status.content = "\n\n".join(lines)
        set_value(self._slider, row)

    def close(self) -> None:
        """Close the simulator."""
        self._stage.close()

    def _scene(self, row: int) -> Scene:
        obs = self._tape.episodes[self._episode].obs["obs"]
        self._stage.env.show_observations(obs, min(row, len(obs) - 1))
        return self._stage.scene()

    def _choose(self, titles: Sequence[str], title: str) -> None:
        if title in titles:
            self._go(titles.index(title), 0)

    def _go(self, number: int, row: int) -> None:
        self._is_playing = False
        self._cycles = self._tape.cycles(number)
        self._episode, self._row = number, float(row)
        self._slider.max = max(1, len(self._cycles) - 1)

    def _scrub(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:  # a person, not we
            self._is_playing, self._row = False, min(number_of(event.target), len(self._cycles) - 1.0)

    def _jump(self, titles: Sequence[str], title: str) -> None:
        if title in titles[1:]:
            self._go(*self._tape.find(self._tape.moments[titles.index(title) - 1]))

    def _press(self, button: str) -> None:
        last = len(self._cycles) - 1
        if button == "Play":
            self._row = 0.0 if self._row >= last else self._row
            self._is_playing = True
        elif button in WAYS:
            self._is_playing = False
            way = WAYS[button]
            self._row = float(min(last, max(0, int(self._row) + way)))


def _of_one_policy(recording: Recording, name: str | None) -> Sequence[RecordedEpisode]:
    """Return the episodes of the policy that was named, or of the one that comes first."""
    found: list[RecordedEpisode] = []
    for episode in episodes(recording):
        wanted = name or (found[0].policy.contract.name if found else episode.policy.contract.name)
        if episode.policy.contract.name == wanted:
            found.append(episode)
        if len(found) == MOST_EPISODES:
            break
    return found


def _title(episode: RecordedEpisode) -> str:
    return f"{episode.final_status or ('ended' if episode.ended else 'no end')}, {len(episode)} decisions"


def _moment_title(number: int, moment: Moment) -> str:
    return f"{number + 1}. step {moment.step}: {moment.element} {moment.recorded:.3g} -> {moment.replayed:.3g}"
