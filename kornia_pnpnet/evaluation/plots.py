"""Pictures of a pose, an evaluation and a training.

The suffix of a file determines its format. The settings of matplotlib change only while a picture is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.evaluation.results import row_errors

with needs("eval", "Pictures need matplotlib"):
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.ticker import Formatter, LogLocator, NullFormatter

__all__ = ["plot_errors", "plot_pose", "plot_success", "plot_training"]

#: Colours that colour-blind readers can tell apart: the palette ``colorblind`` of seaborn.
COLOURS = ("#0173b2", "#de8f05", "#029e73", "#d55e00", "#cc78bc", "#ca9161", "#fbafe4", "#949494", "#ece133", "#56b4e9")
BLUE, ORANGE, GREEN, VERMILION, PINK, BROWN, _, GREY, _, SKY = COLOURS
WIDTH = 7.2  #: Width of figures in inches: the text width of a page with two columns.
#: Settings of matplotlib while a picture is drawn. Names of solvers are not read as formulas.
THEME: Any = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize", "figure.titlesize"), 9.0),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 8.4),
    **dict.fromkeys(("axes.spines.right", "axes.spines.top", "legend.frameon", "text.parse_math"), False),
    **{"axes.axisbelow": True, "axes.edgecolor": "#444444", "axes.grid": True, "grid.color": "#cccccc"},
    **{"axes.titlelocation": "left", "errorbar.capsize": 1.6, "font.sans-serif": ["DejaVu Sans"]},
}
themed = rc_context(THEME)  #: Decorator of functions that draw pictures.


def make_figure(width: float, height: float, *heading: str) -> Figure:
    """Make a white figure. The size is in inches, and each ``heading`` is a line of the title."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    if heading:
        figure.suptitle("\n".join(heading), x=0.01, ha="left")
    return figure


def save(figure: Figure, path: str | Path) -> Path:
    """Write the figure, and make missing folders."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=200)
    return Path(path)


@themed
def plot_pose(path: str | Path, img_points: Tensor, reprojections: Tensor, rejected: Tensor, title: str) -> Path:
    """Draw the pixels of an image, and a line from each pixel to the reprojection of its point.

    Args:
        path: the file to write.
        img_points: pixels, shape (N, 2). Only finite pixels are drawn. If no pixel is finite, ``ValueError`` is raised.
        reprojections: reprojected points in pixels, shape (N, 2), not finite for points behind the camera.
        rejected: whether a pair is rejected, bool, shape (N,).
        title: first part of the title.
    """
    there = img_points.isfinite().all(-1)
    if not there.any():
        raise ValueError("There is no pixel to draw.")
    pixels, projected, bad = (x[there].numpy() for x in (img_points, reprojections, rejected))
    visible = np.isfinite(projected).all(1)
    margin = 0.3 * max(1.0, np.ptp(pixels, axis=0).max())
    low, high = pixels.min(0) - margin, pixels.max(0) + margin
    figure = make_figure(WIDTH, 1.0 + 6.2 * (high - low)[1] / (high - low)[0])
    axes = figure.subplots()
    for rows, colour, dash in ((visible & ~bad, BLUE, "-"), (visible & bad, VERMILION, "--")):
        lines = list(np.stack((pixels[rows], projected[rows]), axis=1))
        axes.add_collection(LineCollection(lines, colors=colour, linestyles=dash, alpha=0.8))
    axes.plot(*pixels[~bad].T, "o", color=BLUE, markersize=9.0, markerfacecolor="none", label="pixel, kept")
    axes.plot(*pixels[bad].T, "x", color=VERMILION, markersize=9.0, markeredgewidth=2.2, label="pixel, rejected")
    axes.plot(*projected[visible].T, "+", color="black", markersize=9.0, label="reprojection")
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xlabel="u (px)", ylabel="v (px)", aspect="equal")
    behind = "" if visible.all() else f", {(~visible).sum()} behind the camera"
    axes.set_title(f"{title}: n = {len(pixels)}, {bad.sum()} rejected{behind}")
    figure.legend(loc="outside lower center", ncols=3)
    return save(figure, path)


@themed
def plot_success(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw success rates with 95 % intervals: one panel for each data set and one line for each solver."""
    panels, colours = _panels(results)
    names, lines = list(colours), math.ceil(len(panels) / 3)
    figure = make_figure(WIDTH, 0.5 + (0.7 + 0.17 * len(names)) * lines, "Success with 95 % intervals")
    grid = list(figure.subplots(lines, math.ceil(len(panels) / lines), sharex=True, sharey=True, squeeze=False).flat)
    for axes, (title, rows) in zip(grid, panels.items(), strict=False):
        for row in rows:
            name, (rate, low, high) = row["solver"], (100 * row["success"][key] for key in ("rate", "low", "high"))
            reach = [[max(rate - low, 0.0)], [max(high - rate, 0.0)]]  # rounding can put the rate outside the interval
            axes.errorbar([rate], [names.index(name)], xerr=reach, fmt="o", color=colours[name], label=name)
        axes.set(title=title, xlabel="solved (%)", xlim=(-3, 103), ylim=(len(names) - 0.4, -0.6))
        axes.set_yticks(range(len(names)), names)
    for axes in grid[len(panels) :]:
        axes.remove()
    return save(figure, path)


