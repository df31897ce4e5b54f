"""The look of all pictures: theme, legend, colour, marker and order of the solvers, panels of dots and of curves."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, Formatter, LogLocator, MaxNLocator, NullFormatter

#: Colours that colour-blind readers can tell apart.
COLOURS = tuple(sns.color_palette("colorblind").as_hex())
BLUE, ORANGE, GREEN, VERMILION, PINK, BROWN, _, GREY, _, SKY = COLOURS
WIDTH = 7.2  #: inches; the width of a page with two columns, so that letters are printed at their size
_DPI = 200  # 1440 pixels across: sharp on a web page of 800 pixels, and a small file
_LETTERS, _HANDLE = 112, 11  # of a legend: letters across the page, and letters that a piece of line takes

#: Settings of matplotlib while a picture is drawn. Names of solvers are not read as formulas.
THEME: Any = {
    **sns.axes_style("whitegrid"),
    **sns.plotting_context("paper", font_scale=0.95),  # the smallest letters have 8.4 points
    "axes.edgecolor": "#444444",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "errorbar.capsize": 1.6,
    "font.sans-serif": ["DejaVu Sans"],
    "legend.frameon": False,
    "text.parse_math": False,
}
themed = rc_context(THEME)  #: Decorator of functions that draw.

# Colour, marker and line of a solver, in the order of the rows. A solver has the look of the longest name that its name
# begins with, up to a hyphen. A bound has no marker.
# fmt: off
_LOOKS = {
    "pnpnet": (BLUE, "o", "-"), "pnpnet-n9-paper": (BROWN, "o", "-"), "pnpnet-paper": (BROWN, "o", "-"),
    "pnpnet-set": (BLUE, "D", "-."), "net": (SKY, "o", "--"),
    "epnp": (VERMILION, "v", "--"), "epnp-lm": (VERMILION, "v", "-"),
    "reppnp": (GREEN, "^", "--"), "reppnp-lm": (GREEN, "^", "-"), "ransac-epnp-lm": (PINK, "s", "-"),
    "p3p-ransac": (ORANGE, "P", "-"), "p3p-ransac-noise": (ORANGE, "D", "--"), "identity-lm": (BROWN, "X", "-."),
    "opencv-epnp": ("k", "<", ":"), "opencv-sqpnp": ("k", "<", "-."), "opencv-ransac": ("k", ">", "-"),
    "opencv-ransac-sqpnp": ("k", "*", "-."), "opencv-usac": ("k", ">", "--"), "opencv": ("k", "*", ":"),
    "kornia-rs": (GREY, "X", ":"), "poselib": (GREY, "p", "-"), "pycolmap": (GREY, "h", "--"),
    "": ("", "", ""),  # all other solvers
    "known-inliers": ("k", "", "-."), "known-inliers-and-noise": ("k", "", ":"),
}
# fmt: on
_MORE = (("#882255", "d"), ("#44AA99", "8"), ("#999933", "H"), ("#6644AA", "P"))
_OTHERS = [(colour, marker, line) for line in ("-", "--", ":") for colour, marker in _MORE]
_ROW = 0.165  # inches from one solver to the next: a line of letters
_WITH_NUMBERS = 3  # largest number of panels side by side that each have room for numbers
_MOST_TICKS = 6  # largest number of places on a horizontal axis that are all ticked
_LABELS = {"rate": "solved (%)", "us": "µs per problem", "n": "pairs n", "m": "iterations m"}
Styles = Mapping[str, Mapping[str, Any]]  # arguments of Axes.plot by name
Panel = tuple[str, pd.DataFrame, str]


def solver_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Arguments of ``Axes.plot`` by name of the solver, in the order of legends.

    A known solver has the same look in all pictures, with any options. Up to 12 unknown solvers have different looks.
    """
    base = {name: name.partition(":")[0] for name in names}
    known = {n: max((key for key in _LOOKS if f"{b}-".startswith(key and f"{key}-")), key=len) for n, b in base.items()}
    unknown = sorted({base[name] for name, key in known.items() if not key})
    looks = {name: _LOOKS[key] if key else _OTHERS[unknown.index(base[name]) % 12] for name, key in known.items()}
    natural = {name: re.sub(r"\d+", lambda number: number[0].zfill(9), name) for name in base}  # n9 before n20
    order = sorted(base, key=lambda name: (list(_LOOKS).index(known[name]), natural[name]))
    return {name: line_style(*looks[name], ours=is_ours(name)) for name in order}


