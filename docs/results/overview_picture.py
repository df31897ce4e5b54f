"""The picture of the README: success and time of a few solvers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.patches import Patch

from kornia_pnpnet.evaluation.figures.style import BLUE, GREY, SKY, WIDTH, make_figure, save, themed
from kornia_pnpnet.metrics import SuccessRate

_PALE = {BLUE: SKY, GREY: "#cccccc"}
_BAR = 0.36  # thickness of one of the two bars of a solver; solvers are 1 apart


class OverviewRow(NamedTuple):
    """One solver: name, whether its row stands out, success without and with outliers, microseconds with outliers."""

    name: str
    ours: bool
    without_outliers: SuccessRate
    with_outliers: SuccessRate
    us_per_problem: float


@themed
def plot_overview(path: str | Path, rows: Sequence[OverviewRow], *, outliers: str) -> Path:
    """Draw success (left) and time per problem (right) as bars. ``outliers`` is the number of outliers in words."""
    places = np.arange(len(rows))
    colours = [BLUE if row.ours else GREY for row in rows]
    figure = make_figure(WIDTH, 1.3 + 0.45 * len(rows))
    solved, time = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    pale = [_PALE[colour] for colour in colours]
    for shift, fill, kind in ((-_BAR / 2, pale, "without_outliers"), (_BAR / 2, colours, "with_outliers")):
        rate, low, high = 100 * np.array([getattr(row, kind)[:3] for row in rows]).T
        reach = np.clip([rate - low, high - rate], 0, None)
        bars = solved.barh(places + shift, rate, _BAR, color=fill, xerr=reach, error_kw={"elinewidth": 1.0})
        solved.bar_label(bars, [f"{value:.1f} %" for value in rate], padding=3)
    times = [row.us_per_problem for row in rows]
    time.bar_label(time.barh(places, times, 2 * _BAR, color=colours), fmt="{:.0f} µs", padding=3)
    solved.set(xlim=(0, 117), xticks=range(0, 101, 25), ylim=(len(rows) - 0.4, -0.6), xlabel="solved (%)")
    solved.set_yticks(places, [row.name for row in rows])
    for label, row in zip(solved.get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row.ours else "normal")
    time.set(xlim=(0, 1.3 * max(times)), xlabel="µs per problem", title="Time: less is better")
    solved.set_title("Problems solved: more is better")
    for axes in (solved, time):
        axes.grid(visible=False, axis="y")
    shades = [Patch(facecolor=_PALE[GREY]), Patch(facecolor=GREY)]
    figure.legend(shades, ["pale: no outliers", f"dark: {outliers}"], loc="outside lower left", ncols=2)
    return save(figure, path)
