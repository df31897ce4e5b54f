"""Panels of dots and panels of curves."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator

from kornia_pnpnet.evaluation.figures import style

_ROW = 0.165  # inches from one solver to the next: a line of letters
_WITH_NUMBERS = 3  # largest number of panels side by side that each have room for numbers
_MOST_TICKS = 6  # largest number of places on a horizontal axis that are all ticked
_LABELS = {"rate": "solved (%)", "us": "µs per problem", "operations": "operations"}

Styles = Mapping[str, Mapping[str, Any]]  # arguments of Axes.plot by name


def reach(table: pd.DataFrame) -> np.ndarray:
    """Lengths of the intervals below and above the rates. A rounded rate can lie just outside its interval."""
    return np.clip([table.rate - table.low, table.high - table.rate], 0, None)


def draw_dots(path: str | Path, heading: Sequence[str], lines: Sequence[Mapping[str, pd.DataFrame]], most: int) -> Path:
    """Draw success: a row for each solver, a panel for each table with ``solver``, ``rate``, ``low`` and ``high``.

    Tables are by title, at most ``most`` side by side. The first panel has numbers, and others where there is room.
    """
    grouped = [list(line.items()) for line in lines]
    sizes = [math.ceil(len(line) / math.ceil(len(line) / most)) for line in grouped]  # lines of about equal length
    split = [line[i : i + size] for line, size in zip(grouped, sizes, strict=True) for i in range(0, len(line), size)]
    styles = style.solver_styles(solver for line in split for _, table in line for solver in table.solver)
    columns = max(sizes)
    narrow = columns > _WITH_NUMBERS
    figure = style.make_figure(style.WIDTH, 0.5 + (_ROW * len(styles) + 0.85) * len(split), *heading)
    ratios = [2 if narrow and column == 0 else 1 for column in range(columns)]
    grid = figure.subplots(len(split), columns, sharex=True, sharey=True, squeeze=False, width_ratios=ratios)
    for line, places in zip(split, grid, strict=True):
        for index, (axes, (title, table)) in enumerate(zip(places, line, strict=False)):
            _draw_dots(axes, table, styles, numbers=index == 0 or not narrow)
            axes.set_title(textwrap.fill(title.replace("_", " "), 11 if narrow and index else 34))
            axes.set_xlabel(_LABELS["rate"])
        for axes in places[len(line) :]:
            axes.remove()
        places[0].set_yticks(range(len(styles)), [style.shortened(name) for name in styles])
        for label, name in zip(places[0].get_yticklabels(), styles, strict=True):
            label.set_fontweight("bold" if style.is_ours(name) else "normal")
    grid[0, 0].set(xlim=(-3, 103), ylim=(len(styles) - 0.4, -0.6), xticks=range(0, 101, 50 if narrow else 25))
    return style.save(figure, path)


def _draw_dots(axes: Axes, table: pd.DataFrame, styles: Styles, *, numbers: bool) -> None:
    """Draw one panel: dots with intervals, a line across for each bound, and numbers on the right."""
    for name, rate, (low, high) in zip(table.solver, table.rate, reach(table).T, strict=True):
        look, row = styles[name], list(styles).index(name)
        if not look["marker"]:
            axes.axvline(rate, color=look["color"], linestyle=look["linestyle"], linewidth=0.9, zorder=1)
        dot = {**look, "linestyle": "none", "marker": look["marker"] or "|"}
        axes.errorbar([rate], [row], xerr=[[low], [high]], label=name, elinewidth=1.4, clip_on=False, **dot)
        if numbers:
            font: dict[str, Any] = {"fontsize": 8, "fontweight": "bold" if style.is_ours(name) else "normal"}
            place: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "va": "center_baseline"}
            axes.text(1.04, row, f"{rate:.1f} ±{max(low, high):.1f}", **font, **place)


@rc_context(style.THEME)
def draw_curves(
    path: str | Path,
    heading: Sequence[str],
    panels: Sequence[tuple[str, pd.DataFrame, str]],
    x: str,
    label: str,
    *,
    columns: int = 3,
    log: bool = False,
    styles: Styles | None = None,
) -> Path:
    """Draw panels of curves with one legend below. ``x`` is the column of the horizontal axis, ``label`` its label.

    A panel is a title, a table with the column ``solver``, and the column of its vertical axis: ``rate`` in per cent
    (with ``low`` and ``high``), ``us`` or ``operations``. Panels with the same vertical axis share its limits.
    """
    found = {solver for _, table, _ in panels for solver in table.solver}
    styles = {name: look for name, look in (styles or style.solver_styles(found)).items() if name in found}
    columns = min(columns, len(panels))
    lines = -(-len(panels) // columns)
    figure = style.make_figure(style.WIDTH, 1.0 + (2.4 if lines > 1 else 3.0) * lines + 0.04 * len(styles), *heading)
    grid = list(figure.subplots(lines, columns, squeeze=False).flat)
    first: dict[str, Axes] = {}
    for index, (axes, (title, table, y)) in enumerate(zip(grid, panels, strict=False)):
        for name, look in styles.items():
            line = table[table.solver == name].sort_values(x)
            error, every = reach(line) if y == "rate" else None, max(1, len(line) // 8)
            if len(line):
                axes.errorbar(line[x], line[y], yerr=error, label=name, elinewidth=1.0, markevery=every, **look)
        axes.set(title=title, xlabel=label, xscale="log" if log else "linear")
        if index % columns == 0 or panels[index - 1][2] != y:
            axes.set_ylabel(_LABELS[y])
        if y in first:
            axes.sharey(first[y])
        first.setdefault(y, axes)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if log else MaxNLocator(_MOST_TICKS, integer=True))
        places = sorted(table[x].unique())
        if len(places) <= _MOST_TICKS:
            axes.set_xticks(places)
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.set_xticks([], minor=True)
    for axes in grid[len(panels) :]:
        axes.remove()
    for y, axes in first.items():
        if y == "rate":
            axes.set(ylim=(-3, 103), yticks=range(0, 101, 20))
        else:
            style.log_scale(axes.yaxis, EngFormatter(sep="") if y == "operations" else "{x:g}")
    style.draw_legend(figure, styles)
    return style.save(figure, path)
