"""What the policy sees, as a table and in words, and what it does, as moving plots."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
import viser
import viser.uplot
from numpy.typing import NDArray

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.spaces import BoxSpec, LeafSpec
from rlservo.serve_app.runtime.drift import SMALLEST_STD, training_moments

FAR, VERY_FAR = 3.0, 5.0  # standard deviations from the training's mean
AMBER, RED = "#ffe08a", "#ff9d8f"
WINDOW = 200  # control cycles in a plot
MOST_SERIES = 8
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#17becf")
MOST_WORDS = 4

Vector = NDArray[np.float64]


class Elements:
    """A space's elements: names, units, bounds, and where known what they were in training."""

    def __init__(self, space: LeafSpec, moments: tuple[Vector, Vector] | None = None) -> None:
        named = dict(enumerate(space.elements))
        self.names = [named[index].name if index in named else str(index) for index in range(space.size)]
        self.units = [named[index].unit if index in named else "" for index in range(space.size)]
        low, high = space.bounds()
        self.low, self.high = low.ravel(), high.ravel()
        self.moments = moments

    @classmethod
    def observed(cls, contract: Contract) -> Elements:
        """Return what a policy observes."""
        space = contract.observation_space
        assert isinstance(space, BoxSpec)  # of our simulators
        return cls(space, training_moments(contract))

    @classmethod
    def acted(cls, contract: Contract) -> Elements:
        """Return what a policy commands."""
        space = contract.action_space
        assert isinstance(space, BoxSpec)
        return cls(space)

    def deviations(self, values: Vector) -> Vector:
        """Return how many standard deviations of the training values are from its mean; 0 where that is not known."""
        if self.moments is None:
            return np.zeros(len(values))
        mean, std = self.moments
        return (values - mean) / np.maximum(std, SMALLEST_STD)

    def words(self, values: Vector) -> list[str]:
        """Return sentences on what is out of bounds or out of distribution, the worst first."""
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
                trained = f"{self.moments[0][index]:.2g} &plusmn; {self.moments[1][index]:.2g}"
            style = f" style='background:{colour};color:#000'" if colour else ""
            rows.append(
                f"<tr{style} title='{deviations[index]:+.1f} standard deviations'>"
                f"<td>{html.escape(name)}</td><td style='text-align:right'>{values[index]:.3f}</td>"
                f"<td>{html.escape(self.units[index])}</td><td>{_bounds(self.low[index], self.high[index])}</td>"
                f"<td>{trained}</td></tr>"
            )
        return (
            "<div style='overflow-x:auto;padding:0 0.5em'><table style='font-size:0.72em;line-height:1.3;width:100%;"
            "border-spacing:3px 0'><thead><tr><th align=left>element</th><th align=right>value</th><th align=left>unit"
            "</th><th align=left>bounds</th><th align=left>training</th></tr></thead><tbody>"
            f"{''.join(rows)}</tbody></table></div>"
        )


class Plot:
    """A moving plot of some series."""

    def __init__(self, gui: viser.GuiApi, title: str, labels: Sequence[str], height: int = 150) -> None:
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
            scales={"x": viser.uplot.Scale(time=False)},
            legend=viser.uplot.Legend(show=self._count > 1),
            height=height,
        )

    def update(self, x: Sequence[float] | Vector, series: Sequence[Sequence[float] | Vector]) -> None:
        """Show these values; None and not-a-number leave a gap."""
        columns = [np.asarray(values, np.float64) for values in series[: self._count]]
        self._plot.data = (np.asarray(x, np.float64), *columns)

    def remove(self) -> None:
        self._plot.remove()


def _without_common_end(names: Sequence[str]) -> list[str]:
    """Return names without the words at their end that all of them have: a legend is narrow."""
    words = [name.split("_") for name in names]
    while len(words) > 1 and len({each[-1] for each in words}) == 1 and min(map(len, words)) > 1:
        words = [each[:-1] for each in words]
    return ["_".join(each) for each in words]


def _bounds(low: float, high: float) -> str:
    if not (np.isfinite(low) or np.isfinite(high)):
        return ""
    return f"{low:.3g} .. {high:.3g}"
