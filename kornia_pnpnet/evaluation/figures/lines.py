"""Curves, their names and their ticks, for the pictures against n, m and the number of mismatches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Annotation

from kornia_pnpnet.evaluation.figures.style import (
    GREY,
    LETTERS,
    SMALL,
    WIDTH,
    SolverStyle,
    make_figure,
    shortened,
    tidy,
)
from kornia_pnpnet.metrics import SuccessRate

_LINE_PT, _TICK_PT = 9.6, 13.5  # from one name to the next, and from one tick to the next, in points
_BESIDE = 1.06  # where names begin, in widths of the axes
_MOST_COLUMNS, _HEIGHT = 3, 2.9  # of panels side by side; inches of each
_LEGEND_COLUMNS, _HANDLE = 4, 11  # at most; what a piece of line takes beside its name, in letters


class Curve(NamedTuple):
    """Values at some places, ``x`` ascending, with or without the ends of their intervals."""

    name: str
    look: SolverStyle
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] = ()
    high: Sequence[float] = ()

    @classmethod
    def of_rates(cls, name: str, look: SolverStyle, rates: Mapping[float, SuccessRate]) -> Curve:
        """Success in per cent, by its place on the horizontal axis."""
        x = sorted(rates)
        y, low, high = ([100 * getattr(rates[place], key) for place in x] for key in ("rate", "low", "high"))
        return cls(name, look, x, y, low, high)


def make_panels(count: int) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` panels, three side by side or two."""
    columns = count if count <= _MOST_COLUMNS else 2
    lines = -(-count // columns)
    figure = make_figure(WIDTH, 1.1 + _HEIGHT * lines)
    grid = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes in grid[count:]:
        axes.remove()
    return figure, grid[:count]


def draw_rates(axes: Axes, curves: Sequence[Curve]) -> None:
    """Draw curves of success and set up the vertical axis."""
    for curve in curves:
        y = np.array(curve.y)
        # A rate of the file is rounded, so a bound can lie just inside.
        reach = np.stack((y - curve.low, np.array(curve.high) - y)).clip(min=0)
        axes.errorbar(curve.x, y, yerr=reach, label=curve.name, capsize=1.8, elinewidth=0.9, **curve.look.line())
    place = axes.get_subplotspec()
    label = "problems solved (%)" if place is None or place.is_first_col() else ""
    axes.set(ylim=(-3, 103), yticks=range(0, 101, 20), ylabel=label)
    tidy(axes)


def few_ticks(figure: Figure, panels: Mapping[Axes, Iterable[int]]) -> None:
    """Tick the first and the last place of each horizontal axis, and the places between with room for a number.

    This needs the layout: call this function last.
    """
    figure.draw_without_rendering()
    for axes, places in panels.items():
        points = {place: axes.transData.transform((place, 1))[0] * 72 / figure.dpi for place in places}
        chosen: list[int] = []
        for place in sorted(points, key=lambda place: (place not in (min(points), max(points)), place)):
            if all(abs(points[place] - points[other]) >= _TICK_PT for other in chosen):
                chosen.append(place)
        axes.set_xticks(chosen, [f"{place}" for place in chosen])
        axes.set_xticks([], minor=True)


def write_names(legend: Legend, names: Iterable[str]) -> None:
    """Write names into a legend as they are: matplotlib hides labels with an underscore and parses dollar signs."""
    for text, name in zip(legend.get_texts(), names, strict=True):
        text.set(text=name, parse_math=False)


def name_curves(figure: Figure, panels: Mapping[Axes, Sequence[Curve]]) -> None:
    """Write the names of drawn curves beside the axes, moved apart, each joined to the end of its curve.

    This needs the layout: call this function last.
    """
    beside = {}
    for axes, curves in panels.items():
        right = max(curve.x[-1] for curve in curves)
        beside[axes] = [_write_name(axes, curve, right) for curve in curves]
    figure.draw_without_rendering()  # gives the axes their size, with room for the names
    for axes, names in beside.items():
        height = axes.get_window_extent().height * 72 / figure.dpi
        ends = [height * axes.transAxes.inverted().transform(axes.transData.transform(name.xy))[1] for name in names]
        for name, place in zip(names, _apart(ends, _LINE_PT, height), strict=True):
            name.set_position((_BESIDE, place / height))


def _write_name(axes: Axes, curve: Curve, right: float) -> Annotation:
    leader: dict[str, Any] = {"arrowstyle": "-", "linewidth": 0.7, "relpos": (0, 0.5), "shrinkA": 1, "shrinkB": 3}
    # A solid line from an end further left would look like the curve.
    leader |= {"color": curve.look.colour} if curve.x[-1] == right else {"color": GREY, "linestyle": ":"}
    font: dict[str, Any] = {"fontsize": SMALL, "fontweight": "bold" if curve.look.ours else None, "parse_math": False}
    return axes.annotate(
        shortened(curve.name),
        (curve.x[-1], curve.y[-1]),
        (_BESIDE, 0.5),
        textcoords="axes fraction",
        arrowprops=leader,
        annotation_clip=False,
        va="center",
        **font,
    )


def list_curves(figure: Figure, looks: Mapping[str, SolverStyle]) -> None:
    """Write a legend below all panels, for curves that end too close together for names beside their ends."""
    handles = [Line2D([], [], **look.line()) for look in looks.values()]
    names = [shortened(name) for name in looks]
    columns = min(_LEGEND_COLUMNS, LETTERS // (_HANDLE + max(map(len, names))))
    lines = -(-len(names) // columns)
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": -(-len(names) // lines)}
    legend = figure.legend(handles, ["-"] * len(names), fontsize=SMALL, frameon=False, handlelength=3.4, **place)
    write_names(legend, names)
    for text, look in zip(legend.get_texts(), looks.values(), strict=True):
        text.set(fontweight="bold" if look.ours else "normal")


def _apart(places: Sequence[float], gap: float, height: float) -> list[float]:
    """Places at least ``gap`` apart, within 0 and ``height`` if there is room, with the least squared moves.

    Sorted and less ``gap`` for each place below, the places must not decrease. Least squares under this condition pools
    decreasing neighbours into their mean (Ayer et al., 1955).
    """
    order = np.argsort(places, kind="stable")
    pools: list[tuple[float, int]] = []
    for index, place in enumerate(np.array(places)[order]):
        pools.append((place - gap * index, 1))
        while len(pools) > 1 and pools[-2][0] >= pools[-1][0]:
            (mean, count), (last, more) = pools[-2:]
            pools[-2:] = [((mean * count + last * more) / (count + more), count + more)]
    flat = np.concatenate([np.full(count, mean) for mean, count in pools])
    flat = flat.clip(0, max(0.0, height - gap * (len(flat) - 1)))
    moved = np.empty(len(flat))
    moved[order] = flat + gap * np.arange(len(flat))
    return moved.tolist()