@themed
def plot_errors(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw the cumulative distribution of the errors. Raise ``ValueError`` when there are no per-problem errors."""
    panels, colours = _panels(results)
    heading = "Problems with an error of at most x; the vertical line is the limit of a success"
    figure = make_figure(WIDTH, 1.2 + 2.2 * len(panels) + 0.05 * len(colours), heading)
    for (title, rows), line in zip(panels.items(), figure.subplots(len(panels), 2, squeeze=False), strict=True):
        entry = results["data"][title]
        labels = "rotation error (°)", f"translation error ({entry['unit'] or 'world units'})"
        limits = entry["max_rotation_deg"], entry["max_translation"]
        for index, (axes, limit, label) in enumerate(zip(line, limits, labels, strict=True)):
            for row in rows:
                axes.ecdf(row_errors(row)[0][index].numpy(), color=colours[row["solver"]], label=row["solver"])
            axes.axvline(limit, color=GREY)
            axes.set(xlim=(limit / 1000, limit * 180), xlabel=label, title=title, ylabel="problems")
            log_scale(axes, "x")
            axes.yaxis.set_major_formatter("{x:.0%}")
    curves = {str(line.get_label()): line for axes in figure.axes for line in axes.lines}
    figure.legend([curves[name] for name in colours], list(colours), loc="outside lower center", ncols=3)
    return save(figure, path)


def _panels(results: Mapping[str, Any]) -> tuple[dict[str, list[Mapping[str, Any]]], dict[str, str]]:
    """Group the rows by data set, and choose a colour for each solver. Raise ``ValueError`` if there are no rows."""
    panels: dict[str, list[Mapping[str, Any]]] = {}
    for row in results["rows"]:
        panels.setdefault(row["data"], []).append(row)
    if not panels:
        raise ValueError("The results hold no rows to draw.")
    return panels, dict(zip(dict.fromkeys(row["solver"] for row in results["rows"]), cycle(COLOURS), strict=False))


@themed
def plot_training(path: str | Path, history_csv: str | Path) -> Path:
    """Draw the learning curves of a training: loss, pose distances and validation success at each update."""
    distances = [[f"{stage}_{part}" for stage in ("init", "refined")] for part in ("rotation", "translation")]
    rows = list(read_csv(history_csv, ["update", "total", *distances[0], *distances[1]]).values())
    if not rows:
        raise ValueError(f"'{history_csv}' has no rows.")
    success = [name for name in rows[0] if name.startswith("val/") and name.endswith("/success")]
    panels = (
        ("training loss (refined terms ramp in)", ["total"]),
        ("validation success", success),
        ("rotation distance ‖R̂ − R‖", distances[0]),
        ("translation distance ‖t̂ − t‖", distances[1]),
    )
    figure = make_figure(WIDTH, 5.8)
    for axes, (title, columns) in zip(figure.subplots(2, 2, sharex=True).flat, panels, strict=True):
        for colour, column in zip(cycle(COLOURS), columns, strict=False):
            try:
                curve = np.array([[float(row[name] or "nan") for row in rows] for name in ("update", column)])
            except ValueError as error:
                raise ValueError(f"'{history_csv}': {error}") from error
            label = column.split("/")[1] if columns is success else column.split("_")[0]
            axes.plot(*curve[:, np.isfinite(curve).all(0)], label=label, color=colour)
        axes.set(title=title, xlabel="update")
        if "distance" in title:
            log_scale(axes, "y")
    figure.legend(handles=figure.axes[2].lines, loc="outside lower left")
    figure.legend(handles=figure.axes[1].lines, loc="outside lower right", ncols=4)
    return save(figure, path)


def log_scale(axes: Axes, name: str, formatter: Formatter | str = "{x:g}") -> None:
    """Make the axis ``"x"`` or ``"y"`` logarithmic. Labels are at powers of 10, and on short axes also in between."""
    axes.set(**{f"{name}scale": "log"})
    axis, (low, high) = getattr(axes, f"{name}axis"), getattr(axes, f"get_{name}lim")()
    axis.set_major_locator(LogLocator(subs=(1, 2, 3, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(formatter)
    axis.set_minor_formatter(NullFormatter())
