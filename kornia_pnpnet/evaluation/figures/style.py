"""The look of all pictures: theme, legend, and the colour, marker and order of the solvers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import seaborn as sns
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import Formatter, LogLocator, NullFormatter

#: Colours that colour-blind readers can tell apart.
COLOURS = tuple(sns.color_palette("colorblind").as_hex())
BLUE, ORANGE, GREEN, VERMILION, PINK, BROWN, _, GREY, _, SKY = COLOURS
_BLACK = "#222222"

WIDTH = 7.2  #: inches; the width of a page with two columns, so that letters are printed at their size
_DPI = 200  # 1440 pixels across: sharp on a web page of 800 pixels, and a small file
_LETTERS, _HANDLE = 105, 11  # of a legend: letters across the page, and letters that a piece of line takes

#: Settings of matplotlib while a picture is drawn: ``@rc_context(THEME)``. Names of solvers are not read as formulas.
THEME: dict[str, Any] = {
    **sns.axes_style("whitegrid"),
    **sns.plotting_context("paper", font_scale=0.95),  # the smallest letters have 8.4 points
    "axes.edgecolor": "#444444",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "errorbar.capsize": 1.6,
    "font.sans-serif": ["DejaVu Sans"],
    "grid.color": "#dddddd",
    "legend.frameon": False,
    "text.parse_math": False,
}

# Colour, marker and line of a solver, in the order of the rows. A solver has the look of the longest name that its name
# begins with, up to a hyphen. A bound has no marker.
# fmt: off
_LOOKS = {
    "pnpnet": (BLUE, "o", "-"), "pnpnet-set": (BLUE, "D", "-."), "net": (SKY, "o", "--"),
    "epnp": (VERMILION, "v", "--"), "epnp-lm": (VERMILION, "v", "-"),
    "reppnp": (GREEN, "^", "--"), "reppnp-lm": (GREEN, "^", "-"), "ransac-epnp-lm": (PINK, "s", "-"),
    "p3p-ransac": (ORANGE, "P", "-"), "p3p-ransac-noise": (ORANGE, "D", "--"), "identity-lm": (BROWN, "X", "-."),
    "opencv-epnp": (_BLACK, "<", ":"), "opencv-sqpnp": (_BLACK, "<", "-."), "opencv-ransac": (_BLACK, ">", "-"),
    "opencv-ransac-sqpnp": (_BLACK, "*", "-."), "opencv-usac": (_BLACK, ">", "--"), "opencv": (_BLACK, "*", ":"),
    "poselib": (GREY, "p", "-"), "pycolmap": (GREY, "h", "--"),
    "": ("", "", ""),  # all other solvers
    "known-inliers": (_BLACK, "", "-."), "known-inliers-and-noise": (_BLACK, "", ":"),
}
# fmt: on
_OTHERS = [(COLOURS[i], marker, line) for line in ("-", "--", ":") for i, marker in ((8, "d"), (6, "8"), (4, "H"))]


def solver_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Arguments of ``Axes.plot`` by name of the solver, in the order of legends.

    A known solver has the same look in all pictures, with any options. Up to 9 unknown solvers have different looks.
    """
    base = {name: name.partition(":")[0] for name in names}
    known = {n: max((key for key in _LOOKS if f"{b}-".startswith(key and f"{key}-")), key=len) for n, b in base.items()}
    unknown = sorted({base[name] for name, key in known.items() if not key})
    looks = {name: _LOOKS[key] if key else _OTHERS[unknown.index(base[name]) % 9] for name, key in known.items()}
    natural = {name: [part.zfill(9) for part in re.findall(r"\d+|\D+", name)] for name in base}
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


def save(figure: Figure, path: str | Path, *, dpi: int = _DPI) -> Path:
    """Write the figure and make missing folders. The ending of the path gives the format."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    return path


def draw_legend(figure: Figure, styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a legend below all panels, our solvers in bold."""
    names = [shortened(name) for name in styles]
    columns = min(4, _LETTERS // (_HANDLE + max(map(len, names))))
    handles = [Line2D([], [], **style) for style in styles.values()]
    legend = figure.legend(handles, names, loc="outside lower center", ncols=columns, handlelength=3.4)
    for text in legend.get_texts():
        text.set_fontweight("bold" if is_ours(text.get_text()) else "normal")


def log_scale(axis: Axis, formatter: Formatter | str = "{x:g}") -> None:
    """Make an axis logarithmic, with a number at every power of 10, and at more places of a short axis."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 3, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(formatter)
    axis.set_minor_formatter(NullFormatter())


def shortened(name: str) -> str:
    """The name; the middle of names above 27 letters is left out."""
    return name if len(name) <= 27 else f"{name[:12]}…{name[-14:]}"
