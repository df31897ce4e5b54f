"""Reliability diagrams: predicted probabilities against observed shares."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from kornia_pnpnet.evaluation.figures.lines import write_names
from kornia_pnpnet.evaluation.figures.style import COLOURS, GREY, SMALL, WIDTH, make_figure, save, tidy

__all__ = ["plot_reliability"]

_MARKERS = ("o", "s", "^", "D", "v", "P")


def plot_reliability(path: str | Path, curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Path:
    """Draw observed shares against predicted probabilities, and below the number of predictions in each range.

    Args:
        path: the picture to write; the ending gives the format.
        curves: by name the lists ``number``, ``predicted`` and ``observed`` of a
            :class:`~kornia_pnpnet.metrics.Reliability`, with one entry for each range. Empty ranges are left out.

    Returns:
        The path.

    Raises:
        ValueError: when there is no curve, the lists differ in length, or a number is negative, or all are 0.
    """
    if not curves:
        raise ValueError("plot_reliability needs at least one curve, got none.")
    for name, curve in curves.items():
        lists = [curve.get(key, ()) for key in ("number", "predicted", "observed")]
        counted = all(0 <= count < math.inf for count in lists[0]) and sum(lists[0]) > 0
        if len(set(map(len, lists))) > 1 or not counted:
            raise ValueError(
                f"The curve '{name}' needs 'number', 'predicted' and 'observed' of one length, and numbers of "
                "at least 0 that are not all 0."
            )
    figure = make_figure(0.72 * WIDTH, 6.0)
    chance, share = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    chance.plot((0, 1), (0, 1), color=GREY, linewidth=1.0, linestyle=":")
    for index, curve in enumerate(curves.values()):
        colour, marker = COLOURS[index % len(COLOURS)], _MARKERS[index % len(_MARKERS)]
        there = [i for i, count in enumerate(curve["number"]) if count > 0]
        x, y = ([curve[key][i] for i in there] for key in ("predicted", "observed"))
        chance.plot(x, y, color=colour, marker=marker, markersize=4.5, linewidth=1.5)
        total = sum(curve["number"])
        shares = [100 * curve["number"][i] / total for i in there]
        share.plot(x, shares, color=colour, marker=marker, markersize=4.5, linewidth=1.0)
    chance.set(ylim=(-0.02, 1.02), xlim=(-0.02, 1.02), ylabel="share that is right")
    legend = chance.legend(chance.lines[1:], ["-"] * len(curves), frameon=False, fontsize=SMALL, loc="upper left")
    write_names(legend, curves)
    share.set(yscale="log", xlabel="weight: the chance that a pair is right", ylabel="pairs (%)")
    for axes in (chance, share):
        tidy(axes)
    return save(figure, path)
