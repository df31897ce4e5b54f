"""Success and time of a few solvers on one page width: the picture of the README."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from kornia_pnpnet.evaluation.figures.style import BLUE, GREY, SMALL, TITLE, WIDTH, make_figure, save, tidy
from kornia_pnpnet.metrics import SuccessRate

__all__ = ["OverviewRow", "plot_overview"]

_PALE_BLUE, _PALE_GREY = "#9ecae1", "#c8c8c8"
_BAR = 0.36  # thickness of one of the two bars of a solver; solvers are 1 apart
_DPI = 160  # 1150 pixels across: sharp at the 800 pixels of a web page, and a small file


class OverviewRow(NamedTuple):
    """One solver of the overview.

    Attributes:
        name: title of the row.
        ours: whether the row stands out in colour.
        without_outliers: success on problems without outliers.
        with_outliers: success on problems with outliers.
        us_per_problem: time per problem with outliers, in microseconds.
    """

    name: str
    ours: bool
    without_outliers: SuccessRate
    with_outliers: SuccessRate
    us_per_problem: float


def plot_overview(path: str | Path, rows: Sequence[OverviewRow], *, outliers: str) -> Path:
    """Draw success (left) and time per problem (right) as bars, one row for each solver.

    Args:
        path: where the picture goes; the ending gives the format.
        rows: the solvers, from the top of the picture down.
        outliers: number of outliers of :attr:`OverviewRow.with_outliers` in words, for the legend.

    Returns:
        The path.

    Raises:
        ValueError: when there are no rows.
    """
    if not rows:
        raise ValueError("plot_overview needs at least one row, got none.")
    places = np.arange(len(rows))
    figure = make_figure(WIDTH, 1.3 + 0.45 * len(rows))
    solved, time = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    kinds = (
        ("no outliers", -_BAR / 2, [row.without_outliers for row in rows], (_PALE_BLUE, _PALE_GREY)),
        (outliers, _BAR / 2, [row.with_outliers for row in rows], (BLUE, GREY)),
    )
    for label, shift, rates, (ours, others) in kinds:
        values = np.array([[100 * rate.rate, 100 * rate.low, 100 * rate.high] for rate in rates]).T
        # A rate of the file is rounded, so a bound can lie just inside.
        reach = np.abs(values[1:] - values[0]) * (np.sign(values[1:] - values[0]) == [[-1], [1]])
        colours = [ours if row.ours else others for row in rows]
        error: dict[str, Any] = {"ecolor": "#222222", "elinewidth": 1.0}
        solved.barh(places + shift, values[0], _BAR, color=colours, label=label, xerr=reach, error_kw=error)
        _write(solved, places + shift, values[2], [f"{value:.1f} %" for value in values[0]], rows)
    times = [row.us_per_problem for row in rows]
    time.barh(places, times, 2 * _BAR, color=[BLUE if row.ours else GREY for row in rows])
    _write(time, places, times, [f"{value:.0f} µs" for value in times], rows)

    solved.set(xlim=(0, 115), xticks=range(0, 101, 25), ylim=(len(rows) - 0.4, -0.6), xlabel="solved (%)")
    solved.set_yticks(places, [row.name for row in rows], parse_math=False)
    time.set(xlim=(0, 1.3 * max(times)), xlabel="µs per problem")
    for axes, title in ((solved, "Problems solved: more is better"), (time, "Time: less is better")):
        axes.set_title(title, fontsize=TITLE, fontweight="bold", loc="left")
        tidy(axes, grid="x")
        axes.tick_params(axis="y", length=0, labelsize=TITLE)
    for label, row in zip(solved.get_yticklabels(), rows, strict=True):
        label.set(fontweight="bold" if row.ours else "normal", color=BLUE if row.ours else "black")
    shades = [Patch(facecolor=colour) for colour in (_PALE_GREY, GREY)]
    names = [f"pale: {kinds[0][0]}", f"dark: {outliers}"]
    figure.legend(shades, names, loc="outside lower left", ncols=2, frameon=False, fontsize=SMALL)
    return save(figure, path, dpi=_DPI)


def _write(axes: Axes, places: np.ndarray, ends: Sequence[float], texts: Sequence[str], rows: Sequence[Any]) -> None:
    """Write a text behind the end of each bar."""
    for place, end, text, row in zip(places, ends, texts, rows, strict=True):
        weight = "bold" if row.ours else "normal"
        font: dict[str, Any] = {"fontsize": TITLE - 0.5, "fontweight": weight, "va": "center_baseline"}
        axes.annotate(text, (end, place), (3, 0), textcoords="offset points", **font)
