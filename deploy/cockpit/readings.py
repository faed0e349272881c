"""Readings of a policy: a table and remarks on its observation, moving plots of its actions."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
import viser
import viser.uplot
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import BoxSpec, LeafSpec
from rlservo.deploy.cockpit.view import Cycle
from rlservo.policy.drift import SMALLEST_STD, training_moments

FAR, VERY_FAR = 3.0, 5.0  # standard deviations from the training's mean
AMBER, RED = "#ffe08a", "#ff9d8f"
WINDOW = 200  # control cycles in a plot
MOST_SERIES = 8
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#17becf")
MOST_WORDS = 4
PANEL_WIDTH = 320  # [pixels]

Vector = NDArray[np.float64]


class Elements:
    """A space's elements: names, units, bounds and, if known, their values in training."""

    def __init__(self, space: LeafSpec, moments: tuple[Vector, Vector] | None = None) -> None:
        named = dict(enumerate(space.elements))
        self.names = [named[index].name if index in named else str(index) for index in range(space.size)]
        self.units = [named[index].unit if index in named else "" for index in range(space.size)]
        low, high = space.bounds()
        self.low, self.high = low.ravel(), high.ravel()
        self.moments = moments

    @classmethod
    def observed(cls, contract: Contract) -> Elements:
        """Return a policy's observation elements."""
        space = contract.observation_space
        assert isinstance(space, BoxSpec)  # of our simulators
        return cls(space, training_moments(contract))

    @classmethod
    def acted(cls, contract: Contract) -> Elements:
        """Return a policy's action elements."""
        space = contract.action_space
        assert isinstance(space, BoxSpec)
        return cls(space)

    def deviations(self, values: Vector) -> Vector:
        """Return the distance from training's mean in standard deviations; 0 if unknown."""
        if self.moments is None:
            return np.zeros(len(values))
        mean, std = self.moments
        return (values - mean) / np.maximum(std, SMALLEST_STD)

    def words(self, values: Vector) -> list[str]:
        """Return sentences on elements that are out of bounds or out of distribution, the worst first."""
        sentences = [
            f"{self.names[index]} is {values[index]:.4g}, outside {self.low[index]:g} to {self.high[index]:g}"
            for index in np.flatnonzero((values < self.low) | (values > self.high))
        ]
        deviations = self.deviations(values)
        for index in np.argsort(-np.abs(deviations)):
            if abs(deviations[index]) > VERY_FAR:
                sentences.append(
                    f"{self.names[index]} is {abs(deviations[index]):.1f} standard deviations "
                    f"{'above' if deviations[index] > 0 else 'below'} what it was in training"
                )
        return sentences[:MOST_WORDS]

    def table(self, values: Vector) -> str:
        """Return an HTML table: value and unit, bounds, training; out of distribution is amber, then red."""
        deviations = self.deviations(values)
        outside = (values < self.low) | (values > self.high)
        rows = []
        for index, name in enumerate(self.names):
            off = abs(float(deviations[index]))
            colour = RED if outside[index] or off > VERY_FAR else AMBER if off > FAR else ""
            trained = ""
            if self.moments is not None:
                mean, std = float(self.moments[0][index]), float(self.moments[1][index])
                trained = f"{mean if abs(mean) > std / 100 else 0:.2g} &plusmn; {std:.2g}"
            style = f" style='background:{colour};color:#000'" if colour else ""
            rows.append(
                f"<tr{style} title='{deviations[index]:+.1f} standard deviations'>"
                f"<td style='white-space:normal'>{html.escape(name).replace('_', '_<wbr>')}</td>"
                f"<td style='text-align:right'>{values[index]:.3f}</td>"
                f"<td>{html.escape(self.units[index])}</td><td>{_bounds(self.low[index], self.high[index])}</td>"
                f"<td>{trained}</td></tr>"
            )
        return (
            "<div style='overflow-x:auto;padding:0 0.5em'><table style='font-size:0.72em;line-height:1.3;width:100%;"
            "border-spacing:3px 0;white-space:nowrap'><thead><tr><th align=left>element</th><th align=right>value</th>"
            "<th align=left>unit</th><th align=left>bounds</th><th align=left>training</th></tr></thead><tbody>"
            f"{''.join(rows)}</tbody></table></div>"
        )


