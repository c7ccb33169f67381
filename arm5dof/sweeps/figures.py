"""A sweep's figures: how its configurations learnt, and what its axes are worth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from arm5dof.sweeps.summary import Headline, Line, curve, short, spelled
from arm5dof.training.report import STYLE, axes_over_episodes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_CURVES = 10
"""Configurations in one figure: more cannot be told apart."""

Curves = Mapping[str, Sequence[Mapping[str, Any]]]
"""By label, the rows of the members that a curve is of."""


def drawn(rows: Sequence[Mapping[str, Any]], lines: Sequence[Line], headline: Headline) -> dict[str, Figure]:
    """A sweep's figures by name: `learning`, and `axes` where there are others than seeds."""
    import matplotlib

    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        found = {"learning": learning(curves(rows, lines), headline)}
        axes = axes_figure(lines, headline)
    return found if axes is None else {**found, "axes": axes}


def curves(rows: Sequence[Mapping[str, Any]], lines: Sequence[Line], prefix: str = "") -> Curves:
    """The rows of each configuration, the best first, by what tells it apart."""
    return {
        prefix + (", ".join(f"{short(k)} {spelled(v)}" for k, v in line.settings.items()) or "all seeds"): [
            row for row in rows if all(row[name] == value for name, value in line.settings.items())
        ]
        for line in lines
    }


def learning(curves: Curves, headline: Headline) -> Figure:
    """The headline against episodes: interquartile means over members, and their confidence intervals as bands."""
    figure, axes = axes_over_episodes(headline.label)
    for label, rows in itertools.islice(curves.items(), MOST_CURVES):
        episodes, found = curve(rows)
        (line,) = axes.plot(episodes, [e.value for e in found], "o-", ms=3, lw=1.5, label=label)
        axes.fill_between(episodes, [e.low for e in found], [e.high for e in found], color=line.get_color(), alpha=0.15)
    left_out = f", the best {MOST_CURVES} of {len(curves)}" if len(curves) > MOST_CURVES else ""
    axes.set_title(f"Learning{left_out}: interquartile mean, 95 % interval", loc="left", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    return figure


def axes_figure(lines: Sequence[Line], headline: Headline) -> Figure | None:
    """What the axes are worth: points with intervals for one axis, a heat map for two, parallel coordinates for more.
    None if there is no axis but seeds, or nothing was measured."""
    from matplotlib.figure import Figure

    shown = [line for line in lines if line.seeds]
    names = list(lines[0].settings) if lines else []
    if not shown or not names:
        return None
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.add_subplot()
    scales = {name: _values([line.settings[name] for line in lines]) for name in names}
    if len(names) == 1:
        _points(axes, names[0], scales[names[0]], shown, headline)
    elif len(names) == 2 and len(shown) > 1 and math.prod(len(v) for v in scales.values()) <= 4 * len(lines):
        _heat_map(figure, axes, scales, shown, headline)
    else:
        _parallel(figure, axes, scales, shown, headline)
    return figure


def _values(given: Sequence[Any]) -> list[Any]:
    """The values that there are: numbers in order, others as they come."""
    found = list(dict.fromkeys(given))
    return sorted(found) if all(isinstance(v, (int, float)) for v in found) else found


def _points(axes: Any, name: str, values: list[Any], shown: Sequence[Line], headline: Headline) -> None:
    for line in shown:
        at, found = values.index(line.settings[name]), line.headline
        axes.plot(at, found.value, "o", color="#2a6fb0")
        if not math.isnan(found.low):
            axes.vlines(at, found.low, found.high, color="#2a6fb0", lw=2, alpha=0.5)
    axes.set_xticks(range(len(values)), [spelled(v) for v in values])
    axes.set_xlabel(short(name))
    axes.set_ylabel(headline.label)


def _heat_map(figure: Any, axes: Any, scales: dict[str, list[Any]], shown: Sequence[Line], headline: Headline) -> None:
    (row, rows), (column, columns) = scales.items()
    grid = np.full((len(rows), len(columns)), np.nan)
    for line in shown:
        grid[rows.index(line.settings[row]), columns.index(line.settings[column])] = line.headline.value
    image = axes.pcolormesh(grid, cmap=_colours(headline))
    for i, j in zip(*np.nonzero(np.isfinite(grid)), strict=True):
        axes.text(j + 0.5, i + 0.5, f"{grid[i, j]:.3g}", ha="center", va="center", fontsize=9)
    axes.set_xticks(np.arange(len(columns)) + 0.5, [spelled(v) for v in columns])
    axes.set_yticks(np.arange(len(rows)) + 0.5, [spelled(v) for v in rows])
    axes.set_xlabel(short(column))
    axes.set_ylabel(short(row))
    axes.grid(False)
    figure.colorbar(image, label=headline.label)


def _parallel(figure: Any, axes: Any, scales: dict[str, list[Any]], shown: Sequence[Line], headline: Headline) -> None:
    """Each configuration a line through its values, of the colour of its headline; the best drawn last."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    found = [line.headline.value for line in shown]
    colours = ScalarMappable(Normalize(min(found), max(found)), _colours(headline))
    for line in reversed(shown):
        heights = [scales[n].index(line.settings[n]) / max(len(scales[n]) - 1, 1) for n in scales]
        axes.plot(range(len(scales)), heights, color=colours.to_rgba(line.headline.value), lw=1.5, alpha=0.8)
    for at, values in enumerate(scales.values()):
        steps = range(0, len(values), max(len(values) // 8, 1))
        for i in steps:
            axes.text(at, i / max(len(values) - 1, 1), f" {spelled(values[i])}", fontsize=8)
    axes.set_xticks(range(len(scales)), [short(name) for name in scales])
    axes.set_yticks([])
    axes.set_xlim(-0.1, len(scales) - 0.6)
    figure.colorbar(colours, ax=axes, label=headline.label)


def _colours(headline: Headline) -> str:
    """Bright is better."""
    return "viridis" if headline.metric.higher_is_better else "viridis_r"