def line_style(colour: str, marker: str, line: str, *, ours: bool = False) -> dict[str, Any]:
    """Arguments of ``Axes.plot``. Dashed and dotted lines have open markers, our lines are thick."""
    face = "white" if line in ("--", ":") else colour
    marks = {"marker": marker, "markersize": 4.6, "markerfacecolor": face, "markeredgecolor": colour}
    return {"color": colour, "linestyle": line, "linewidth": 2.0 if ours else 1.2, "zorder": 4 if ours else 3, **marks}


def is_ours(name: str) -> bool:
    """Whether the solver stands out."""
    return name.startswith("pnpnet")


def make_figure(width: float, height: float, *heading: str) -> Figure:
    """An opaque white figure with lines of a title, readable on a dark page too. Sizes are in inches."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    if heading:
        figure.suptitle("\n".join(heading), x=0.01, ha="left", fontsize=9)
    return figure


def save(figure: Figure, path: str | Path) -> Path:
    """Write the figure and make missing folders. The ending of the path gives the format."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI)
    return Path(path)


def draw_legend(figure: Figure, styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a legend below all panels, our solvers in bold."""
    names = [shortened(name) for name in styles]
    columns = min(4, _LETTERS // (_HANDLE + max(map(len, names))))
    handles = [Line2D([], [], **style) for style in styles.values()]
    legend = figure.legend(handles, names, loc="outside lower center", ncols=columns, handlelength=3.4)
    for text in legend.get_texts():
        text.set_fontweight("bold" if is_ours(text.get_text()) else "normal")


def log_scale(axes: Axes, name: str, formatter: Formatter | str = "{x:g}") -> None:
    """Make the axis x or y logarithmic, with a number at every power of 10, and at more places of a short axis."""
    axes.set(**{f"{name}scale": "log"})
    axis, (low, high) = getattr(axes, f"{name}axis"), getattr(axes, f"get_{name}lim")()
    axis.set_major_locator(LogLocator(subs=(1, 2, 3, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(formatter)
    axis.set_minor_formatter(NullFormatter())


def shortened(name: str) -> str:
    """The name; the middle of names above 27 letters is left out."""
    return name if len(name) <= 27 else f"{name[:12]}…{name[-14:]}"


def reach(table: pd.DataFrame) -> np.ndarray:
    """Lengths of the intervals below and above the rates. A rounded rate can lie just outside its interval."""
    return np.clip([table.rate - table.low, table.high - table.rate], 0, None)


def draw_dots(
    path: str | Path, heading: Sequence[str], lines: Sequence[Mapping[str, pd.DataFrame]], most: int = _WITH_NUMBERS
) -> Path:
    """Draw success: a row for each solver, a panel for each table with ``solver``, ``rate``, ``low`` and ``high``.

    Tables are by title, at most ``most`` side by side. The first panel has numbers, and others where there is room.
    """
    grouped = [list(line.items()) for line in lines]
    sizes = [math.ceil(len(line) / math.ceil(len(line) / most)) for line in grouped]  # lines of about equal length
    split = [line[i : i + size] for line, size in zip(grouped, sizes, strict=True) for i in range(0, len(line), size)]
    styles = solver_styles(solver for line in split for _, table in line for solver in table.solver)
    columns, narrow = max(sizes), max(sizes) > _WITH_NUMBERS
    figure = make_figure(WIDTH, 0.5 + (_ROW * len(styles) + 0.85) * len(split), *heading)
    ratios = [2 if narrow and column == 0 else 1 for column in range(columns)]
    grid = figure.subplots(len(split), columns, sharex=True, sharey=True, squeeze=False, width_ratios=ratios)
    for line, places in zip(split, grid, strict=True):
        for index, (axes, (title, table)) in enumerate(zip(places, line, strict=False)):
            for name, rate, (low, high) in zip(table.solver, table.rate, reach(table).T, strict=True):
                look, row = styles[name], list(styles).index(name)
                if not look["marker"]:  # a bound is a line across the panel
                    axes.axvline(rate, color=look["color"], linestyle=look["linestyle"], linewidth=0.9, zorder=1)
                dot = {**look, "linestyle": "none", "marker": look["marker"] or "|", "clip_on": False}
                axes.errorbar([rate], [row], xerr=[[low], [high]], label=name, elinewidth=1.4, **dot)
                if index == 0 or not narrow:
                    font: dict[str, Any] = {"fontsize": 8, "fontweight": "bold" if is_ours(name) else "normal"}
                    font |= {"transform": axes.get_yaxis_transform(), "va": "center_baseline"}
                    axes.text(1.04, row, f"{rate:.1f} ±{max(low, high):.1f}", **font)
            title = textwrap.fill(title.replace("_", " "), 11 if narrow and index else 34)
            axes.set(title=title, xlabel=_LABELS["rate"])
        for axes in places[len(line) :]:
            axes.remove()
        places[0].set_yticks(range(len(styles)), [shortened(name) for name in styles])
        for label, name in zip(places[0].get_yticklabels(), styles, strict=True):
            label.set_fontweight("bold" if is_ours(name) else "normal")
    grid[0, 0].set(xlim=(-3, 103), ylim=(len(styles) - 0.4, -0.6), xticks=range(0, 101, 50 if narrow else 25))
    return save(figure, path)


@themed
def draw_curves(
    path: str | Path, heading: Sequence[str], panels: Sequence[Panel], x: str, styles: Styles | None = None
) -> Path:
    """Draw panels of curves against the column ``x``, with one legend below.

    A panel is a title, a table with the column ``solver``, and the column of its vertical axis: ``rate`` in per cent
    (with ``low`` and ``high``), ``us`` or ``operations``. Panels with the same vertical axis share its limits.
    """
    found = {solver for _, table, _ in panels for solver in table.solver}
    styles = {name: look for name, look in (styles or solver_styles(found)).items() if name in found}
    lines = math.ceil(len(panels) / 4)
    columns = math.ceil(len(panels) / lines)
    figure = make_figure(WIDTH, 1.0 + (2.4 if lines > 1 else 3.0) * lines + 0.04 * len(styles), *heading)
    grid = list(figure.subplots(lines, columns, squeeze=False).flat)
    first: dict[str, Axes] = {}
    for index, (axes, (title, table, y)) in enumerate(zip(grid, panels, strict=False)):
        for name, look in styles.items():
            line = table[table.solver == name].sort_values(x)
            error, every = reach(line) if y == "rate" else None, max(1, len(line) // 8)
            if len(line):
                axes.errorbar(line[x], line[y], yerr=error, label=name, elinewidth=1.0, markevery=every, **look)
        places = sorted(table[x].unique())
        log = 0 < 8 * places[0] < places[-1]
        axes.set(title=title, xlabel=_LABELS.get(x, x), xscale="log" if log else "linear")
        if index % columns == 0 or panels[index - 1][2] != y:
            axes.set_ylabel(_LABELS.get(y, y))
        if y in first:
            axes.sharey(first[y])
        first.setdefault(y, axes)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if log else MaxNLocator(_MOST_TICKS, integer=True))
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
            log_scale(axes, "y", EngFormatter(sep="") if y == "operations" else "{x:g}")
    draw_legend(figure, styles)
    return save(figure, path)