class Plot:
    """A moving plot of some series over the control cycles."""

    def __init__(self, gui: viser.GuiApi, title: str, labels: Sequence[str], unit: str = "", height: int = 165) -> None:
        shown = _without_common_end(labels[:MOST_SERIES])
        self._count = len(shown)
        empty = np.zeros(1)
        self._plot = gui.add_uplot(
            (empty,) * (self._count + 1),
            (
                viser.uplot.Series(label="cycle"),
                *(
                    viser.uplot.Series(label=label, stroke=COLOURS[index], width=1.5)
                    for index, label in enumerate(shown)
                ),
            ),
            title=title,
            axes=(_axis("control cycle"), _axis(unit)),
            scales={"x": viser.uplot.Scale(time=False)},
            legend=viser.uplot.Legend(show=self._count > 1),
            height=height,
        )

    def update(self, x: Sequence[float], series: Sequence[Sequence[float] | Vector]) -> None:
        """Show these values over time; unknown ones are left out, and so is a plot without any."""
        columns = np.array([x, *series[: self._count]], np.float64)
        known = columns[:, np.isfinite(columns).all(axis=0)]
        self.visible = known.shape[1] > 0
        if self.visible:
            self._plot.data = tuple(known)

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self._plot.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        if self._plot.visible != visible:
            self._plot.visible = visible


def _axis(label: str) -> viser.uplot.Axis:
    return viser.uplot.Axis(label=label, labelSize=16 if label else 0, labelFont="11px sans-serif")


class Readings:
    """Plots of one policy's actions, and a table of its observation, in a panel next to the scene."""

    def __init__(
        self, gui: viser.GuiApi, contract: Contract, difference: str = "Ghost's action minus the action"
    ) -> None:
        self._observed = Elements.observed(contract)
        acted = Elements.acted(contract)
        has_value = any(tensor.name == "value" for tensor in contract.outputs)
        self._panel = gui.add_panel()
        with self._panel.add_tab("Plots"):
            units = set(acted.units) - {"", "1"}
            unit = units.pop() if len(units) == 1 else ""
            self._distance = Plot(gui, "Distance from the target", ["distance"], "m")
            self._action = Plot(gui, "Action", acted.names, unit)
            self._difference = Plot(gui, difference, acted.names, unit)
            self._value = Plot(gui, "Value (the critic's)", ["value"], "return") if has_value else None
            self._latency = Plot(gui, "Latency", ["latency", "late beyond"], "ms")
        with self._panel.add_tab("Observation"):
            self._table = gui.add_html("")
        self._panel.dock_left()
        self._panel.set_width(PANEL_WIDTH)

    def update(self, history: Sequence[Cycle], *, late_beyond_ms: float) -> list[str]:
        """Show the last cycles; return a remark on the last observation."""
        if not history:
            return []
        shown = history[-WINDOW:]
        x = [cycle.number for cycle in shown]
        nothing = np.full(len(shown[-1].action), np.nan)
        differences = [nothing if cycle.difference is None else cycle.difference for cycle in shown]
        self._distance.update(x, [[_number(cycle.distance) for cycle in shown]])
        self._action.update(x, np.array([cycle.action for cycle in shown]).T)
        self._difference.update(x, np.array(differences).T)
        if self._value is not None:
            self._value.update(x, [[_number(cycle.value) for cycle in shown]])
        self._latency.update(x, [[cycle.latency_ms for cycle in shown], [late_beyond_ms] * len(shown)])
        observation = shown[-1].obs.astype(np.float64).ravel()
        self._table.content = self._observed.table(observation)
        return [*shown[-1].warnings, *self._observed.words(observation)]

    def remove(self) -> None:
        self._panel.remove()


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _without_common_end(names: Sequence[str]) -> list[str]:
    """Return names without their common last words: a legend is narrow."""
    words = [name.split("_") for name in names]
    while len(words) > 1 and len({each[-1] for each in words}) == 1 and min(map(len, words)) > 1:
        words = [each[:-1] for each in words]
    return ["_".join(each) for each in words]


def _bounds(low: float, high: float) -> str:
    if not (np.isfinite(low) or np.isfinite(high)):
        return ""
    return f"&plusmn;{high:.3g}" if low == -high else f"{low:.3g} .. {high:.3g}"


def escape(text: str) -> str:
    """Return text escaped for markdown."""
    return "".join(f"\\{character}" if character in r"\`*_{}[]<>#|" else character for character in text)
