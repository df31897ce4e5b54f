"""Reliability diagrams: predicted probabilities against observed shares."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context

from kornia_pnpnet.evaluation.figures.style import COLOURS, GREY, THEME, WIDTH, make_figure, save

_MARKERS = ("o", "s", "^", "D", "v", "P")


@rc_context(THEME)
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
    figure = make_figure(0.72 * WIDTH, 6.0)
    chance, share = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    diagonal = chance.plot((0, 1), (0, 1), color=GREY, linewidth=1.0, linestyle=":")
    for index, (name, curve) in enumerate(curves.items()):
        lists = [curve.get(key, ()) for key in ("number", "predicted", "observed")]
        counted = all(0 <= count < math.inf for count in lists[0]) and sum(lists[0]) > 0
        if len(set(map(len, lists))) > 1 or not counted:
            raise ValueError(
                f"The curve '{name}' needs 'number', 'predicted' and 'observed' of one length, and numbers of "
                "at least 0 that are not all 0."
            )
        number, predicted, observed = np.array(lists, dtype=float)[:, np.array(lists[0]) > 0]
        look = {"color": COLOURS[index % len(COLOURS)], "marker": _MARKERS[index % len(_MARKERS)], "markersize": 4.5}
        chance.plot(predicted, observed, **look)
        share.plot(predicted, 100 * number / number.sum(), **look)
    chance.set(ylim=(-0.02, 1.02), xlim=(-0.02, 1.02), ylabel="share of inliers")
    chance.legend([line for line in chance.lines if line not in diagonal], list(curves), loc="upper left")
    share.set(yscale="log", xlabel="weight: the predicted probability of an inlier", ylabel="pairs (%)")
    share.yaxis.set_major_formatter("{x:g}")
    return save(figure, path)
